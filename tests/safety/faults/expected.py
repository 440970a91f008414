"""What must come of the faults: rules by name, and which of them holds in which phase."""

from __future__ import annotations

import math
from collections.abc import Mapping

from companion.types import Phase
from tests.safety.faults.flight import HIDDEN_S, SETTINGS
from tests.safety.faults.rules import (
    ACQUIRE,
    AWAIT,
    ENDED,
    EVERY,
    GROUPS,
    HAND_OVER,
    INHIBITED,
    RELEASED,
    STALL,
    STANDBY,
    Rule,
)

_LOSS = SETTINGS.loss
_TICK_S = 0.02
_INF = math.inf
_ENGAGED = frozenset(GROUPS["engaged"])

GOES_ON = Rule(
    "the flight goes on",
    ends_in=_ENGAGED,
    never=frozenset({HAND_OVER, RELEASED, ENDED, INHIBITED}),
)
STANDS = Rule("no speed without a person's act", still=(0.0, _INF))
WATCHES = Rule("silent until a person acts", silent=(0.0, _INF))
FALLS_SILENT = Rule(
    "silent when the hand-over's patience is over",
    reach=((RELEASED, _LOSS.hand_over_patience_s),),
    still=(0.0, _INF),
    silent=(_LOSS.hand_over_patience_s, _INF),
)
TAKEN = Rule("silent at once", reach=((RELEASED, 0.1),), silent=(0.1, _INF))
TAKEN_THEN_READY = Rule(
    "released at once, then standstill until OFFBOARD is chosen anew",
    reach=((RELEASED, 0.1),),
    still=(0.1, _INF),
    ends_in=frozenset({STANDBY, AWAIT}),
)
STOPS = Rule(
    "stands still at once, asks for the mode, ends",
    reach=((HAND_OVER, 0.05), (ENDED, 1.0)),
    still=(0.05, _INF),
    silent=(1.0, _INF),
)
ENDS = Rule("ends", reach=((ENDED, 0.1),), silent=(0.1, _INF))
BOUNDED = Rule("stays within the limits")


def rules(**by: Rule) -> Mapping[Phase, Rule]:
    """Rules by group of phases, the special after the general.

    Where nothing is said: what stands is not moved, who watches stays silent, a hand-over that is refused
    ends in silence, and everything else goes on.
    """
    found = dict.fromkeys(EVERY, GOES_ON) | {AWAIT: STANDS, STANDBY: STANDS, HAND_OVER: FALLS_SILENT}
    found |= dict.fromkeys(GROUPS["silent"], WATCHES)
    for group, phases in GROUPS.items():
        if group in by:
            found |= dict.fromkeys(phases, by.pop(group))
    assert not by, f"no such group: {by}"
    return found


def only(*phases: Phase, rule: Rule) -> Mapping[Phase, Rule]:
    """This rule in these phases, and no other phase is flown."""
    return dict.fromkeys(phases, rule)


def ranges_lost(for_s: float) -> Mapping[Phase, Rule]:
    """No believed range for so long: coast, stand, hand over, each by its time."""
    if for_s > _LOSS.hand_over_after_s:
        gone = Rule(
            "coasts, stands still, hands over, each in time",
            reach=((STALL, _LOSS.stall_after_s), (HAND_OVER, _LOSS.hand_over_after_s)),
            still=(_LOSS.stall_after_s, _INF),
            ends_in=frozenset({STANDBY, AWAIT, RELEASED}),
        )
        return rules(
            engaged=gone,
            standby=Rule(
                "falls silent", reach=((AWAIT, _LOSS.stall_after_s),), silent=(_LOSS.stall_after_s, _INF)
            ),
        )
    if for_s > _LOSS.stall_after_s:
        stalls = Rule(
            "stands still in time, then acquires anew",
            reach=((STALL, _LOSS.stall_after_s),),
            still=(_LOSS.stall_after_s, for_s),
            ends_in=_ENGAGED,
            never=frozenset({HAND_OVER, RELEASED, ENDED}),
        )
        return rules(engaged=stalls)
    return rules()


def after(for_s: float, rule: Rule) -> Rule:
    """The same rule, and what it forbids is allowed again once the fault is over."""
    return rule._replace(
        still=(rule.still[0], for_s), silent=(rule.silent[0], for_s if rule.silent[0] < _INF else _INF)
    )


