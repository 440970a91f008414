"""Where to begin the fit: the beacons' possible places, mirror images included, and the stations they allow.

Gauss-Newton finds the optimum next to its start, and there may be several: after little turning, a beacon to
the left looks like one to the right. So every beacon alone is tried at all bearings; its two best places, and
the two sides of the line through the beacons, make the starts; each is refined and the cheapest is the fit.
All that in small portions, so that no step of the flight waits for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import msgspec
from msgspec.structs import replace

from companion.guidance.station_fit import (
    TINY,
    Common,
    Fit,
    Moments,
    normal,
    refine,
    shape,
)

RING = 24
"""Bearings tried at which a beacon may stand."""
ROUNDS = 6
"""Gauss-Newton steps from each start at most."""
SETTLED_M = 1e-3
"""A fit whose station moves by less in a step has found its optimum."""
UNLIKELY = 20.0
"""A hypothesis that costs this much more (half a χ²) is not followed."""
FLIPS = 3
"""So many beacons, those that are least certain, are tried at their second place too."""
APART_M = 0.5
"""Fits whose stations and beacons are closer than this are the same."""


class Modes(msgspec.Struct, frozen=True):
    """The best and, where there is one, the second best place of a beacon taken alone, and their costs."""

    bx: float
    by: float
    cost: float
    other_bx: float
    other_by: float
    other_cost: float


def modes(
    m: Moments, x: float, y: float, range_m: float, drift_sigma: float,
    t: float = 0.0, wx: float = 0.0, wy: float = 0.0,
) -> Modes:  # fmt: skip
    """Try a ring of bearings around the vehicle, distance and drift free at each; its two lowest minima.

    The vehicle is at (x, y) + (wx, wy) t now, if the drift is (wx, wy); the places are those for that drift.
    This is where the mirror image shows: after little turning, the minima to both sides are as deep.
    """
    prior = 1.0 / (drift_sigma * drift_sigma)
    places: list[tuple[float, float, float]] = []
    for i in range(RING):
        a = 2.0 * math.pi * i / RING
        ux, uy = math.cos(a), math.sin(a)
        bx, by = x + wx * t + range_m * ux, y + wy * t + range_m * uy
        n = normal(m, bx, by, wx, wy)
        # Newton's step over (distance from where the vehicle is now, drift): b moves by t with the drift
        g = n.gbx * ux + n.gby * uy
        ax, ay = n.axx * ux + n.axy * uy, n.axy * ux + n.ayy * uy
        h = ax * ux + ay * uy + TINY
        f1 = t * ax - n.hxx * ux - n.hxy * uy
        f2 = t * ay - n.hxy * ux - n.hyy * uy
        s11 = n.cxx - 2.0 * t * n.hxx + t * t * n.axx + prior - f1 * f1 / h
        s12 = n.cxy - 2.0 * t * n.hxy + t * t * n.axy - f1 * f2 / h
        s22 = n.cyy - 2.0 * t * n.hyy + t * t * n.ayy + prior - f2 * f2 / h
        g1 = n.gwx + t * n.gbx + prior * wx - f1 * g / h
        g2 = n.gwy + t * n.gby + prior * wy - f2 * g / h
        det = s11 * s22 - s12 * s12
        w1 = -(s22 * g1 - s12 * g2) / det
        w2 = -(s11 * g2 - s12 * g1) / det
        out = -(g + f1 * w1 + f2 * w2) / h
        cost = n.cost - 0.5 * g * g / h + 0.5 * (g1 * w1 + g2 * w2)
        places.append((cost, bx + out * ux, by + out * uy))
    minima = sorted(
        place for i, place in enumerate(places) if place <= min(places[i - 1], places[(i + 1) % RING])
    )
    best = minima[0]
    other = minima[1] if len(minima) > 1 else (math.inf, best[1], best[2])
    return Modes(best[1], best[2], best[0], other[1], other[2], other[0])


def trilaterate(beacons: Sequence[tuple[float, float]], distances: Sequence[float]) -> tuple[float, float]:
    """The point at these distances from the beacons, from the differences of their equations (which are
    linear): (b_i − b̄)·p = ½(|b_i|² − d_i² − mean)."""
    n = len(beacons)
    mx = sum(b[0] for b in beacons) / n
    my = sum(b[1] for b in beacons) / n
    terms = [
        0.5 * ((b[0] - mx) ** 2 + (b[1] - my) ** 2 - d * d) for b, d in zip(beacons, distances, strict=True)
    ]
    mean = sum(terms) / n
    sxx = sxy = syy = rx = ry = 0.0
    for (bx, by), term in zip(beacons, terms, strict=True):
        dx, dy, e = bx - mx, by - my, term - mean
        sxx += dx * dx
        sxy += dx * dy
        syy += dy * dy
        rx += dx * e
        ry += dy * e
    # beacons nearly in a line say little across it: a ridge keeps the point near their middle
    ridge = 1e-3 * (sxx + syy) + TINY
    sxx += ridge
    syy += ridge
    det = sxx * syy - sxy * sxy
    return mx + (syy * rx - sxy * ry) / det, my + (sxx * ry - sxy * rx) / det


def stations(beacons: Sequence[tuple[float, float]], distances: Sequence[float]) -> list[tuple[float, float]]:
    """Where the station may be, to start from: the trilaterated point, and its mirror image in the line of
    the beacons where they lie not far from one."""
    px, py = trilaterate(beacons, distances)
    of = shape(beacons)
    # nearly collinear: the point's distance from the line follows from the ranges, not its side
    along = (px - of.x) * of.ux + (py - of.y) * of.uy
    off = 0.0
    for (bx, by), d in zip(beacons, distances, strict=True):
        gap = (bx - of.x) * of.ux + (by - of.y) * of.uy - along
        off += math.sqrt(max(d * d - gap * gap, 0.0)) / len(beacons)
    fx, fy = of.x + along * of.ux, of.y + along * of.uy
    return [(fx - off * of.uy, fy + off * of.ux), (fx + off * of.uy, fy - off * of.ux)]


class Candidate(msgspec.Struct, frozen=True):
    """A beacon that takes part: its number, what its ranges say, d*, and its possible places."""

    number: int
    moments: Moments
    distance: float
    modes: Modes


class Start(NamedTuple):
    """A station with its drift, and places of the beacons, to begin from."""

    u: Common
    beacons: tuple[tuple[float, float], ...]


class Search(msgspec.Struct, frozen=True):
    """How far a search has come: candidates first (`looked` beacons so far), then fits from all starts.

    The first `planned` starts are those of the search itself. `trial` is the fit under way, after `rounds`
    Gauss-Newton steps.
    """

    looked: int
    candidates: tuple[Candidate, ...]
    wx: float = 0.0
    wy: float = 0.0
    starts: tuple[Start, ...] = ()
    planned: int = 0
    fits: tuple[Fit, ...] = ()
    trial: Fit | None = None
    rounds: int = 0

    @property
    def is_drifting(self) -> bool:
        """True where it begins with a drift."""
        return self.wx != 0.0 or self.wy != 0.0

    @property
    def is_done(self) -> bool:
        """True once every start has been tried."""
        return 0 < len(self.starts) == len(self.fits)


NEW = Search(0, ())


def look(search: Search, found: Candidate | None) -> Search:
    """One more beacon has been looked at, or had nothing to show."""
    candidates = search.candidates if found is None else (*search.candidates, found)
    return replace(search, looked=search.looked + 1, candidates=candidates)


def plan(search: Search) -> Search:
    """All beacons have been looked at: list the starts, the most probable first.

    The moments are those of the moment at which each beacon was looked at: costs compare on the same data.
    """
    starts = []
    distances = [c.distance for c in search.candidates]
    for beacons in combinations([c.modes for c in search.candidates]):
        for px, py in stations(beacons, distances):
            starts.append(Start(Common(px, py, search.wx, search.wy), tuple(beacons)))
    return replace(search, starts=tuple(starts), planned=len(starts))


def attempt(search: Search, drift_sigma: float) -> Search:
    """One more Gauss-Newton step from the start in turn."""
    start, trial = search.starts[len(search.fits)], search.trial
    u, beacons = start if trial is None else (trial.at.u, trial.beacons)
    moments = [c.moments for c in search.candidates]
    fit = refine(moments, [c.distance for c in search.candidates], u, beacons, drift_sigma)
    moved_m = math.hypot(fit.at.u.px - u.px, fit.at.u.py - u.py)
    if search.rounds + 1 == ROUNDS or moved_m < SETTLED_M or fit.cost == math.inf:
        return replace(search, fits=(*search.fits, fit), trial=None, rounds=0)
    return replace(search, trial=fit, rounds=search.rounds + 1)


def also(search: Search, start: Start) -> Search:
    """Try one more start, on the same data."""
    return replace(search, starts=(*search.starts, start))


def image(of: Fit) -> Start:
    """The station on the other side of the line through the beacons; it costs the same where they lie in
    one."""
    u, line = of.at.u, shape(of.beacons)
    off = 2.0 * ((u.px - line.x) * line.uy - (u.py - line.y) * line.ux)
    return Start(Common(u.px - off * line.uy, u.py + off * line.ux, u.wx, u.wy), of.beacons)


def result(search: Search, t: float) -> tuple[Fit, float]:
    """The best fit, and how much more the next best *other* one costs (half a χ²; infinite: none): one with
    the station or a beacon elsewhere at the time t."""
    fits = sorted(search.fits, key=_cost)
    best = fits[0]
    for other in fits[1:]:
        if apart_m(best, other, t) > APART_M:
            return best, other.cost - best.cost
    return best, math.inf


def apart_m(a: Fit, b: Fit, t: float) -> float:
    """How far apart two fits have the station or a beacon, at the time t as seen from the vehicle."""
    driftx, drifty = (a.at.u.wx - b.at.u.wx) * t, (a.at.u.wy - b.at.u.wy) * t
    one, other = ((a.at.u.px, a.at.u.py), *a.beacons), ((b.at.u.px, b.at.u.py), *b.beacons)
    return max(
        math.hypot(p[0] - q[0] - driftx, p[1] - q[1] - drifty) for p, q in zip(one, other, strict=True)
    )


def _cost(of: Fit) -> float:
    return of.cost


def combinations(places: Sequence[Modes]) -> list[list[tuple[float, float]]]:
    """Every beacon at its best place; and those that are least certain flipped, in all combinations."""
    best = [(m.bx, m.by) for m in places]
    gaps = sorted((m.other_cost - m.cost, i) for i, m in enumerate(places))
    flips = [i for gap, i in gaps[:FLIPS] if gap < UNLIKELY]
    chosen = []
    for mask in range(1 << len(flips)):
        beacons = list(best)
        for bit, i in enumerate(flips):
            if mask >> bit & 1:
                beacons[i] = (places[i].other_bx, places[i].other_by)
        chosen.append(beacons)
    return chosen


def on_circle(m: Moments, px: float, py: float, distance: float) -> tuple[float, float] | None:
    """Where a beacon is that is `distance` from a known station, from ranges taken at known places; None
    while that is open."""
    places = []
    for i in range(4 * RING):
        a = 0.5 * math.pi * i / RING
        bx, by = px + distance * math.cos(a), py + distance * math.sin(a)
        places.append((normal(m, bx, by, 0.0, 0.0).cost, bx, by))
    minima = sorted(p for i, p in enumerate(places) if p <= min(places[i - 1], places[(i + 1) % len(places)]))
    if len(minima) > 1 and minima[1][0] - minima[0][0] < UNLIKELY:
        return None
    return minima[0][1], minima[0][2]
