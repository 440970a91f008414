"""Steering of `seek`: to a target whose bearing is open, to one that is known, and the stop at it."""

from __future__ import annotations

import math

from companion.guidance import drift, lq, model, readout
from companion.guidance.drift import Fix
from companion.guidance.scheme import PROBE, REST, TRACK, UNKNOWN_M, Command
from companion.guidance.seek import (
    FOLLOW,
    GATHER,
    NEAR_RANGE_M,
    SEARCH,
    Manner,
    Seeking,
    SeekParameters,
    caught_up,
)

AGREED = 0.9
"""The search ends where the resultant of the bearing's posterior is above this."""
TURN_ON = 0.88
"""Below this resultant the vehicle turns at the largest yaw rate."""
LOOK_AHEAD_S = 1.0
"""To which side: as if the bearing were known after this time."""
SEARCH_S = 6.0
"""The search ends after this time in any case; the read-out goes on correcting itself."""
CRAB_MAX = 0.9
"""Largest sine of the crab angle."""
AIMED_RAD = 0.3
"""A turn on the spot ends where the target is this near to straight ahead."""
TURN_RAD = 0.5
"""A target inside the turning circle is turned to on the spot where it is this far off."""
PATIENCE_S = 30.0
"""Near the target the certainty that a stop asks for fades over this time: knowledge has its limits too."""


def command(p: SeekParameters, s: Seeking, dt_s: float, yaw_rate_rad_s: float) -> tuple[Seeking, Command]:
    """Read the lift out, and steer by what it says."""
    if s.mode == GATHER:
        return s, Command(p.v, s.manner.turn * p.omega_max, PROBE)
    s = caught_up(p, s)
    f, h = s.lift, s.heard
    offset, height = h.range_m * p.offset, h.dh_m * h.sigma_dh_m
    offset_variance = offset * offset + height * height
    if s.mode == SEARCH:
        return search(p, s, offset_variance, yaw_rate_rad_s)
    q = readout.renewed(f, offset_variance, s.fix)
    s = Seeking(s.accepted, s.noise, s.mode, s.since_s, s.agreed, s.nearest_m, s.motion, h, f, q, s.manner)
    return follow(p, s, dt_s, yaw_rate_rad_s)


def search(
    p: SeekParameters, s: Seeking, offset_variance: float, yaw_rate_rad_s: float
) -> tuple[Seeking, Command]:
    """Turn to the side of the shorter path while the directions disagree, then to their mean."""
    f, m = s.lift, s.motion
    d = max(drift.distance(f), NEAR_RANGE_M)
    weights = readout.posterior(f, readout.information(f, offset_variance), d)
    open_ = readout.mean_direction(weights)
    hx, hy = math.cos(m.heading), math.sin(m.heading)
    theta = math.atan2(hy * open_.cos - hx * open_.sin, hx * open_.cos + hy * open_.sin)
    omega = yaw_rate(p, s.manner.turn, d, theta, 0.0, yaw_rate_rad_s)
    if s.since_s < p.search_turn_s + p.lag:
        omega = s.manner.turn * p.omega_max
    elif open_.resultant < TURN_ON:
        omega = p.omega_max * shorter_side(p, weights, m.heading, s.manner.turn, yaw_rate_rad_s)
    q = Fix(d * open_.cos, d * open_.sin, 0.0, 0.0, 0.0, 0.0, 0.0)
    mode = SEARCH
    if open_.resultant > AGREED or s.since_s > SEARCH_S:
        mode = FOLLOW
        q = readout.fix(f, offset_variance, q.x, q.y, 0.0, 0.0)
    manner = Manner(side(omega, s.manner.turn), False, False, 0.0)
    agreed = max(open_.resultant, drift.TINY)
    s = Seeking(s.accepted, s.noise, mode, s.since_s, agreed, UNKNOWN_M, m, s.heard, f, q, manner)
    return s, Command(p.v, omega, PROBE)


def shorter_side(
    p: SeekParameters, weights: list[float], heading_rad: float, turn: float, yaw_rate_rad_s: float
) -> float:
    """The side to turn to while the bearing is open: the shorter path on the mean, were the bearing known
    LOOK_AHEAD_S from now.

    Far from the target, a path is longer than the way that it gains towards it by ∫ v (1 − cos θ) dt: so
    much for turning to one side or the other until then, and R (|θ| − sin |θ|), with R = v/ω̄, for the
    shorter turn from there.
    """
    lag_s = p.lag * (1.0 - math.exp(-LOOK_AHEAD_S / p.lag)) if p.lag > 0.0 else 0.0
    coast_rad = yaw_rate_rad_s * lag_s
    turn_rad = turn * p.omega_max * (LOOK_AHEAD_S - lag_s)
    on_rad, back_rad = coast_rad + turn_rad, coast_rad - turn_rad
    difference = 0.0
    for k in range(readout.AZIMUTHS):
        left_rad = readout.AZIMUTH_RAD[k] - heading_rad
        difference += weights[k] * (excess_m(p, left_rad, on_rad) - excess_m(p, left_rad, back_rad))
    return turn if difference <= 0.0 else -turn


