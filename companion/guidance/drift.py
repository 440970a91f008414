"""A linear filter on a lift that knows of drift: half the squared distance, the target's position, the drift.

The frame is dead-reckoned: its axes are fixed, with the heading zero where guidance began. The drift w is the
motion that the dead reckoning does not see: wind, or a wrong velocity. With ρ the target as seen from the
vehicle, x1 = |ρ|²/2 changes by ρ·w, and that by |w|²: with these two as states of their own the motion is
linear, and so is the measurement, half the squared range. The filter needs no guess of the bearing and no
linearisation, and keeps all that the ranges tell.

That the states belong together, x1 = |ρ|²/2, s = ρ·w, u = |w|², is used where the estimate is *read*
(`readout.fix`), never fed back: an early, wrong bearing cannot harden.
"""

from __future__ import annotations

import math

import msgspec

TINY = 1e-9
"""Variances that are divided by are kept above this."""


class Noise(msgspec.Struct, frozen=True, gc=False):
    """What the filter expects of the vehicle.

    `drift_m_s`: one-sigma prior of each component of the drift. Variances per second: `drift` ((m/s)²/s) for
    its changes, `position` (m²/s) for an imprecise velocity, `turn` (rad²/s) for an imprecise yaw rate.
    """

    drift_m_s: float
    drift: float
    position: float
    turn: float


class Fix(msgspec.Struct, frozen=True, gc=False):
    """Where the target is relative to the vehicle, with the covariance of that, and the drift: the lift as
    read out last."""

    x: float
    y: float
    xx: float
    xy: float
    yy: float
    wx: float
    wy: float


class DriftLift(msgspec.Struct, frozen=True, gc=False):
    """Mean and covariance (its upper triangle) of the seven states.

    x1: half the squared horizontal distance; (x, y) = ρ: the target relative to the vehicle; (wx, wy) = w:
    the drift; s = ρ·w; u = |w|².
    """

    x1: float
    x: float
    y: float
    wx: float
    wy: float
    s: float
    u: float
    p00: float
    p01: float
    p02: float
    p03: float
    p04: float
    p05: float
    p06: float
    p11: float
    p12: float
    p13: float
    p14: float
    p15: float
    p16: float
    p22: float
    p23: float
    p24: float
    p25: float
    p26: float
    p33: float
    p34: float
    p35: float
    p36: float
    p44: float
    p45: float
    p46: float
    p55: float
    p56: float
    p66: float


def start(d_m: float, variance_m2: float, n: Noise) -> DriftLift:
    """A distance with its variance, and no bearing at all: on a circle of radius d, E[x²] = E[y²] = d²/2."""
    half = 0.5 * d_m * d_m
    drift = n.drift_m_s * n.drift_m_s
    z = 0.0
    return DriftLift(
        half, z, z, z, z, z, 2.0 * drift,
        d_m * d_m * variance_m2 + 1e-4, z, z, z, z, z, z,
        half, z, z, z, z, z,
        half, z, z, z, z,
        drift, z, z, z,
        drift, z, z,
        drift * d_m * d_m + TINY, z,
        4.0 * drift * drift + TINY,
    )  # fmt: skip


def distance(f: DriftLift) -> float:
    """The distance that belongs to x1, 0 where it is negative (which noise makes it, close to the target)."""
    return math.sqrt(2.0 * f.x1) if f.x1 > 0.0 else 0.0


