"""A linear filter on a lift that knows of drift: half the squared distance, the target's position, the drift.

The frame is dead-reckoned: its axes are fixed, with the heading zero where guidance began. Half the squared
range is linear in the lift, so the filter needs no guess of the bearing, and no linearisation while the
bearing is open. That its first entry is half the square of the next two is used where the estimate is *read*
(`readout`), never fed back: an early, wrong bearing cannot harden.

The drift w is the motion that the dead reckoning does not see: wind, or a wrong velocity. What it does to
the distance is ρ·w, a product of two unknowns. While the bearing is open it is a state of its own; once the
bearing is known (`settle`) it is linear enough, and the state's place is taken by the bias of the gyro.
"""

from __future__ import annotations

import math

import msgspec

TINY = 1e-9
"""Variances that are divided by are kept above this."""


class Noise(msgspec.Struct, frozen=True, gc=False):
    """What the filter expects of the vehicle.

    One-sigma priors: `drift_m_s` of each component of the drift, `gyro_rad_s` of the gyro's bias. The drift
    varies by `drift_change_m_s` (one-sigma, Gauss-Markov with time constant `drift_tau_s`). Variances per
    second: `position` (m²/s) for an imprecise velocity, `turn` (rad²/s) for an imprecise yaw rate.
    """

    drift_m_s: float
    drift_change_m_s: float
    drift_tau_s: float
    gyro_rad_s: float
    position: float
    turn: float


class DriftLift(msgspec.Struct, frozen=True, gc=False):
    """Mean and covariance (its upper triangle) of the six states.

    x1: half the squared horizontal distance; (x, y) = ρ: the target relative to the vehicle; (wx, wy): the
    drift; s: ρ·w before `settle`, the gyro's bias after.
    """

    x1: float
    x: float
    y: float
    wx: float
    wy: float
    s: float
    p00: float
    p01: float
    p02: float
    p03: float
    p04: float
    p05: float
    p11: float
    p12: float
    p13: float
    p14: float
    p15: float
    p22: float
    p23: float
    p24: float
    p25: float
    p33: float
    p34: float
    p35: float
    p44: float
    p45: float
    p55: float


class Known(msgspec.Struct, frozen=True, gc=False):
    """Target and drift as read out last: what the filter is linearised at once the bearing is known."""

    x: float
    y: float
    wx: float
    wy: float


def start(d_m: float, sigma_m: float, n: Noise) -> DriftLift:
    """A distance, the median of five ranges (its variance is 0.3 σ²), and no bearing at all: on a circle of
    radius d, E[x²] = E[y²] = d²/2."""
    half = 0.5 * d_m * d_m
    drift = n.drift_m_s * n.drift_m_s
    z = 0.0
    return DriftLift(
        half, z, z, z, z, z,
        0.3 * d_m * d_m * sigma_m * sigma_m + 1e-4, z, z, z, z, z,
        half, z, z, z, z,
        half, z, z, z,
        drift, z, z,
        drift, z,
        drift * d_m * d_m + TINY,
    )  # fmt: skip


def distance(f: DriftLift) -> float:
    """The distance that belongs to x1, 0 where it is negative (which noise makes it, close to the target)."""
    return math.sqrt(2.0 * f.x1) if f.x1 > 0.0 else 0.0


