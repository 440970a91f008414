"""The geometry of one vehicle and one target: Eq. (1) to (7) and (15) to (22) of the paper.

Plain floats, `math` only. Distances are horizontal, in metres; the frame and the signs are those of
`companion.types`: θ = heading − azimuth of the line of sight, θ > 0 means the target is on the right.
"""

from __future__ import annotations

import math
from typing import NamedTuple

TWO_PI = 2.0 * math.pi
NEAR_M = 0.15
"""Distances below this count as this much wherever something is divided by d."""


class Lifted(NamedTuple):
    """The state x_o = [d²/2, d sin θ, d cos θ] in which motion and measurement are both linear.

    x2 is the right-hand and x3 the forward component of the target's position seen from the vehicle. As an
    estimate its three entries are free of each other: x1 = (x2² + x3²)/2 need not hold.
    """

    x1: float
    x2: float
    x3: float


class Step(NamedTuple):
    """How the vehicle moved for a short while, in the body axes at its beginning; see `step`."""

    forward_m: float
    left_m: float
    cos_turn: float
    sin_turn: float


def wrap(angle_rad: float) -> float:
    """Bring an angle into (−π, π]. (The [0, 2π) of Eq. (36) would tear the feedback apart at θ = 0.)"""
    if -math.pi < angle_rad <= math.pi:
        return angle_rad
    turned = angle_rad - TWO_PI * math.ceil((angle_rad - math.pi) / TWO_PI)
    return turned if abs(turned) < math.pi else math.pi  # which rounding may have passed


def clip(value: float, bound: float) -> float:
    """Limit to [−bound, bound]."""
    return -bound if value < -bound else bound if value > bound else value


def pose_rates(heading_rad: float, v_m_s: float, omega_rad_s: float) -> tuple[float, float, float]:
    """Eq. (1), Eq. (2): rates of x, y (m/s, ENU) and of the heading (rad/s)."""
    return v_m_s * math.cos(heading_rad), v_m_s * math.sin(heading_rad), omega_rad_s


def is_captured(d_m: float, radius_m: float, margin_m: float, was_captured: bool) -> bool:
    """Eq. (3): True where the speed is 0, False where it is v̄.

    The paper switches at ε exactly, where a noisy estimate chatters and may stop the vehicle outside. Here it
    stops at ε − margin, and goes on if the estimate, which gets better at rest, turns out to be beyond ε.
    """
    return d_m <= (radius_m if was_captured else radius_m - margin_m)


def polar_rates(d_m: float, theta_rad: float, v_m_s: float, omega_rad_s: float) -> tuple[float, float]:
    """Eq. (4), Eq. (5), in state-space form Eq. (6): rates of d and θ; the output Eq. (7) is d itself.

    Erratum: the second entry of f is printed without its fraction bar, it is (v/x1) sin x2. And the bearing
    of the paper's example, θ_T(0) = 0.68, is the azimuth of the line of sight: θ_T(0) is 0.885.
    """
    return -v_m_s * math.cos(theta_rad), omega_rad_s + v_m_s / d_m * math.sin(theta_rad)


class Jacobian(NamedTuple):
    """A = [[0, a], [−b, c]] of the linearised motion."""

    a: float
    b: float
    c: float


def jacobian(d_m: float, theta_rad: float, v_m_s: float) -> Jacobian:
    """Eq. (15), Eq. (16), Eq. (17): A = ∂f/∂x = [[0, v s], [−v s/d², v c/d]], s = sin θ, c = cos θ.

    Erratum: Eq. (17) is printed without its fraction bars. The affine rest f(x̂) − A x̂ of Eq. (16) is
    [−v(c + θ s), v(2s − θ c)/d]; the paper calls it a known disturbance and drops it, and so does `lq`.
    """
    d = max(d_m, NEAR_M)
    s = math.sin(theta_rad)
    return Jacobian(v_m_s * s, v_m_s * s / (d * d), v_m_s * math.cos(theta_rad) / d)


def lift(d_m: float, theta_rad: float) -> Lifted:
    """The lifted state that belongs to a distance and a bearing."""
    return Lifted(0.5 * d_m * d_m, d_m * math.sin(theta_rad), d_m * math.cos(theta_rad))


def bearing(x: Lifted) -> float:
    """Eq. (26): θ̂ = ∠[x̂3, x̂2], in (−π, π]; 0 where both are 0."""
    return wrap(math.atan2(x.x2, x.x3))


def distance(x: Lifted) -> float:
    """d̂ = √(2 x̂1), 0 where x̂1 is negative (which noise makes it, close to the target)."""
    return math.sqrt(max(2.0 * x.x1, 0.0))


