"""Which ranges are believed: known beacon, plausible, in order, fresh. (Outliers are told by the observer.)"""

from __future__ import annotations

import math
from enum import Enum
from typing import NamedTuple

from companion.settings import RangesSettings
from companion.types import LineOfSight, RangeSample


class Verdict(Enum):
    """What became of a range."""

    ACCEPTED = "accepted"
    UNKNOWN_BEACON = "unknown beacon"
    ABSURD = "absurd"
    REPEATED = "repeated"
    OUT_OF_ORDER = "out of order"
    STALE = "stale"
    OUTLIER = "outlier"


class Track(NamedTuple):
    """What is remembered of one beacon's stream."""

    session: str
    seq: int
    least_delay_ns: int | None
    """Smallest (reception − publisher's clock) of the session: the age of a range is its excess over that,
    whatever the publisher's clock is set to."""


def judge(cfg: RangesSettings, track: Track | None, sample: RangeSample) -> tuple[Track | None, Verdict]:
    """Decide whether a range from a known beacon may be used, and remember it."""
    if not 0.0 < sample.range_m <= cfg.max_range_m:  # NaN fails both
        return track, Verdict.ABSURD
    if sample.sigma_m is not None and not 0.0 < sample.sigma_m < math.inf:
        return track, Verdict.ABSURD
    same_session = track is not None and track.session == sample.session
    least = track.least_delay_ns if track is not None and same_session else None
    if track is not None and same_session and sample.seq <= track.seq:
        return track, Verdict.REPEATED if sample.seq == track.seq else Verdict.OUT_OF_ORDER
    stale = False
    if sample.sent_t_ns is not None:
        delay = sample.t_ns - sample.sent_t_ns
        least = delay if least is None else min(least, delay)
        stale = delay - least > cfg.max_age_s * 1e9
    return Track(sample.session, sample.seq, least), Verdict.STALE if stale else Verdict.ACCEPTED


def sigma_m(cfg: RangesSettings, sample: RangeSample, default_m: float) -> float:
    """The range's one-sigma: its own or the beacon's, widened where the signal was not in line of sight."""
    sigma = default_m if sample.sigma_m is None else max(sample.sigma_m, 0.2 * default_m)
    return sigma * cfg.nlos_sigma_factor if sample.los is LineOfSight.NLOS else sigma