def predict(
    f: DriftLift, n: Noise, k: Known, bearing_is_known: bool, dt_s: float, mx: float, my: float
) -> DriftLift:
    """The vehicle moved by (mx, my) within dt_s, as far as dead reckoning can tell."""
    x1, x, y, wx, wy, s = f.x1, f.x, f.y, f.wx, f.wy, f.s
    p00, p01, p02, p03, p04, p05 = f.p00, f.p01, f.p02, f.p03, f.p04, f.p05
    p11, p12, p13, p14, p15 = f.p11, f.p12, f.p13, f.p14, f.p15
    p22, p23, p24, p25 = f.p22, f.p23, f.p24, f.p25
    p33, p34, p35, p44, p45, p55 = f.p33, f.p34, f.p35, f.p44, f.p45, f.p55
    keep = max(1.0 - dt_s / n.drift_tau_s, 0.0)
    keep2 = keep * keep
    more = n.drift_change_m_s * n.drift_change_m_s * 2.0 / n.drift_tau_s * dt_s
    position = n.position * dt_s
    turn = n.turn * dt_s
    xs, ys = k.x, k.y
    if bearing_is_known:
        # ρ·w about what was read out last, and the gyro's bias, which turns ρ around the vehicle
        tx, ty = mx + k.wx * dt_s, my + k.wy * dt_s
        gx = ax = xs * dt_s
        gy = ay = ys * dt_s
        b = ex = ey = more_s = 0.0
        x1 += -x * tx - y * ty + 0.5 * (tx * tx + ty * ty) - ax * (wx - k.wx) - ay * (wy - k.wy)
        x -= mx + wx * dt_s + s * gy
        y -= my + wy * dt_s - s * gx
    else:
        tx = ex = mx
        ty = ey = my
        b = dt_s
        ax = ay = gx = gy = 0.0
        more_s = more * 2.0 * max(x1, 0.0)
        x1 += -x * tx - y * ty + 0.5 * (tx * tx + ty * ty) - s * dt_s
        x -= mx + wx * dt_s
        y -= my + wy * dt_s
        s -= tx * wx + ty * wy + (wx * wx + wy * wy) * dt_s
    xs -= tx
    ys -= ty
    # P ← F P Fᵀ + Q: the rows first, then the columns
    m00 = p00 - tx * p01 - ty * p02 - ax * p03 - ay * p04 - b * p05
    m01 = p01 - tx * p11 - ty * p12 - ax * p13 - ay * p14 - b * p15
    m02 = p02 - tx * p12 - ty * p22 - ax * p23 - ay * p24 - b * p25
    m03 = p03 - tx * p13 - ty * p23 - ax * p33 - ay * p34 - b * p35
    m04 = p04 - tx * p14 - ty * p24 - ax * p34 - ay * p44 - b * p45
    m05 = p05 - tx * p15 - ty * p25 - ax * p35 - ay * p45 - b * p55
    m11 = p11 - dt_s * p13 - gy * p15
    m12 = p12 - dt_s * p23 - gy * p25
    m13 = p13 - dt_s * p33 - gy * p35
    m14 = p14 - dt_s * p34 - gy * p45
    m15 = p15 - dt_s * p35 - gy * p55
    m22 = p22 - dt_s * p24 + gx * p25
    m23 = p23 - dt_s * p34 + gx * p35
    m24 = p24 - dt_s * p44 + gx * p45
    m25 = p25 - dt_s * p45 + gx * p55
    m53 = p35 - ex * p33 - ey * p34
    m54 = p45 - ex * p34 - ey * p44
    m55 = p55 - ex * p35 - ey * p45
    return DriftLift(
        x1, x, y, keep * wx, keep * wy, s,
        m00 - tx * m01 - ty * m02 - ax * m03 - ay * m04 - b * m05 + position * (xs * xs + ys * ys),
        m01 - dt_s * m03 - gy * m05 + position * xs, m02 - dt_s * m04 + gx * m05 + position * ys,
        keep * m03, keep * m04, m05 - ex * m03 - ey * m04,
        m11 - dt_s * m13 - gy * m15 + position + turn * ys * ys,
        m12 - dt_s * m14 + gx * m15 - turn * xs * ys, keep * m13, keep * m14, m15 - ex * m13 - ey * m14,
        m22 - dt_s * m24 + gx * m25 + position + turn * xs * xs, keep * m23, keep * m24,
        m25 - ex * m23 - ey * m24,
        keep2 * p33 + more, keep2 * p34, keep * m53,
        keep2 * p44 + more, keep * m54,
        m55 - ex * m53 - ey * m54 + more_s,
    )  # fmt: skip


