"""The lift that knows of drift: exact where nothing errs, and read out as what it stands for."""

from __future__ import annotations

import math
from itertools import pairwise

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance import drift, readout
from companion.guidance.drift import DriftLift, Fix, Noise

CALM = Noise(drift_m_s=0.15, drift=0.0, position=0.0, turn=0.0)
NOWHERE = Fix(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
COORDINATE = st.floats(-30.0, 30.0)
MOVE = st.tuples(st.floats(0.01, 1.0), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
DRIFT = st.floats(-0.3, 0.3)


def of(x: float, y: float, wx: float, wy: float) -> DriftLift:
    """The lift that belongs to a target and a drift, with the covariance of a fresh one."""
    half = 0.5 * (x * x + y * y)
    fresh = drift.start(max(math.hypot(x, y), 0.5), 0.01, CALM)
    s, u = x * wx + y * wy, wx * wx + wy * wy
    return msgspec.structs.replace(fresh, x1=half, x=x, y=y, wx=wx, wy=wy, s=s, u=u)


@given(x=COORDINATE, y=COORDINATE, wx=DRIFT, wy=DRIFT, moves=st.lists(MOVE, min_size=1, max_size=30))
def test_the_motion_is_linear_in_the_lift(
    x: float, y: float, wx: float, wy: float, moves: list[tuple[float, float, float]]
) -> None:
    """After any moves in any drift the states are those of where the target then is."""
    f = of(x, y, wx, wy)
    for dt_s, mx, my in moves:
        f = drift.predict(f, CALM, NOWHERE, 0.0, dt_s, mx, my)
        x, y = x - mx - wx * dt_s, y - my - wy * dt_s
    there = of(x, y, wx, wy)
    for name in ("x1", "x", "y", "wx", "wy", "s", "u"):
        assert getattr(f, name) == pytest.approx(getattr(there, name), abs=1e-6, rel=1e-9)


@given(moves=st.lists(MOVE, min_size=1, max_size=30))
def test_the_covariance_is_the_spread_of_the_states(moves: list[tuple[float, float, float]]) -> None:
    """P follows the same linear map as the states: along any direction, the variance is that of two lifts
    that differ by it."""
    f = g = of(10.0, -4.0, 0.1, 0.05)
    step = (0.3, 0.1, -0.2, 0.02, 0.03, 0.1, 0.01)
    g = msgspec.structs.replace(
        f, x1=f.x1 + step[0], x=f.x + step[1], y=f.y + step[2], wx=f.wx + step[3], wy=f.wy + step[4],
        s=f.s + step[5], u=f.u + step[6],
    )  # fmt: skip
    names = [f"p{i}{j}" for i in range(7) for j in range(i, 7)]
    pairs = [(i, j) for i in range(7) for j in range(i, 7)]
    outer = {name: step[i] * step[j] for name, (i, j) in zip(names, pairs, strict=True)}
    f = msgspec.structs.replace(f, **outer)
    for dt_s, mx, my in moves:
        f = drift.predict(f, CALM, NOWHERE, 0.0, dt_s, mx, my)
        g = drift.predict(g, CALM, NOWHERE, 0.0, dt_s, mx, my)
    apart = [getattr(g, n) - getattr(f, n) for n in ("x1", "x", "y", "wx", "wy", "s", "u")]
    for name, (i, j) in zip(names, pairs, strict=True):
        assert getattr(f, name) == pytest.approx(apart[i] * apart[j], abs=1e-6, rel=1e-6)


def heard(wx: float, wy: float) -> DriftLift:
    """A target 8 m ahead and 6 m to the left, a walk with two bends in a drift, ranges that do not err."""
    corners = [(0.0, 0.0), (3.0, 0.0), (3.0, 3.0), (7.0, 3.0)]
    f = drift.start(10.0, 0.01, CALM)
    x, y = 8.0, 6.0
    for (ax, ay), (bx, by) in pairwise(corners):
        for _ in range(80):
            mx, my, dt_s = (bx - ax) / 80.0, (by - ay) / 80.0, 0.08
            x, y = x - mx - wx * dt_s, y - my - wy * dt_s
            f = drift.predict(f, CALM, NOWHERE, 0.0, dt_s, mx, my)
            variance = 0.03**2 * (x * x + y * y)
            f = drift.correct(f, 0.5 * (x * x + y * y) - f.x1, f.p00 + variance)
    return f


@pytest.mark.parametrize("wind", [(0.0, 0.0), (0.1, 0.0), (-0.05, 0.15)])
def test_target_and_drift_are_read_out_of_a_walk(wind: tuple[float, float]) -> None:
    wx, wy = wind
    f = heard(wx, wy)
    q = readout.fix(f, 0.0, f.x, f.y, f.wx, f.wy)
    flown_s = 3 * 80 * 0.08
    assert (q.x, q.y) == pytest.approx((8.0 - 7.0 - wx * flown_s, 6.0 - 3.0 - wy * flown_s), abs=0.3)
    assert (q.wx, q.wy) == pytest.approx(wind, abs=0.03)
    assert math.sqrt(q.xx + q.yy) < 1.0


def test_what_is_read_out_is_a_target_with_a_drift() -> None:
    """Read from any nearby guess, the same comes out; and of a lift that is consistent, the lift itself."""
    f = heard(0.1, 0.05)
    q = readout.fix(f, 0.0, f.x, f.y, f.wx, f.wy)
    again = readout.fix(f, 0.0, q.x + 0.2, q.y - 0.2, q.wx + 0.02, q.wy)
    assert (again.x, again.y, again.wx, again.wy) == pytest.approx((q.x, q.y, q.wx, q.wy), abs=1e-2)
    exact = of(4.0, -2.0, 0.1, 0.0)
    q = readout.fix(exact, 0.0, 4.0, -2.0, 0.1, 0.0)
    assert (q.x, q.y, q.wx, q.wy) == pytest.approx((4.0, -2.0, 0.1, 0.0), abs=1e-9)


def test_a_height_error_that_changes_is_no_motion() -> None:
    """Noise of the measured x1 alone leaves the target's position as certain as it was."""
    f = of(1.0, 0.5, 0.0, 0.0)
    quiet = drift.predict(f, CALM, NOWHERE, 0.0, 1.0, 0.0, 0.0)
    noisy = drift.predict(f, CALM, NOWHERE, 0.02, 1.0, 0.0, 0.0)
    assert noisy == msgspec.structs.replace(quiet, p00=quiet.p00 + 0.02)