_ONE_HEARD_S = HIDDEN_S + 0.2
"""By then the first of the ranges that are not hidden any more has come, and some may be lost before it."""
STALLS_AFTER_ONE = Rule(
    "stands still in time after the first repeat, new to it",
    reach=((STALL, _ONE_HEARD_S + _LOSS.stall_after_s),),
    still=(_ONE_HEARD_S + _LOSS.stall_after_s, 8.0),
    ends_in=_ENGAGED,
    never=frozenset({HAND_OVER, RELEASED, ENDED}),
)
HEADING_LOST = Rule(
    "stands still",
    reach=((STALL, _LOSS.telemetry_after_s + _TICK_S),),
    still=(_LOSS.telemetry_after_s + _TICK_S, _INF),
)
VEHICLE_LOST = Rule(
    "stands still, then silent: the vehicle is gone",
    reach=((RELEASED, _LOSS.vehicle_after_s),),
    still=(_LOSS.telemetry_after_s + _TICK_S, _INF),
    silent=(_LOSS.vehicle_after_s, _INF),
)
STANDBY_VEHICLE_LOST = Rule("falls silent", reach=((AWAIT, 0.6),), silent=(0.6, _INF))
HELD_UP = Rule("held up for so long it stays silent: OFFBOARD is a person's choice", silent=(0.0, _INF))


HANDS_OVER = Rule(
    "stands still, hands over, silent",
    reach=((HAND_OVER, 1.1), (RELEASED, 1.2)),
    still=(1.1, _INF),
    silent=(1.2, _INF),
)
FALLS_SILENT_2_S = Rule("falls silent", reach=((AWAIT, 1.1),), silent=(1.1, _INF))
NEXT_HEARTBEAT = Rule("silent with the next heartbeat", reach=((RELEASED, 3.1),), silent=(3.1, _INF))
FALLEN_BACK = Rule("silent when PX4 falls back", reach=((RELEASED, 1.25),), silent=(1.25, _INF))
STANDS_FOR_2_S = STANDS._replace(still=(0.0, 2.0))
ENGAGED_ANEW = Rule(
    "released, and engaged anew",
    reach=((RELEASED, 0.1), (STANDBY, 1.7), (ACQUIRE, 2.2)),
    still=(0.1, 2.0),
)
RESTARTED = Rule("silent: taken for a restart", reach=((RELEASED, 0.15),), silent=(0.15, _INF))
TAKEN_BY_HEARTBEAT = Rule("silent with the next heartbeat", reach=((RELEASED, 0.3),), silent=(0.3, _INF))
HANDS_OVER_IN_TIME = Rule(
    "stands still, hands over in time, silent",
    reach=((HAND_OVER, _LOSS.hand_over_after_s), (RELEASED, _LOSS.hand_over_after_s + 0.5)),
    still=(_LOSS.stall_after_s, _INF),
    silent=(_LOSS.hand_over_after_s + 0.5, _INF),
)
INSISTS = Rule(
    "stands still; hands over once the vehicle is heard in GUIDED",
    reach=((HAND_OVER, _LOSS.vehicle_after_s + 0.05),),
    still=(_LOSS.telemetry_after_s + _TICK_S, _INF),
)
NOTHING_ASKED = Rule(
    "stands still, asks for no mode: the pilot is heard first",
    still=(_LOSS.telemetry_after_s + _TICK_S, _INF),
)
DISARMED = Rule("ends with the next heartbeat", reach=((ENDED, 1.1),), silent=(1.1, _INF))
REBOOTED = Rule("ends: disarmed", reach=((ENDED, 3.5),), still=(0.6, _INF), silent=(3.5, _INF))
NO_HOLD = Rule(
    "hands over in time: lands, as Hold is not to be had",
    reach=((HAND_OVER, _LOSS.hand_over_after_s), (RELEASED, _LOSS.hand_over_after_s + 0.2)),
    still=(_LOSS.stall_after_s, _INF),
)
BUDGET = Rule("a budget ends it", reach=((HAND_OVER, 110.0),), still=(110.0, _INF))
HELD_UP_TAKEOVER = TAKEN_THEN_READY._replace(reach=((RELEASED, 0.8),), still=(0.8, _INF))
