"""The paper's observer: its poles, and that it finds the bearing while it turns steadily."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance import luenberger, model


@given(
    omega=st.floats(0.05, 3.0),
    side=st.sampled_from((-1.0, 1.0)),
    v=st.floats(0.05, 5.0),
    pole=st.floats(0.05, 3.0),
)
def test_all_three_poles_are_where_they_are_asked_for(
    omega: float, side: float, v: float, pole: float
) -> None:
    w = side * omega
    k = luenberger.gains(w, v, pole, 0.01)
    closed = np.array([[-k.x1, 0.0, -v], [-k.x2, 0.0, w], [-k.x3, -w, 0.0]])
    expected = [1.0, 3.0 * pole, 3.0 * pole**2, pole**3]
    scale = (1.0 + np.abs(closed).max()) ** 3
    assert np.poly(closed) == pytest.approx(expected, abs=1e-9 * scale)


@pytest.mark.parametrize("omega", [0.0, -0.0, 1e-9, -1e-9])
def test_where_there_is_no_gain_the_floor_keeps_it_finite(omega: float) -> None:
    k = luenberger.gains(omega, 0.5, 0.2, 0.02)
    at_floor = luenberger.gains(math.copysign(0.02, omega), 0.5, 0.2, 0.02)
    assert k == at_floor


def test_a_steady_turn_finds_the_bearing_from_a_wrong_one() -> None:
    v, omega, dt = 0.5, 0.5, 0.02
    truth, x = model.lift(8.0, 1.0), model.lift(8.0, -2.0)
    k = luenberger.gains(omega, v, 0.5, 0.02)
    m = model.step(dt, v, 0.0, omega)
    for _ in range(1500):
        truth, x = model.flow(truth, m), model.flow(x, m)
        x = luenberger.correct(x, k, truth.x1, dt)
    assert model.bearing(x) == pytest.approx(model.bearing(truth), abs=0.02)


def test_a_gap_or_a_divergence_keeps_the_numbers_finite() -> None:
    x = model.Lifted(1e6, -1e6, 1e6)
    for _ in range(100):
        x = luenberger.correct(x, luenberger.gains(0.0, 0.05, 5.0, 0.01), 0.0, 1e9)
    assert all(abs(value) <= luenberger.BOUND for value in x)
