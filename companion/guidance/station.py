"""Station keeping (Problem 2 of the paper) with all beacons: find them, fly to the station, stay.

WAIT until enough beacons are heard; SEARCH: turn, and fit the beacons, the station and the drift to all
ranges (`station_fit`, `station_search`); FOLLOW: fly to the station while the fit goes on, one Gauss-Newton
step per range, and look around there while another map is still possible; KEEP: once the map of beacons is
good enough, leave it as it is and locate the vehicle in it (`station_pose`), so that what varies (drift,
heading) is followed and what does not is not forgotten. Errors of the map matter little at the station: the
ranges there and the distances given err by the same map.
"""

from __future__ import annotations

import math

from msgspec.structs import replace

from companion.guidance import station_fit, station_pose, station_search, station_steer
from companion.guidance.scheme import PROBE, REFUSE, TRACK, Command, Scheme
from companion.guidance.settings import GuidanceSettings
from companion.guidance.station_fit import Fit
from companion.guidance.station_settings import BEACONS_NEEDED, StationSettings
from companion.guidance.station_state import (
    FIRST_RANGES,
    FRESH_S,
    UNSEEN,
    Mode,
    Parameters,
    Problem,
    Station,
    anew,
    initial,
    knowledge,
    known_by,
    predict,
    situation,
    update,
    with_beacon,
)
from companion.guidance.station_steer import Law, Situation

AMBIGUOUS = 3.0
"""A second station is still possible where it costs less than this more (half a χ²)."""
IN_LINE = 0.1
"""Beacons whose spread across their line is less than this part of the spread along it lie in a line."""
CLOSE_M = 2.0
"""So close to where the station seems to be, a map twice as uncertain is good enough."""
STEP_M, STEP_S, STEPS_S, LOOK_AROUND_S = 0.2, 4.0, 8.0, 20.0
"""At the station with a map that may be wrong, the vehicle steps aside by the first, for the second at a
time; what that has not decided after the third it circles. After the last, beacons that still seem to lie in
a line do, and the most probable map is taken."""
STEADY = 0.2
"""Flown at less than this part of the speed on average, the direction of a map is not known by the drift."""
KEEP_AFTER_S = 10.0
"""A map is not kept sooner: an early fit may be a wrong one that is sure of itself."""
PATIENCE_S = 5.0
"""After this long without enough beacons that is told as a problem."""
LOOKS, PLACES = 3, 45
"""A step of the search looks for so many beacons, or improves so many beacons' places (at most, but for one
round over all of them), to bound its time."""


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
    if s.mode == Mode.KEEP:
        stay, wanted = station_steer.steer(p.law, situation(s), s.stay, dt_s, yaw_rate_rad_s)
        return replace(s, stay=stay), wanted
    # at the station, but the map may still be wrong: look around until that is decided
    q = _aside(s) if s.stay.is_there else situation(s)
    law = p.law if s.steps_s < STEPS_S else p.circling
    stay, wanted = station_steer.steer(law, q, s.stay, dt_s, yaw_rate_rad_s)
    steps_s = s.steps_s + dt_s if stay.is_there or stay.near_s > 0.0 else s.steps_s
    s = replace(s, stay=replace(stay, near_s=0.0), steps_s=steps_s)
    return s, Command(wanted.v_m_s, wanted.omega_rad_s, TRACK)


def _aside(s: Station) -> Situation:
    """Where to step at the station: a standstill tells nothing of the map."""
    q = situation(s)
    # to the side of the way here, then to the other
    azimuth = math.atan2(s.at.u.py, s.at.u.px) + math.copysign(0.5 * math.pi, s.steps_s - STEP_S)
    return replace(q, ex=q.ex + STEP_M * math.cos(azimuth), ey=q.ey + STEP_M * math.sin(azimuth))


