"""The geometry: the lift against the true motion, and the shortest path against optimal control."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from companion.guidance import model

ANGLES = st.floats(-math.pi, math.pi)
SPEEDS = st.floats(-1.0, 1.0)


@given(st.floats(-1e4, 1e4))
def test_wrap_keeps_the_direction(angle: float) -> None:
    wrapped = model.wrap(angle)
    assert -math.pi < wrapped <= math.pi
    assert math.isclose(math.cos(wrapped), math.cos(angle), abs_tol=1e-9)
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)


def test_wrap_takes_pi_and_not_minus_pi() -> None:
    assert model.wrap(math.pi) == math.pi
    assert model.wrap(-math.pi) == math.pi


@pytest.mark.parametrize(
    "angle", [math.nextafter(turns * math.pi, to) for turns in range(-9, 10, 2) for to in (-99, 99)]
)
def test_wrap_never_leaves_its_bounds_by_rounding(angle: float) -> None:
    assert -math.pi < model.wrap(angle) <= math.pi


@given(d=st.floats(0.0, 50.0), theta=ANGLES, v=SPEEDS, w=SPEEDS, omega=st.floats(-2.0, 2.0))
def test_the_lift_flows_as_the_vehicle_moves(
    d: float, theta: float, v: float, w: float, omega: float
) -> None:
    dt, n = 0.05, 200
    x = y = heading = 0.0
    for _ in range(n):  # the pose, integrated finely by the midpoint rule
        middle = heading + 0.5 * omega * dt / n
        ahead = model.pose_rates(middle, v, omega)
        left = model.pose_rates(middle + 0.5 * math.pi, w, omega)
        x += (ahead[0] + left[0]) * dt / n
        y += (ahead[1] + left[1]) * dt / n
        heading += omega * dt / n
    dx = d * math.cos(-theta) - x
    dy = d * math.sin(-theta) - y
    expected = (
        0.5 * (dx * dx + dy * dy),
        dx * math.sin(heading) - dy * math.cos(heading),  # to the right
        dx * math.cos(heading) + dy * math.sin(heading),  # ahead
    )
    got = model.flow(model.lift(d, theta), model.step(dt, v, w, omega))
    assert got == pytest.approx(expected, abs=5e-5 * (1.0 + d))


@given(d=st.floats(0.3, 50.0), theta=ANGLES, v=st.floats(0.1, 1.0), omega=st.floats(-1.0, 1.0))
def test_polar_rates_are_those_of_the_lift(d: float, theta: float, v: float, omega: float) -> None:
    h = 1e-6
    x = model.flow(model.lift(d, theta), model.step(h, v, 0.0, omega))
    d_rate, theta_rate = model.polar_rates(d, theta, v, omega)
    assert (model.distance(x) - d) / h == pytest.approx(d_rate, abs=1e-4)
    assert model.wrap(model.bearing(x) - theta) / h == pytest.approx(theta_rate, abs=1e-4)


@given(d=st.floats(0.3, 50.0), theta=ANGLES, v=st.floats(0.1, 1.0))
def test_jacobian_is_the_derivative_of_the_polar_rates(d: float, theta: float, v: float) -> None:
    h = 1e-6
    m = model.jacobian(d, theta, v)
    by_d = np.subtract(model.polar_rates(d + h, theta, v, 0.0), model.polar_rates(d - h, theta, v, 0.0))
    by_theta = np.subtract(model.polar_rates(d, theta + h, v, 0.0), model.polar_rates(d, theta - h, v, 0.0))
    assert by_d / (2.0 * h) == pytest.approx([0.0, -m.b], abs=1e-5)
    assert by_theta / (2.0 * h) == pytest.approx([m.a, m.c], abs=1e-5)


@given(d=st.floats(1e-3, 100.0), theta=st.floats(-3.14, math.pi))
def test_lift_and_back(d: float, theta: float) -> None:
    x = model.lift(d, theta)
    assert model.distance(x) == pytest.approx(d)
    assert model.bearing(x) == pytest.approx(theta, abs=1e-9)


def test_overhead_a_range_shorter_than_the_height_is_no_error() -> None:
    y = model.lifted_range(4.9, 5.0)
    assert y < 0.0
    assert model.distance(model.Lifted(y, 0.0, 0.0)) == 0.0


def test_stops_inside_and_goes_on_only_outside() -> None:
    assert not model.is_captured(0.46, 0.5, 0.05, was_captured=False)
    assert model.is_captured(0.44, 0.5, 0.05, was_captured=False)
    assert model.is_captured(0.49, 0.5, 0.05, was_captured=True)
    assert not model.is_captured(0.51, 0.5, 0.05, was_captured=True)


# ---------------------------------------------------------------------------------------- shortest path

DISCS = st.floats(0.01, 2.0)
TURNS = st.floats(0.1, 2.0)


def test_the_papers_example_needs_13_33_seconds() -> None:
    d, theta = math.hypot(5.5, 4.5), math.pi / 2 - math.atan2(4.5, 5.5)
    assert model.shortest_path_m(d, theta, 0.5, 0.5, 1.0) / 0.5 == pytest.approx(13.33, abs=0.005)


@given(d=st.floats(0.0, 20.0), radius=DISCS, rho=TURNS)
def test_straight_ahead(d: float, radius: float, rho: float) -> None:
    assert model.shortest_path_m(d, 0.0, radius, rho, 1.0) == pytest.approx(max(d - radius, 0.0), abs=1e-6)


@given(d=st.floats(0.0, 20.0), theta=ANGLES, radius=DISCS, rho=TURNS)
def test_both_sides_are_equal_and_no_path_is_shorter_than_straight(
    d: float, theta: float, radius: float, rho: float
) -> None:
    length = model.shortest_path_m(d, theta, radius, rho, 1.0)
    assert length == model.shortest_path_m(d, -theta, radius, rho, 1.0)
    assert max(d - radius, 0.0) - 1e-6 <= length <= d + 4.0 * math.pi * rho


@given(
    d=st.floats(0.0, 6.0),
    theta=ANGLES,
    radius=DISCS,
    rho=TURNS,
    side=st.sampled_from((-1, 0, 1)),
    way=st.floats(0.0, 1.0),
)
def test_no_first_move_beats_it(
    d: float, theta: float, radius: float, rho: float, side: int, way: float
) -> None:
    """The dynamic programming inequality V(x) ≤ s + V(x after moving s): V is no longer than the optimum."""
    turn = side * way / rho
    if side == 0:
        x, y = way, 0.0
    else:
        x, y = rho * math.sin(way / rho), side * rho * (1.0 - math.cos(way / rho))
    dx, dy = d * math.cos(theta) - x, -d * math.sin(theta) - y
    after_d, after_theta = math.hypot(dx, dy), model.wrap(turn - math.atan2(dy, dx))
    assume(after_d > radius + 1e-9)
    here = model.shortest_path_m(d, theta, radius, rho, 1.0)
    assert here <= way + model.shortest_path_m(after_d, after_theta, radius, rho, 1.0) + 1e-5


@pytest.mark.parametrize("seed", range(60))
def test_a_path_of_that_length_exists(seed: int) -> None:
    """A search over all paths of an arc, then a line or an arc, finds one no longer than V."""
    rng = np.random.default_rng(seed)
    rho, radius = rng.choice([0.2, 0.5, 1.0, 2.0]), rng.choice([0.02, 0.1, 0.3, 0.5, 1.0])
    d, theta = radius + rng.exponential(1.5), rng.uniform(-math.pi, math.pi)
    found = min(_search(d, theta, radius, rho, first, second) for first in (-1, 1) for second in (-1, 0, 1))
    assert model.shortest_path_m(d, theta, radius, rho, 1.0) == pytest.approx(found, abs=0.01)


def _search(d: float, theta: float, radius: float, rho: float, first: int, second: int) -> float:
    """Shortest path of an arc to the side `first`, then to `second` (0: straight), on a grid of arcs."""
    tx, ty = d * math.cos(theta), -d * math.sin(theta)
    arc = np.linspace(0.0, 2.0 * math.pi, 20_001)
    x, y, heading = rho * np.sin(arc), first * rho * (1.0 - np.cos(arc)), first * arc
    inside = np.hypot(x - tx, y - ty) <= radius
    best = rho * float(arc[np.argmax(inside)]) if inside.any() else math.inf
    dx, dy = tx - x, ty - y
    if second == 0:
        ahead = dx * np.cos(heading) + dy * np.sin(heading)
        aside = dy * np.cos(heading) - dx * np.sin(heading)
        hit = (np.abs(aside) <= radius) & (ahead >= 0.0) & ~inside
        rest = ahead - np.sqrt(np.maximum(radius**2 - aside**2, 0.0))
    else:
        cx, cy = x - second * rho * np.sin(heading), y + second * rho * np.cos(heading)
        far = np.hypot(tx - cx, ty - cy)
        hit = (np.abs(far - rho) <= radius) & ~inside
        spread = np.arccos(np.clip((rho**2 + far**2 - radius**2) / (2.0 * rho * far), -1.0, 1.0))
        between = np.arctan2(ty - cy, tx - cx) - np.arctan2(y - cy, x - cx)
        rest = rho * ((second * between - spread) % (2.0 * math.pi))
    return min(best, float((rho * arc + rest)[hit].min())) if hit.any() else best


@given(d=st.floats(0.0, 30.0), more=st.floats(0.0, 10.0), theta=ANGLES, radius=DISCS, rho=TURNS)
def test_far_away_farther_is_longer(d: float, more: float, theta: float, radius: float, rho: float) -> None:
    """Close by it is not so: a target just abeam of a vehicle that turns wide needs a detour."""
    d += radius + 4.0 * rho
    length = model.shortest_path_m(d, theta, radius, rho, 1.0)
    assert length <= model.shortest_path_m(d + more, theta, radius, rho, 1.0) + 1e-9
