"""Others on the onboard link: a second companion, commander or vehicle. Faults switch them on.

What is sent here is not the autopilot's: each message has ids of its own.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from pymavlink.dialects.v20 import development as mavlink

from companion.types import Party, PartyHeard
from sitl_mock.clock import Clock
from sitl_mock.faults import Fault, Faults

OTHER_SYSTEM = 42
"""The id of the second vehicle, and the one that ours takes when its id changes."""
COMMANDER_COMPONENT = 195
_COMPANION_COMPONENT = 191


class Visitor(NamedTuple):
    """A message, and whose it is."""

    system: int
    component: int
    message: Any


class Visitors:
    """Who else speaks now. Time comes in through `step`."""

    def __init__(self, faults: Faults) -> None:
        self._faults = faults
        self._beats, self._setpoints = Clock(1.0), Clock(20.0)

    def step(self, steps: int, system: int) -> list[Visitor]:
        """What others say in this step; `system`: our vehicle's id."""
        beat, setpoint = self._beats.due(steps), self._setpoints.due(steps)
        if not self._faults.any:
            return []
        said = []
        if beat and self._faults.active(Fault.TWIN):
            said.append(Visitor(system, _COMPANION_COMPONENT, _heartbeat(autopilot=False)))
        if beat and self._faults.active(Fault.SECOND_VEHICLE):
            said.append(Visitor(OTHER_SYSTEM, mavlink.MAV_COMP_ID_AUTOPILOT1, _heartbeat(autopilot=True)))
        if setpoint and self._faults.active(Fault.SECOND_COMMANDER):
            said.append(Visitor(system, COMMANDER_COMPONENT, _standstill(system)))
        return said

    def heard(self, steps: int, t_ns: int) -> list[PartyHeard]:
        """The same as a simulated app is told it."""
        return [
            PartyHeard(t_ns, _PARTY[v.component], v.system, v.component, v.message.get_type())
            for v in self.step(steps, 1)
        ]


_PARTY = {
    _COMPANION_COMPONENT: Party.TWIN,
    mavlink.MAV_COMP_ID_AUTOPILOT1: Party.AUTOPILOT,
    COMMANDER_COMPONENT: Party.COMMANDER,
}


def _heartbeat(autopilot: bool) -> Any:
    if autopilot:
        return mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, 1, 4 << 16 | 3 << 24, 3, 3
        )
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3
    )


def _standstill(system: int) -> Any:
    """A BODY_NED setpoint of zero speed."""
    return mavlink.MAVLink_set_position_target_local_ned_message(
        0, system, 1, mavlink.MAV_FRAME_BODY_NED, 1479, *([0.0] * 11)
    )
