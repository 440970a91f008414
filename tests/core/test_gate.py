"""Which ranges are believed."""

from __future__ import annotations

import math
from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion import gate
from companion.settings import RangesSettings
from companion.types import LineOfSight, RangeSample, Verdict

CFG = RangesSettings(max_range_m=50.0, max_age_s=0.3)
MS = 1_000_000


def sample(seq: int = 1, range_m: float = 5.0, t_ms: int = 0, **more: object) -> RangeSample:
    return RangeSample(t_ns=t_ms * MS, beacon="b1", session="s", seq=seq, range_m=range_m, **more)  # type: ignore[arg-type]


def verdicts(*samples: RangeSample) -> list[Verdict]:
    track, out = None, []
    for s in samples:
        track, verdict = gate.judge(CFG, track, s)
        out.append(verdict)
    return out


@pytest.mark.parametrize("lie", [math.nan, math.inf, -1.0, 0.0, 50.1])
def test_absurd_ranges_are_dropped_and_leave_no_trace(lie: float) -> None:
    assert gate.judge(CFG, None, sample(range_m=lie)) == (None, Verdict.ABSURD)


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


def test_a_restarted_beacon_counts_from_anew() -> None:
    again = RangeSample(t_ns=MS, beacon="b1", session="other", seq=0, range_m=5.0)
    assert verdicts(sample(900), again) == [Verdict.ACCEPTED, Verdict.ACCEPTED]


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


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32))
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
    assert set(verdicts(*paced(0, 100_000, 0, drift))) == {Verdict.ACCEPTED}


def test_without_line_of_sight_a_range_weighs_less() -> None:
    clear = gate.sigma_m(CFG, sample(sigma_m=0.1, los=LineOfSight.LOS), 0.07)
    hidden = gate.sigma_m(CFG, sample(sigma_m=0.1, los=LineOfSight.NLOS), 0.07)
    assert hidden == CFG.nlos_sigma_factor * clear


def test_a_range_that_claims_to_be_perfect_is_not_believed_to_be() -> None:
    assert gate.sigma_m(CFG, sample(sigma_m=1e-9), 0.07) == pytest.approx(0.014)
