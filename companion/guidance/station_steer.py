"""Flying to a station that is known by now, and staying there: with the speeds 0 and v̄ alone, against drift.

The vehicle stops where its lag carries it onto the station. Against a drift it comes to rest up the drift,
far enough to be carried in while it turns to face it; then it creeps back whenever it has been carried off.
A vehicle that cannot stop flies the smallest circle around the station instead.
"""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace

from companion.guidance import lq
from companion.guidance.model import clip, wrap
from companion.guidance.scheme import STAY, TRACK, Command

DRIFT_FLOOR_M_S = 0.03
"""An estimated drift of this size may be none at all, and is taken for none."""
CREEP_ON_M = 0.07
CREEP_OFF_M = -0.05
"""Against a drift, creep from the first until the second of these distances ahead (below 0: past it)."""
CREEP_RADII = 0.2
"""Without a drift, creep back from this part of the radius."""
FACING_RAD = 0.7
"""The vehicle faces the drift within this."""
TURN_M = 0.09
"""Nearer than this the direction of the station means nothing, and the vehicle does not turn to it."""
ALIGNED_RAD = 0.3
"""Without a drift, the vehicle turns on the spot until the station is ahead within this."""
ASIDE_RAD = 0.5
"""A station further aside than this may lie inside the tightest turn."""
LOOK_S = 2.5
"""At the station, head for the point from which the drift would bring the vehicle here in this time."""
SETTLE_S = 2.0
"""The vehicle stays at the station after it has been near for this long."""
NEAR, FAR = 0.5, 1.0
"""Near is within the first part of the radius; what stays is near until it is beyond the second."""
CIRCLE_MARGIN = 1.15
"""The smallest circle is this much wider than the tightest turn."""


class Law(msgspec.Struct, frozen=True, gc=False):
    """Constants of the vehicle and of the steering law; SI units, weights as in `GuidanceSettings`."""

    v: float
    omega_max: float
    yaw_rate_lag: float
    speed_lag: float
    radius: float
    turn_through: float
    q1: float
    q2: float
    r: float
    can_stop: bool


class Situation(msgspec.Struct, frozen=True, gc=False):
    """The station seen from the vehicle, the heading, the velocity through the air, and the drift: one frame,
    metres, radians, m/s."""

    ex: float
    ey: float
    heading: float
    vx: float
    vy: float
    wx: float
    wy: float


class Stay(msgspec.Struct, frozen=True, gc=False):
    """Whether the vehicle has come to the station, whether it creeps back, and for how long the station has
    seemed near: it stays once that is `SETTLE_S`, as the estimate settles while the vehicle stands."""

    is_there: bool
    creeps: bool
    near_s: float


AWAY = Stay(False, False, 0.0)


def steer(law: Law, q: Situation, stay: Stay, dt_s: float, yaw_rate_rad_s: float) -> tuple[Stay, Command]:
    """The next command, dt_s after the last. STAY means settled inside the radius; all else is TRACK."""
    heading = q.heading
    w = math.hypot(q.wx, q.wy) + 1e-9
    real = max(0.0, 1.0 - (DRIFT_FLOOR_M_S / w) ** 2)
    wx, wy, w = real * q.wx, real * q.wy, real * w
    q = replace(q, wx=wx, wy=wy)
    if not law.can_stop:
        return _circle(law, q, stay, dt_s, yaw_rate_rad_s)
    # the station as it will be seen when the vehicle has lost its speed
    rx, ry = q.ex - law.speed_lag * q.vx, q.ey - law.speed_lag * q.vy
    turn = abs(wrap(heading - math.atan2(-wy, -wx))) if w > 0.0 else 0.0
    if stay.is_there:
        return _hold(law, q, stay, (rx, ry), turn, dt_s, yaw_rate_rad_s)
    # stop so far up the drift that it carries the vehicle in while that turns
    wait_s = turn / law.omega_max + law.yaw_rate_lag * min(turn, 1.0)
    ax, ay = rx - wx * wait_s, ry - wy * wait_s
    near = math.hypot(ax, ay)
    ahead = ax * math.cos(heading) + ay * math.sin(heading)
    if near < 0.1 * law.radius or (near < 0.5 * law.radius and ahead < 0.02):
        return Stay(True, False, 0.0), Command(0.0, 0.0, TRACK)
    theta = _bearing(ax, ay, heading)
    crab = _crab(law, ax, ay, wx, wy) * min(1.0, 2.0 * near)
    # what lies inside the tightest turn would be circled for ever: turn to it on the spot
    inside = abs(theta) > ASIDE_RAD and near < 2.0 * law.v / law.omega_max * abs(math.sin(theta))
    v = 0.0 if inside else law.v
    return AWAY, Command(v, _approach_rate(law, theta, crab, near, yaw_rate_rad_s), TRACK)


