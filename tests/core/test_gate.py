"""Which ranges are believed."""

from __future__ import annotations

import math
from random import Random

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from companion import beacons, gate
from companion.network_settings import BeaconSettings, RangesSettings
from companion.types import BeaconTold, LineOfSight, RangeSample, Verdict

CFG = RangesSettings(max_range_m=50.0, max_age_s=0.3)
MS = 1_000_000


def sample(seq: int = 1, range_m: float = 5.0, t_ms: int = 0, **more: object) -> RangeSample:
    return RangeSample(t_ns=t_ms * MS, beacon="b1", session="s", seq=seq, range_m=range_m, **more)  # type: ignore[arg-type]


BEACON = beacons.configured(0, BeaconSettings())
RATE_M_S = 1.5
"""The vehicle flies 0.5 m/s and is believed to be wrong by 1.0 m/s at most."""


def judge(
    track: gate.Track | None, s: RangeSample, cfg: RangesSettings = CFG, beacon: beacons.Beacon = BEACON
) -> tuple[gate.Track | None, Verdict]:
    sigma_m = beacons.sigma_m(cfg, s, beacon.sigma_m)
    return gate.judge(cfg, track, s, beacons.range_m(beacon, s), sigma_m, RATE_M_S)


def verdicts(*samples: RangeSample, cfg: RangesSettings = CFG) -> list[Verdict]:
    track, out = None, []
    for s in samples:
        track, verdict = judge(track, s, cfg)
        out.append(verdict)
    return out


@pytest.mark.parametrize("lie", [math.nan, math.inf, -1.0, 0.0, 50.1])
def test_absurd_ranges_are_dropped_and_leave_no_trace(lie: float) -> None:
    assert judge(None, sample(range_m=lie)) == (None, Verdict.ABSURD)


@pytest.mark.parametrize("lie", [math.nan, math.inf, -1.0, 0.0])
def test_an_absurd_sigma_is_dropped(lie: float) -> None:
    assert verdicts(sample(sigma_m=lie)) == [Verdict.ABSURD]


def test_each_range_counts_once_and_in_order() -> None:
    assert verdicts(sample(5), sample(5), sample(4), sample(9), sample(8)) == [
        Verdict.ACCEPTED,
        Verdict.REPEATED,
        Verdict.OUT_OF_ORDER,
        Verdict.ACCEPTED,
        Verdict.OUT_OF_ORDER,
    ]


def of(session: str, seq: int, t_ms: int, range_m: float = 5.0, **more: object) -> RangeSample:
    return RangeSample(t_ns=t_ms * MS, beacon="b1", session=session, seq=seq, range_m=range_m, **more)  # type: ignore[arg-type]


def test_a_restarted_beacon_counts_from_anew() -> None:
    assert verdicts(of("a", 900, 0), of("b", 0, 1500)) == [Verdict.ACCEPTED] * 2


def test_of_two_publishers_the_first_is_believed_and_the_other_is_named() -> None:
    track = None
    told: dict[str, set[Verdict]] = {"a": set(), "b": set()}
    for k in range(100):
        for session, range_m in (("a", 5.0), ("b", 6.0)):
            track, verdict = judge(track, of(session, k, 50 * k, range_m))
            told[session].add(verdict)
    assert told == {"a": {Verdict.ACCEPTED}, "b": {Verdict.SECOND_PUBLISHER}}
    assert track is not None
    assert (track.session, track.rival) == ("a", "b")


def test_the_second_publisher_is_heard_once_the_first_is_silent_and_no_range_counts_twice() -> None:
    first = [of("a", k, 50 * k) for k in range(10)]
    second = [of("b", k, 2000 + 50 * k) for k in range(10)]
    again = [of("a", k, 5000 + 50 * k) for k in range(12)]
    assert verdicts(*first, *second) == [Verdict.ACCEPTED] * 20
    told = verdicts(*first, *second, *again)
    assert told[20:30] == [Verdict.OUT_OF_ORDER] * 10
    assert told[30:] == [Verdict.ACCEPTED] * 2


