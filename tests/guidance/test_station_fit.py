"""The fit on sums: gradients, elimination, and that it finds what made the ranges."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from companion.guidance import station_fit, station_search
from companion.guidance.station_fit import Common, Fit, Moments

COORDINATE = st.floats(-12.0, 12.0)
SMALL = st.floats(-0.3, 0.3)


def moments(
    bx: float, by: float, wx: float = 0.0, wy: float = 0.0, turn_s: float = 6.0, noise: float = 0.0
) -> Moments:
    """Ranges to a beacon along a circle, 20 a second."""
    rng = np.random.default_rng(1)
    m = station_fit.NOTHING
    for k in range(int(turn_s * 20)):
        t = 0.05 * k
        x, y = 0.5 * math.sin(t), 0.5 * (1.0 - math.cos(t))
        r = math.hypot(bx - x - wx * t, by - y - wy * t) + noise * float(rng.normal())
        weight = 1.0 / (max(r, 0.2) * 0.07) ** 2
        m = station_fit.accumulate(m, 1.0, weight, x, y, t, 0.5 * (r * r - x * x - y * y))
    return m


@given(COORDINATE, COORDINATE, COORDINATE, COORDINATE, SMALL, SMALL)
def test_the_gradient_is_that_of_the_cost(
    bx: float, by: float, x: float, y: float, wx: float, wy: float
) -> None:
    m = moments(bx, by, turn_s=2.0)
    n = station_fit.normal(m, x, y, wx, wy)
    h = 1e-4
    for axis, slope in enumerate((n.gbx, n.gby, n.gwx, n.gwy)):
        costs = []
        for sign in (1.0, -1.0):
            at = [x, y, wx, wy]
            at[axis] += sign * h
            costs.append(station_fit.normal(m, *at).cost)
        assert (costs[0] - costs[1]) / (2.0 * h) == pytest.approx(slope, rel=1e-3, abs=1.0)


def test_the_fit_finds_station_beacons_and_drift() -> None:
    beacons = ((9.0, 6.0), (3.0, -7.0), (-6.0, 2.0))
    station = (2.0, 3.0)
    wx, wy = 0.1, -0.05
    distances = [math.dist(b, station) for b in beacons]
    search = station_search.NEW
    for i, (bx, by) in enumerate(beacons):
        m = moments(bx, by, wx, wy, turn_s=9.0)
        places = station_search.modes(m, 0.5, 0.5, math.hypot(bx, by), 0.15)
        search = station_search.look(search, station_search.Candidate(i, m, distances[i], places))
    search = station_search.plan(search)
    while not search.is_done:
        search = station_search.attempt(search, 0.15)
    best, gap = station_search.result(search, 9.0)
    assert best.at.u[:2] == pytest.approx(station, abs=0.1)
    assert best.at.u[2:] == pytest.approx((wx, wy), abs=0.02)
    assert gap > station_search.UNLIKELY


def test_late_in_a_drift_places_are_those_for_the_drift_that_is_known() -> None:
    wx, wy = 0.05, 0.2
    m = station_fit.NOTHING
    # straight on at 0.5 m/s, after a minute in the drift
    for k in range(400):
        t = 60.0 + 0.05 * k
        x = 0.5 * t
        bx, by = 45.0, 25.0
        r = math.hypot(bx - x - wx * t, by - wy * t)
        m = station_fit.accumulate(m, 1.0, 1.0 / (r * 0.07) ** 2, x, 0.0, t, 0.5 * (r * r - x * x))

    def missed_m(*drift: float) -> float:
        places = station_search.modes(m, x, 0.0, r, 0.15, t, *drift)
        found = [(places.bx, places.by), (places.other_bx, places.other_by)]
        return min(math.dist(place, (45.0, 25.0)) for place in found)

    assert missed_m(wx, wy) < 1.5
    assert missed_m(0.0, 0.0) > 5.0


def test_fits_are_told_apart_by_where_things_are_now() -> None:
    def fit(cost: float, px: float, wx: float, bx: float) -> Fit:
        at = station_fit.Solution(Common(px, 0.0, wx, 0.0), *(0.0,) * 10)
        return Fit(cost, at, ((bx, 0.0),))

    def gap(other: Fit) -> float:
        search = replace(station_search.NEW, fits=(fit(1.0, 10.0, 0.0, 20.0), other))
        return station_search.result(search, 50.0)[1]

    assert gap(fit(3.0, 10.0, 0.0, 20.1)) == math.inf
    assert gap(fit(3.0, 15.0, 0.1, 25.0)) == math.inf  # elsewhere at first, and carried to the same places
    assert gap(fit(3.0, 10.0, 0.0, 22.0)) == 2.0
    assert gap(fit(3.0, 10.0, 0.1, 20.0)) == 2.0


def test_the_mean_velocity_is_that_of_the_path() -> None:
    m = station_fit.NOTHING
    for k in range(40):
        m = station_fit.accumulate(m, 1.0, 2.0, 3.0 + 0.4 * k, 1.0 - 0.2 * k, 5.0 + k, 0.0)
    assert station_fit.velocity([m, station_fit.NOTHING]) == pytest.approx((0.4, -0.2))


def test_too_short_a_turn_leaves_the_mirror_image() -> None:
    straight = station_fit.NOTHING
    for k in range(60):
        x = 0.025 * k
        r2 = (8.0 - x) ** 2 + 36.0
        straight = station_fit.accumulate(
            straight, 1.0, 1.0 / (r2 * 0.0049), x, 0.0, 0.05 * k, 0.5 * (r2 - x * x)
        )
    places = station_search.modes(straight, 1.5, 0.0, math.hypot(6.5, 6.0), 0.05)
    assert places.other_by == pytest.approx(-places.by, abs=1e-6)
    assert places.other_cost == pytest.approx(places.cost, abs=1e-6)


@given(st.lists(st.tuples(COORDINATE, COORDINATE), min_size=4, max_size=8), COORDINATE, COORDINATE)
def test_the_closest_point_is_the_station(beacons: list[tuple[float, float]], x: float, y: float) -> None:
    of = station_fit.shape(beacons)
    distances = [math.dist(b, (x, y)) for b in beacons]
    if of.across_m < 2.0 or min(distances) < 1.0:
        return
    found = station_fit.closest(x + 0.1, y - 0.1, beacons, distances, [1.0] * len(beacons))
    assert found == pytest.approx((x, y), abs=0.05)


def test_shape_of_a_line_and_of_a_square() -> None:
    assert station_fit.shape([(0.0, 0.0), (1.0, 1.0), (4.0, 4.0)]).across_m == pytest.approx(0.0, abs=1e-6)
    square = station_fit.shape([(1.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (1.0, -1.0)])
    assert (square.along_m, square.across_m) == pytest.approx((1.0, 1.0))


@given(COORDINATE, COORDINATE, SMALL, SMALL)
def test_elimination_is_exact(px: float, py: float, wx: float, wy: float) -> None:
    """Solving block by block gives what solving all unknowns at once gives."""
    u = Common(px, py, wx, wy)
    beacons = ((9.0, 6.0), (3.0, -7.0))
    ms = [moments(bx, by, turn_s=3.0, noise=0.05) for bx, by in beacons]
    blocks = [station_fit.linearise(m, u, bx, by, 8.0) for m, (bx, by) in zip(ms, beacons, strict=True)]
    at = station_fit.solve(blocks, 0.15)
    h, g = np.zeros((8, 8)), np.zeros(8)
    h[:2, :2] += station_fit.TINY * np.eye(2)
    h[2:4, 2:4] += np.eye(2) / 0.15**2
    g[2:4] += np.array([wx, wy]) / 0.15**2
    for i, (m, (bx, by)) in enumerate(zip(ms, beacons, strict=True)):
        n = station_fit.normal(m, bx, by, wx, wy)
        a = np.array([[n.axx, n.axy], [n.axy, n.ayy]])
        hh = np.array([[n.hxx, n.hxy], [n.hxy, n.hyy]])
        q = np.array([bx - px, by - py])
        length = float(np.hypot(*q))
        unit = q / length
        pull = station_fit.STIFF * np.outer(unit, unit)
        k = slice(4 + 2 * i, 6 + 2 * i)
        h[:2, :2] += pull
        h[2:4, 2:4] += np.array([[n.cxx, n.cxy], [n.cxy, n.cyy]])
        h[k, k] = a + pull + station_fit.RIDGE * np.eye(2)
        h[:2, k] = h[k, :2] = -pull
        h[2:4, k] = h[k, 2:4] = -hh
        g[:2] -= station_fit.STIFF * (length - 8.0) * unit
        g[2:4] += (n.gwx, n.gwy)
        g[k] = np.array([n.gbx, n.gby]) + station_fit.STIFF * (length - 8.0) * unit
    step = -np.linalg.solve(h, g)
    assert at.u == pytest.approx(np.array(u) + step[:4], rel=1e-4, abs=1e-4)
    for i, (block, (bx, by)) in enumerate(zip(blocks, beacons, strict=True)):
        expected = np.array([bx, by]) + step[4 + 2 * i : 6 + 2 * i]
        assert station_fit.place(block, at.u) == pytest.approx(expected, rel=1e-4, abs=1e-4)
