"""The observer of the default: a discrete Kalman filter on the lift, Eq. (27) to (31) done right.

Motion and measurement are linear in the lift (`model.Lifted`), so the filter needs neither a linearisation
nor a guess of the bearing: it starts with x2 = x3 = 0 and a variance that covers the circle.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import msgspec

from companion.guidance.model import Lifted, Step, flow, lifted_range

TINY = 1e-12
"""Variances are kept above this against rounding."""


class Gaussian(NamedTuple):
    """Mean and covariance (its upper triangle) of the lifted state."""

    x: Lifted
    p11: float
    p12: float
    p13: float
    p22: float
    p23: float
    p33: float


class Measured(msgspec.Struct, frozen=True, gc=False):
    """A measurement of d²/2 (m²), and its variance (m⁴)."""

    y: float
    variance: float


def measured(
    range_m: float, sigma_m: float, dh_m: float, sigma_dh_m: float, expected_range_m: float
) -> Measured:
    """Eq. (28): y = d²/2 + noise, from one slant range with its sigma and the height above the beacon.

    Erratum: the paper feeds y where y_o is meant, and takes the noise's variance r_o as constant. With range
    noise σ, r² has the mean ρ² + σ² (ρ the true range), so y = (r² − Δh² − σ²)/2; its variance is
    ρ²σ² + Δh²σ_h² + σ⁴/2. For ρ the range expected by the filter is used: with the measured one, readings
    that happen to be short would weigh more.
    """
    var = sigma_m * sigma_m
    slant = dh_m * sigma_dh_m
    return Measured(
        lifted_range(range_m, dh_m) - 0.5 * var,
        expected_range_m * expected_range_m * var + slant * slant + 0.5 * var * var,
    )


def start(m: Measured) -> Gaussian:
    """The belief after the first measurement (a median of five): a distance, and no bearing at all.

    A bearing spread evenly over the circle has E[x2²] = E[x3²] = d²/2 = y. The variance of a median of five
    is 0.29 of a single reading's; half is kept, as readings are not always as good as they say.
    """
    spread = max(m.y, 0.0) + math.sqrt(m.variance)
    return Gaussian(Lifted(m.y, 0.0, 0.0), 0.5 * m.variance + 1e-4, 0.0, 0.0, spread, 0.0, spread)


def predict(g: Gaussian, m: Step, dt_s: float, q_position: float, q_turn: float) -> Gaussian:
    """Eq. (27), and the prediction half of Eq. (31): the vehicle moved by `m`.

    Process noise, as variance per second: `q_position` (m²/s) on x2 and x3 each, for an imprecise velocity,
    and `q_turn` (rad²/s) on the angle between them, for an imprecise yaw rate.

    Erratum: Eq. (31) is an algebraic equation, which has no solution at ω = 0. The covariance must be
    carried along, here P ← F P Fᵀ + Q with F the exact transition. And Q_o is the covariance of the process
    noise, not of a measurement.
    """
    x = flow(g.x, m)
    _, p11, p12, p13, p22, p23, p33 = g
    forward, w, c, s = m
    f = -forward
    # P ← F1 P F1ᵀ for the chord, F1 = [[1, w, f], [0, 1, 0], [0, 0, 1]]
    q12 = p12 + w * p22 + f * p23
    q13 = p13 + w * p23 + f * p33
    p11 += w * (p12 + q12) + f * (p13 + q13)
    # then the turn on rows and columns 2 and 3, and the noise
    cc, ss, cs = c * c, s * s, c * s
    cross = 2.0 * cs * p23
    shake = q_turn * dt_s
    noise = q_position * dt_s
    _, right, ahead = x
    return Gaussian(
        x,
        p11,
        c * q12 + s * q13,
        c * q13 - s * q12,
        cc * p22 + cross + ss * p33 + noise + shake * ahead * ahead,
        cs * (p33 - p22) + (cc - ss) * p23 - shake * right * ahead,
        ss * p22 - cross + cc * p33 + noise + shake * right * right,
    )


def is_plausible(g: Gaussian, m: Measured, gate_sigma: float) -> bool:
    """True if the measurement lies within `gate_sigma` standard deviations of what is expected."""
    innovation = m.y - g.x.x1
    return innovation * innovation < gate_sigma * gate_sigma * (g.p11 + m.variance)


def update(g: Gaussian, m: Measured) -> Gaussian:
    """Eq. (29), Eq. (30), and the measurement half of Eq. (31): one believed measurement of x1.

    With C = [1, 0, 0] the gain is the first column of P divided by S = p11 + variance.
    """
    x, p11, p12, p13, p22, p23, p33 = g
    s_inv = 1.0 / (p11 + m.variance)
    innovation = (m.y - x.x1) * s_inv
    rest = m.variance * s_inv
    return Gaussian(
        Lifted(x.x1 + p11 * innovation, x.x2 + p12 * innovation, x.x3 + p13 * innovation),
        max(p11 * rest, TINY),
        p12 * rest,
        p13 * rest,
        max(p22 - p12 * p12 * s_inv, TINY),
        p23 - p12 * p13 * s_inv,
        max(p33 - p13 * p13 * s_inv, TINY),
    )


def distance_sigma(g: Gaussian, d_m: float) -> float:
    """One sigma of d̂ = √(2 x1), in metres; near d = 0, where the root has no slope, its right scale."""
    root = math.sqrt(max(g.p11, TINY))
    return root / max(d_m, math.sqrt(root))


def bearing_sigma(g: Gaussian, d_m: float) -> float:
    """One sigma of θ̂ in radians, at most π: the spread across the line of sight over its length.

    The length is at least d̂/4: at the start x2 = x3 = 0 and all of the circle is possible.
    """
    length = math.hypot(g.x.x2, g.x.x3)
    c = g.x.x3 / length if length > TINY else 1.0
    s = g.x.x2 / length if length > TINY else 0.0
    across = max(g.p22 * c * c + g.p33 * s * s - 2.0 * g.p23 * s * c, 0.0)
    return min(math.sqrt(across) / max(length, 0.25 * d_m, 0.3), math.pi)


def median_of_five(values: tuple[float, float, float, float, float]) -> float:
    """The median, by comparisons."""
    a, b, c, d, e = values
    low = max(min(a, b), min(c, d))
    high = min(max(a, b), max(c, d))
    return max(min(low, high), min(max(low, high), e))
