"""Flight modes as autopilots number them, the telemetry that a flight asks for, and what steers."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from pymavlink.dialects.v20 import development as mavlink

from companion.settings import VehicleSettings
from companion.types import FlightMode

_PX4_MODES = {
    (1, 0): FlightMode.MANUAL,
    (2, 0): FlightMode.ALTCTL,
    (3, 0): FlightMode.POSCTL,
    (4, 1): FlightMode.AUTO_READY,
    (4, 2): FlightMode.AUTO_TAKEOFF,
    (4, 3): FlightMode.AUTO_LOITER,
    (4, 4): FlightMode.AUTO_MISSION,
    (4, 5): FlightMode.AUTO_RTL,
    (4, 6): FlightMode.AUTO_LAND,
    (5, 0): FlightMode.ACRO,
    (6, 0): FlightMode.OFFBOARD,
    (7, 0): FlightMode.STABILIZED,
}
"""PX4 custom mode (main, sub) → mode."""

PX4_CUSTOM = {mode: number for number, mode in _PX4_MODES.items()}
"""Mode → PX4 custom mode (main, sub)."""


def px4_mode(custom_mode: int) -> FlightMode:
    """PX4's custom_mode as a flight mode."""
    main, sub = (custom_mode >> 16) & 0xFF, (custom_mode >> 24) & 0xFF
    return _PX4_MODES.get((main, sub if main == 4 else 0), FlightMode.OTHER)


def _px4_parameters(mode: FlightMode) -> tuple[float, ...]:
    return (mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, *PX4_CUSTOM[mode])


_ARDUPILOT_MODES = {
    0: FlightMode.STABILIZED,
    1: FlightMode.ACRO,
    2: FlightMode.ALTCTL,
    3: FlightMode.AUTO_MISSION,
    4: FlightMode.OFFBOARD,
    5: FlightMode.POSCTL,
    6: FlightMode.AUTO_RTL,
    9: FlightMode.AUTO_LAND,
    16: FlightMode.POSCTL,
    17: FlightMode.AUTO_LOITER,
    21: FlightMode.AUTO_RTL,
}
"""ArduCopter's custom_mode → mode. GUIDED (4) is OFFBOARD; LOITER (5) and POSHOLD (16) obey the sticks,
BRAKE (17) holds whatever the throttle stick says."""

_ARDUPILOT_NUMBER = {FlightMode.AUTO_LAND: 9, FlightMode.AUTO_LOITER: 17}
"""The modes that are asked for."""


def ardupilot_mode(custom_mode: int) -> FlightMode:
    """ArduCopter's custom_mode as a flight mode."""
    return _ARDUPILOT_MODES.get(custom_mode, FlightMode.OTHER)


def _ardupilot_parameters(mode: FlightMode) -> tuple[float, ...]:
    return (mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED, _ARDUPILOT_NUMBER[mode])


class Dialect(NamedTuple):
    """How one kind of autopilot speaks of modes."""

    vendor: int
    """MAV_AUTOPILOT in its HEARTBEAT."""
    mode: Callable[[int], FlightMode]
    """custom_mode → mode."""
    request: Callable[[FlightMode], tuple[float, ...]]
    """Mode → the parameters of MAV_CMD_DO_SET_MODE."""
    rates_hz: dict[str, float]
    """Messages that tell the mode, and how often they are asked for."""


DIALECTS = {
    "px4": Dialect(mavlink.MAV_AUTOPILOT_PX4, px4_mode, _px4_parameters, {"CURRENT_MODE": 20.0}),
    "ardupilot": Dialect(
        mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA,
        ardupilot_mode,
        _ardupilot_parameters,
        {"HEARTBEAT": 5.0},
    ),
}
"""By `vehicle.kind`."""

STEERING = frozenset(
    {
        "SET_POSITION_TARGET_LOCAL_NED",
        "SET_POSITION_TARGET_GLOBAL_INT",
        "SET_ATTITUDE_TARGET",
        "SET_ACTUATOR_CONTROL_TARGET",
    }
)
"""Setpoints: whoever sends these to our vehicle flies it."""

_LANDED_RATE_HZ = 5.0


def wanted_rates(settings: VehicleSettings) -> dict[str, float]:
    """The messages that a flight asks for by name, and how often, Hz: what `companion check` judges too."""
    hz = settings.telemetry_rate_hz
    return {
        "ATTITUDE": hz,
        "LOCAL_POSITION_NED": hz,
        **DIALECTS[settings.kind].rates_hz,
        "EXTENDED_SYS_STATE": _LANDED_RATE_HZ,
    }


def message_id(name: str) -> int:
    """A message's number."""
    number: int = getattr(mavlink, f"MAVLINK_MSG_ID_{name}")
    return number