def correct(f: DriftLift, innovation: float, variance: float) -> DriftLift:
    """A measurement of x1 that differs from it by `innovation`; `variance` is that of the innovation."""
    p00, p01, p02, p03, p04, p05 = f.p00, f.p01, f.p02, f.p03, f.p04, f.p05
    k0, k1, k2 = p00 / variance, p01 / variance, p02 / variance
    k3, k4, k5 = p03 / variance, p04 / variance, p05 / variance
    e = innovation
    return DriftLift(
        f.x1 + k0 * e, f.x + k1 * e, f.y + k2 * e, f.wx + k3 * e, f.wy + k4 * e, f.s + k5 * e,
        p00 - k0 * p00, p01 - k0 * p01, p02 - k0 * p02, p03 - k0 * p03, p04 - k0 * p04, p05 - k0 * p05,
        f.p11 - k1 * p01, f.p12 - k1 * p02, f.p13 - k1 * p03, f.p14 - k1 * p04, f.p15 - k1 * p05,
        f.p22 - k2 * p02, f.p23 - k2 * p03, f.p24 - k2 * p04, f.p25 - k2 * p05,
        f.p33 - k3 * p03, f.p34 - k3 * p04, f.p35 - k3 * p05,
        f.p44 - k4 * p04, f.p45 - k4 * p05,
        f.p55 - k5 * p05,
    )  # fmt: skip


def settle(f: DriftLift, x: float, y: float, spread_m2: float, n: Noise) -> DriftLift:
    """The bearing is known: s = ρ·w becomes a measurement of w, with ρ = (x, y) known but for `spread_m2`."""
    b0 = f.p05 - x * f.p03 - y * f.p04
    b1 = f.p15 - x * f.p13 - y * f.p14
    b2 = f.p25 - x * f.p23 - y * f.p24
    b3 = f.p35 - x * f.p33 - y * f.p34
    b4 = f.p45 - x * f.p34 - y * f.p44
    b5 = f.p55 - x * f.p35 - y * f.p45
    t = max(b5 - x * b3 - y * b4, 0.0) + n.drift_m_s * n.drift_m_s * spread_m2 + TINY
    k0, k1, k2, k3, k4 = b0 / t, b1 / t, b2 / t, b3 / t, b4 / t
    e = x * f.wx + y * f.wy - f.s
    z = 0.0
    return DriftLift(
        f.x1 + k0 * e, f.x + k1 * e, f.y + k2 * e, f.wx + k3 * e, f.wy + k4 * e, z,
        f.p00 - k0 * b0, f.p01 - k0 * b1, f.p02 - k0 * b2, f.p03 - k0 * b3, f.p04 - k0 * b4, z,
        f.p11 - k1 * b1, f.p12 - k1 * b2, f.p13 - k1 * b3, f.p14 - k1 * b4, z,
        f.p22 - k2 * b2, f.p23 - k2 * b3, f.p24 - k2 * b4, z,
        f.p33 - k3 * b3, f.p34 - k3 * b4, z,
        f.p44 - k4 * b4, z,
        n.gyro_rad_s * n.gyro_rad_s,
    )  # fmt: skip


def widen(f: DriftLift, spread_m2: float, n: Noise) -> DriftLift:
    """The same mean with less trust in it: the priors of `n` and `spread_m2` on the position come on top."""
    drift = n.drift_m_s * n.drift_m_s
    return DriftLift(
        f.x1, f.x, f.y, f.wx, f.wy, f.s,
        f.p00, f.p01, f.p02, f.p03, f.p04, f.p05,
        f.p11 + spread_m2, f.p12, f.p13, f.p14, f.p15,
        f.p22 + spread_m2, f.p23, f.p24, f.p25,
        f.p33 + drift, f.p34, f.p35,
        f.p44 + drift, f.p45,
        f.p55 + n.gyro_rad_s * n.gyro_rad_s,
    )  # fmt: skip
