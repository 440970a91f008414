"""PX4's parameters, judged: what it does when our stream is lost, and who may take over."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from companion.check.report import Part, Row, State, never_came
from companion.link.survey import VehicleFindings
from companion.settings import Settings

_LONG_LOSS_S = 2.0
_STICK_OVERRIDE, _OFFBOARD_WITHOUT_RC = 2, 4
"""COM_RC_OVERRIDE bit 1, COM_RCL_EXCEPT bit 2."""
_FALLBACK = {
    0: "Position",
    1: "Altitude",
    2: "Manual",
    3: "Return",
    4: "Land",
    5: "Hold",
    6: "Terminate",
    7: "Disarm",
}
"""COM_OBL_RC_ACT."""

_Rule = Callable[[Settings, VehicleFindings, float], Row]


def judge(settings: Settings, found: VehicleFindings, watched_s: float) -> Iterator[Row]:
    """A row for each parameter that is asked for; `watched_s`: for how long it was."""
    for name, (rule, vital, why) in _RULES.items():
        value = found.parameters.get(name)
        if value is None:
            state = State.FAIL if vital else State.WARN
            yield never_came(Part.PARAMETERS, name, watched_s, why, state)
        else:
            yield rule(settings, found, value)


def _row(name: str, state: State, found: str, why: str = "", do: str = "") -> Row:
    return Row(Part.PARAMETERS, name, state, found, why, do)


def _has_rc(found: VehicleFindings) -> bool:
    return found.health is not None and found.health.remote_control


def _of_loss_t(settings: Settings, _: VehicleFindings, value: float) -> Row:
    name, speed = "COM_OF_LOSS_T", settings.guidance.speed_m_s
    text = f"{value:g} s: our stream lost, it flies on for {value * speed:.1f} m, then acts"
    period_s = 1.0 / settings.stream.min_rate_hz
    if value < 3.0 * period_s:
        why = f"At a setpoint every {period_s * 1e3:.0f} ms, a few lost packets end OFFBOARD."
        return _row(name, State.FAIL, text, why, f"set {name} to 1.0")
    held_up_s = settings.loss.held_up_after_s
    if value <= held_up_s:
        why = "Held up for that long the app would stream on, and PX4, which has acted, return to OFFBOARD."
        return _row(name, State.FAIL, text, why, f"set {name} above loss.held_up_after_s ({held_up_s:g} s)")
    if value > _LONG_LOSS_S:
        why = "That long nobody steers."
        return _row(name, State.WARN, text, why, f"set {name} to 1.0")
    return _row(name, State.OK, text)


def _obl_rc_act(_: Settings, found: VehicleFindings, value: float) -> Row:
    name, action = "COM_OBL_RC_ACT", _FALLBACK.get(int(value), "unknown")
    text = f"{value:g} ({action}): what it does when our stream is lost"
    is_global = found.estimator is None or found.estimator.global_position
    advice = f"set {name} to {'5 (Hold) or ' if is_global else ''}4 (Land)"
    if action == "unknown":
        return _row(name, State.FAIL, text, "Only 0 to 7 are known here.", advice)
    if action in ("Terminate", "Disarm"):
        return _row(name, State.FAIL, text, "The motors would stop in the air.", advice)
    if action in ("Position", "Altitude", "Manual"):
        if _has_rc(found):
            return _row(name, State.OK, f"{text}: the pilot flies")
        why = "Without radio control that is a blind descent: 0.7 m/s down, wherever it drifts."
        return _row(name, State.FAIL, text, why, advice)
    if action in ("Return", "Hold") and not is_global:
        why = "Not available without a global position: PX4 lands instead, or descends blindly."
        return _row(name, State.WARN, text, why, advice)
    return _row(name, State.OK, text)


def _rcl_except(_: Settings, found: VehicleFindings, value: float) -> Row:
    name, has_bit = "COM_RCL_EXCEPT", bool(int(value) & _OFFBOARD_WITHOUT_RC)
    text = f"{value:g}: OFFBOARD {'goes on' if has_bit else 'ends'} without radio control"
    if has_bit or _has_rc(found):
        return _row(name, State.OK, text)
    why = "There is no radio control now: OFFBOARD would fail over at once."
    return _row(name, State.FAIL, text, why, f"add 4 to {name} (bit 2), or switch the transmitter on")


def _rc_override(_: Settings, found: VehicleFindings, value: float) -> Row:
    name, has_bit = "COM_RC_OVERRIDE", bool(int(value) & _STICK_OVERRIDE)
    text = f"{value:g}: sticks {'take' if has_bit else 'do not take'} over from OFFBOARD"
    if has_bit or not _has_rc(found):
        return _row(name, State.OK, text if _has_rc(found) else f"{text}; no radio control now")
    why = "A pilot in a hurry moves the sticks first, and nothing happens (up to PX4 1.17)."
    return _row(name, State.WARN, text, why, f"add 2 to {name} (bit 1)")


def _takeoff_alt(settings: Settings, _: VehicleFindings, value: float) -> Row:
    name, limits = "MIS_TAKEOFF_ALT", settings.limits
    text = f"{value:g} m; the flight is configured for {settings.vehicle.height_m:g} m"
    if limits.height_min_m <= value <= limits.height_max_m:
        return _row(name, State.OK, text)
    why = f"Outside the height band of {limits.height_min_m:g} to {limits.height_max_m:g} m ([limits])."
    return _row(name, State.WARN, text, why, f"set {name} to vehicle.height_m")


_RULES: dict[str, tuple[_Rule, bool, str]] = {
    "COM_OF_LOSS_T": (_of_loss_t, True, "How long it flies on without us is not known."),
    "COM_OBL_RC_ACT": (_obl_rc_act, True, "What it does when our stream is lost is not known."),
    "COM_RCL_EXCEPT": (_rcl_except, False, "Whether OFFBOARD needs radio control is not known."),
    "COM_RC_OVERRIDE": (_rc_override, False, "Whether sticks take over is not known."),
    "MIS_TAKEOFF_ALT": (_takeoff_alt, False, "How high a take-off goes is not known."),
}
"""Parameter → its rule, whether a flight may not begin without knowing it, what is not known without it."""
