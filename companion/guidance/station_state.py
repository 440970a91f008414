"""What is known while a station is looked for and kept, and what motion and ranges do to it.

All of it lives in the frame in which the search began, dead-reckoned and carried along by the drift; in KEEP,
in that of the map.
"""

from __future__ import annotations

import math
from enum import IntEnum

import msgspec
from msgspec.structs import replace

from companion.guidance import station_fit, station_pose, station_search, station_steer
from companion.guidance.model import clip, wrap
from companion.guidance.scheme import UNKNOWN_M, Knowledge
from companion.guidance.station_fit import Block, Common, Moments, Solution
from companion.guidance.station_pose import Pose
from companion.guidance.station_settings import BEACONS_NEEDED, StationSettings
from companion.guidance.station_steer import Law, Situation, Stay

FIRST_RANGES = 5
"""A beacon is heard once the median of this many ranges is known."""
NEAR_RANGE_M = 0.2
"""The noise of d²/2 is never taken for smaller than at this range."""
REJECTION_MEMORY = 0.97
"""Forgetting factor, per range, of the average that tells when a beacon is not believed any more."""
FRESH_S = 3.0
"""A beacon not heard for longer has gone, and says little of where the station is."""


class Mode(IntEnum):
    """What the scheme is at."""

    WAIT = 0
    SEARCH = 1
    FOLLOW = 2
    KEEP = 3


class Problem(IntEnum):
    """Why the station cannot be found or kept."""

    NONE = 0
    TOO_FEW = 1
    """Fewer than three beacons are heard (fewer than two, once they are located)."""
    COLLINEAR = 2
    """The beacons lie in a line: the station may be on either side of it. The flight is refused."""


class Parameters(msgspec.Struct, frozen=True, gc=False):
    """What stays the same; `distances` d_i* by beacon number."""

    distances: tuple[float, ...]
    law: Law
    circling: Law
    keeping: StationSettings
    first_turn: float
    gate_sigma: float


class Beacon(msgspec.Struct, frozen=True, gc=False):
    """One beacon: its range as followed from reading to reading, what its ranges say, and its place."""

    seen: int
    range_m: float
    rate_m_s: float
    t: float
    rejected: float
    recent: tuple[float, float, float, float, float]
    moments: Moments
    located: bool
    bx: float
    by: float
    block: Block


class Station(msgspec.Struct, frozen=True, gc=False):
    """State. Time, path and heading count from the beginning of the search; `vx`, `vy` are through the air,
    in the frame of the fit (of the map, in KEEP). `turn` is +1.0 to the left, −1.0 to the right; `steps_s`
    is how long the vehicle has looked around at the station."""

    accepted: float
    mode: Mode
    problem: Problem
    t: float
    x: float
    y: float
    heading: float
    vx: float
    vy: float
    beacons: tuple[Beacon, ...]
    at: Solution
    pose: Pose
    search: station_search.Search
    t_refit: float
    turn: float
    stay: Stay
    steps_s: float


UNSEEN = Beacon(0, 0.0, 0.0, 0.0, 0.0, (0.0,) * 5, station_fit.NOTHING, False, 0.0, 0.0, station_fit.EMPTY)
NOWHERE = Solution(Common(0.0, 0.0, 0.0, 0.0), *(0.0,) * 10)


def initial(p: Parameters) -> Station:
    """No range yet."""
    return anew(p, p.first_turn)


def anew(p: Parameters, turn: float) -> Station:
    """Nothing is known; the search will turn to this side."""
    return Station(
        0.0, Mode.WAIT, Problem.NONE, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (UNSEEN,) * len(p.distances), NOWHERE,
        station_pose.NOWHERE, station_search.NEW, 0.0, turn, station_steer.AWAY, 0.0,
    )  # fmt: skip


def predict(
    p: Parameters, s: Station, dt_s: float, forward_m_s: float, left_m_s: float, yaw_rate_rad_s: float
) -> Station:
    """The vehicle moved so for dt_s."""
    turned = yaw_rate_rad_s * dt_s
    pose = s.pose
    if s.mode == Mode.KEEP:
        pose = station_pose.predict(pose, dt_s, forward_m_s, left_m_s, turned)
        middle = pose.heading - 0.5 * turned
    else:
        middle = s.heading + 0.5 * turned
    c, sn = math.cos(middle), math.sin(middle)
    vx = forward_m_s * c - left_m_s * sn
    vy = forward_m_s * sn + left_m_s * c
    return replace(
        s,
        t=s.t + dt_s,
        x=s.x + vx * dt_s,
        y=s.y + vy * dt_s,
        heading=s.heading + turned,
        vx=vx,
        vy=vy,
        pose=pose,
    )


# ---------------------------------------------------------------------------------------------- ranges


