"""The benchmark's plant: its bound with wind, its errors, its lags, and that it is the same for everybody."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from companion.bench.batch import Flyer, fly_plain
from companion.bench.cases import CASES
from companion.bench.plant import Plant, Start, shortest_time_s, wander_start, wander_step
from companion.guidance.model import shortest_path_m
from companion.guidance.scheme import TRACK, Command, Knowledge, Scheme
from sitl_mock.estimate import Spread

D = st.floats(2.0, 30.0)
ANGLE = st.floats(-math.pi, math.pi)


# ------------------------------------------------------------------------------------------------ bound


@given(d=st.floats(0.0, 30.0), theta=ANGLE)
def test_without_wind_the_bound_is_the_shortest_path(d: float, theta: float) -> None:
    path = shortest_path_m(d, theta, 0.5, 0.5, 1.0)
    assert shortest_time_s(d, theta, 0.5, 0.5, 1.0, 0.0, 0.0) == pytest.approx(path / 0.5, abs=1e-6)


@given(d=D, wind=st.floats(-0.4, 0.4))
def test_dead_ahead_the_wind_adds_to_the_speed(d: float, wind: float) -> None:
    expected = (d - 0.5) / (0.5 + wind)
    assert shortest_time_s(d, 0.0, 0.5, 0.5, 1.0, wind, 0.0) == pytest.approx(expected, abs=1e-6)


@given(d=D, theta=ANGLE, wind=st.floats(0.0, 0.3), azimuth=ANGLE)
def test_the_bound_mirrors(d: float, theta: float, wind: float, azimuth: float) -> None:
    ahead, left = wind * math.cos(azimuth), wind * math.sin(azimuth)
    one = shortest_time_s(d, theta, 0.5, 0.5, 1.0, ahead, left)
    other = shortest_time_s(d, -theta, 0.5, 0.5, 1.0, ahead, -left)
    assert one == pytest.approx(other, abs=1e-6)


@settings(max_examples=20)
@given(d=st.floats(2.0, 12.0), theta=ANGLE, wind=st.floats(0.0, 0.3), azimuth=ANGLE)
@example(d=12.0, theta=math.pi, wind=0.25390625, azimuth=0.0)
def test_no_flight_is_earlier_than_the_bound_and_the_best_attains_it(
    d: float, theta: float, wind: float, azimuth: float
) -> None:
    v, omega, radius = 0.5, 1.0, 0.5
    ahead, left = wind * math.cos(azimuth), wind * math.sin(azimuth)
    bound = shortest_time_s(d, theta, radius, v, omega, ahead, left)
    assume(bound < 60.0)
    t = np.arange(0.0, bound + 1.0, 0.01)
    tx, ty = d * math.cos(theta), -d * math.sin(theta)

    def arrival(side: float, turn: float) -> float:
        heading = side * np.minimum(omega * t, turn)
        straight = v * np.maximum(t - turn / omega, 0.0)
        x = side * v / omega * np.sin(heading) + straight * np.cos(heading) + ahead * t
        y = side * v / omega * (1.0 - np.cos(heading)) + straight * np.sin(heading) + left * t
        inside = np.flatnonzero(np.hypot(tx - x, ty - y) <= radius)
        return float(t[inside[0]]) if len(inside) else math.inf

    # every turn, then those about the best more finely: half a degree is decimetres at the end
    turns = [(side, turn) for side in (1.0, -1.0) for turn in np.linspace(0.0, 2.0 * math.pi, 361)]
    side, turn = min(turns, key=lambda flight: arrival(*flight))
    fine = [(side, turn + more) for more in np.linspace(-0.02, 0.02, 41) if turn + more >= 0.0]
    earliest = min(arrival(*flight) for flight in fine)
    assert bound - 0.011 <= earliest <= bound + 0.05


# --------------------------------------------------------------------------------------- errors and lags


def test_an_error_has_the_spread_and_the_smoothness_that_it_should() -> None:
    spread = Spread(0.3, 0.2, 1.5)
    np.random.seed(1)
    start = [wander_start(spread) for _ in range(4000)]
    later = [wander_step(w, spread, 0.1) for w in start]
    for _ in range(14):
        later = [wander_step(w, spread, 0.1) for w in later]
    a, b = np.array([w.second for w in start]), np.array([w.second for w in later])
    assert np.std([w.value for w in start]) == pytest.approx(math.hypot(0.3, 0.2), rel=0.05)
    assert np.std(b) == pytest.approx(0.2, rel=0.06)
    # one τ later the correlation is (1 + 1) exp(−1)
    assert np.corrcoef(a, b)[0, 1] == pytest.approx(2.0 * math.exp(-1.0), abs=0.05)


class Spy(NamedTuple):
    """A scheme that only writes down what it is given, and turns as it is told to."""

    accepted: float
    ranges: list[tuple[int, float]]
    commands: list[float]
    turns: list[tuple[float, float, float]]


def _spy(v_m_s: float, omega_rad_s: float) -> tuple[Flyer, Spy]:
    spy = Spy(1.0, [], [], [])

    def predict(p: Any, s: Spy, dt_s: float, forward: float, left: float, yaw_rate: float) -> Spy:
        s.turns.append((dt_s, yaw_rate, left))
        return s

    def update(p: Any, s: Spy, beacon: int, range_m: float, *rest: float) -> Spy:
        s.ranges.append((len(s.commands), range_m))
        return s

    def command(p: Any, s: Spy, dt_s: float, yaw_rate: float) -> tuple[Spy, Command]:
        s.commands.append(yaw_rate)
        return s, Command(v_m_s, omega_rad_s, TRACK)

    scheme = Scheme(None, lambda p: spy, predict, update, command, lambda p, s: Knowledge(0.0, 0.0, 0.0, 0.0))
    return Flyer(scheme), spy


@pytest.mark.parametrize("case", ["nominal", "stock", "outage"])
def test_everybody_meets_the_same_noise_at_the_same_moments(case: str) -> None:
    plant = CASES[case].plant._replace(limit_s=20.0)
    (one, seen), (other, seen_too) = _spy(0.0, 0.0), _spy(0.5, 0.3)
    start = Start(12.0, 1.0, 7)
    _, trace = fly_plain(one, plant, start)
    _, trace_too = fly_plain(other, plant, start)
    assert [n for n, _ in seen.ranges] == [n for n, _ in seen_too.ranges]
    if case == "stock":
        return  # there the height wanders too
    noise = [r - trace[n, 4] for n, r in seen.ranges]
    noise_too = [r - trace_too[n, 4] for n, r in seen_too.ranges]
    assert noise == pytest.approx(noise_too, abs=1e-9)
    assert len(set(np.diff([n for n, _ in seen.ranges]))) > 1


def test_ranges_fall_silent_for_three_seconds_in_twenty() -> None:
    flyer, seen = _spy(0.0, 0.0)
    fly_plain(flyer, CASES["outage"].plant._replace(limit_s=60.0, dropout=0.0), Start(9.0, 0.0, 1))
    gaps = np.diff([n for n, _ in seen.ranges]) * 0.05
    assert sorted(gaps)[-2] == pytest.approx(3.0, abs=0.11)


def test_the_yaw_rate_answers_after_its_dead_time_with_its_lag() -> None:
    plant = CASES["px4"].plant._replace(limit_s=6.0)
    flyer, spy = _spy(0.5, 1.0)
    _, trace = fly_plain(flyer, plant, Start(20.0, 0.0, 1))
    t, omega = trace[:, 0], trace[:, 7]
    assert (omega[t <= 0.151] == 0.0).all()
    assert np.interp(0.62, t, omega) == pytest.approx(1.0 - math.exp(-1.0), abs=0.03)
    # what the scheme is told to have turned is what was turned
    told = sum(dt_s * rate for dt_s, rate, _ in spy.turns)
    assert told == pytest.approx(trace[-1, 3], abs=0.05)
    # in a left turn the nose leads and the vehicle slips to the right of it
    assert spy.turns[-1][2] < -0.1


def test_the_paper_and_the_air_path_agree_on_a_straight_flight() -> None:
    flyer, _ = _spy(0.5, 0.0)
    calm = Plant(yaw_rate_lag_s=0.0, velocity_lag_s=0.0)
    flight, _ = fly_plain(flyer, calm, Start(8.0, 0.0, 1))
    assert flight.path_m == pytest.approx(7.5, abs=1e-6)
    assert flight.bound_m == pytest.approx(7.5)
    assert flight.time_s == pytest.approx(15.0, abs=1e-6)
    flight, _ = fly_plain(flyer, calm._replace(drift_m_s=0.3), Start(0.4, 0.0, 1))
    assert flight.bound_m == 0.0
