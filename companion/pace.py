"""How old a range is when it comes: by the publisher's stamps or numbers, so its clock need not be set."""

from __future__ import annotations

import msgspec
from msgspec.structs import replace

from companion.types import RangeSample


class Pace(msgspec.Struct, frozen=True, gc=False):
    """What is remembered of when the ranges of one session came."""

    seq: int
    t_ns: int
    sent_t_ns: int | None = None
    least_delay_ns: float = 0.0
    """Smallest (reception − publisher's clock) of late: the age of a range is its excess over that, whatever
    the publisher's clock is set to."""
    late_in_a_row: int = 0
    """Late ranges that came at their own pace, not in a burst: the clock was set back, or it paused."""
    spent_ns: float = 0.0
    counted: float = 0.0
    """Time and numbers of the last twenty or so: their quotient is the usual spacing, told by no stamp."""


_CLOCK_DRIFT = 2e-4
"""Two clocks may drift apart by so much; twice what crystals do."""
_CLOCK_WAS_SET = 10
"""So many late ranges at their own pace mean that the clock was set, not that the ranges are old."""
_PAUSED = 3
"""The same without stamps: the publisher measured nothing for a while, and nothing was held up."""
_FORGET = 0.95
_FAST = 1.1
"""The clock made of sequence numbers is let run fast, so that a spacing a little wrong never adds up."""


def judged(pace: Pace, sample: RangeSample, max_age_s: float) -> tuple[Pace, bool]:
    """The pace with one more range of the session, and whether that range is fresh."""
    if sample.sent_t_ns is not None:
        return _by_stamp(pace, sample, sample.sent_t_ns, _CLOCK_WAS_SET, max_age_s)
    return _by_number(pace, sample, max_age_s)


_ENOUGH = 8
"""Spacings after which their mean is one: the first ranges may come close together by chance."""


def _by_number(pace: Pace, sample: RangeSample, max_age_s: float) -> tuple[Pace, bool]:
    """Without a stamp the sequence number is the publisher's clock: it counts usual spacings.

    A backlog that comes at once is thus told from its numbers, from its oldest range to its newest.
    """
    since, steps = sample.t_ns - pace.t_ns, sample.seq - pace.seq
    is_known = pace.counted >= _ENOUGH
    spacing = pace.spent_ns / pace.counted if is_known else since / max(steps, 1)
    sent_t_ns = 0 if pace.sent_t_ns is None else pace.sent_t_ns + round(_FAST * steps * spacing)
    after, is_fresh = _by_stamp(pace, sample, sent_t_ns, _PAUSED, max_age_s)
    if pace.late_in_a_row == _PAUSED - 1 and is_fresh:
        return replace(after, spent_ns=float(since), counted=float(steps)), True
    if not is_fresh:
        return replace(after, spent_ns=pace.spent_ns, counted=pace.counted), False
    spent_ns, counted = _FORGET * pace.spent_ns + since, _FORGET * pace.counted + steps
    return replace(after, spent_ns=spent_ns, counted=counted), True


def _by_stamp(
    pace: Pace, sample: RangeSample, sent_t_ns: int, patience: int, max_age_s: float
) -> tuple[Pace, bool]:
    """A range that took much longer than the quickest ones has waited somewhere: it is old.

    After `patience` late ones at their own pace the clock is taken as set anew.
    """
    delay = float(sample.t_ns - sent_t_ns)
    since = sample.t_ns - pace.t_ns
    late_in_a_row = 0
    least = delay
    if pace.sent_t_ns is not None:
        least = min(delay, pace.least_delay_ns + _CLOCK_DRIFT * since)
        if delay - least > max_age_s * 1e9:
            in_a_burst = since < 0.5 * (sent_t_ns - pace.sent_t_ns)
            late_in_a_row = 0 if in_a_burst else pace.late_in_a_row + 1
    if late_in_a_row >= patience:
        least, late_in_a_row = delay, 0
    is_fresh = delay - least <= max_age_s * 1e9
    return Pace(sample.seq, sample.t_ns, sent_t_ns, least, late_in_a_row), is_fresh