def predict(
    f: DriftLift, n: Noise, q: Fix, height_noise: float, dt_s: float, mx: float, my: float
) -> DriftLift:
    """The vehicle moved by (mx, my) within dt_s, as far as dead reckoning can tell.

    `q` shapes the noise, which is not the same in all directions of the lift. `height_noise` (m⁴/s) is that
    of the measured x1: a height error that changes looks like a target that comes nearer.
    """
    p03, p04, p05, p06 = f.p03, f.p04, f.p05, f.p06
    p13, p14, p15, p16 = f.p13, f.p14, f.p15, f.p16
    p23, p24, p25, p26 = f.p23, f.p24, f.p25, f.p26
    p33, p34, p36, p44, p46, p66 = f.p33, f.p34, f.p36, f.p44, f.p46, f.p66
    # the move alone: x1 − ρ·m + |m|²/2, ρ − m, s − m·w
    a1 = f.p01 - mx * f.p11 - my * f.p12
    a2 = f.p02 - mx * f.p12 - my * f.p22
    a3 = p03 - mx * p13 - my * p23
    a4 = p04 - mx * p14 - my * p24
    a5 = p05 - mx * p15 - my * p25 - mx * a3 - my * a4
    a6 = p06 - mx * p16 - my * p26
    a0 = f.p00 - mx * f.p01 - my * f.p02 - mx * a1 - my * a2
    b1 = p15 - mx * p13 - my * p14
    b2 = p25 - mx * p23 - my * p24
    b3 = f.p35 - mx * p33 - my * p34
    b4 = f.p45 - mx * p34 - my * p44
    b5 = f.p55 - mx * f.p35 - my * f.p45 - mx * b3 - my * b4
    b6 = f.p56 - mx * p36 - my * p46
    x1 = f.x1 - f.x * mx - f.y * my + 0.5 * (mx * mx + my * my)
    s = f.s - mx * f.wx - my * f.wy
    # the drift alone: x1 − s dt + u dt²/2, ρ − w dt, s − u dt
    h = 0.5 * dt_s * dt_s
    c1 = a1 - dt_s * b1 + h * p16
    c2 = a2 - dt_s * b2 + h * p26
    c3 = a3 - dt_s * b3 + h * p36
    c4 = a4 - dt_s * b4 + h * p46
    c5 = a5 - dt_s * b5 + h * b6
    c6 = a6 - dt_s * b6 + h * p66
    c0 = a0 - dt_s * a5 + h * a6 - dt_s * c5 + h * c6
    d3 = p13 - dt_s * p33
    d4 = p14 - dt_s * p34
    d5 = b1 - dt_s * b3
    d6 = p16 - dt_s * p36
    e3 = p23 - dt_s * p34
    e4 = p24 - dt_s * p44
    e5 = b2 - dt_s * b4
    e6 = p26 - dt_s * p46
    # noise: of the velocity, of the heading, and the drift's changes
    position = n.position * dt_s
    turn = n.turn * dt_s
    more = n.drift * dt_s
    xs, ys, wx, wy = q.x, q.y, q.wx, q.wy
    gx, gy = more * xs, more * ys
    return DriftLift(
        x1 - s * dt_s + h * f.u, f.x - mx - f.wx * dt_s, f.y - my - f.wy * dt_s,
        f.wx, f.wy, s - f.u * dt_s, f.u,
        c0 + position * (xs * xs + ys * ys) + height_noise * dt_s,
        c1 - dt_s * c3 + position * xs,
        c2 - dt_s * c4 + position * ys,
        c3, c4, c5 - dt_s * c6, c6,
        f.p11 - dt_s * p13 - dt_s * d3 + position + turn * ys * ys,
        f.p12 - dt_s * p14 - dt_s * e3 - turn * xs * ys,
        d3, d4, d5 - dt_s * d6, d6,
        f.p22 - dt_s * p24 - dt_s * e4 + position + turn * xs * xs,
        e3, e4, e5 - dt_s * e6, e6,
        p33 + more, p34, b3 - dt_s * p36 + gx, p36 + 2.0 * more * wx,
        p44 + more, b4 - dt_s * p46 + gy, p46 + 2.0 * more * wy,
        b5 - 2.0 * dt_s * b6 + dt_s * dt_s * p66 + more * 2.0 * max(x1, 0.0),
        b6 - dt_s * p66 + 2.0 * (gx * wx + gy * wy),
        p66 + 4.0 * more * (wx * wx + wy * wy),
    )  # fmt: skip


def correct(f: DriftLift, innovation: float, variance: float) -> DriftLift:
    """A measurement of x1 that differs from it by `innovation`; `variance` is that of the innovation."""
    p00, p01, p02 = f.p00, f.p01, f.p02
    p03, p04, p05, p06 = f.p03, f.p04, f.p05, f.p06
    k0, k1, k2 = p00 / variance, p01 / variance, p02 / variance
    k3, k4, k5, k6 = p03 / variance, p04 / variance, p05 / variance, p06 / variance
    e = innovation
    return DriftLift(
        f.x1 + k0 * e, f.x + k1 * e, f.y + k2 * e, f.wx + k3 * e, f.wy + k4 * e, f.s + k5 * e, f.u + k6 * e,
        p00 - k0 * p00, p01 - k0 * p01, p02 - k0 * p02, p03 - k0 * p03, p04 - k0 * p04, p05 - k0 * p05,
        p06 - k0 * p06,
        f.p11 - k1 * p01, f.p12 - k1 * p02, f.p13 - k1 * p03, f.p14 - k1 * p04, f.p15 - k1 * p05,
        f.p16 - k1 * p06,
        f.p22 - k2 * p02, f.p23 - k2 * p03, f.p24 - k2 * p04, f.p25 - k2 * p05, f.p26 - k2 * p06,
        f.p33 - k3 * p03, f.p34 - k3 * p04, f.p35 - k3 * p05, f.p36 - k3 * p06,
        f.p44 - k4 * p04, f.p45 - k4 * p05, f.p46 - k4 * p06,
        f.p55 - k5 * p05, f.p56 - k5 * p06,
        f.p66 - k6 * p06,
    )  # fmt: skip


def widen(f: DriftLift, spread_m2: float, n: Noise) -> DriftLift:
    """The same mean with less trust in it: the priors of `n` and `spread_m2` on the position come on top."""
    drift = n.drift_m_s * n.drift_m_s
    return DriftLift(
        f.x1, f.x, f.y, f.wx, f.wy, f.s, f.u,
        f.p00, f.p01, f.p02, f.p03, f.p04, f.p05, f.p06,
        f.p11 + spread_m2, f.p12, f.p13, f.p14, f.p15, f.p16,
        f.p22 + spread_m2, f.p23, f.p24, f.p25, f.p26,
        f.p33 + drift, f.p34, f.p35, f.p36,
        f.p44 + drift, f.p45, f.p46,
        f.p55 + drift * 2.0 * max(f.x1, 0.0), f.p56,
        f.p66 + 4.0 * drift * drift,
    )  # fmt: skip
