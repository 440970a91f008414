"""What the lift of `drift` says of target and drift, read where its states belong together."""

from __future__ import annotations

import math
from typing import NamedTuple

import msgspec

from companion.guidance.drift import TINY, DriftLift, Fix

AZIMUTHS = 24
"""The bearing's posterior is summed over this many azimuths."""
AZIMUTH_RAD = tuple(2.0 * math.pi * (i + 0.5) / AZIMUTHS for i in range(AZIMUTHS))
COS = tuple(math.cos(azimuth) for azimuth in AZIMUTH_RAD)
SIN = tuple(math.sin(azimuth) for azimuth in AZIMUTH_RAD)
STEPS = 4
DONE_M2 = 1e-4
"""Gauss-Newton ends after so many steps, or after one shorter than a centimetre."""
SAME = 0.3
"""One step is enough from a fix that differs from the lift's own place by less than this share of the
distance."""


class Information(NamedTuple):
    """Inverse of the covariance of [x1, x, y], its upper triangle."""

    i11: float
    i12: float
    i13: float
    i22: float
    i23: float
    i33: float


class Circle(msgspec.Struct, frozen=True, gc=False):
    """The bearing while it is open: a unit vector in the mean direction, and how much the directions agree.

    `resultant` is 0 for a bearing spread over the circle and 1 for a certain one.
    """

    cos: float
    sin: float
    resultant: float


def information(f: DriftLift, offset_variance: float) -> Information:
    """What the lift says of [x1, x, y], with a constant error of the measured x1 (that of the range or of the
    height) of the given variance (m⁴)."""
    a, b, c, d, e, g = f.p00 + offset_variance, f.p01, f.p02, f.p11, f.p12, f.p22
    m11 = d * g - e * e
    m12 = c * e - b * g
    m13 = b * e - c * d
    det = a * m11 + b * m12 + c * m13
    if det < 1e-30:
        det = 1e-30
    return Information(
        m11 / det, m12 / det, m13 / det, (a * g - c * c) / det, (b * c - a * e) / det, (a * d - b * b) / det
    )


def renewed(f: DriftLift, offset_variance: float, q: Fix) -> Fix:
    """The fix after one more range, from the last one: with a range every few hundredths of a second one step
    keeps up. Where the lift's own place is elsewhere, the fix begins there anew."""
    ex, ey = q.x - f.x, q.y - f.y
    if ex * ex + ey * ey < SAME * SAME * (f.x * f.x + f.y * f.y):
        return fix(f, offset_variance, q.x, q.y, q.wx, q.wy, 1)
    return fix(f, offset_variance, f.x, f.y, f.wx, f.wy)


