"""Flight modes as autopilots number them."""

from __future__ import annotations

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
