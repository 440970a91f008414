"""The closed-form gains against two solvers, over the whole range of distance and bearing."""

from __future__ import annotations

import math
from typing import Any

import control
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import solve_continuous_are

from companion.guidance import lq, model

DISTANCES = np.geomspace(model.NEAR_M, 60.0, 12)
BEARINGS = [s * b for b in (1e-3, 0.01, 0.3, 1.0, 1.6, 2.5, math.pi - 1e-3) for s in (-1.0, 1.0)]
PAPER = (0.5, 1.0, 100.0)


def _paper_system(d: float, theta: float) -> tuple[Any, Any]:
    m = model.jacobian(d, theta, 0.5)
    return np.array([[0.0, m.a], [-m.b, m.c]]), np.array([[0.0], [1.0]])


@pytest.mark.parametrize("theta", BEARINGS)
@pytest.mark.parametrize("d", DISTANCES)
def test_paper_gains_solve_the_regulators_riccati_equation(d: float, theta: float) -> None:
    q1, q2, r = PAPER
    a, b = _paper_system(d, theta)
    p = solve_continuous_are(a, b, np.diag([q1, q2]), [[r]])
    by_control, _, _ = control.lqr(a, b, np.diag([q1, q2]), [[r]])
    k = lq.paper_gains(d, theta, 0.5, *PAPER)
    assert k == pytest.approx((b.T @ p / r)[0], rel=1e-6, abs=1e-9)
    assert k == pytest.approx(by_control[0], rel=1e-6, abs=1e-9)


@given(
    d=st.floats(model.NEAR_M, 1e3),
    theta=st.floats(-math.pi, math.pi).filter(lambda t: abs(math.sin(t)) > 1e-12),
    v=st.floats(0.05, 5.0),
    q1=st.floats(1e-3, 1e3),
    q2=st.floats(0.0, 1e3),
    r=st.floats(1e-2, 1e3),
)
def test_paper_gains_are_a_root_and_stabilise_where_solvers_give_up(
    d: float, theta: float, v: float, q1: float, q2: float, r: float
) -> None:
    k = lq.paper_gains(d, theta, v, q1, q2, r)
    m = model.jacobian(d, theta, v)
    p12, p22 = r * k.k1, r * k.k2
    top = -2.0 * m.b * p12 - p12 * p12 / r + q1
    bottom = 2.0 * m.a * p12 + 2.0 * m.c * p22 - p22 * p22 / r + q2
    assert abs(top) <= 1e-9 * (q1 + 4.0 * m.b**2 * r)
    assert abs(bottom) <= 1e-9 * (q2 + r * (4.0 * m.c**2 + k.k2**2 + abs(m.a * k.k1)))
    # closed loop s² + (k2 − c) s + a (b + k1): both coefficients positive
    assert k.k2 - m.c > 0.0
    assert m.a * (m.b + k.k1) > 0.0


def test_near_the_line_of_sight_the_paper_law_is_a_relay_towards_it() -> None:
    for theta in (1e-6, -1e-6):
        omega = lq.paper_yaw_rate(10.0, theta, lq.paper_gains(10.0, theta, 0.5, *PAPER))
        assert omega == pytest.approx(-math.copysign(10.0 * math.sqrt(0.5 / 100.0), theta), rel=1e-3)


def test_the_equation_as_printed_pushes_away_from_the_line_of_sight() -> None:
    """The erratum of Eq. (11): the printed, transposed form gives k1 the other sign near θ = 0."""
    q1, q2, r = PAPER
    a, b = _paper_system(10.0, 0.01)
    printed = solve_continuous_are(a.T, b, np.diag([q1, q2]), [[r]])
    assert (b.T @ printed / r)[0, 0] < 0.0 < lq.paper_gains(10.0, 0.01, 0.5, *PAPER).k1


@pytest.mark.parametrize("lag", [0.02, 0.2, 0.47, 2.0])
@pytest.mark.parametrize("d", DISTANCES)
@pytest.mark.parametrize("q", [(16.0, 1e-6), (1.0, 0.5)])
def test_bearing_gains_are_those_of_a_solver(d: float, lag: float, q: tuple[float, float]) -> None:
    a = np.array([[0.5 / d, 1.0], [0.0, -1.0 / lag]])
    b = np.array([[0.0], [1.0 / lag]])
    by_control, _, _ = control.lqr(a, b, np.diag(q), [[1.0]])
    p = solve_continuous_are(a, b, np.diag(q), [[1.0]])
    k = lq.bearing_gains(d, 0.5, lag, *q, 1.0)
    assert k == pytest.approx((b.T @ p)[0], rel=1e-7)
    assert k == pytest.approx(by_control[0], rel=1e-7)


@pytest.mark.parametrize("d", DISTANCES)
def test_without_a_lag_the_bearing_alone_is_fed_back(d: float) -> None:
    by_control, _, _ = control.lqr([[0.5 / d]], [[1.0]], [[16.0]], [[1.0]])
    assert lq.bearing_gains(d, 0.5, 0.0, 16.0, 0.0, 1.0) == pytest.approx((by_control[0, 0], 0.0))
