"""Which ranges are believed."""

from __future__ import annotations

import math

import pytest

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
