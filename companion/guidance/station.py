"""Station keeping (Problem 2 of the paper) with all beacons: find them, fly to the station, stay.

WAIT until enough beacons are heard; SEARCH: turn, and fit the beacons, the station and the drift to all
ranges (`station_fit`, `station_search`); FOLLOW: fly to the station while the fit goes on, one Gauss-Newton
step per range; KEEP: once the map of beacons is good enough, leave it as it is and locate the vehicle in it
(`station_pose`), so that what varies (drift, heading) is followed and what does not is not forgotten. Errors
of the map matter little at the station: the ranges there and the distances given err by the same map.
"""

from __future__ import annotations

import math
from enum import IntEnum

import msgspec
from msgspec.structs import replace

from companion.guidance import station_fit, station_pose, station_search, station_steer
from companion.guidance.model import clip, wrap
from companion.guidance.scheme import PROBE, REFUSE, UNKNOWN_M, Command, Knowledge, Scheme
from companion.guidance.settings import GuidanceSettings
from companion.guidance.station_fit import Block, Common, Fit, Moments, Solution
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
AMBIGUOUS = 3.0
"""A second station is still possible where it costs less than this more (half a χ²)."""
IN_LINE = 0.1
"""Beacons whose spread across their line is less than this part of the spread along it lie in a line."""
CLOSE_M = 2.0
"""So close to where the station seems to be, beacons that still seem to lie in a line do, and a map twice
as uncertain is good enough."""
KEEP_AFTER_S = 10.0
"""A map is not kept sooner: an early fit may be a wrong one that is sure of itself."""
PATIENCE_S = 5.0
"""After this long without enough beacons that is told as a problem."""
LOOKS, PLACES = 3, 45
"""A step of the search looks for so many beacons, or improves so many beacons' places (at most, but for one
round over all of them), to bound its time."""


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
    in the frame of the fit (of the map, in KEEP). `turn` is +1.0 to the left, −1.0 to the right."""

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


_UNSEEN = Beacon(0, 0.0, 0.0, 0.0, 0.0, (0.0,) * 5, station_fit.NOTHING, False, 0.0, 0.0, station_fit.EMPTY)
_NOWHERE = Solution(Common(0.0, 0.0, 0.0, 0.0), *(0.0,) * 10)


def initial(p: Parameters) -> Station:
    """No range yet."""
    return _fresh(p, p.first_turn)


def _fresh(p: Parameters, turn: float) -> Station:
    return Station(
        0.0, Mode.WAIT, Problem.NONE, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (_UNSEEN,) * len(p.distances), _NOWHERE,
        station_pose.NOWHERE, station_search.NEW, 0.0, turn, station_steer.AWAY,
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
        return replace(s, accepted=1.0, beacons=_with(s.beacons, beacon, b))
    if s.mode == Mode.KEEP and b.located:
        pose, accepted = station_pose.update(
            s.pose, b.bx, b.by, range_m, sigma_m, dh_m, sigma_dh_m, p.gate_sigma
        )
        if not accepted:
            return _reject(p, s, beacon)
        b = replace(b, rejected=REJECTION_MEMORY * b.rejected, t=s.t)
        return replace(s, accepted=1.0, pose=pose, beacons=_with(s.beacons, beacon, b))
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
    return replace(s, accepted=1.0, beacons=_with(s.beacons, beacon, b))


def _with(beacons: tuple[Beacon, ...], i: int, b: Beacon) -> tuple[Beacon, ...]:
    return (*beacons[:i], b, *beacons[i + 1 :])


def _reject(p: Parameters, s: Station, beacon: int) -> Station:
    """Count a range that is not believed; where most are not, begin with the beacon anew, or with all."""
    b = s.beacons[beacon]
    rejected = REJECTION_MEMORY * b.rejected + 1.0 - REJECTION_MEMORY
    s = replace(s, accepted=0.0)
    if rejected <= 0.5:
        return replace(s, beacons=_with(s.beacons, beacon, replace(b, rejected=rejected)))
    if s.mode != Mode.KEEP:
        # its ranges have jumped; what they said before holds
        return replace(s, beacons=_with(s.beacons, beacon, replace(b, seen=0, rejected=0.0)))
    others = [o for i, o in enumerate(s.beacons) if i != beacon and o.located and s.t - o.t < FRESH_S]
    doubted = 2 * sum(o.rejected > 0.4 for o in others) > len(others)
    if len(others) < 2 or doubted or (len(others) < BEACONS_NEEDED and not s.stay.is_there):
        return _fresh(p, s.turn)
    return replace(s, beacons=_with(s.beacons, beacon, _UNSEEN))


# --------------------------------------------------------------------------------------------- commands


def command(p: Parameters, s: Station, dt_s: float, yaw_rate_rad_s: float) -> tuple[Station, Command]:
    """Stand, turn to find out, fly there, or stay."""
    stand = Command(0.0, 0.0, PROBE) if p.law.can_stop else Command(p.law.v, s.turn * p.law.omega_max, PROBE)
    if s.problem == Problem.COLLINEAR:
        return s, Command(stand.v_m_s, stand.omega_rad_s, REFUSE)
    if s.mode == Mode.WAIT:
        if sum(b.seen >= FIRST_RANGES for b in s.beacons) < BEACONS_NEEDED:
            return replace(s, problem=Problem.TOO_FEW if s.t > PATIENCE_S else Problem.NONE), stand
        beacons = tuple(replace(b, t=b.t - s.t) for b in s.beacons)
        s = replace(
            s, mode=Mode.SEARCH, problem=Problem.NONE, t=0.0, x=0.0, y=0.0, heading=0.0, beacons=beacons
        )
    if s.mode == Mode.SEARCH:
        s = _search(p, s)
        if s.mode == Mode.SEARCH:
            return s, Command(p.law.v, s.turn * p.law.omega_max, PROBE)
    if s.mode == Mode.FOLLOW:
        s = _follow(p, s)
    elif s.t >= s.t_refit:
        s = _keep(p, s)
    if s.mode == Mode.WAIT or s.problem == Problem.TOO_FEW:
        return s, stand
    stay, wanted = station_steer.steer(p.law, _situation(s), s.stay, dt_s, yaw_rate_rad_s)
    return replace(s, stay=stay), wanted


def _situation(s: Station) -> Situation:
    u = s.at.u
    if s.mode == Mode.KEEP:
        g = s.pose
        return Situation(u.px - g.x, u.py - g.y, g.heading, s.vx, s.vy, g.wx, g.wy)
    return Situation(u.px - s.x - u.wx * s.t, u.py - s.y - u.wy * s.t, s.heading, s.vx, s.vy, u.wx, u.wy)


def _search(p: Parameters, s: Station) -> Station:
    """Fit again and again while turning, until the station is known well enough to fly to it."""
    if s.t < 0.5 * p.keeping.probe_turn_s:
        return s
    s = _advance(p, s, LOOKS)
    if not s.search.is_done:
        return s
    best, gap = station_search.result(s.search)
    s = replace(s, at=best.at)
    late = s.t > p.keeping.search_max_s
    known = _knowledge(s)
    if s.t < p.keeping.probe_turn_s or (
        not late and (known.sigma_theta_rad > p.keeping.probe_sigma_rad or gap < AMBIGUOUS)
    ):
        return replace(s, search=station_search.NEW)
    return replace(_adopt(s, best), mode=Mode.FOLLOW, t_refit=0.0)


def _advance(p: Parameters, s: Station, looks: int) -> Station:
    """Go on with the search: look for so many beacons, or list the starts, or fit from some of them."""
    search = s.search
    n = len(s.beacons)
    if search.looked < n:
        for i in range(search.looked, min(search.looked + looks, n)):
            b = s.beacons[i]
            found = None
            if b.moments.one > 0.0:
                places = station_search.modes(b.moments, s.x, s.y, b.range_m, p.keeping.drift_sigma_m_s)
                found = station_search.Candidate(i, b.moments, p.distances[i], places)
            search = station_search.look(search, found)
        return replace(s, search=search)
    if len(search.candidates) < BEACONS_NEEDED:
        return replace(s, search=station_search.NEW)
    if not search.starts:
        return replace(s, search=station_search.plan(search))
    for _ in range(max(1, PLACES // n)):
        if not search.is_done:
            search = station_search.attempt(search, p.keeping.drift_sigma_m_s)
    return replace(s, search=search)


def _adopt(s: Station, fit: Fit) -> Station:
    """Go on from this fit."""
    beacons = list(s.beacons)
    for c, (bx, by) in zip(s.search.candidates, fit.beacons, strict=True):
        b = beacons[c.number]
        block = station_fit.linearise(b.moments, fit.at.u, bx, by, c.distance)
        beacons[c.number] = replace(b, bx=bx, by=by, block=block, located=True)
    return replace(s, at=fit.at, beacons=tuple(beacons), search=station_search.NEW)


def _present(s: Station) -> station_search.Start:
    """The fit that is flown by, to be held against those of the search on the same data."""
    places = []
    for c in s.search.candidates:
        b = s.beacons[c.number]
        places.append(station_fit.place(b.block, s.at.u) if b.located else (c.modes.bx, c.modes.by))
    return station_search.Start(s.at.u, tuple(places))


def _follow(p: Parameters, s: Station) -> Station:
    """Improve the fit; now and then look for a better one elsewhere; keep the map once it is good enough."""
    at = station_fit.solve([b.block for b in s.beacons], p.keeping.drift_sigma_m_s)
    s = replace(s, at=at)
    if s.t < s.t_refit:
        return s
    search = s.search
    if not search.is_done:
        return _advance(p, s, 1)
    more = len(search.fits) - search.planned
    if more == 0:
        return replace(s, search=station_search.also(search, _present(s)))
    best, gap = station_search.result(search)
    now = search.fits[search.planned]
    taken = best if best.cost < now.cost - 1.0 else now
    if more == 1:
        return replace(s, search=station_search.also(search, station_search.image(taken)))
    image = search.fits[-1]
    s = replace(_adopt(s, taken), t_refit=s.t + p.keeping.refit_s)
    known = _knowledge(s)
    sigma_m = math.hypot(known.sigma_d_m, known.sigma_theta_rad * max(known.d_m, 0.3))
    of = station_fit.shape(taken.beacons)
    if image.cost - taken.cost < AMBIGUOUS and of.across_m < IN_LINE * of.along_m:
        # on the way more is learnt of how they lie
        return replace(s, problem=Problem.COLLINEAR) if known.d_m < CLOSE_M else s
    if (
        s.t < KEEP_AFTER_S
        or gap < station_search.UNLIKELY
        or sigma_m > (2.0 if known.d_m < CLOSE_M else 1.0) * p.keeping.map_sigma_m
    ):
        return s
    a, t = s.at, s.t
    speed = math.hypot(s.vx, s.vy) + 1e-3
    across = (s.vy * s.vy * a.c33 - 2.0 * s.vx * s.vy * a.c34 + s.vx * s.vx * a.c44) / (speed * speed)
    pose = station_pose.start(
        s.x + a.u.wx * t, s.y + a.u.wy * t, s.heading, a.u.wx, a.u.wy, s.vx, s.vy,
        math.sqrt(max(across, 0.0)) / max(speed, 0.5 * p.law.v),
    )  # fmt: skip
    beacons = []
    for b in s.beacons:
        bx, by = station_fit.place(b.block, a.u)
        beacons.append(replace(b, bx=bx, by=by) if b.located else _UNSEEN)
    return _keep(p, replace(s, mode=Mode.KEEP, pose=pose, beacons=tuple(beacons)))


def _keep(p: Parameters, s: Station) -> Station:
    """Once a second: place beacons that have come, and put the station where the ranges of the beacons heard
    now will be the distances given, whatever the map's errors."""
    u = s.at.u
    if math.hypot(s.pose.wx, s.pose.wy) > 3.0 * p.keeping.drift_sigma_m_s:
        # there is no such drift: the map is wrong
        return _fresh(p, s.turn)
    places, distances, weights = [], [], []
    heard = 0
    for i, b in enumerate(s.beacons):
        if not b.located and b.moments.one > 0.0:
            found = station_search.on_circle(b.moments, u.px, u.py, p.distances[i])
            if found is not None:
                b = replace(b, located=True, bx=found[0], by=found[1], rejected=0.0)
                s = replace(s, beacons=_with(s.beacons, i, b))
        if b.located:
            fresh = s.t - b.t < FRESH_S
            heard += fresh
            places.append((b.bx, b.by))
            distances.append(p.distances[i])
            weights.append(1.0 if fresh else 0.03)
    px, py = station_fit.closest(u.px, u.py, places, distances, weights)
    return replace(
        s,
        at=s.at._replace(u=u._replace(px=px, py=py)),
        t_refit=s.t + 1.0,
        problem=Problem.NONE if heard >= 2 else Problem.TOO_FEW,
    )


