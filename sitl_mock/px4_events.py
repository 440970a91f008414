"""PX4's EVENT (410) messages, as far as they were recorded: what it tells a companion instead of STATUSTEXT.

An event's number is the 24-bit FNV-1a hash of its name, with the component's number (1) above it.
"""

from __future__ import annotations

import struct
from typing import Any, ClassVar, NamedTuple

from pymavlink.dialects.v20 import development as mavlink

from sitl_mock.modes import WIRE, Mode

_EVENT, _CRC_EXTRA = 410, 160
_ARGUMENT_BYTES = 40
_OFFBOARD_STATE = 1 << 14
_SYSTEM_COMPONENT = 20
_ACTION = {0: 2, 1: 3, 2: 4, 3: 6, 4: 7, 5: 5}
"""COM_OBL_RC_ACT → failsafe_action_t."""


class Event(NamedTuple):
    """An event before it has a time and a sequence number."""

    name: str
    levels: int
    arguments: bytes = b""

    @property
    def number(self) -> int:
        """EVENT.id."""
        number = 0x811C9DC5
        for byte in self.name.encode():
            number = (number ^ byte) * 0x01000193 & 0xFFFFFFFF
        return number & 0xFFFFFF | 1 << 24

    def message(self, boot_ms: int, sequence: int) -> EventMessage:
        """The EVENT message."""
        return EventMessage(self.number, boot_ms, sequence & 0xFFFF, self.levels, self.arguments)


class EventMessage(mavlink.MAVLink_message):  # type: ignore[misc]
    """EVENT on the wire: pymavlink's dialects do not have it."""

    fieldnames: ClassVar = ["id", "event_time_boot_ms", "sequence", "log_levels", "arguments"]

    def __init__(self, number: int, boot_ms: int, sequence: int, levels: int, arguments: bytes) -> None:
        super().__init__(_EVENT, "EVENT")
        self.id, self.event_time_boot_ms, self.sequence = number, boot_ms, sequence
        self.log_levels, self.arguments = levels, list(arguments.ljust(_ARGUMENT_BYTES, b"\0"))

    def pack(self, mav: Any) -> bytes:
        """The packet; broadcast, as PX4 sends it."""
        payload = struct.pack(
            "<IIHBBB40B",
            self.id,
            self.event_time_boot_ms,
            self.sequence,
            0,
            0,
            self.log_levels,
            *self.arguments,
        )
        data: bytes = self._pack(mav, _CRC_EXTRA, payload)
        return data


ARMED = Event("commander_armed_by", 102, b"\4")
DISARMED_BY_LANDING = Event("commander_disarmed_by", 102, b"\6")
TAKE_OFF = Event("commander_takeoff_detected", 102)
LANDED = Event("commander_landing_detected", 102)
ARM_DENIED = Event("commander_arm_denied_resolve_failures", 98)
NO_OFFBOARD = Event("check_modes_offboard_signal", 51, struct.pack("<IB", _OFFBOARD_STATE, _SYSTEM_COMPONENT))


def failsafe(intended: Mode, offboard_action: int) -> Event:
    """`commander_failsafe_enter_generic`: the intended mode, and what is done instead."""
    action = _ACTION.get(offboard_action, 0) if intended is Mode.OFFBOARD else 0
    return Event(
        "commander_failsafe_enter_generic", 66, struct.pack("<IBB", WIRE[intended].custom, action, 0)
    )
