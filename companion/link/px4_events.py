"""PX4's EVENT (410) in words: what it tells a companion instead of STATUSTEXT.

An event's number is the 24-bit FNV-1a hash of its name, with a component's number (1: the autopilot) above
it; its arguments are packed without gaps. Only what explains a mode change is known here; names and arguments
as PX4 1.17 sends them.
"""

from __future__ import annotations

from companion.link.modes import px4_mode

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
    """The event in words; empty for one that explains nothing about OFFBOARD."""
    first = int.from_bytes(arguments[:4], "little")
    if number in _FAILSAFE and len(arguments) > 4:
        action = arguments[4]
        name = _ACTION[action] if action < len(_ACTION) else f"action {action}"
        return f"failsafe in {px4_mode(first).value}: {name}"
    if number in _CANNOT_RUN:
        return f"OFFBOARD cannot run: {_CANNOT_RUN[number]}" if first & _OFFBOARD_BIT else ""
    return _PLAIN.get(number, "")
