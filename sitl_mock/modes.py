"""PX4's flight modes and what they look like on the wire, and its answers to commands."""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import NamedTuple

from companion.types import FlightMode


class Result(IntEnum):
    """MAV_RESULT, as far as PX4 uses it here."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4


class Mode(Enum):
    """PX4's navigation states. DESCEND, the blind descent, is entered by a failsafe only."""

    __hash__ = object.__hash__  # looked up on every step; Enum's own hashes the name

    MANUAL = "manual"
    ALTCTL = "altctl"
    POSCTL = "posctl"
    ACRO = "acro"
    STABILIZED = "stabilized"
    OFFBOARD = "offboard"
    READY = "ready"
    TAKEOFF = "takeoff"
    LOITER = "loiter"
    MISSION = "mission"
    RTL = "rtl"
    LAND = "land"
    DESCEND = "descend"

    @property
    def is_auto(self) -> bool:
        """True for the automatic modes (stick override by COM_RC_OVERRIDE bit 0)."""
        return self in _AUTO

    @property
    def is_manual(self) -> bool:
        """True for the modes that need a radio control."""
        return self in _MANUAL


_AUTO = frozenset({Mode.READY, Mode.TAKEOFF, Mode.LOITER, Mode.MISSION, Mode.RTL, Mode.LAND})
_MANUAL = frozenset({Mode.MANUAL, Mode.ALTCTL, Mode.POSCTL, Mode.ACRO, Mode.STABILIZED})


class Wire(NamedTuple):
    """A mode on the wire: PX4's main and sub mode, MAV_STANDARD_MODE, base-mode flags, its common name."""

    main: int
    sub: int
    standard: int
    base: int
    name: FlightMode

    @property
    def custom(self) -> int:
        """HEARTBEAT.custom_mode."""
        return self.main << 16 | self.sub << 24


_CUSTOM, _AUTO_FLAG, _GUIDED, _STABILIZE, _MANUAL_FLAG = 1, 4, 8, 16, 64
_AUTOMATIC = _CUSTOM | _AUTO_FLAG | _GUIDED | _STABILIZE
_STICKS = _CUSTOM | _MANUAL_FLAG | _STABILIZE

WIRE: dict[Mode, Wire] = {
    Mode.MANUAL: Wire(1, 0, 0, _CUSTOM | _MANUAL_FLAG, FlightMode.MANUAL),
    Mode.ALTCTL: Wire(2, 0, 4, _STICKS, FlightMode.ALTCTL),
    Mode.POSCTL: Wire(3, 0, 1, _STICKS, FlightMode.POSCTL),
    Mode.ACRO: Wire(5, 0, 0, _CUSTOM | _MANUAL_FLAG, FlightMode.ACRO),
    Mode.OFFBOARD: Wire(6, 0, 0, _CUSTOM | _STABILIZE, FlightMode.OFFBOARD),
    Mode.STABILIZED: Wire(7, 0, 0, _STICKS, FlightMode.STABILIZED),
    Mode.READY: Wire(4, 1, 0, _AUTOMATIC, FlightMode.AUTO_READY),
    Mode.TAKEOFF: Wire(4, 2, 8, _AUTOMATIC, FlightMode.AUTO_TAKEOFF),
    Mode.LOITER: Wire(4, 3, 0, _AUTOMATIC, FlightMode.AUTO_LOITER),
    Mode.MISSION: Wire(4, 4, 6, _AUTOMATIC, FlightMode.AUTO_MISSION),
    Mode.RTL: Wire(4, 5, 5, _AUTOMATIC, FlightMode.AUTO_RTL),
    Mode.LAND: Wire(4, 6, 7, _AUTOMATIC, FlightMode.AUTO_LAND),
    # Recorded: PX4 tells its blind descent as POSCTL.
    Mode.DESCEND: Wire(3, 0, 1, _STICKS, FlightMode.POSCTL),
}

BY_CUSTOM: dict[tuple[int, int], Mode] = {
    (wire.main, wire.sub): mode for mode, wire in WIRE.items() if mode is not Mode.DESCEND
}
"""(main, sub) as DO_SET_MODE tells them."""

BY_NAME: dict[FlightMode, Mode] = {wire.name: mode for mode, wire in WIRE.items() if mode is not Mode.DESCEND}
