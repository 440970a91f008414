"""Where the beacons, the station and the drift are: a least-squares fit to all ranges, in plain floats.

Everything lives in the dead-reckoned frame: origin and heading zero where the fit began. At the time t the
vehicle is at x(t) + w t, x the path from its own motion, w the constant drift. Half the squared range to a
beacon at b,

    |b − x − w t|²/2 = |b|²/2 − b·x − t b·w + t x·w + t² |w|²/2 + |x|²/2,

is linear in products of unknowns with 1, x, t, t x and t²: the lift of Eq. (18) to (22), with drift, and at
rest because the frame is. So a fixed number of sums over the ranges (`Moments`) holds all that the ranges
say; the batch fit needs none of them again, may start anywhere as often as it likes, and costs the same after
an hour as after a second.

The unknowns are the station p, the drift w, and for each beacon the azimuth φ at which the station sees it:
b = p + d* (cos φ, sin φ), so that |p − b| = d* holds by construction. Given (p, w) the beacons are
independent of each other, which makes every step linear in their number.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec

TINY = 1e-9


class Moments(NamedTuple):
    """Weighted sums over one beacon's ranges: of products of the path x, y and the time t, and with z =
    (r² − Δh² − σ²)/2 − (x² + y²)/2. The weight is one over the variance of z."""

    one: float
    x: float
    y: float
    t: float
    xx: float
    xy: float
    yy: float
    tx: float
    ty: float
    tt: float
    txx: float
    txy: float
    tyy: float
    ttx: float
    tty: float
    ttt: float
    ttxx: float
    ttxy: float
    ttyy: float
    tttx: float
    ttty: float
    tttt: float
    z: float
    zx: float
    zy: float
    zt: float
    ztx: float
    zty: float
    ztt: float


NOTHING = Moments(*(0.0,) * 29)


def accumulate(m: Moments, keep: float, weight: float, x: float, y: float, t: float, z: float) -> Moments:
    """One more range, after what is known has been discounted by `keep` (1: not at all)."""
    wx = weight * x
    wy = weight * y
    wt = weight * t
    wxx = wx * x
    wxy = wx * y
    wyy = wy * y
    wtt = wt * t
    wttt = wtt * t
    wz = weight * z
    wzt = wz * t
    return Moments(
        keep * m[0] + weight,
        keep * m[1] + wx,
        keep * m[2] + wy,
        keep * m[3] + wt,
        keep * m[4] + wxx,
        keep * m[5] + wxy,
        keep * m[6] + wyy,
        keep * m[7] + wt * x,
        keep * m[8] + wt * y,
        keep * m[9] + wtt,
        keep * m[10] + wxx * t,
        keep * m[11] + wxy * t,
        keep * m[12] + wyy * t,
        keep * m[13] + wtt * x,
        keep * m[14] + wtt * y,
        keep * m[15] + wttt,
        keep * m[16] + wtt * x * x,
        keep * m[17] + wtt * x * y,
        keep * m[18] + wtt * y * y,
        keep * m[19] + wttt * x,
        keep * m[20] + wttt * y,
        keep * m[21] + wttt * t,
        keep * m[22] + wz,
        keep * m[23] + wz * x,
        keep * m[24] + wz * y,
        keep * m[25] + wzt,
        keep * m[26] + wzt * x,
        keep * m[27] + wzt * y,
        keep * m[28] + wzt * t,
    )


def velocity(moments: Sequence[Moments]) -> tuple[float, float]:
    """The mean velocity of the path along which the ranges were taken."""
    tt = tx = ty = 0.0
    for m in moments:
        if m.one > 0.0:
            tt += m.tt - m.t * m.t / m.one
            tx += m.tx - m.t * m.x / m.one
            ty += m.ty - m.t * m.y / m.one
    return tx / (tt + TINY), ty / (tt + TINY)


class Normal(NamedTuple):
    """Half the weighted sum of squared residuals at (b, w), up to a constant; its gradient; and its
    Gauss-Newton matrix [[a, −h], [−h, c]] in (b, w): a, h, c = Σ ρρᵀ, Σ t ρρᵀ, Σ t² ρρᵀ, ρ = b − x − w t."""

    cost: float
    gbx: float
    gby: float
    gwx: float
    gwy: float
    axx: float
    axy: float
    ayy: float
    hxx: float
    hxy: float
    hyy: float
    cxx: float
    cxy: float
    cyy: float


def normal(m: Moments, bx: float, by: float, wx: float, wy: float) -> Normal:
    """The fit's cost, gradient and matrix for one beacon."""
    (
        m1, mx, my, mt, mxx, mxy, myy, mtx, mty, mtt, mtxx, mtxy, mtyy, mttx, mtty, mttt,
        mttxx, mttxy, mttyy, mtttx, mttty, mtttt, z, zx, zy, zt, ztx, zty, ztt,
    ) = m  # fmt: skip
    q0 = 0.5 * (bx * bx + by * by)
    q3 = bx * wx + by * wy
    q6 = 0.5 * (wx * wx + wy * wy)
    # sums of the residual times 1, −x, −y, −t, t x, t y, t²
    e0 = m1 * q0 - mx * bx - my * by - mt * q3 + mtx * wx + mty * wy + mtt * q6 - z
    e1 = -mx * q0 + mxx * bx + mxy * by + mtx * q3 - mtxx * wx - mtxy * wy - mttx * q6 + zx
    e2 = -my * q0 + mxy * bx + myy * by + mty * q3 - mtxy * wx - mtyy * wy - mtty * q6 + zy
    e3 = -mt * q0 + mtx * bx + mty * by + mtt * q3 - mttx * wx - mtty * wy - mttt * q6 + zt
    e4 = mtx * q0 - mtxx * bx - mtxy * by - mttx * q3 + mttxx * wx + mttxy * wy + mtttx * q6 - ztx
    e5 = mty * q0 - mtxy * bx - mtyy * by - mtty * q3 + mttxy * wx + mttyy * wy + mttty * q6 - zty
    e6 = mtt * q0 - mttx * bx - mtty * by - mttt * q3 + mtttx * wx + mttty * wy + mtttt * q6 - ztt
    cost = 0.5 * (
        q0 * (e0 - z) + bx * (e1 + zx) + by * (e2 + zy) + q3 * (e3 + zt)
        + wx * (e4 - ztx) + wy * (e5 - zty) + q6 * (e6 - ztt)
    )  # fmt: skip
    # first moments of x + w t under the weights 1, t, t²
    sx, sy = mx + wx * mt, my + wy * mt
    tsx, tsy = mtx + wx * mtt, mty + wy * mtt
    ttsx, ttsy = mttx + wx * mttt, mtty + wy * mttt
    xx, xy, yy = bx * bx, bx * by, by * by
    vxx, vxy, vyy = wx * wx, wx * wy, wy * wy
    return Normal(
        cost,
        bx * e0 + e1 + wx * e3,
        by * e0 + e2 + wy * e3,
        bx * e3 + e4 + wx * e6,
        by * e3 + e5 + wy * e6,
        xx * m1 - 2.0 * bx * sx + mxx + 2.0 * wx * mtx + vxx * mtt,
        xy * m1 - bx * sy - by * sx + mxy + wx * mty + wy * mtx + vxy * mtt,
        yy * m1 - 2.0 * by * sy + myy + 2.0 * wy * mty + vyy * mtt,
        xx * mt - 2.0 * bx * tsx + mtxx + 2.0 * wx * mttx + vxx * mttt,
        xy * mt - bx * tsy - by * tsx + mtxy + wx * mtty + wy * mttx + vxy * mttt,
        yy * mt - 2.0 * by * tsy + mtyy + 2.0 * wy * mtty + vyy * mttt,
        xx * mtt - 2.0 * bx * ttsx + mttxx + 2.0 * wx * mtttx + vxx * mtttt,
        xy * mtt - bx * ttsy - by * ttsx + mttxy + wx * mttty + wy * mtttx + vxy * mtttt,
        yy * mtt - 2.0 * by * ttsy + mttyy + 2.0 * wy * mttty + vyy * mtttt,
    )


