"""PX4's EVENT (410) in words: what it tells a companion instead of STATUSTEXT.

An event's number is the 24-bit FNV-1a hash of its name, with a component's number (1: the autopilot) above
it; its arguments are packed without gaps. Only what explains a mode change is known here; names and arguments
as PX4 1.17 sends them.
"""

from __future__ import annotations

import struct
from typing import Any, ClassVar

from pymavlink.dialects.v20 import development as mavlink

from companion.link.modes import px4_mode

EVENT_ID = 410


class EventMessage(mavlink.MAVLink_message):  # type: ignore[misc]
    """EVENT: pymavlink's dialects do not have it. In the form that its decoder expects of generated ones."""

    id = EVENT_ID
    msgname = "EVENT"
    fieldnames: ClassVar = [
        "destination_component", "destination_system", "id", "event_time_boot_ms", "sequence", "log_levels",
        "arguments",
    ]  # fmt: skip
    orders: ClassVar = [3, 4, 0, 1, 2, 5, 6]
    lengths: ClassVar = [1] * 7
    crc_extra = 160
    unpacker = struct.Struct("<IIHBBB40s")

    def __init__(self, component: int, system: int, *fields: Any) -> None:
        super().__init__(EVENT_ID, "EVENT")
        self._fieldnames = self.fieldnames
        self.destination_component, self.destination_system = component, system
        self.id, self.event_time_boot_ms, self.sequence, self.log_levels, self.arguments = fields


mavlink.mavlink_map[EVENT_ID] = EventMessage

_OFFBOARD_BIT = 1 << 14
"""OFFBOARD in a mask of navigation states."""
_ACTION = ("none", "warning", "Position", "Altitude", "Stabilized", "Hold", "Return", "Land", "descent",
           "disarming", "termination")  # fmt: skip
"""events::px4::enums::failsafe_action_t, by number."""


def event_id(name: str) -> int:
    """The number of an event of the autopilot's."""
    number = 0x811C9DC5
    for byte in name.encode():
        number = (number ^ byte) * 0x01000193 & 0xFFFFFFFF
    return number & 0xFFFFFF | 1 << 24


_FAILSAFE = frozenset(map(event_id, ("commander_failsafe_enter_generic", "commander_failsafe_enter")))
_CANNOT_RUN = {
    event_id("check_modes_offboard_signal"): "no offboard signal",
    event_id("check_modes_local_pos"): "no valid position estimate",
    event_id("check_modes_global_pos"): "no valid global position estimate",
    event_id("check_modes_local_alt"): "no valid altitude estimate",
    event_id("check_modes_attitude"): "no valid attitude estimate",
    event_id("check_modes_angular_velocity"): "no valid angular velocity",
}
"""Why modes cannot run: the arguments begin with the mask of those modes."""
_PLAIN = {
    event_id("commander_arm_denied_resolve_failures"): "arming denied: resolve system health failures first",
}


def event_words(number: int, arguments: bytes) -> str:
    """The event in words; empty for one that explains nothing. Zeros at the end may be missing."""
    arguments = arguments.ljust(5, b"\0")
    first = int.from_bytes(arguments[:4], "little")
    if number in _FAILSAFE:
        action = arguments[4]
        name = _ACTION[action] if action < len(_ACTION) else f"action {action}"
        return f"failsafe in {px4_mode(first).value}: {name}"
    if number in _CANNOT_RUN:
        return f"OFFBOARD cannot run: {_CANNOT_RUN[number]}" if first & _OFFBOARD_BIT else ""
    return _PLAIN.get(number, "")
