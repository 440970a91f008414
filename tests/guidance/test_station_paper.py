"""The paper's station keeping: its gains against a Riccati solver, and what the scheme does, and does not."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import solve_continuous_are

from companion.bench.station_plant import Air, Field, fly, random_field
from companion.guidance import model
from companion.guidance.scheme import STAY, TRACK
from companion.guidance.station_paper import (
    Parameters,
    error,
    integral_gains,
    station_paper,
    steer,
)

IDEAL = Air(dropout=0.0, reflected=0.0, yaw_rate_lag_s=1e-3, speed_lag_s=1e-3, limit_s=120.0, hold_s=0.1)


@given(
    st.floats(0.3, 30.0),
    st.floats(-3.1, 3.1).filter(lambda theta: abs(math.sin(theta)) > 0.02),
    st.floats(0.01, 10.0),
)
def test_gains_solve_the_riccati_equation(d: float, theta: float, q: float) -> None:
    m = model.jacobian(d, theta, 0.5)
    a = np.array([[0.0, m.a, 0.0], [-m.b, m.c, 0.0], [-1.0, 0.0, 0.0]])
    b = np.array([[0.0], [1.0], [0.0]])
    p = solve_continuous_are(a, b, np.diag([0.0, 0.0, q]), np.array([[100.0]]))
    expected = (b.T @ p / 100.0)[0]
    np.testing.assert_allclose(integral_gains(d, theta, 0.5, q, 100.0), expected, rtol=1e-5, atol=1e-7)


@given(st.floats(0.5, 20.0), st.floats(0.05, 3.0), st.floats(-50.0, 50.0))
def test_the_law_is_its_own_mirror_image(d: float, theta: float, integral: float) -> None:
    p = station_paper((3.0, 4.0, 5.0), 0.5, 1.0, 0.3).p
    assert steer(p, d, theta, integral) == pytest.approx(-steer(p, d, -theta, integral), abs=1e-9)


def enters(field: Field, seconds: float) -> bool:
    """Fly by the law alone, with the true state; the vehicle never stops."""
    p: Parameters = station_paper(field.distances_m, 0.5, 1.0, 0.3).p
    x = y = heading = 0.0
    w = [0.0] * len(field.beacons)
    for _ in range(int(seconds / 0.05)):
        d = [math.dist(b, (x, y)) for b in field.beacons]
        e = [error(star, now) for star, now in zip(field.distances_m, d, strict=True)]
        w = [wi + ei * 0.05 for wi, ei in zip(w, e, strict=True)]
        i = max(range(len(e)), key=lambda k: abs(e[k]))
        bx, by = field.beacons[i]
        omega = steer(p, d[i], model.wrap(heading - math.atan2(by - y, bx - x)), w[i])
        x += 0.025 * math.cos(heading + 0.025 * omega)
        y += 0.025 * math.sin(heading + 0.025 * omega)
        heading += 0.05 * omega
        if math.dist((x, y), field.station) <= 0.3:
            return True
    return False


def test_with_the_true_state_most_flights_come_by_the_station() -> None:
    rng = random.Random(3)
    fields = [random_field(rng) for _ in range(30)]
    assert np.mean([enters(field, 300.0) for field in fields]) >= 0.7


def test_it_stops_where_all_errors_are_small_which_need_not_be_the_station() -> None:
    """From 4 m away as in the paper's Fig. 6, bearings known, ideal vehicle: few stops are inside ε."""
    rng = random.Random(4)
    inside = 0
    for k in range(10):
        field = random_field(rng)
        dx, dy = field.station[0] - 4.0, field.station[1] - 1.0
        near = Field((4.0, 1.0), tuple((x - dx, y - dy) for x, y in field.beacons))
        bearings = tuple(-math.atan2(y, x) for x, y in near.beacons)
        scheme = station_paper(near.distances_m, 0.5, 1.0, 0.3, bearings_rad=bearings)
        inside += fly(scheme, near, k, IDEAL).worst_m <= 0.3
    assert inside <= 6


def test_it_rests_where_the_distances_are_those_given() -> None:
    scheme = station_paper((3.0, 4.0, 5.0), 0.5, 1.0, 0.3)
    s = scheme.initial(scheme.p)
    s, wanted = scheme.command(scheme.p, s, 0.05, 0.0)
    assert wanted.v_m_s == 0.0
    for beacon, range_m in enumerate((3.1, 3.9, 5.2)):
        s = scheme.update(scheme.p, s, beacon, range_m, 0.07, 0.0, 0.0)
    s, wanted = scheme.command(scheme.p, s, 0.05, 0.0)
    assert (wanted.v_m_s, wanted.purpose) == (0.0, STAY)
    s = scheme.update(scheme.p, s, 2, 5.4, 0.07, 0.0, 0.0)
    s, wanted = scheme.command(scheme.p, s, 0.05, 0.0)
    assert (wanted.v_m_s, wanted.purpose) == (0.5, STAY)  # it moves, and has not left
    s = scheme.update(scheme.p, s, 2, 5.7, 0.07, 0.0, 0.0)
    assert scheme.command(scheme.p, s, 0.05, 0.0)[1].purpose == TRACK