def test_one_forged_count_does_not_shut_the_beacon_out() -> None:
    forged = of("a", 2**53 - 1, 500)
    after = [of("a", k, 550 + 50 * k) for k in range(40)]
    told = verdicts(*(of("a", k, 25 * k) for k in range(20)), forged, *after)
    assert told[21:41] == [Verdict.OUT_OF_ORDER] * 20
    assert told[42:] == [Verdict.ACCEPTED] * 19


def test_the_same_range_again_and_again_is_never_a_restart() -> None:
    assert set(verdicts(*(of("a", 7, 50 * k) for k in range(100)))[1:]) == {Verdict.REPEATED}


@pytest.mark.parametrize("clock_error_ns", [0, -(10**18), 86_400 * 10**9])
def test_a_backlog_that_arrives_late_is_stale_whatever_the_publishers_clock_says(
    clock_error_ns: int,
) -> None:
    def measured(k: int) -> int:
        return 10**18 + clock_error_ns + k * 50 * MS

    on_time = [sample(k, t_ms=1000 + 50 * k, sent_t_ns=measured(k)) for k in range(5)]
    frozen = [sample(k, t_ms=4000, sent_t_ns=measured(k)) for k in range(5, 50)]
    after = [sample(k, t_ms=1000 + 50 * k, sent_t_ns=measured(k)) for k in range(61, 65)]
    assert verdicts(*on_time, *frozen, *after) == (
        [Verdict.ACCEPTED] * 5 + [Verdict.STALE] * 45 + [Verdict.ACCEPTED] * 4
    )


def numbered(first: int, count: int, t_ms: float, spacing_ms: float) -> list[RangeSample]:
    """Ranges that tell no time; the first of them comes at t_ms."""
    return [sample(first + k, t_ms=round(t_ms + spacing_ms * k)) for k in range(count)]


@pytest.mark.parametrize("spacing_ms", [20, 50, 200])
def test_a_backlog_without_stamps_is_told_from_its_numbers(spacing_ms: int) -> None:
    """The link stands still for 3 s, then delivers all at once: what is fresh by its number counts."""
    frozen, late = 3000 // spacing_ms, 300 // spacing_ms
    on_time = numbered(0, 40, 0, spacing_ms)
    burst = numbered(40, frozen, 40 * spacing_ms + 3000, 0)
    after = numbered(40 + frozen, 40, 40 * spacing_ms + 3000 + spacing_ms, spacing_ms)
    told = verdicts(*on_time, *burst, *after)
    assert set(told[:40] + told[-40:]) == {Verdict.ACCEPTED}
    believed = told[40:-40].count(Verdict.ACCEPTED)
    assert believed <= 1 + late + 0.1 * frozen + 1  # the clock of numbers runs a tenth fast
    assert set(told[40 : 40 + frozen - believed]) == {Verdict.STALE}


def test_a_publisher_without_stamps_that_paused_is_believed_again_at_its_third_range() -> None:
    """Its numbers do not count what was not measured, so that a pause looks like a delay."""
    told = verdicts(*numbered(0, 40, 0, 50), *numbered(40, 40, 5000, 50))
    assert told == [Verdict.ACCEPTED] * 40 + [Verdict.STALE] * 2 + [Verdict.ACCEPTED] * 38


@pytest.mark.parametrize("before_ms", [20, 50, 200])
@pytest.mark.parametrize("after_ms", [20, 50, 200])
def test_a_publisher_without_stamps_may_change_its_rate(before_ms: int, after_ms: int) -> None:
    first = numbered(0, 100, 0, before_ms)
    told = verdicts(*first, *numbered(100, 200, 100 * before_ms, after_ms))
    assert told.count(Verdict.STALE) <= 3
    assert set(told[-180:]) == {Verdict.ACCEPTED}