class Common(NamedTuple):
    """What is common to all beacons: the station p and the drift w."""

    px: float
    py: float
    wx: float
    wy: float


class Block(NamedTuple):
    """What one beacon says of u = (p, w), its place eliminated: ½ uᵀ S u − kᵀ u, S the upper triangle. The
    place that goes with u is (bx, by) − Y u; `cost` is that at the point of linearisation."""

    s11: float
    s12: float
    s13: float
    s14: float
    s22: float
    s23: float
    s24: float
    s33: float
    s34: float
    s44: float
    k1: float
    k2: float
    k3: float
    k4: float
    y11: float
    y12: float
    y13: float
    y14: float
    y21: float
    y22: float
    y23: float
    y24: float
    bx: float
    by: float
    cost: float


EMPTY = Block(*(0.0,) * 25)


def place(b: Block, u: Common) -> tuple[float, float]:
    """Where the beacon is, for this (p, w)."""
    return (
        b.bx - b.y11 * u.px - b.y12 * u.py - b.y13 * u.wx - b.y14 * u.wy,
        b.by - b.y21 * u.px - b.y22 * u.py - b.y23 * u.wx - b.y24 * u.wy,
    )


def linearise(m: Moments, u: Common, bx: float, by: float, d: float) -> Block:
    """One beacon's block at (p, w, b)."""
    px, py, wx, wy = u
    n = normal(m, bx, by, wx, wy)
    _, gbx, gby, gwx, gwy, axx, axy, ayy, hxx, hxy, hyy, cxx, cxy, cyy = n
    # the given distance, |b − p| = d*
    qx, qy = bx - px, by - py
    length = math.sqrt(qx * qx + qy * qy) + TINY
    ux, uy = qx / length, qy / length
    pull = STIFF * (length - d)
    rxx, rxy, ryy = STIFF * ux * ux, STIFF * ux * uy, STIFF * uy * uy
    gpx, gpy = -pull * ux, -pull * uy
    gbx -= gpx
    gby -= gpy
    # eliminate b: B = A + R, and Y = B⁻¹ [−R, −H]
    b11, b12, b22 = axx + rxx + RIDGE, axy + rxy, ayy + ryy + RIDGE
    det = 1.0 / (b11 * b22 - b12 * b12)
    i11, i12, i22 = b22 * det, -b12 * det, b11 * det
    y11, y12 = -i11 * rxx - i12 * rxy, -i11 * rxy - i12 * ryy
    y21, y22 = -i12 * rxx - i22 * rxy, -i12 * rxy - i22 * ryy
    y13, y14 = -i11 * hxx - i12 * hxy, -i11 * hxy - i12 * hyy
    y23, y24 = -i12 * hxx - i22 * hxy, -i12 * hxy - i22 * hyy
    s11 = rxx + rxx * y11 + rxy * y21
    s12 = rxy + rxx * y12 + rxy * y22
    s13 = rxx * y13 + rxy * y23
    s14 = rxx * y14 + rxy * y24
    s22 = ryy + rxy * y12 + ryy * y22
    s23 = rxy * y13 + ryy * y23
    s24 = rxy * y14 + ryy * y24
    s33 = cxx + hxx * y13 + hxy * y23
    s34 = cxy + hxx * y14 + hxy * y24
    s44 = cyy + hxy * y14 + hyy * y24
    return Block(
        s11, s12, s13, s14, s22, s23, s24, s33, s34, s44,
        s11 * px + s12 * py + s13 * wx + s14 * wy - gpx + y11 * gbx + y21 * gby,
        s12 * px + s22 * py + s23 * wx + s24 * wy - gpy + y12 * gbx + y22 * gby,
        s13 * px + s23 * py + s33 * wx + s34 * wy - gwx + y13 * gbx + y23 * gby,
        s14 * px + s24 * py + s34 * wx + s44 * wy - gwy + y14 * gbx + y24 * gby,
        y11, y12, y13, y14, y21, y22, y23, y24,
        bx - i11 * gbx - i12 * gby + y11 * px + y12 * py + y13 * wx + y14 * wy,
        by - i12 * gbx - i22 * gby + y21 * px + y22 * py + y23 * wx + y24 * wy,
        n.cost + 0.5 * pull * (length - d),
    )  # fmt: skip


