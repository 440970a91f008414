"""What can be made to fail, and when: switched by a schedule (`NAME@T[:DURATION]`) or at run time."""

from __future__ import annotations

from collections.abc import Iterable
from enum import Enum
from math import inf, isfinite
from typing import NamedTuple


class Fault(Enum):
    """Everything that can be switched on; it lasts until it is switched off, unless it says otherwise."""

    RANGE_LOSS = "range-loss"
    """No beacon is heard."""
    RANGE_FROZEN = "range-frozen"
    """Every beacon repeats its last message, sequence number, stamp and all."""
    RANGE_BIAS = "range-bias"
    """Every range is 1.5 m too long: the line of sight is blocked."""
    BEACON_RESTART = "beacon-restart"
    """Once: new session, sequence numbers from 0."""
    TELEMETRY_STOP = "telemetry-stop"
    """The autopilot sends its heartbeat and answers, but no telemetry."""
    HEARTBEAT_STOP = "heartbeat-stop"
    """No heartbeat; everything else goes on."""
    LINK_LOSS = "link-loss"
    """Nothing goes in or out on the onboard link."""
    GCS_LOSS = "gcs-loss"
    """Nothing goes in or out on the ground station's link."""
    PACKET_LOSS = "packet-loss"
    """Three in ten MAVLink messages are lost, either way."""
    SETPOINTS_REFUSED = "setpoints-refused"
    """Setpoints do not reach the autopilot."""
    VELOCITY_INVALID = "velocity-invalid"
    """The velocity estimate is invalid: no local position, no OFFBOARD ("no offboard signal")."""
    GPS_LOST = "gps-lost"
    """No global position: Hold and Return are not available, nor is arming."""
    BATTERY_LOW = "battery-low"
    """The battery is at its critical level; COM_LOW_BAT_ACT says what happens."""
    BATTERY_WARNING = "battery-warning"
    """The battery is low, not critical yet: that is told, and nothing more happens."""
    TWIN = "twin"
    """A second companion with the app's own ids is heard on the onboard link."""
    SECOND_COMMANDER = "second-commander"
    """Somebody else's setpoints pass on the onboard link."""
    HIDDEN_COMMANDER = "hidden-commander"
    """Somebody else's setpoints reach the autopilot over another link and mix with the app's."""
    SECOND_VEHICLE = "second-vehicle"
    """Another autopilot, system 42, is heard on the onboard link."""
    UNSIGNED = "unsigned"
    """On a signed link the autopilot's messages carry no signature."""
    RC_SWITCH = "rc-switch"
    """Once: a pilot's switch selects POSCTL. While this or the next is on, a radio control is there."""
    RC_STICKS = "rc-sticks"
    """Once: a pilot moves the sticks; COM_RC_OVERRIDE says whether that takes over."""
    REBOOT = "reboot"
    """Once: the autopilot restarts (motors stop, silence for two seconds, clock and modes begin anew)."""
    ID_CHANGE = "id-change"
    """Once: the autopilot's system id (MAV_SYS_ID) becomes 42."""
    DISARM = "disarm"
    """Once: the motors are killed, in the air too."""


class FaultAt(NamedTuple):
    """A fault, the second at which it is switched on and how long it lasts."""

    fault: Fault
    start_s: float
    duration_s: float = inf


def parse_fault(text: str) -> FaultAt:
    """Read `NAME@T[:DURATION]`, seconds; raise ValueError, in words for a person, if it cannot be read."""
    name, at, times = text.partition("@")
    try:
        fault = Fault(name.strip().lower().replace("_", "-"))
    except ValueError:
        raise ValueError(f"fault {name!r}: must be one of {', '.join(f.value for f in Fault)}") from None
    start, colon, duration = times.partition(":")
    try:
        result = FaultAt(fault, float(start) if at else 0.0, float(duration) if colon else inf)
    except ValueError:
        raise ValueError(f"fault {text!r}: must be NAME@T or NAME@T:DURATION, in seconds") from None
    if not isfinite(result.start_s) or result.start_s < 0.0 or not result.duration_s > 0.0:
        raise ValueError(f"fault {text!r}: T must be at least 0 and DURATION above 0")
    return result


class Faults:
    """Which faults are on. Time comes in through `advance`, from whoever owns the clock."""

    def __init__(self, schedule: Iterable[FaultAt] = ()) -> None:
        edges: list[tuple[float, bool, Fault]] = []
        for fault, start_s, duration_s in schedule:
            edges.append((start_s, True, fault))
            if isfinite(duration_s):
                edges.append((start_s + duration_s, False, fault))
        self._edges = sorted(edges, key=lambda edge: edge[0], reverse=True)
        self._on: set[Fault] = set()
        self.any = False
        """True while anything is on."""
        self.changes = 0
        """How often anything was switched: an owner that acts on the moment of switching looks at this."""

    def advance(self, t_s: float) -> None:
        """Switch what is due at this time."""
        while self._edges and self._edges[-1][0] <= t_s:
            _, on, fault = self._edges.pop()
            self.switch(fault, on)

    def switch(self, fault: Fault, on: bool) -> None:
        """Switch a fault on or off now."""
        (self._on.add if on else self._on.discard)(fault)
        self.any = bool(self._on)
        self.changes += 1

    def active(self, fault: Fault) -> bool:
        """True while this fault is on."""
        return self.any and fault in self._on  # hashing an enum is slow, and mostly nothing is on
