"""Which ranges are believed: plausible, from one publisher, in order, fresh, and no faster than the vehicle.

Outliers are the observer's matter. Nothing here locks itself out: each rule that refuses ends by itself, a
second or so after whoever was believed before has fallen silent or has become impossible.
"""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace

from companion import pace, reach
from companion.network_settings import RangesSettings
from companion.pace import Pace
from companion.reach import Reach
from companion.types import LineOfSight, RangeSample, Verdict


class Track(msgspec.Struct, frozen=True, gc=False):
    """What is remembered of one beacon's stream."""

    session: str
    pace: Pace
    reach: Reach | None = None
    former: str = ""
    former_seq: int = -1
    """The session before this one, and how far it had counted: its ranges do not come twice."""
    rival: str = ""
    rival_t_ns: int = 0
    """Another session that was heard while this one was, and when last."""


def judge(
    cfg: RangesSettings,
    track: Track | None,
    sample: RangeSample,
    range_m: float,
    sigma_m: float,
    rate_m_s: float,
) -> tuple[Track | None, Verdict]:
    """Decide whether a range from a known beacon may be used, and remember it.

    `range_m` and `sigma_m` are those of `beacons`; `rate_m_s`: the distance cannot change faster than this.
    """
    if not 0.0 < range_m <= cfg.max_range_m:  # NaN fails both
        return track, Verdict.ABSURD
    if sample.sigma_m is not None and not 0.0 < sample.sigma_m < math.inf:
        return track, Verdict.ABSURD
    if track is None:
        track = Track(sample.session, Pace(sample.seq, sample.t_ns))
    else:
        refused = _out_of_turn(cfg, track, sample)
        if refused is Verdict.SECOND_PUBLISHER:
            return replace(track, rival=sample.session, rival_t_ns=sample.t_ns), refused
        if refused is not None:
            return track, refused
        if sample.session != track.session:
            track = _taken_over(track, sample)
        elif sample.seq < track.pace.seq:
            track = replace(track, pace=Pace(sample.seq, sample.t_ns))
    t, is_fresh = pace.judged(track.pace, sample, cfg.max_age_s)
    if not is_fresh:
        return replace(track, pace=t), Verdict.STALE
    if sample.los is LineOfSight.NLOS and cfg.nlos == "drop":
        return replace(track, pace=t), Verdict.NLOS
    r, is_within = reach.judged(track.reach, sample.t_ns, range_m, sigma_m, rate_m_s)
    return replace(track, pace=t, reach=r), Verdict.ACCEPTED if is_within else Verdict.JUMP


def _out_of_turn(cfg: RangesSettings, track: Track, sample: RangeSample) -> Verdict | None:
    """Session and sequence. A stream that has been silent for a while may begin anew, with any count."""
    is_silent = sample.t_ns - track.pace.t_ns > cfg.restart_after_s * 1e9
    if sample.session == track.session:
        if sample.seq > track.pace.seq:
            return None
        if sample.seq == track.pace.seq:
            return Verdict.REPEATED
        return None if is_silent else Verdict.OUT_OF_ORDER
    if not is_silent:
        return Verdict.SECOND_PUBLISHER
    if sample.session == track.former and sample.seq <= track.former_seq:
        return Verdict.OUT_OF_ORDER
    return None


def _taken_over(track: Track, sample: RangeSample) -> Track:
    """Another session: its numbers and its clock are its own, the beacon's distance is the same."""
    return replace(
        track,
        session=sample.session,
        pace=Pace(sample.seq, sample.t_ns),
        former=track.session,
        former_seq=track.pace.seq,
    )
