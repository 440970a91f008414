"""What the lift of `drift` says of the target, read where x1 is half the square of (x, y)."""

from __future__ import annotations

import math
from typing import NamedTuple

import msgspec

from companion.guidance.drift import TINY, DriftLift

AZIMUTHS = 24
"""The bearing's posterior is summed over this many azimuths."""
AZIMUTH_RAD = tuple(2.0 * math.pi * (i + 0.5) / AZIMUTHS for i in range(AZIMUTHS))
COS = tuple(math.cos(azimuth) for azimuth in AZIMUTH_RAD)
SIN = tuple(math.sin(azimuth) for azimuth in AZIMUTH_RAD)
_STEPS = 4
_DONE_M2 = 1e-6
"""Gauss-Newton ends after so many steps, or after one shorter than a millimetre."""


class Information(NamedTuple):
    """Inverse of the covariance of [x1, x, y], its upper triangle."""

    i11: float
    i12: float
    i13: float
    i22: float
    i23: float
    i33: float


class Fix(msgspec.Struct, frozen=True, gc=False):
    """Where the target is relative to the vehicle, with the covariance of that, and the drift."""

    x: float
    y: float
    xx: float
    xy: float
    yy: float
    wx: float
    wy: float


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


def fix(f: DriftLift, i: Information, x: float, y: float) -> Fix:
    """The most probable (x, y), by Gauss-Newton from the one given, and the drift that goes with it."""
    i11, i12, i13, i22, i23, i33 = i
    longer = 2.0 * f.x1 / (x * x + y * y + TINY)
    if longer > 1.0:
        stretch = math.sqrt(longer)
        x *= stretch
        y *= stretch
    n11 = n12 = n22 = det = 1.0
    g1 = g2 = g3 = 0.0
    for _ in range(_STEPS):
        xx, yy = x * x, y * y
        e1 = 0.5 * (xx + yy) - f.x1
        e2 = x - f.x
        e3 = y - f.y
        g1 = i11 * e1 + i12 * e2 + i13 * e3
        g2 = i12 * e1 + i22 * e2 + i23 * e3
        g3 = i13 * e1 + i23 * e2 + i33 * e3
        n11 = xx * i11 + 2.0 * x * i12 + i22
        n12 = x * y * i11 + x * i13 + y * i12 + i23
        n22 = yy * i11 + 2.0 * y * i13 + i33
        det = n11 * n22 - n12 * n12
        if det < 1e-30:
            det = 1e-30
        q1 = x * g1 + g2
        q2 = y * g1 + g3
        dx = (n12 * q2 - n22 * q1) / det
        dy = (n12 * q1 - n11 * q2) / det
        x += dx
        y += dy
        if dx * dx + dy * dy < _DONE_M2:
            break
    return Fix(
        x,
        y,
        n22 / det,
        -n12 / det,
        n11 / det,
        f.wx + f.p03 * g1 + f.p13 * g2 + f.p23 * g3,
        f.wy + f.p04 * g1 + f.p14 * g2 + f.p24 * g3,
    )


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