RIDGE = 1e-3
"""Keeps a beacon where it is, to one sigma of 30 m, where its ranges say nothing."""
FAR_M = 1e4
"""A fit that runs further away than this has no optimum near its start."""
STIFF = 1.0 / 0.05**2
"""Weight of a given station distance: one over the variance of its error, which is never quite zero."""


class Solution(msgspec.Struct, frozen=True):
    """The optimum of (p, w), and its covariance: [[pp, pw], [pwᵀ, ww]] as an upper triangle."""

    u: Common
    c11: float
    c12: float
    c13: float
    c14: float
    c22: float
    c23: float
    c24: float
    c33: float
    c34: float
    c44: float


def solve(blocks: Sequence[Block], drift_sigma: float) -> Solution:
    """Minimise the sum of the blocks and of the drift's prior, by Cholesky's method."""
    s11 = s12 = s13 = s14 = s22 = s23 = s24 = s34 = k1 = k2 = k3 = k4 = 0.0
    s33 = s44 = 1.0 / (drift_sigma * drift_sigma)
    s11 = s22 = TINY
    for b in blocks:
        s11 += b[0]
        s12 += b[1]
        s13 += b[2]
        s14 += b[3]
        s22 += b[4]
        s23 += b[5]
        s24 += b[6]
        s33 += b[7]
        s34 += b[8]
        s44 += b[9]
        k1 += b[10]
        k2 += b[11]
        k3 += b[12]
        k4 += b[13]
    # S = L Lᵀ, with the reciprocals of the diagonal
    i1 = 1.0 / math.sqrt(max(s11, TINY))
    l21, l31, l41 = s12 * i1, s13 * i1, s14 * i1
    i2 = 1.0 / math.sqrt(max(s22 - l21 * l21, TINY))
    l32, l42 = (s23 - l31 * l21) * i2, (s24 - l41 * l21) * i2
    i3 = 1.0 / math.sqrt(max(s33 - l31 * l31 - l32 * l32, TINY))
    l43 = (s34 - l41 * l31 - l42 * l32) * i3
    i4 = 1.0 / math.sqrt(max(s44 - l41 * l41 - l42 * l42 - l43 * l43, TINY))
    # J = L⁻¹, then S⁻¹ = Jᵀ J
    j21 = -l21 * i1 * i2
    j32 = -l32 * i2 * i3
    j31 = -(l31 * i1 + l32 * j21) * i3
    j43 = -l43 * i3 * i4
    j42 = -(l42 * i2 + l43 * j32) * i4
    j41 = -(l41 * i1 + l42 * j21 + l43 * j31) * i4
    c11 = i1 * i1 + j21 * j21 + j31 * j31 + j41 * j41
    c12 = j21 * i2 + j31 * j32 + j41 * j42
    c13 = j31 * i3 + j41 * j43
    c14 = j41 * i4
    c22 = i2 * i2 + j32 * j32 + j42 * j42
    c23 = j32 * i3 + j42 * j43
    c24 = j42 * i4
    c33 = i3 * i3 + j43 * j43
    c34 = j43 * i4
    c44 = i4 * i4
    u = Common(
        c11 * k1 + c12 * k2 + c13 * k3 + c14 * k4,
        c12 * k1 + c22 * k2 + c23 * k3 + c24 * k4,
        c13 * k1 + c23 * k2 + c33 * k3 + c34 * k4,
        c14 * k1 + c24 * k2 + c34 * k3 + c44 * k4,
    )
    return Solution(u, c11, c12, c13, c14, c22, c23, c24, c33, c34, c44)


