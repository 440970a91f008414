"""Every phase of a flight and every transition, as one table.

`conditions()` names what holds at this moment, most important first; the first of them that the present phase
has an entry for decides. A pair without an entry means: stay, and look at the next condition.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum
from functools import lru_cache

import msgspec

from companion.guidance.scheme import PROBE, REFUSE, REST, STAY, TRACK
from companion.types import FlightMode, Phase, Severity


class Ranges(Enum):
    """How old the last believed range is (`[loss]`)."""

    __hash__ = object.__hash__  # hashed on every event, as one of the `Facts`

    FRESH = "fresh"
    LATE = "late"
    STALE = "stale"
    LOST = "lost"


class Facts(msgspec.Struct, frozen=True, gc=False):
    """What the table looks at. Everything else of the pilot's state is none of its business."""

    stop_asked: bool = False
    vehicle_gone: bool = False
    actual: FlightMode | None = None
    intended: FlightMode | None = None
    armed: bool | None = None
    grounded: bool = False
    """Known to be on the ground."""
    was_engaged: bool = False
    waited_out: bool = False
    telemetry_late: bool = True
    ranges: Ranges = Ranges.LOST
    bearing_lost: bool = False
    """The bearing is less certain than coasting allows."""
    budget_spent: bool = False
    hand_over_overdue: bool = False
    purpose: int = PROBE
    """What the guidance is doing: PROBE, TRACK, REST, STAY or REFUSE."""
    held_up: bool = False
    """This app did not run for so long that the autopilot may have acted on its silence."""


class Condition(Enum):
    """In order of importance; the text is the reason told to people."""

    __hash__ = object.__hash__  # Enum's own, of the name, costs more than all else here

    FLIGHT_OVER = "disarmed: the flight is over"
    VEHICLE_GONE = "no heartbeat from the vehicle"
    LEFT_OFFBOARD = "the vehicle left OFFBOARD"
    HELD_UP = "this app did not run for a while: select another mode, then OFFBOARD again"
    STOP_ASKED = "stop asked for"
    WAITED_OUT = "waited long enough"
    OFFBOARD_ALREADY = (
        "OFFBOARD was selected before this app was ready: select another mode, then OFFBOARD again"
    )
    OTHER_MODE = "another mode is selected: OFFBOARD can be chosen anew"
    INPUTS_MISSING = "telemetry or ranges stopped"
    READY = "vehicle and ranges are there: waiting for OFFBOARD"
    ENGAGED = "OFFBOARD selected"
    HAND_OVER_OVERDUE = "the mode asked for did not come"
    BUDGET_SPENT = "a limit is spent"
    RANGES_LOST = "no ranges for too long"
    TELEMETRY_LATE = "no heading from the vehicle"
    RANGES_STALE = "no ranges: standing still"
    BEARING_LOST = "no ranges and the bearing is uncertain: standing still"
    RANGES_LATE = "no ranges: flying on the prediction"
    PROBING = "bearing not known yet: turning"
    TRACKING = "bearing known"
    RESTING = "inside the capture radius"
    STAYING = "at the station"
    REFUSING = "the beacons lie in one line: the station may be on either side of it"


def conditions(f: Facts) -> Iterator[Condition]:
    """What holds, most important first."""
    offboard = f.actual is FlightMode.OFFBOARD
    inputs = not (f.vehicle_gone or f.telemetry_late) and f.actual is not None
    if f.was_engaged and not f.armed:
        yield Condition.FLIGHT_OVER
    if f.vehicle_gone:
        yield Condition.VEHICLE_GONE
    if not offboard:
        yield Condition.LEFT_OFFBOARD
    if f.held_up:
        yield Condition.HELD_UP
    if f.stop_asked:
        yield Condition.STOP_ASKED
    if f.waited_out:
        yield Condition.WAITED_OUT
    if not f.vehicle_gone and (offboard or f.intended is FlightMode.OFFBOARD):
        yield Condition.OFFBOARD_ALREADY
    elif not f.vehicle_gone and f.intended is not None:
        yield Condition.OTHER_MODE
    if not inputs or f.ranges in (Ranges.STALE, Ranges.LOST):
        yield Condition.INPUTS_MISSING
    if inputs and f.ranges is Ranges.FRESH:
        yield Condition.READY
        if offboard and f.armed and not f.grounded:
            yield Condition.ENGAGED
    if f.hand_over_overdue:
        yield Condition.HAND_OVER_OVERDUE
    if f.budget_spent:
        yield Condition.BUDGET_SPENT
    if f.ranges is Ranges.LOST:
        yield Condition.RANGES_LOST
    if f.telemetry_late:
        yield Condition.TELEMETRY_LATE
    if f.ranges in (Ranges.STALE, Ranges.LOST):
        yield Condition.RANGES_STALE
    elif f.ranges is Ranges.LATE:
        if f.bearing_lost:
            yield Condition.BEARING_LOST
        yield Condition.RANGES_LATE
    else:
        yield _PURPOSE[f.purpose]


_PURPOSE = {
    PROBE: Condition.PROBING,
    TRACK: Condition.TRACKING,
    REST: Condition.RESTING,
    STAY: Condition.STAYING,
    REFUSE: Condition.REFUSING,
}