@settings(max_examples=50)
@given(st.integers(0, 2**32))
@example(162180)
def test_jitter_and_losses_make_no_range_without_a_stamp_stale(seed: int) -> None:
    """Each is up to 80 ms late, and some never arrive; they stay in order."""
    chance = Random(seed)
    steps = [(chance.uniform(0.0, 80.0), chance.randint(1, 5)) for _ in range(400)]
    t_ms, seq, samples = 0.0, 0, []
    for late_ms, step in steps:
        seq += step
        t_ms = max(t_ms, 50.0 * seq + late_ms)
        samples.append(sample(seq, t_ms=round(t_ms)))
    assert set(verdicts(*samples)) == {Verdict.ACCEPTED}


def paced(first: int, count: int, offset_ms: int, drift: float = 0.0) -> list[RangeSample]:
    """Ranges that come 50 ms apart, from a publisher whose clock is off by so much."""
    return [
        sample(k, t_ms=50 * k, sent_t_ns=10**18 + int(50 * k * (1.0 + drift)) * MS + offset_ms * MS)
        for k in range(first, first + count)
    ]


@pytest.mark.parametrize("step_ms", [-3_600_000, -5_000, 5_000, 3_600_000])
def test_a_publisher_whose_clock_is_set_is_believed_again_within_a_second(step_ms: int) -> None:
    told = verdicts(*paced(0, 20, 0), *paced(20, 40, step_ms))
    assert told[:20] == [Verdict.ACCEPTED] * 20
    assert told[40:] == [Verdict.ACCEPTED] * 20


@pytest.mark.parametrize("drift", [-1e-4, 1e-4])
def test_a_publisher_whose_clock_drifts_is_believed_for_hours(drift: float) -> None:
    assert set(verdicts(*paced(0, 72_000, 0, drift))) == {Verdict.ACCEPTED}


def test_without_line_of_sight_a_range_weighs_less() -> None:
    clear = beacons.sigma_m(CFG, sample(sigma_m=0.1, los=LineOfSight.LOS), 0.07)
    hidden = beacons.sigma_m(CFG, sample(sigma_m=0.1, los=LineOfSight.NLOS), 0.07)
    assert hidden == CFG.nlos_sigma_factor * clear


def test_a_range_that_claims_to_be_perfect_is_not_believed_to_be() -> None:
    assert beacons.sigma_m(CFG, sample(sigma_m=1e-9), 0.07) == pytest.approx(0.014)


def test_without_line_of_sight_a_range_is_dropped_where_the_configuration_says_so() -> None:
    cfg = RangesSettings(nlos="drop")
    told = [sample(k, t_ms=50 * k, los=los) for k, los in enumerate(LineOfSight)]
    assert verdicts(*told, cfg=cfg) == [Verdict.ACCEPTED, Verdict.NLOS, Verdict.ACCEPTED]
    assert verdicts(*told) == [Verdict.ACCEPTED] * 3


# ------------------------------------------------------------------------------------------------ jumps


def stream(*ranges_m: float, every_ms: int = 50, after_ms: int = 0, seq: int = 0) -> list[RangeSample]:
    return [sample(seq + k, range_m=r, t_ms=after_ms + every_ms * k) for k, r in enumerate(ranges_m)]


def test_no_honest_range_jumps() -> None:
    noise = Random(1)
    honest = [10.0 - 0.025 * k + noise.gauss(0.0, 0.07) for k in range(300)]
    assert set(verdicts(*stream(*honest))) == {Verdict.ACCEPTED}


def test_what_no_vehicle_can_fly_is_a_jump() -> None:
    told = verdicts(*stream(*[5.0] * 20, 8.0, *[5.0] * 5, 2.0, *[5.0] * 5))
    assert [k for k, verdict in enumerate(told) if verdict is Verdict.JUMP] == [20, 26]
    assert set(told) == {Verdict.ACCEPTED, Verdict.JUMP}


@pytest.mark.parametrize("rate_m_s", [-4.0, 4.0])
def test_a_distance_that_creeps_faster_than_the_vehicle_is_not_followed(rate_m_s: float) -> None:
    creeping = [30.0 + rate_m_s * 0.05 * k for k in range(60)]
    track, believed_m = None, 30.0
    for s in stream(*creeping):
        track, verdict = judge(track, s)
        if verdict is Verdict.ACCEPTED:
            believed_m = s.range_m
        elif s.t_ns > 2.5e9:
            break
    # of the first second's 4 m no more than the vehicle's 1.5 m/s and the noise's 0.7 m
    assert abs(believed_m - 30.0) < 3.0