def update(
    p: Parameters, s: Station, beacon: int, range_m: float, sigma_m: float, dh_m: float, sigma_dh_m: float
) -> Station:
    """One slant range."""
    b = s.beacons[beacon]
    if b.seen < FIRST_RANGES:
        recent = (range_m, *b.recent[:4])
        b = replace(b, seen=b.seen + 1, recent=recent, range_m=sorted(recent)[2], rate_m_s=0.0, t=s.t)
        return replace(s, accepted=1.0, beacons=with_beacon(s.beacons, beacon, b))
    if s.mode == Mode.KEEP and b.located:
        pose, accepted = station_pose.update(
            s.pose, b.bx, b.by, range_m, sigma_m, dh_m, sigma_dh_m, p.gate_sigma
        )
        if not accepted:
            return _reject(p, s, beacon)
        b = replace(b, rejected=REJECTION_MEMORY * b.rejected, t=s.t)
        return replace(s, accepted=1.0, pose=pose, beacons=with_beacon(s.beacons, beacon, b))
    # believed if it follows from the last ones; the fit may still be wrong
    dt = s.t - b.t
    expected = b.range_m + b.rate_m_s * dt
    spread = 0.05 + 0.3 * dt
    off = range_m - expected
    variance = sigma_m * sigma_m
    if off * off > p.gate_sigma * p.gate_sigma * (variance + spread * spread):
        return _reject(p, s, beacon)
    near = max(expected, NEAR_RANGE_M)
    z = 0.5 * (range_m * range_m - dh_m * dh_m - variance)
    high = dh_m * sigma_dh_m
    # Cauchy's weight: what looks like a reflection counts for less
    weight = 1.0 / (
        (near * near * variance + high * high + 0.5 * variance * variance)
        * (1.0 + off * off / (6.25 * variance))
    )
    x, y, t = (s.pose.x, s.pose.y, 0.0) if s.mode == Mode.KEEP else (s.x, s.y, s.t)
    keep = 1.0 - min(dt / p.keeping.memory_s, 0.5)
    m = station_fit.accumulate(b.moments, keep, weight, x, y, t, z - 0.5 * (x * x + y * y))
    bx, by, block = b.bx, b.by, b.block
    if s.mode == Mode.FOLLOW and b.located:
        px, py = station_fit.place(block, s.at.u)
        bx += clip(px - bx, 1.0)
        by += clip(py - by, 1.0)
        block = station_fit.linearise(m, s.at.u, bx, by, p.distances[beacon])
    rate = clip(b.rate_m_s + 0.04 * off / max(dt, 0.02), 2.0 * p.law.v)
    b = Beacon(
        b.seen, expected + 0.25 * off, rate, s.t, REJECTION_MEMORY * b.rejected, b.recent, m, b.located,
        bx, by, block,
    )  # fmt: skip
    return replace(s, accepted=1.0, beacons=with_beacon(s.beacons, beacon, b))


def with_beacon(beacons: tuple[Beacon, ...], i: int, b: Beacon) -> tuple[Beacon, ...]:
    """The beacons, the one of number i replaced."""
    return (*beacons[:i], b, *beacons[i + 1 :])


def _reject(p: Parameters, s: Station, beacon: int) -> Station:
    """Count a range that is not believed; where most are not, begin with the beacon anew, or with all."""
    b = s.beacons[beacon]
    rejected = REJECTION_MEMORY * b.rejected + 1.0 - REJECTION_MEMORY
    s = replace(s, accepted=0.0)
    if rejected <= 0.5:
        return replace(s, beacons=with_beacon(s.beacons, beacon, replace(b, rejected=rejected)))
    if s.mode != Mode.KEEP:
        # its ranges have jumped; what they said before holds
        return replace(s, beacons=with_beacon(s.beacons, beacon, replace(b, seen=0, rejected=0.0)))
    others = [o for i, o in enumerate(s.beacons) if i != beacon and o.located and s.t - o.t < FRESH_S]
    doubted = 2 * sum(o.rejected > 0.4 for o in others) > len(others)
    if len(others) < 2 or doubted or (len(others) < BEACONS_NEEDED and not s.stay.is_there):
        return anew(p, s.turn)
    return replace(s, beacons=with_beacon(s.beacons, beacon, UNSEEN))


# ---------------------------------------------------------------------------------------- what is known


def situation(s: Station) -> Situation:
    """The station as it is seen from the vehicle, by what is known now."""
    u = s.at.u
    if s.mode == Mode.KEEP:
        g = s.pose
        return Situation(u.px - g.x, u.py - g.y, g.heading, s.vx, s.vy, g.wx, g.wy)
    return Situation(u.px - s.x - u.wx * s.t, u.py - s.y - u.wy * s.t, s.heading, s.vx, s.vy, u.wx, u.wy)


def knowledge(p: Parameters, s: Station) -> Knowledge:
    """Distance and bearing of the station, with their sigmas; while searching, that it is unknown."""
    if s.mode in (Mode.WAIT, Mode.SEARCH):
        return Knowledge(0.0, 0.0, UNKNOWN_M, math.pi)
    return known_by(s)


def known_by(s: Station) -> Knowledge:
    """Distance and bearing of the station, with their sigmas, by the fit or the map."""
    q = situation(s)
    if s.mode == Mode.KEEP:
        xx, xy, yy, turn = s.pose.pxx, s.pose.pxy, s.pose.pyy, s.pose.phh
    else:
        a, t = s.at, s.t
        xx = a.c11 - 2.0 * t * a.c13 + t * t * a.c33
        xy = a.c12 - t * (a.c14 + a.c23) + t * t * a.c34
        yy = a.c22 - 2.0 * t * a.c24 + t * t * a.c44
        turn = 0.0
    d = math.hypot(q.ex, q.ey)
    ux, uy = q.ex / (d + 1e-6), q.ey / (d + 1e-6)
    along = ux * ux * xx + 2.0 * ux * uy * xy + uy * uy * yy
    across = uy * uy * xx - 2.0 * ux * uy * xy + ux * ux * yy
    return Knowledge(
        d,
        wrap(q.heading - math.atan2(q.ey, q.ex)),
        math.sqrt(max(along, 0.0)),
        min(math.sqrt(max(across, 0.0) / max(d * d, 0.09) + turn), math.pi),
    )
