"""Which ranges are believed: known beacon, plausible, in order, fresh. Outliers are the observer's matter."""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace

from companion.settings import RangesSettings
from companion.types import LineOfSight, RangeSample, Verdict


class Track(msgspec.Struct, frozen=True, gc=False):
    """What is remembered of one beacon's stream."""

    session: str
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


def judge(cfg: RangesSettings, track: Track | None, sample: RangeSample) -> tuple[Track | None, Verdict]:
    """Decide whether a range from a known beacon may be used, and remember it."""
    if not 0.0 < sample.range_m <= cfg.max_range_m:  # NaN fails both
        return track, Verdict.ABSURD
    if sample.sigma_m is not None and not 0.0 < sample.sigma_m < math.inf:
        return track, Verdict.ABSURD
    if track is None or track.session != sample.session:
        track = Track(sample.session, sample.seq, sample.t_ns)
    elif sample.seq <= track.seq:
        return track, Verdict.REPEATED if sample.seq == track.seq else Verdict.OUT_OF_ORDER
    if sample.sent_t_ns is not None:
        return _judge_age(cfg, track, sample, sample.sent_t_ns, _CLOCK_WAS_SET)
    return _judge_pace(cfg, track, sample)


def _judge_pace(cfg: RangesSettings, track: Track, sample: RangeSample) -> tuple[Track, Verdict]:
    """Without a stamp the sequence number is the publisher's clock: it counts usual spacings.

    A backlog that comes at once is thus told from its numbers, from its oldest range to its newest.
    """
    since, steps = sample.t_ns - track.t_ns, sample.seq - track.seq
    spacing = track.spent_ns / track.counted if track.counted else since / max(steps, 1)
    sent_t_ns = None if track.sent_t_ns is None else track.sent_t_ns + round(_FAST * steps * spacing)
    before = track
    track, verdict = _judge_age(cfg, track, sample, 0 if sent_t_ns is None else sent_t_ns, _PAUSED)
    if before.late_in_a_row == _PAUSED - 1 and verdict is Verdict.ACCEPTED:
        return replace(track, spent_ns=float(since), counted=float(steps)), verdict
    if verdict is Verdict.STALE:
        return replace(track, spent_ns=before.spent_ns, counted=before.counted), verdict
    spent_ns, counted = _FORGET * before.spent_ns + since, _FORGET * before.counted + steps
    return replace(track, spent_ns=spent_ns, counted=counted), verdict


def _judge_age(
    cfg: RangesSettings, track: Track, sample: RangeSample, sent_t_ns: int, patience: int
) -> tuple[Track, Verdict]:
    """A range that took much longer than the quickest ones has waited somewhere: it is old.

    After `patience` late ones at their own pace the clock is taken as set anew.
    """
    delay = float(sample.t_ns - sent_t_ns)
    since = sample.t_ns - track.t_ns
    late_in_a_row = 0
    least = delay
    if track.sent_t_ns is not None:
        least = min(delay, track.least_delay_ns + _CLOCK_DRIFT * since)
        if delay - least > cfg.max_age_s * 1e9:
            in_a_burst = since < 0.5 * (sent_t_ns - track.sent_t_ns)
            late_in_a_row = 0 if in_a_burst else track.late_in_a_row + 1
    if late_in_a_row >= patience:
        least, late_in_a_row = delay, 0
    stale = delay - least > cfg.max_age_s * 1e9
    track = Track(sample.session, sample.seq, sample.t_ns, sent_t_ns, least, late_in_a_row)
    return track, Verdict.STALE if stale else Verdict.ACCEPTED


def sigma_m(cfg: RangesSettings, sample: RangeSample, default_m: float) -> float:
    """The range's one-sigma: its own or the beacon's, widened where the signal was not in line of sight."""
    sigma = default_m if sample.sigma_m is None else max(sample.sigma_m, 0.2 * default_m)
    return sigma * cfg.nlos_sigma_factor if sample.los is LineOfSight.NLOS else sigma