def test_a_jump_that_stays_is_believed_in_the_end() -> None:
    told = verdicts(*stream(*[5.0] * 20, *[9.0] * 40))
    assert told[20:35] == [Verdict.JUMP] * 15
    assert told[-15:] == [Verdict.ACCEPTED] * 15


def test_after_a_gap_one_lie_is_found_out_by_the_next_range() -> None:
    """In two seconds the vehicle may have flown 3 m: a range that says so is believed until the next one."""
    told = verdicts(*stream(*[5.0] * 20), *stream(7.5, *[5.0] * 10, after_ms=3000, seq=60))
    assert set(told) == {Verdict.ACCEPTED}
    flown = verdicts(*stream(*[5.0] * 20), *stream(*[7.5] * 10, after_ms=3000, seq=60))
    assert set(flown) == {Verdict.ACCEPTED}


def test_a_reflection_beside_the_direct_path_does_not_take_over() -> None:
    """Two of five ranges come by way of a wall, 2 m longer, for ten seconds."""
    track, told = None, []
    for k in range(200):
        is_reflected = k % 5 in (1, 3)
        track, verdict = judge(track, sample(k, range_m=7.0 if is_reflected else 5.0, t_ms=50 * k))
        told.append((is_reflected, verdict))
    assert set(told[2:]) == {(True, Verdict.JUMP), (False, Verdict.ACCEPTED)}


@pytest.mark.parametrize("every_ms", [20, 50, 200, 1000])
def test_a_first_range_that_lies_does_not_shut_the_others_out(every_ms: int) -> None:
    others = [5.0, 5.05, 4.95, 25.0, 5.0] * 40
    told = verdicts(*stream(40.0, *others, every_ms=every_ms))
    honest = [v for v, r in zip(told[1:], others, strict=True) if r < 6.0]
    assert set(honest[max(4, 2200 // every_ms) :]) == {Verdict.ACCEPTED}


# ------------------------------------------------------------------------------------------------- bias


def test_the_bias_is_taken_off_before_anything_is_judged() -> None:
    beacon = beacons.configured(0, BeaconSettings(bias_m=0.3, bias_per_m=0.01, bias_per_db=-0.005))
    assert beacons.range_m(beacon, sample(range_m=0.3 + 1.01 * 20.0)) == pytest.approx(20.0)
    strong = sample(range_m=0.3 + 1.01 * 20.0 - 0.005 * 10.0, rssi_dbm=-70.0)
    assert beacons.range_m(beacon, strong) == pytest.approx(20.0)
    assert judge(None, sample(range_m=0.2), beacon=beacon)[1] is Verdict.ABSURD
    assert judge(None, sample(range_m=50.3), beacon=beacon)[1] is Verdict.ACCEPTED


@pytest.mark.parametrize(
    ("ours", "height_m", "bias_m", "named"),
    [
        (BeaconSettings(), 2.0, 0.3, ""),
        (BeaconSettings(height_m=2.0), 2.0, 0.3, ""),
        (
            BeaconSettings(height_m=1.5),
            1.5,
            0.3,
            "b1 tells height 2 m, the configuration 1.5 m, which counts",
        ),
        (BeaconSettings(bias_m=0.0), 2.0, 0.0, "b1 tells bias 0.3 m, the configuration 0 m, which counts"),
    ],
)
def test_the_configuration_wins_over_what_the_beacon_tells(
    ours: BeaconSettings, height_m: float, bias_m: float, named: str
) -> None:
    known = beacons.told(beacons.configured(0, ours), ours, BeaconTold(0, "b1", height_m=2.0, bias_m=0.3))
    assert (known.height_m, known.bias_m, known.contradiction) == (height_m, bias_m, named)
