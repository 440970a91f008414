"""The vehicle's kinematics."""

from __future__ import annotations

from math import cos, hypot, isfinite, pi, sin

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sitl_mock.scenario import Scenario
from sitl_mock.vehicle import STEP_S, Vehicle

IDEAL = Scenario(
    yaw_rate_lag_s=0.0,
    yaw_rate_delay_s=0.0,
    yaw_rate_gain=1.0,
    yaw_rate_creep=0.0,
    velocity_lag_s=0.0,
    velocity_delay_s=0.0,
    vertical_lag_s=0.0,
)
speeds = st.floats(-2.0, 2.0)


def flying(scenario: Scenario, height_m: float = 3.0) -> Vehicle:
    """A vehicle at the origin, in the air, the nose to the East."""
    vehicle = Vehicle(scenario, 0.0, 0.0, height_m, 0.0)
    vehicle.motors_on = True
    return vehicle


def test_ideal_plant_does_what_it_is_told_at_once() -> None:
    vehicle = flying(IDEAL)
    vehicle.command(0.5, -0.25, 0.2, 0.4)
    vehicle.step()
    assert (vehicle.vx_m_s, vehicle.vy_m_s, vehicle.climb_m_s) == (0.5, -0.25, 0.2)
    assert vehicle.yaw_rate_rad_s == pytest.approx(0.4)


def test_ideal_plant_flies_the_circle_of_the_unicycle() -> None:
    """Speed 0.5 along the nose at 0.5 rad/s: a circle of 1 m, back at its start after 4π s."""
    vehicle = flying(IDEAL)
    for _ in range(round(4 * pi / STEP_S)):
        vehicle.command(0.5 * cos(vehicle.heading_rad), 0.5 * sin(vehicle.heading_rad), 0.0, 0.5)
        vehicle.step()
        assert hypot(vehicle.x_m, vehicle.y_m - 1.0) == pytest.approx(1.0, abs=0.01)
    assert hypot(vehicle.x_m, vehicle.y_m) < 0.02
    assert vehicle.path_m == pytest.approx(2 * pi, rel=1e-3)


def test_dead_time_and_lags() -> None:
    """Nothing moves during the dead time; the area under a step's rest is dead time plus lags."""
    scenario = Scenario(velocity_delay_s=0.2, velocity_lag_s=0.6)
    vehicle = flying(scenario)
    vehicle.command(1.0, 0.0, 0.0, 0.0)
    missing = 0.0
    for step in range(1000):
        vehicle.step()
        if (step + 1) * STEP_S <= 0.2:
            assert vehicle.vx_m_s == 0.0
        missing += (1.0 - vehicle.vx_m_s) * STEP_S
    assert missing == pytest.approx(0.8, abs=2 * STEP_S)


def test_ground_stops_everything_but_a_lift_off() -> None:
    vehicle = flying(Scenario(), height_m=0.5)
    vehicle.command(1.0, 0.0, -1.0, 0.5)
    for _ in range(300):
        vehicle.step()
        assert vehicle.height_m >= 0.0
    assert vehicle.on_ground
    assert (vehicle.vx_m_s, vehicle.climb_m_s, vehicle.yaw_rate_rad_s) == (0.0, 0.0, 0.0)
    rest = vehicle.x_m
    vehicle.command(0.0, 0.0, 1.0, 0.0)
    for _ in range(200):
        vehicle.step()
    assert vehicle.height_m > 1.0
    assert vehicle.x_m == rest


def test_without_motors_it_falls() -> None:
    vehicle = flying(Scenario(), height_m=5.0)
    vehicle.motors_on = False
    steps = 0
    while not vehicle.on_ground:
        vehicle.step()
        steps += 1
    assert steps * STEP_S == pytest.approx(1.0, abs=0.05)


@given(st.lists(st.tuples(speeds, speeds, speeds, speeds), min_size=1, max_size=20))
@settings(max_examples=60)
def test_bounded_commands_give_bounded_motion(commands: list[tuple[float, float, float, float]]) -> None:
    vehicle = flying(Scenario(), height_m=50.0)
    for command in commands:
        vehicle.command(*command)
        for _ in range(20):
            vehicle.step()
            state = (vehicle.vx_m_s, vehicle.vy_m_s, vehicle.climb_m_s, vehicle.yaw_rate_rad_s)
            assert all(isfinite(v) and abs(v) <= 2.0 + 1e-9 for v in state)
            assert -pi < vehicle.heading_rad <= pi


@given(st.lists(st.tuples(speeds, speeds, speeds), min_size=1, max_size=12))
@settings(max_examples=40)
def test_motion_is_mirror_symmetric(commands: list[tuple[float, float, float]]) -> None:
    """Mirrored commands give the mirrored flight."""
    one, other = flying(Scenario()), flying(Scenario())
    for vx, vy, yaw_rate in commands:
        one.command(vx, vy, 0.0, yaw_rate)
        other.command(vx, -vy, 0.0, -yaw_rate)
        for _ in range(15):
            one.step()
            other.step()
    assert (one.x_m, one.y_m) == pytest.approx((other.x_m, -other.y_m), abs=1e-12)
    assert sin(one.heading_rad) == pytest.approx(-sin(other.heading_rad), abs=1e-12)
