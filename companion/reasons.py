"""Why a phase was entered, in words for a person: what the condition's name cannot tell."""

from __future__ import annotations

import math
from typing import Literal

from companion import limits
from companion.health import battery_words, fresh_estimator, shortfalls
from companion.phase import Condition
from companion.state import Plan, State, age_s
from companion.status import with_the_silent
from companion.types import FlightMode, Landed, Phase

_WORDS_FRESH_S = 2.0
"""Later words of the autopilot do not explain what happens now."""

_LOSSES = frozenset(
    {Condition.RANGES_LATE, Condition.BEARING_LOST, Condition.RANGES_STALE, Condition.RANGES_LOST}
)

HandOverTo = Literal["land", "hold", "release"]


def hand_over_to(p: Plan, s: State, condition: Condition, t_ns: int) -> HandOverTo:
    """What is asked for at a hand-over: as configured, but never for a Hold that is known to be refused."""
    wanted = _configured(p, condition)
    e = fresh_estimator(s.health, t_ns)
    return "land" if wanted == "hold" and e is not None and not e.global_position else wanted


def reason(p: Plan, s: State, after: Phase, condition: Condition, t_ns: int) -> str:
    """The reason of a transition that is about to happen."""
    words = _reason(p, s, condition, t_ns)
    if after is Phase.HAND_OVER and hand_over_to(p, s, condition, t_ns) != _configured(p, condition):
        words += "; asking for Land, as Hold needs a global position"
    return f"shadow: {words}" if p.settings.mission.shadow else words


def _configured(p: Plan, condition: Condition) -> HandOverTo:
    cfg = p.settings.loss
    return cfg.battery_to if condition is Condition.BATTERY_LOW else cfg.hand_over_to


def _reason(p: Plan, s: State, condition: Condition, t_ns: int) -> str:
    h, text = s.health, condition.value
    if condition in (Condition.PROBING, Condition.TRACKING):
        return _bearing(p, s, text)
    if condition is Condition.RANGES_LOST and (
        age_s(s.ranging.t_enough_ns, t_ns) <= p.settings.loss.hand_over_after_s
    ):
        return "only stray ranges for too long"
    if condition in _LOSSES:
        return with_the_silent(p, s, t_ns, text)
    if condition is Condition.BUDGET_SPENT:
        return limits.spent(p.settings.limits, s.steering.limits, t_ns) or _spent_silence(p, s, t_ns)
    if condition is Condition.BATTERY_LOW:
        return f"battery {battery_words(h)}"
    if condition is Condition.SECOND_COMMANDER and h.commander is not None:
        c = h.commander
        return f"{text}: {c.party.value} ({c.message} from system {c.system_id} component {c.component_id})"
    if condition in (Condition.VEHICLE_CHANGED, Condition.OTHER_VEHICLE) and h.other_vehicle is not None:
        return f"{text}: system {h.other_vehicle.system_id}"
    if condition is Condition.ESTIMATE_INVALID:
        return _estimate(p, s, t_ns) or text
    if condition is Condition.FLIGHT_OVER and s.vehicle.landed is Landed.IN_AIR:
        return "disarmed in the air (a kill switch, or the autopilot restarted): the flight is over"
    if condition is Condition.LEFT_OFFBOARD:
        return _left(p, s, t_ns)
    return text


def _bearing(p: Plan, s: State, text: str) -> str:
    """How well the bearing is known: what can be observed of it now, not only whether that is enough."""
    known = p.scheme.knowledge(p.scheme.p, s.observing.guidance)
    if known.sigma_theta_rad >= math.pi:
        return text
    what, colon, then = text.partition(":")
    return f"{what} (± {math.degrees(known.sigma_theta_rad):.0f}°){colon}{then}"


def _spent_silence(p: Plan, s: State, t_ns: int) -> str:
    """Why a vehicle that only a mode change can stop is handed over (`pilot` counts silence as spent)."""
    sent = s.steering.setpoint
    if age_s(None if sent is None else sent.t_ns, t_ns) > p.settings.loss.held_up_after_s:
        return "this app did not run for a while"
    return Condition.VEHICLE_GONE.value


def _left(p: Plan, s: State, t_ns: int) -> str:
    """Who took OFFBOARD away, and what the autopilot says of it."""
    v, w = s.vehicle, s.health.words
    text = Condition.LEFT_OFFBOARD.value
    if v.actual is not None:
        text += f" for {v.actual.value}"
    if v.intended is FlightMode.OFFBOARD:
        text += ", which is still intended: the autopilot's own failsafe"
        estimate = _estimate(p, s, t_ns)
        if estimate:
            text += f"; {estimate}"
    if w is not None and age_s(w.t_ns, t_ns) <= _WORDS_FRESH_S:
        text += f"; it says: {w.text}"
    return text


def _estimate(p: Plan, s: State, t_ns: int) -> str:
    """What vital the estimate lacks; empty where nothing is known to."""
    e = fresh_estimator(s.health, t_ns)
    if e is None:
        return ""
    lacks = shortfalls(p.settings.vehicle, p.settings.loss.hand_over_to, e)
    return "; ".join(lack.text() for lack in lacks if lack.vital)
