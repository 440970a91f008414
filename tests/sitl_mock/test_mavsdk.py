"""A client that this project did not write flies the mock: MAVSDK 4 on the ground station's link."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from math import hypot
from typing import Any

import pytest

from tests.sitl_mock.process import free_udp_port, running_mock

pytest.importorskip("mavsdk")

from mavsdk.asyncio import Configuration, Mavsdk
from mavsdk.asyncio.plugins.action import ActionAsync
from mavsdk.asyncio.plugins.offboard import OffboardAsync
from mavsdk.asyncio.plugins.telemetry import TelemetryAsync
from mavsdk.plugins.offboard import VelocityBodyYawspeed
from mavsdk.plugins.telemetry import FlightMode, LandedState

TAKE_OFF_M = 1.5


async def until(
    read: Callable[[], Awaitable[Any]], holds: Callable[[Any], bool], limit_s: float = 40.0
) -> Any:
    """Poll telemetry until it says what is waited for."""
    async with asyncio.timeout(limit_s):
        while not holds(value := await read()):
            await asyncio.sleep(0.05)
    return value


async def fly(port: int) -> None:
    """Health, take-off, offboard velocity forwards and turning, stop, land, disarmed."""
    mavsdk = Mavsdk(Configuration.create_manual(245, 190, True))
    await mavsdk.add_any_connection(f"udpin://127.0.0.1:{port}")
    system = await mavsdk.first_autopilot(40.0)
    assert system is not None, "MAVSDK does not discover the mock"
    telemetry, action, offboard = TelemetryAsync(system), ActionAsync(system), OffboardAsync(system)
    await telemetry.set_rate_position_velocity_ned(20.0)

    health = await until(telemetry.health, lambda h: h.is_armable and h.is_home_position_ok)
    assert health.is_local_position_ok and health.is_global_position_ok
    assert await telemetry.landed_state() == LandedState.ON_GROUND

    await action.set_takeoff_altitude(TAKE_OFF_M)
    assert await action.get_takeoff_altitude() == pytest.approx(TAKE_OFF_M)
    await action.arm()
    await action.takeoff()
    await until(telemetry.flight_mode, lambda mode: mode == FlightMode.TAKEOFF)
    await until(telemetry.flight_mode, lambda mode: mode == FlightMode.HOLD)
    await until(telemetry.position_velocity_ned, lambda p: p.position.down_m < -TAKE_OFF_M + 0.3)

    start = (await telemetry.position_velocity_ned()).position
    await offboard.set_velocity_body(VelocityBodyYawspeed(1.0, 0.0, 0.0, 0.0))
    await offboard.start()
    await until(telemetry.flight_mode, lambda mode: mode == FlightMode.OFFBOARD)
    await until(
        telemetry.position_velocity_ned,
        lambda p: hypot(p.position.north_m - start.north_m, p.position.east_m - start.east_m) > 1.5,
    )
    moving = (await telemetry.position_velocity_ned()).velocity
    assert hypot(moving.north_m_s, moving.east_m_s) == pytest.approx(1.0, abs=0.15)
    await offboard.set_velocity_body(VelocityBodyYawspeed(0.0, 0.0, 0.0, 30.0))
    await until(
        telemetry.position_velocity_ned,
        lambda p: hypot(p.velocity.north_m_s, p.velocity.east_m_s) < 0.15,
    )
    rate = await until(telemetry.attitude_angular_velocity_body, lambda r: r.yaw_rad_s > 0.3)
    assert rate.yaw_rad_s < 0.7
    await offboard.stop()
    await until(telemetry.flight_mode, lambda mode: mode == FlightMode.HOLD)

    await action.land()
    await until(telemetry.landed_state, lambda state: state == LandedState.LANDING)
    await until(telemetry.landed_state, lambda state: state == LandedState.ON_GROUND)
    await until(telemetry.armed, lambda armed: not armed)
    mavsdk.destroy()


def test_mavsdk_flies_the_mock() -> None:
    onboard, gcs = free_udp_port(), free_udp_port()
    with running_mock(
        "--mavlink", f"udpout:127.0.0.1:{onboard}", "--gcs", f"udpout:127.0.0.1:{gcs}",
        "--param", "MPC_TKO_RAMP_T=0.5", "--param", "MPC_TKO_SPEED=3", "--param", "MPC_LAND_SPEED=1.5",
        "--param", "MPC_LAND_CRWL=1", "--param", "COM_DISARM_LAND=0.2",
    ):  # fmt: skip
        asyncio.run(fly(gcs))
