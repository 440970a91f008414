"""Every phase of a flight and every transition, as one table.

`conditions()` names what holds at this moment, most important first; the first of them that the present phase
has an entry for decides. A pair without an entry means: stay, and look at the next condition.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
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


class Company(Enum):
    """Who else is on the vehicle's link."""

    __hash__ = object.__hash__  # as `Ranges`

    NOBODY = "nobody"
    OTHER_VEHICLE = "another autopilot, and it is not configured which one is ours"
    COMMANDER = "another one that commands our vehicle"


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
    rebooted: bool = False
    """The autopilot's clock has begun anew since this phase was entered."""
    company: Company = Company.NOBODY
    battery_low: bool = False
    estimate_invalid: bool = False
    """What the setpoints need of the autopilot's estimate is told to be invalid."""


class Condition(Enum):
    """In order of importance; the text is the reason told to people."""

    __hash__ = object.__hash__  # Enum's own, of the name, costs more than all else here

    REBOOTED = "the autopilot restarted"
    FLIGHT_OVER = "disarmed: the flight is over"
    VEHICLE_CHANGED = "the vehicle is gone, and another one is on its link"
    VEHICLE_GONE = "no heartbeat from the vehicle"
    LEFT_OFFBOARD = "the vehicle left OFFBOARD"
    HELD_UP = "this app did not run for a while: select another mode, then OFFBOARD again"
    STOP_ASKED = "stop asked for"
    WAITED_OUT = "waited long enough"
    OFFBOARD_ALREADY = (
        "OFFBOARD was selected before this app was ready: select another mode, then OFFBOARD again"
    )
    OTHER_MODE = "another mode is selected: OFFBOARD can be chosen anew"
    SECOND_COMMANDER = "somebody else commands this vehicle"
    LANDED = "the vehicle is on the ground"
    BATTERY_LOW = "the battery is low"
    OTHER_VEHICLE = "another autopilot is on the link"
    INPUTS_MISSING = "telemetry or ranges stopped"
    READY = "vehicle and ranges are there: waiting for OFFBOARD"
    ENGAGED = "OFFBOARD selected"
    HAND_OVER_OVERDUE = "the mode asked for did not come"
    BUDGET_SPENT = "a limit is spent"
    RANGES_LOST = "no ranges for too long"
    ESTIMATE_INVALID = "the autopilot's estimate is not valid"
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
    fit = f.company is Company.NOBODY and not (f.battery_low or f.estimate_invalid)
    if f.rebooted:
        yield Condition.REBOOTED
    if f.was_engaged and not f.armed:
        yield Condition.FLIGHT_OVER
    if f.vehicle_gone:
        if f.company is Company.OTHER_VEHICLE:
            yield Condition.VEHICLE_CHANGED
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
    if f.company is Company.COMMANDER:
        yield Condition.SECOND_COMMANDER
    if f.grounded:
        yield Condition.LANDED
    if f.battery_low:
        yield Condition.BATTERY_LOW
    if f.company is Company.OTHER_VEHICLE:
        yield Condition.OTHER_VEHICLE
    if not inputs or f.ranges in (Ranges.STALE, Ranges.LOST):
        yield Condition.INPUTS_MISSING
    if inputs and fit and f.ranges is Ranges.FRESH:
        # In the air OFFBOARD may still be meant, and a stream would bring it back.
        if f.intended is not None or f.armed is False or f.grounded:
            yield Condition.READY
        if offboard and f.armed and not f.grounded:
            yield Condition.ENGAGED
    if f.hand_over_overdue:
        yield Condition.HAND_OVER_OVERDUE
    if f.budget_spent:
        yield Condition.BUDGET_SPENT
    if f.ranges is Ranges.LOST:
        yield Condition.RANGES_LOST
    if f.estimate_invalid:
        yield Condition.ESTIMATE_INVALID
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
_SILENCED = {
    _C.REBOOTED: _P.RELEASED,
    _C.FLIGHT_OVER: _P.ENDED,
    _C.VEHICLE_CHANGED: _P.RELEASED,
    _C.VEHICLE_GONE: _P.RELEASED,
    _C.LEFT_OFFBOARD: _P.RELEASED,
    _C.HELD_UP: _P.RELEASED,
}
"""Nobody to steer any more, or nobody known to be: every phase that steers falls silent so."""
_LEAVE = _SILENCED | {
    _C.STOP_ASKED: _P.HAND_OVER,
    _C.SECOND_COMMANDER: _P.HAND_OVER,
    _C.LANDED: _P.HAND_OVER,
    _C.BATTERY_LOW: _P.HAND_OVER,
    _C.BUDGET_SPENT: _P.HAND_OVER,
    _C.RANGES_LOST: _P.HAND_OVER,
    _C.ESTIMATE_INVALID: _P.STALL,
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
        _C.REBOOTED: _P.AWAIT,
        _C.FLIGHT_OVER: _P.ENDED,
        _C.VEHICLE_CHANGED: _P.AWAIT,
        _C.VEHICLE_GONE: _P.AWAIT,
        _C.HELD_UP: _P.AWAIT,
        _C.STOP_ASKED: _P.ENDED,
        _C.SECOND_COMMANDER: _P.AWAIT,
        _C.BATTERY_LOW: _P.AWAIT,
        _C.OTHER_VEHICLE: _P.AWAIT,
        _C.INPUTS_MISSING: _P.AWAIT,
        _C.ESTIMATE_INVALID: _P.AWAIT,
        _C.ENGAGED: _P.ACQUIRE,
    },
    _P.INHIBITED: {
        _C.REBOOTED: _P.AWAIT,
        _C.FLIGHT_OVER: _P.ENDED,
        _C.VEHICLE_CHANGED: _P.AWAIT,
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
    _P.HAND_OVER: _SILENCED | {_C.HAND_OVER_OVERDUE: _P.RELEASED},
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
    return decide(phase, conditions(facts))


def decide(phase: Phase, holding: Iterable[Condition]) -> tuple[Phase, Condition | None]:
    """What the table makes of conditions in their order: the first one with an entry decides."""
    row = TABLE[phase]
    for condition in holding:
        after = row.get(condition)
        if after is not None:
            return (phase, None) if after is phase else (after, condition)
    return phase, None


_ALARMING = frozenset(
    {
        _C.REBOOTED,
        _C.VEHICLE_CHANGED,
        _C.VEHICLE_GONE,
        _C.HELD_UP,
        _C.HAND_OVER_OVERDUE,
        _C.BUDGET_SPENT,
        _C.RANGES_LOST,
    }
)


def severity(after: Phase, condition: Condition) -> Severity:
    """How loudly a transition is told."""
    if condition in _ALARMING or after is Phase.HAND_OVER:
        return Severity.CRITICAL
    if after in (Phase.STALL, Phase.COAST, Phase.RELEASED, Phase.INHIBITED):
        return Severity.WARNING
    return Severity.NOTICE if after in (Phase.ACQUIRE, Phase.HOLD, Phase.KEEP, Phase.ENDED) else Severity.INFO
