"""Where the vehicle is among beacons whose places are known: a Kalman filter of five states.

Position, heading and drift in the map's frame. What the vehicle's own motion tells wrongly, slowly varying,
is followed as drift and heading.
"""

from __future__ import annotations

import math
from typing import NamedTuple


class Pose(NamedTuple):
    """Mean and covariance (its upper triangle) of position, heading and drift."""

    x: float
    y: float
    heading: float
    wx: float
    wy: float
    pxx: float
    pxy: float
    pxh: float
    pxu: float
    pxv: float
    pyy: float
    pyh: float
    pyu: float
    pyv: float
    phh: float
    phu: float
    phv: float
    puu: float
    puv: float
    pvv: float


NOWHERE = Pose(*(0.0,) * 20)
"""Before there is a map."""
Q_POSITION = 3e-4
"""Process noise on the position, m²/s."""
Q_HEADING = 1e-3
"""Process noise on the heading, rad²/s."""
Q_DRIFT = 1e-4
"""Process noise on the drift, (m/s)²/s."""
MAP_SIGMA_M = 0.03
"""Added to the ranges' sigma, for the map's errors."""
START_SIGMA_M = 0.05
"""One sigma of the position in a map just made: the ranges fit it well, and with more a reflected range would
be believed."""
START_DRIFT_SIGMA_M_S = 0.03
"""One sigma of the velocity over ground in a map just made."""


def start(
    x: float, y: float, heading: float, wx: float, wy: float, vx: float, vy: float, turn: float
) -> Pose:
    """Begin in a map just made, `turn` one sigma of its orientation, (vx, vy) the mean velocity through the
    air while it was made.

    The velocity over ground (vx, vy) + (wx, wy) is well known from the ranges: a map turned by δ has a drift
    that is wrong by δ (vy, −vx).
    """
    z = 0.0
    q, t, o = START_SIGMA_M * START_SIGMA_M, turn * turn, START_DRIFT_SIGMA_M_S * START_DRIFT_SIGMA_M_S
    return Pose(
        x, y, heading, wx, wy, q, z, z, z, z, q, z, z, z,
        t, t * vy, -t * vx, t * vy * vy + o, -t * vx * vy, t * vx * vx + o,
    )  # fmt: skip


def predict(g: Pose, dt: float, forward: float, left: float, turned: float) -> Pose:
    """The vehicle moved for dt (s) at a body velocity (m/s), and turned (rad)."""
    x, y, h, wx, wy, xx, xy, xh, xu, xv, yy, yh, yu, yv, hh, hu, hv, uu, uv, vv = g
    c, s = math.cos(h + 0.5 * turned), math.sin(h + 0.5 * turned)
    dx = (forward * c - left * s) * dt
    dy = (forward * s + left * c) * dt
    # rows of F P: x gains −dy h + dt u, y gains dx h + dt v
    ah = xh - dy * hh + dt * hu
    au = xu - dy * hu + dt * uu
    av = xv - dy * hv + dt * uv
    bh = yh + dx * hh + dt * hv
    bu = yu + dx * hu + dt * uv
    bv = yv + dx * hv + dt * vv
    ax = xx - dy * xh + dt * xu
    ay = xy - dy * yh + dt * yu
    by = yy + dx * yh + dt * yv
    q = Q_POSITION * dt
    w = Q_DRIFT * dt
    return Pose(
        x + dx + wx * dt, y + dy + wy * dt, h + turned, wx, wy,
        ax - dy * ah + dt * au + q, ay + dx * ah + dt * av, ah, au, av,
        by + dx * bh + dt * bv + q, bh, bu, bv,
        hh + Q_HEADING * dt, hu, hv, uu + w, uv, vv + w,
    )  # fmt: skip


def update(
    g: Pose, bx: float, by: float, range_m: float, sigma_m: float, dh_m: float, sigma_dh_m: float, gate: float
) -> tuple[Pose, bool]:
    """One slant range to the beacon at (bx, by); False where it lies beyond `gate` sigmas."""
    x, y, h, wx, wy, xx, xy, xh, xu, xv, yy, yh, yu, yv, hh, hu, hv, uu, uv, vv = g
    dx, dy = x - bx, y - by
    slant = math.sqrt(dx * dx + dy * dy + dh_m * dh_m) + 1e-6
    cx, cy = dx / slant, dy / slant
    kx, ky = xx * cx + xy * cy, xy * cx + yy * cy
    kh, ku, kv = xh * cx + yh * cy, xu * cx + yu * cy, xv * cx + yv * cy
    high = dh_m * sigma_dh_m / slant
    t = cx * kx + cy * ky + sigma_m * sigma_m + MAP_SIGMA_M * MAP_SIGMA_M + high * high
    off = range_m - slant
    if off * off > gate * gate * t:
        return g, False
    i = 1.0 / t
    e = off * i
    jx, jy, jh, ju, jv = kx * i, ky * i, kh * i, ku * i, kv * i
    return Pose(
        x + kx * e, y + ky * e, h + kh * e, wx + ku * e, wy + kv * e,
        xx - jx * kx, xy - jx * ky, xh - jx * kh, xu - jx * ku, xv - jx * kv,
        yy - jy * ky, yh - jy * kh, yu - jy * ku, yv - jy * kv,
        hh - jh * kh, hu - jh * ku, hv - jh * kv, uu - ju * ku, uv - ju * kv, vv - jv * kv,
    ), True  # fmt: skip