def lifted_range(range_m: float, dh_m: float) -> float:
    """Eq. (22): the output y_o = d²/2, from a slant range and the height above the beacon.

    May be negative: overhead, the noise makes a range shorter than the height.
    """
    return 0.5 * (range_m * range_m - dh_m * dh_m)


def step(dt_s: float, forward_m_s: float, left_m_s: float, omega_rad_s: float) -> Step:
    """A motion at constant body velocity and yaw rate: the chord, and the turn.

    The chord lies along the heading at half time, which is exact up to a factor sinc(ω dt/2).
    """
    half = 0.5 * omega_rad_s * dt_s
    c = math.cos(half)
    s = math.sin(half)
    return Step(
        (forward_m_s * c - left_m_s * s) * dt_s,
        (forward_m_s * s + left_m_s * c) * dt_s,
        1.0 - 2.0 * s * s,
        2.0 * s * c,
    )


def flow(x: Lifted, m: Step) -> Lifted:
    """Eq. (18), Eq. (19), Eq. (20), as one system Eq. (21): ẋ = Ā(ω) x + δ, solved exactly over one step.

    The vehicle moves along its chord, then turns. A velocity w to the left, which the paper has not, adds
    w x2 to ẋ1 and w to ẋ2.
    """
    x1, x2, x3 = x
    forward, left, c, s = m
    right = x2 + left
    ahead = x3 - forward
    return Lifted(
        x1 - forward * x3 + left * x2 + 0.5 * (forward * forward + left * left),
        c * right + s * ahead,
        c * ahead - s * right,
    )


def shortest_path_m(d_m: float, theta_rad: float, radius_m: float, v_m_s: float, omega_rad_s: float) -> float:
    """Length of the shortest path into the disc of `radius_m` around the target, turning at most so tightly.

    The vehicle moves forward at `v_m_s` > 0 and turns at up to `omega_rad_s` > 0 to either side, so that no
    turn is tighter than ρ = v/ω. This is the bound that every flown path is held against.

    By Pontryagin's principle the heading is worth nothing at the end, which leaves three kinds of path: an
    arc, then straight towards the centre of the disc; one arc that ends on the disc; and, for a disc inside
    a turning circle, an arc to the other side and one longer than π back. The shortest of them is meant.
    """
    if d_m <= radius_m:
        return 0.0
    rho = v_m_s / omega_rad_s
    ahead = d_m * math.cos(theta_rad)
    right = d_m * math.sin(theta_rad)
    # everything once for a first turn to the right and once, mirrored, for one to the left
    return min(
        _shortest_turning_right(ahead, right, radius_m, rho),
        _shortest_turning_right(ahead, -right, radius_m, rho),
    )


def _shortest_turning_right(ahead: float, right: float, radius: float, rho: float) -> float:
    """The same for paths whose first arc, of any length, turns right; infinite if there is none.

    Seen from the centre of the right-hand turning circle, the vehicle starts at azimuth 0 and moves to
    growing azimuths (clockwise): a point `out` to the left of that centre and `ahead` of it.
    """
    out = rho - right
    far = math.hypot(ahead, out)
    toward = math.atan2(ahead, out)
    best = math.inf
    # arc, then straight: leave the circle on the tangent that runs through the disc's centre
    if far * far >= rho * rho + radius * radius:
        tangent = math.sqrt(far * far - rho * rho)
        best = rho * _turned(toward - math.atan2(tangent, rho)) + tangent - radius
    # one arc: the first point of the circle that lies on the disc
    if abs(far - rho) <= radius and far > 0.0:
        best = min(best, rho * _turned(toward - _angle(rho, far, radius)))
    # two arcs: switch sides at distance m from the target T, where switch, T and end lie on one line in this
    # order; the power of T with respect to the second circle then is −m radius
    if far > rho:
        m = 0.25 * (math.sqrt(radius * radius + 8.0 * (far * far - rho * rho)) - radius)
        chord = m + radius
        if chord <= 2.0 * rho and abs(far - rho) <= m <= far + rho:
            spread = _angle(rho, far, m)
            back = rho * (TWO_PI - 2.0 * math.asin(chord / (2.0 * rho)))
            best = min(best, rho * _turned(toward - spread) + back, rho * _turned(toward + spread) + back)
    return best


def _turned(angle_rad: float) -> float:
    """The angle in [0, 2π); one that rounding made just negative is none, not a full turn."""
    turned = angle_rad % TWO_PI
    return turned if turned < TWO_PI - 1e-7 else 0.0


def _angle(a: float, b: float, opposite: float) -> float:
    """Angle between the sides a and b of a triangle, from its third side."""
    return math.acos(clip((a * a + b * b - opposite * opposite) / (2.0 * a * b), 1.0))