_C, _P = Condition, Phase
_LEAVE = {
    _C.FLIGHT_OVER: _P.ENDED,
    _C.VEHICLE_GONE: _P.RELEASED,
    _C.LEFT_OFFBOARD: _P.RELEASED,
    _C.HELD_UP: _P.RELEASED,
    _C.STOP_ASKED: _P.HAND_OVER,
    _C.BUDGET_SPENT: _P.HAND_OVER,
    _C.RANGES_LOST: _P.HAND_OVER,
    _C.TELEMETRY_LATE: _P.STALL,
    _C.RANGES_STALE: _P.STALL,
    _C.REFUSING: _P.HAND_OVER,
}
"""Every phase that steers the vehicle is left so."""

TABLE: dict[Phase, dict[Condition, Phase]] = {
    _P.AWAIT: {
        _C.FLIGHT_OVER: _P.ENDED,
        _C.STOP_ASKED: _P.ENDED,
        _C.WAITED_OUT: _P.ENDED,
        _C.OFFBOARD_ALREADY: _P.INHIBITED,
        _C.READY: _P.STANDBY,
    },
    _P.STANDBY: {
        _C.FLIGHT_OVER: _P.ENDED,
        _C.VEHICLE_GONE: _P.AWAIT,
        _C.HELD_UP: _P.AWAIT,
        _C.STOP_ASKED: _P.ENDED,
        _C.INPUTS_MISSING: _P.AWAIT,
        _C.ENGAGED: _P.ACQUIRE,
    },
    _P.INHIBITED: {
        _C.FLIGHT_OVER: _P.ENDED,
        _C.VEHICLE_GONE: _P.AWAIT,
        _C.STOP_ASKED: _P.ENDED,
        _C.OTHER_MODE: _P.AWAIT,
    },
    _P.ACQUIRE: _LEAVE
    | {
        _C.BEARING_LOST: _P.STALL,
        _C.RANGES_LATE: _P.COAST,
        _C.TRACKING: _P.APPROACH,
        _C.RESTING: _P.HOLD,
        _C.STAYING: _P.KEEP,
    },
    _P.APPROACH: _LEAVE
    | {
        _C.BEARING_LOST: _P.STALL,
        _C.RANGES_LATE: _P.COAST,
        _C.PROBING: _P.ACQUIRE,
        _C.RESTING: _P.HOLD,
        _C.STAYING: _P.KEEP,
    },
    _P.HOLD: _LEAVE
    | {
        _C.PROBING: _P.ACQUIRE,
        _C.TRACKING: _P.APPROACH,
    },
    _P.KEEP: _LEAVE
    | {
        _C.BEARING_LOST: _P.STALL,
        _C.RANGES_LATE: _P.COAST,
        _C.PROBING: _P.ACQUIRE,
        _C.TRACKING: _P.APPROACH,
    },
    _P.COAST: _LEAVE
    | {
        _C.BEARING_LOST: _P.STALL,
        _C.PROBING: _P.ACQUIRE,
        _C.TRACKING: _P.APPROACH,
        _C.RESTING: _P.HOLD,
        _C.STAYING: _P.KEEP,
    },
    # Back from a standstill only through re-acquisition, never straight to the approach.
    _P.STALL: _LEAVE
    | {
        _C.PROBING: _P.ACQUIRE,
        _C.TRACKING: _P.ACQUIRE,
        _C.RESTING: _P.HOLD,
        _C.STAYING: _P.ACQUIRE,
    },
    _P.HAND_OVER: {
        _C.FLIGHT_OVER: _P.ENDED,
        _C.VEHICLE_GONE: _P.RELEASED,
        _C.LEFT_OFFBOARD: _P.RELEASED,
        _C.HELD_UP: _P.RELEASED,
        _C.HAND_OVER_OVERDUE: _P.RELEASED,
    },
    _P.RELEASED: {
        _C.FLIGHT_OVER: _P.ENDED,
        _C.STOP_ASKED: _P.ENDED,
        _C.OTHER_MODE: _P.AWAIT,
    },
    _P.ENDED: {},
}

MOVING = frozenset({Phase.ACQUIRE, Phase.APPROACH, Phase.KEEP, Phase.COAST})
"""The only phases in which a forward speed may be commanded."""

STEERED = MOVING | {Phase.HOLD}
"""The only phases in which the guidance is asked for a command, and a yaw rate may be commanded."""

STREAMING = frozenset({Phase.STANDBY}) | frozenset(p for p in Phase if p.is_engaged)
"""The only phases in which setpoints leave at all."""

ASKING = frozenset({Phase.HAND_OVER})
"""The only phase in which a mode is asked for."""


@lru_cache(maxsize=256)
def step(phase: Phase, facts: Facts) -> tuple[Phase, Condition | None]:
    """The next phase, and the condition that decided (None: stay).

    The facts stay the same for many events on end, so the answers to the latest are kept.
    """
    row = TABLE[phase]
    for condition in conditions(facts):
        after = row.get(condition)
        if after is not None:
            return (phase, None) if after is phase else (after, condition)
    return phase, None


_ALARMING = frozenset({_C.VEHICLE_GONE, _C.HELD_UP, _C.HAND_OVER_OVERDUE, _C.BUDGET_SPENT, _C.RANGES_LOST})


def severity(after: Phase, condition: Condition) -> Severity:
    """How loudly a transition is told."""
    if condition in _ALARMING or after is Phase.HAND_OVER:
        return Severity.CRITICAL
    if after in (Phase.STALL, Phase.COAST, Phase.RELEASED, Phase.INHIBITED):
        return Severity.WARNING
    return Severity.NOTICE if after in (Phase.ACQUIRE, Phase.HOLD, Phase.KEEP, Phase.ENDED) else Severity.INFO