class Fit(msgspec.Struct, frozen=True):
    """A fit of everything: its cost, the solution, and the place of every beacon that took part."""

    cost: float
    at: Solution
    beacons: tuple[tuple[float, float], ...]


def refine(
    moments: Sequence[Moments], distances: Sequence[float], u: Common,
    beacons: Sequence[tuple[float, float]],
    drift_sigma: float,
) -> Fit:  # fmt: skip
    """One Gauss-Newton step from a guess. The cost is that of the guess; infinite, the step runs away."""
    blocks = [linearise(m, u, *beacons[i], distances[i]) for i, m in enumerate(moments)]
    cost = sum(b.cost for b in blocks)
    cost += 0.5 * (u.wx * u.wx + u.wy * u.wy) / (drift_sigma * drift_sigma)
    at = solve(blocks, drift_sigma)
    places = tuple([place(b, at.u) for b in blocks])
    if not all(abs(x) < FAR_M and abs(y) < FAR_M for x, y in (*places, (at.u.px, at.u.py))):
        cost = math.inf
    return Fit(cost, at, places)


class Shape(msgspec.Struct, frozen=True):
    """The beacons' middle, the direction of the line that fits them best, and their rms spread along and
    across it."""

    x: float
    y: float
    ux: float
    uy: float
    along_m: float
    across_m: float


def shape(beacons: Sequence[tuple[float, float]]) -> Shape:
    """How the beacons lie: `across_m` = 0 means in one line, which leaves two stations possible."""
    n = len(beacons)
    mx = sum(b[0] for b in beacons) / n
    my = sum(b[1] for b in beacons) / n
    xx = sum((b[0] - mx) ** 2 for b in beacons) / n
    yy = sum((b[1] - my) ** 2 for b in beacons) / n
    xy = sum((b[0] - mx) * (b[1] - my) for b in beacons) / n
    angle = 0.5 * math.atan2(2.0 * xy, xx - yy)
    half = 0.5 * math.hypot(2.0 * xy, xx - yy)
    middle = 0.5 * (xx + yy)
    return Shape(
        mx, my, math.cos(angle), math.sin(angle), math.sqrt(middle + half), math.sqrt(max(middle - half, 0.0))
    )


def closest(
    x: float,
    y: float,
    beacons: Sequence[tuple[float, float]],
    distances: Sequence[float],
    weights: Sequence[float],
) -> tuple[float, float]:
    """The point that fits the distances from the beacons best, by Gauss-Newton from (x, y)."""
    for _ in range(5):
        sxx = syy = RIDGE
        sxy = rx = ry = 0.0
        for (bx, by), d, weight in zip(beacons, distances, weights, strict=True):
            length = math.hypot(x - bx, y - by) + TINY
            ux, uy = (x - bx) / length, (y - by) / length
            e = weight * (d - length)
            sxx += weight * ux * ux
            sxy += weight * ux * uy
            syy += weight * uy * uy
            rx += ux * e
            ry += uy * e
        det = sxx * syy - sxy * sxy
        x += (syy * rx - sxy * ry) / det
        y += (sxx * ry - sxy * rx) / det
    return x, y