def _approach_rate(law: Law, theta: float, crab: float, near: float, yaw_rate: float) -> float:
    gains = lq.bearing_gains(near, law.v, law.yaw_rate_lag, law.q1, law.q2, law.r)
    omega = clip(lq.bearing_yaw_rate(wrap(theta + crab), yaw_rate, gains), law.omega_max)
    turns = abs(yaw_rate) > 0.5 * law.omega_max
    if abs(theta) > math.pi - law.turn_through and turns and omega * yaw_rate < 0.0:
        # almost straight astern, turning on is as near as turning back
        return math.copysign(law.omega_max, yaw_rate)
    return omega


def _hold(
    law: Law, q: Situation, stay: Stay, rest: tuple[float, float], turn: float, dt: float, yaw_rate: float
) -> tuple[Stay, Command]:
    """At the station: face the drift, creep back where it has carried the vehicle off."""
    rx, ry = rest
    drifts = q.wx != 0.0 or q.wy != 0.0
    gx, gy = rx - law.speed_lag * q.wx, ry - law.speed_lag * q.wy
    lx, ly = gx - q.wx * LOOK_S, gy - q.wy * LOOK_S
    away = math.hypot(lx, ly)
    theta = _bearing(lx, ly, q.heading)
    back = gx * math.cos(q.heading) + gy * math.sin(q.heading)
    off = math.hypot(rx, ry)
    if stay.creeps:
        creeps = back > (CREEP_OFF_M if drifts else 0.0)
    elif drifts:
        creeps = back > CREEP_ON_M and turn < FACING_RAD
    else:
        creeps = off > CREEP_RADII * law.radius and abs(theta) < ALIGNED_RAD
    # on the spot, the direction of a station that is almost reached means nothing
    error = theta if creeps or away > TURN_M else 0.0
    gains = lq.bearing_gains(1.0, law.v, law.yaw_rate_lag, 0.25 * law.q1, law.q2, law.r)
    omega = clip(lq.bearing_yaw_rate(error, yaw_rate, gains), law.omega_max)
    near_s = _near_s(stay, math.hypot(q.ex, q.ey), law.radius, dt)
    stay = Stay(off <= 2.5 * law.radius, creeps, near_s)
    return stay, Command(law.v if creeps else 0.0, omega, _purpose(near_s))


def _near_s(stay: Stay, away_m: float, radius_m: float, dt_s: float) -> float:
    is_near = away_m < (FAR if stay.near_s > SETTLE_S else NEAR) * radius_m
    return min(stay.near_s + dt_s, SETTLE_S + 1.0) if is_near else 0.0


def _purpose(near_s: float) -> int:
    return STAY if near_s > SETTLE_S else TRACK


def _circle(law: Law, q: Situation, stay: Stay, dt: float, yaw_rate: float) -> tuple[Stay, Command]:
    """Fly to the circle on a tangent and stay on it, counter-clockwise, the drift crabbed away."""
    wx, wy = q.wx, q.wy
    rho = CIRCLE_MARGIN * (law.v + math.hypot(wx, wy)) / law.omega_max
    d = math.hypot(q.ex, q.ey)
    aside = min(math.pi, max(0.0, 0.5 * math.pi - math.atan(2.0 * (d - rho) / rho)))
    # the course: the line of sight, turned to the right by `aside`
    los = math.atan2(q.ey, q.ex) - aside
    theta = wrap(q.heading - los)
    crab = _crab(law, math.cos(los), math.sin(los), wx, wy)
    gains = lq.bearing_gains(max(d, rho), law.v, law.yaw_rate_lag, law.q1, law.q2, law.r)
    around = law.v / rho * math.sin(aside) if d < 2.0 * rho else 0.0
    omega = lq.bearing_yaw_rate(wrap(theta + crab), yaw_rate - around, gains) + around
    near_s = _near_s(stay, d, 3.0 * rho, dt)
    return Stay(False, False, near_s), Command(law.v, clip(omega, law.omega_max), _purpose(near_s))


def _bearing(x: float, y: float, heading: float) -> float:
    """θ of a point seen from the vehicle: heading minus its azimuth."""
    return math.atan2(
        math.sin(heading) * x - math.cos(heading) * y, math.cos(heading) * x + math.sin(heading) * y
    )


def _crab(law: Law, x: float, y: float, wx: float, wy: float) -> float:
    """The angle by which the heading must lie to the right of a course so that the drift is cancelled."""
    cross = (x * wy - y * wx) / max(math.hypot(x, y), 1e-6)
    return math.asin(clip(cross / law.v, 0.9))