def _search(p: Parameters, s: Station) -> Station:
    """Fit again and again while turning, until the station is known well enough to fly to it."""
    if s.t < 0.5 * p.keeping.probe_turn_s:
        return s
    s = _advance(p, s, LOOKS)
    if not s.search.is_done:
        return s
    best, gap = station_search.result(s.search, s.t)
    if best.cost == math.inf:  # all of them have run away
        return replace(s, search=station_search.NEW)
    s = replace(s, at=best.at)
    late = s.t > p.keeping.search_max_s
    known = known_by(s)
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
                places = station_search.modes(
                    b.moments, s.x, s.y, b.range_m, p.keeping.drift_sigma_m_s, s.t, search.wx, search.wy
                )
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
    # around no drift and around the one found, in turns: the first misses what the second finds, late in a
    # flight with much drift, and the second what the first finds, where the drift found is wrong
    u = fit.at.u
    next_one = station_search.NEW if s.search.is_drifting else replace(station_search.NEW, wx=u.wx, wy=u.wy)
    return replace(s, at=fit.at, beacons=tuple(beacons), search=next_one)


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
    now = search.fits[search.planned]
    best, gap = station_search.result(search, s.t)
    taken = best if best.cost < now.cost - 1.0 else now
    if taken.cost == math.inf:  # a beacon has come of which too little is known: all fits run away
        return replace(s, search=station_search.NEW, t_refit=s.t + p.keeping.refit_s)
    if more == 1:
        return replace(s, search=station_search.also(search, station_search.image(taken)))
    image = search.fits[-1]
    s = replace(_adopt(s, taken), t_refit=s.t + p.keeping.refit_s)
    known = known_by(s)
    sigma_m = math.hypot(known.sigma_d_m, known.sigma_theta_rad * max(known.d_m, 0.3))
    of = station_fit.shape(taken.beacons)
    late = s.steps_s > LOOK_AROUND_S
    if (
        image.cost - taken.cost < AMBIGUOUS
        and of.across_m < IN_LINE * of.along_m
        and station_search.apart_m(image, taken, s.t) > station_search.APART_M
    ):
        # on the way more is learnt of how they lie
        return replace(s, problem=Problem.COLLINEAR) if late else s
    if not late and (
        s.t < KEEP_AFTER_S
        or not search.is_drifting
        or gap < station_search.UNLIKELY
        or sigma_m > (2.0 if known.d_m < CLOSE_M else 1.0) * p.keeping.map_sigma_m
    ):
        return s
    return _keep(p, _mapped(p, s))


def _mapped(p: Parameters, s: Station) -> Station:
    """The beacons' places as they are fitted become the map."""
    a, t = s.at, s.t
    vx, vy = station_fit.velocity([b.moments for b in s.beacons])
    speed = math.hypot(vx, vy) + 1e-3
    across = (vy * vy * a.c33 - 2.0 * vx * vy * a.c34 + vx * vx * a.c44) / (speed * speed)
    pose = station_pose.start(
        s.x + a.u.wx * t, s.y + a.u.wy * t, s.heading, a.u.wx, a.u.wy, vx, vy,
        math.sqrt(max(across, 0.0)) / max(speed, STEADY * p.law.v),
    )  # fmt: skip
    beacons = []
    for b in s.beacons:
        bx, by = station_fit.place(b.block, a.u)
        beacons.append(replace(b, bx=bx, by=by) if b.located else UNSEEN)
    return replace(s, mode=Mode.KEEP, pose=pose, beacons=tuple(beacons))


def _keep(p: Parameters, s: Station) -> Station:
    """Once a second: place a beacon that has come where one is needed, and put the station where the ranges
    of the beacons heard now will be the distances given, whatever the map's errors."""
    u = s.at.u
    if math.hypot(s.pose.wx, s.pose.wy) > 3.0 * p.keeping.drift_sigma_m_s:
        # there is no such drift: the map is wrong
        return anew(p, s.turn)
    places, distances, weights = [], [], []
    # the place of one that comes now is the least certain: on the wrong side, it would lead astray
    needed = sum(b.located and s.t - b.t < FRESH_S for b in s.beacons) < BEACONS_NEEDED
    heard = 0
    for i, b in enumerate(s.beacons):
        if needed and not b.located and b.moments.one > 0.0:
            found = station_search.on_circle(b.moments, u.px, u.py, p.distances[i])
            if found is not None:
                b = replace(b, located=True, bx=found[0], by=found[1], rejected=0.0)
                s = replace(s, beacons=with_beacon(s.beacons, i, b))
        if b.located:
            fresh = s.t - b.t < FRESH_S
            heard += fresh
            places.append((b.bx, b.by))
            distances.append(p.distances[i])
            weights.append(1.0 if fresh else 0.03)
    px, py = station_fit.closest(u.px, u.py, places, distances, weights)
    return replace(
        s,
        at=replace(s.at, u=station_fit.Common(px, py, u.wx, u.wy)),
        t_refit=s.t + 1.0,
        problem=Problem.NONE if heard >= 2 else Problem.TOO_FEW,
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
    circling = replace(law, can_stop=False)
    p = Parameters(distances_m, law, circling, keeping, first_turn, settings.kalman_gate_sigma)
    return Scheme(p, initial, predict, update, command, knowledge)