def fix(
    f: DriftLift, offset_variance: float, x: float, y: float, wx: float, wy: float, steps: int = STEPS
) -> Fix:
    """The most probable target and drift, by Gauss-Newton from the ones given, where the lift is one of a
    target and a drift: x1 = |ρ|²/2, s = ρ·w, u = |w|²."""
    longer = 2.0 * f.x1 / (x * x + y * y + TINY)
    if longer > 1.0:
        stretch = math.sqrt(longer)
        x *= stretch
        y *= stretch
    p00, p01, p02 = f.p00 + offset_variance, f.p01, f.p02
    p03, p04, p05, p06 = f.p03, f.p04, f.p05, f.p06
    p11, p12, p13, p14, p15, p16 = f.p11, f.p12, f.p13, f.p14, f.p15, f.p16
    p22, p23, p24, p25, p26 = f.p22, f.p23, f.p24, f.p25, f.p26
    p33, p34, p35, p36, p44, p45, p46 = f.p33, f.p34, f.p35, f.p36, f.p44, f.p45, f.p46
    for _ in range(steps):
        vx, vy = 2.0 * wx, 2.0 * wy
        # the constraints, linear about (ρ̂, ŵ), and their covariance with the states and with one another:
        # g1 = x1 − ρ·ρ̂ + |ρ̂|²/2, g2 = s − ρ̂·w − ŵ·ρ + ρ̂·ŵ, g3 = u − 2 ŵ·w + |ŵ|²
        a1 = p01 - x * p11 - y * p12
        a2 = p02 - x * p12 - y * p22
        a3 = p03 - x * p13 - y * p23
        a4 = p04 - x * p14 - y * p24
        a5 = p05 - x * p15 - y * p25
        a6 = p06 - x * p16 - y * p26
        a0 = p00 - x * p01 - y * p02
        b1 = p15 - x * p13 - y * p14 - wx * p11 - wy * p12
        b2 = p25 - x * p23 - y * p24 - wx * p12 - wy * p22
        b3 = p35 - x * p33 - y * p34 - wx * p13 - wy * p23
        b4 = p45 - x * p34 - y * p44 - wx * p14 - wy * p24
        b5 = f.p55 - x * p35 - y * p45 - wx * p15 - wy * p25
        b6 = f.p56 - x * p36 - y * p46 - wx * p16 - wy * p26
        c1 = p16 - vx * p13 - vy * p14
        c2 = p26 - vx * p23 - vy * p24
        c3 = p36 - vx * p33 - vy * p34
        c4 = p46 - vx * p34 - vy * p44
        c6 = f.p66 - vx * p36 - vy * p46
        s11 = a0 - x * a1 - y * a2 + TINY
        s12 = a5 - x * a3 - y * a4 - wx * a1 - wy * a2
        s13 = a6 - vx * a3 - vy * a4
        s22 = b5 - x * b3 - y * b4 - wx * b1 - wy * b2 + TINY
        s23 = b6 - vx * b3 - vy * b4
        s33 = c6 - vx * c3 - vy * c4 + TINY
        # Cholesky, and the multipliers that bring the constraints to zero
        l11 = math.sqrt(max(s11, TINY))
        l21 = s12 / l11
        l31 = s13 / l11
        l22 = math.sqrt(max(s22 - l21 * l21, TINY))
        l32 = (s23 - l31 * l21) / l22
        l33 = math.sqrt(max(s33 - l31 * l31 - l32 * l32, TINY))
        e1 = (f.x1 - x * f.x - y * f.y + 0.5 * (x * x + y * y)) / l11
        e2 = (f.s - x * f.wx - y * f.wy - wx * f.x - wy * f.y + x * wx + y * wy - l21 * e1) / l22
        e3 = (f.u - vx * f.wx - vy * f.wy + wx * wx + wy * wy - l31 * e1 - l32 * e2) / l33
        m3 = e3 / l33
        m2 = (e2 - l32 * m3) / l22
        m1 = (e1 - l21 * m2 - l31 * m3) / l11
        dx = f.x - a1 * m1 - b1 * m2 - c1 * m3 - x
        dy = f.y - a2 * m1 - b2 * m2 - c2 * m3 - y
        wx = f.wx - a3 * m1 - b3 * m2 - c3 * m3
        wy = f.wy - a4 * m1 - b4 * m2 - c4 * m3
        x += dx
        y += dy
        if dx * dx + dy * dy < DONE_M2:
            break
    # what is left of the covariance of ρ
    k1 = a1 / l11
    k2 = (b1 - l21 * k1) / l22
    k3 = (c1 - l31 * k1 - l32 * k2) / l33
    j1 = a2 / l11
    j2 = (b2 - l21 * j1) / l22
    j3 = (c2 - l31 * j1 - l32 * j2) / l33
    xx = p11 - k1 * k1 - k2 * k2 - k3 * k3
    xy = p12 - k1 * j1 - k2 * j2 - k3 * j3
    yy = p22 - j1 * j1 - j2 * j2 - j3 * j3
    return Fix(x, y, max(xx, TINY), xy, max(yy, TINY), wx, wy)


def posterior(f: DriftLift, i: Information, d_m: float) -> list[float]:
    """The probability of every azimuth, by the best distance near d_m there."""
    i11, i12, i13, i22, i23, i33 = i
    e1 = 0.5 * d_m * d_m - f.x1
    a1 = i11 * e1 - i12 * f.x - i13 * f.y
    a2 = i12 * e1 - i22 * f.x - i23 * f.y
    a3 = i13 * e1 - i23 * f.x - i33 * f.y
    top = -1e300
    weights = [0.0] * AZIMUTHS
    for k in range(AZIMUTHS):
        c, s = COS[k], SIN[k]
        e2 = d_m * c - f.x
        e3 = d_m * s - f.y
        # information at the point of the circle, then the radial direction taken out of it
        ac = i12 * c + i13 * s
        g2 = i22 * c + i23 * s
        g3 = i23 * c + i33 * s
        h1 = a1 + d_m * ac
        h2 = a2 + d_m * g2
        h3 = a3 + d_m * g3
        radial = d_m * h1 + c * h2 + s * h3
        stiff = d_m * d_m * i11 + 2.0 * d_m * ac + c * g2 + s * g3
        likelihood = -0.5 * (e1 * h1 + e2 * h2 + e3 * h3 - radial * radial / max(stiff, 1e-30))
        weights[k] = likelihood
        top = max(top, likelihood)
    total = 0.0
    for k in range(AZIMUTHS):
        weights[k] = math.exp(max(weights[k] - top, -700.0))
        total += weights[k]
    for k in range(AZIMUTHS):
        weights[k] /= total
    return weights


def mean_direction(weights: list[float]) -> Circle:
    """What the azimuths, with their probabilities, agree on."""
    sum_cos = sum_sin = 0.0
    for k in range(AZIMUTHS):
        sum_cos += weights[k] * COS[k]
        sum_sin += weights[k] * SIN[k]
    length = math.hypot(sum_cos, sum_sin)
    if length < TINY:
        return Circle(1.0, 0.0, 0.0)
    return Circle(sum_cos / length, sum_sin / length, min(length, 1.0))