def knowledge(p: Parameters, s: Station) -> Knowledge:
    """Distance and bearing of the station, with their sigmas; while searching, that it is unknown."""
    if s.mode in (Mode.WAIT, Mode.SEARCH):
        return Knowledge(0.0, 0.0, UNKNOWN_M, math.pi)
    return _knowledge(s)


def _knowledge(s: Station) -> Knowledge:
    q = _situation(s)
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


def station(
    settings: GuidanceSettings,
    keeping: StationSettings,
    distances_m: tuple[float, ...],
    yaw_rate_lag_s: float,
    speed_lag_s: float,
) -> Scheme:
    """The default scheme for the station at these distances from the beacons, in the order of their numbers,
    for a vehicle whose yaw rate and speed lag their commands by so much.

    `state.problem` tells why it does not get on. Raises ValueError for fewer than three beacons.
    """
    if len(distances_m) < BEACONS_NEEDED:
        raise ValueError(f"{len(distances_m)} beacons: a station needs at least {BEACONS_NEEDED}")
    law = Law(
        v=settings.speed_m_s,
        omega_max=settings.yaw_rate_max_rad_s,
        yaw_rate_lag=yaw_rate_lag_s,
        speed_lag=speed_lag_s,
        radius=keeping.radius_m,
        turn_through=settings.turn_through_rad,
        q1=settings.lq_q[0],
        q2=settings.lq_q[1],
        r=settings.lq_r,
        can_stop=keeping.can_stop,
    )
    first_turn = 1.0 if settings.first_turn == "left" else -1.0
    p = Parameters(distances_m, law, keeping, first_turn, settings.kalman_gate_sigma)
    return Scheme(p, initial, predict, update, command, knowledge)