def excess_m(p: SeekParameters, left_rad: float, turned_rad: float) -> float:
    """How much longer the path becomes by a turn of LOOK_AHEAD_S, the target `left_rad` to the left."""
    after = min(abs(model.wrap(left_rad - turned_rad)), p.turn_on_spot)
    # the mean of a cosine over an arc, to the second order
    ahead = math.cos(left_rad - 0.5 * turned_rad) * (1.0 - turned_rad * turned_rad / 24.0)
    return p.v * LOOK_AHEAD_S * (1.0 - ahead) + p.v / p.omega_max * (after - math.sin(after))


def follow(p: SeekParameters, s: Seeking, dt_s: float, yaw_rate_rad_s: float) -> tuple[Seeking, Command]:
    """Steer to the target against the drift, and stop where it will surely rest within the radius."""
    q, m, was = s.fix, s.motion, s.manner
    hx, hy = math.cos(m.heading), math.sin(m.heading)
    # the target as seen from where the vehicle would come to rest if it were stopped now
    ex = q.x - p.velocity_lag * m.vx
    ey = q.y - p.velocity_lag * m.vy
    rest_m = math.hypot(ex, ey)
    ahead = ex * hx + ey * hy
    aside = hy * ex - hx * ey
    sigma_m = math.sqrt(max(q.xx + q.yy, 0.0))
    near_s = was.near_s + dt_s if rest_m < 2.0 * p.radius else max(was.near_s - dt_s, 0.0)
    sure = p.stop_sigma * max(1.0 - (near_s / PATIENCE_S) ** 2, 0.0)
    if was.rests:
        rests = rest_m < 0.9 * p.radius
    else:
        arrived = rest_m < 0.3 * p.radius or was.stands or ahead < 0.0
        rests = arrived and rest_m + max(sure * sigma_m, 0.4 * p.radius) < p.radius
    if rests:
        manner = Manner(was.turn, True, False, near_s)
        return with_manner(s, manner), Command(0.0, 0.0, REST)
    # a target inside the turning circle cannot be reached by turning on, one behind only by a long way: turn
    # on the spot; or, while a target inside is too uncertain for that, fly the circle, which tells its place
    turning_radius = p.v / p.omega_max
    inside = math.hypot(ahead, abs(aside) - turning_radius) < turning_radius
    off = math.atan2(aside, ahead)
    behind = abs(off) > p.turn_on_spot
    if abs(off) > (AIMED_RAD if was.stands else TURN_RAD) and (inside or behind or was.stands):
        if inside and sure * sigma_m > 0.6 * p.radius:
            manner = Manner(was.turn, False, False, near_s)
            return with_manner(s, manner), Command(p.v, was.turn * p.omega_max, TRACK)
        omega = yaw_rate(p, was.turn, turning_radius, off, 0.0, yaw_rate_rad_s)
        if p.paper_law:  # made for a vehicle that flies: it hardly turns one that stands
            omega = -math.copysign(p.omega_max, off)
        manner = Manner(side(omega, was.turn), False, True, near_s)
        return with_manner(s, manner), Command(0.0, omega, TRACK)
    # the velocity follows the nose: aim from where it will have done so
    ax = ex + p.velocity_lag * p.v * hx
    ay = ey + p.velocity_lag * p.v * hy
    d = math.hypot(ax, ay) + drift.TINY
    theta = math.atan2(hy * ax - hx * ay, hx * ax + hy * ay)
    across = (ax * q.wy - ay * q.wx) / d
    crab = math.asin(model.clip(across / p.v, CRAB_MAX))
    omega = yaw_rate(p, was.turn, d, theta, crab, yaw_rate_rad_s)
    manner = Manner(side(omega, was.turn), False, False, near_s)
    return with_manner(s, manner), Command(p.v, omega, TRACK)


def yaw_rate(
    p: SeekParameters, turn: float, d_m: float, theta_rad: float, crab_rad: float, yaw_rate_rad_s: float
) -> float:
    """The yaw rate, within bounds, that brings the heading to `crab_rad` right of the target."""
    if p.paper_law:
        gains = lq.paper_gains(d_m, theta_rad, p.v, p.q1, p.q2, p.r)
        return model.clip(lq.paper_yaw_rate(d_m, theta_rad + crab_rad, gains), p.omega_max)
    error = model.wrap(theta_rad + crab_rad)
    if abs(error) > math.pi - p.turn_through and error * turn > 0.0:
        # almost straight astern, turning on is as near as turning back
        error -= math.copysign(2.0 * math.pi, error)
    gains = lq.bearing_gains(max(d_m, 0.5 * p.radius), p.v, p.lag, p.q1, p.q2, p.r)
    return model.clip(lq.bearing_yaw_rate(error, yaw_rate_rad_s, gains), p.omega_max)


def side(omega_rad_s: float, before: float) -> float:
    """+1.0 for a turn to the left, −1.0 to the right; flying straight on changes nothing."""
    return before if omega_rad_s == 0.0 else math.copysign(1.0, omega_rad_s)


def with_manner(s: Seeking, manner: Manner) -> Seeking:
    """The same state with another manner."""
    return Seeking(
        s.accepted,
        s.noise,
        s.mode,
        s.since_s,
        s.agreed,
        s.nearest_m,
        s.motion,
        s.heard,
        s.lift,
        s.fix,
        manner,
    )
