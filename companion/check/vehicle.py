"""What the vehicle told of itself, judged: would it fly what we ask, and what would it do without us."""

from __future__ import annotations

from collections.abc import Iterator

from companion.check import ardupilot, parameters
from companion.check.report import Part, Row, State, never_came
from companion.health import WITHOUT, Health, on_battery, shortfalls
from companion.link.modes import wanted_rates
from companion.link.signing import NOT_SIGNED, WRONG_SIGNATURE
from companion.link.survey import VehicleFindings
from companion.settings import Settings
from companion.types import BatteryReport, Charge, FlightMode, Landed

_LOW_SHARE = 0.3
"""Below this a flight should not begin; PX4 itself warns at BAT_LOW_THR, 15 %."""
_MUCH_LOST = 0.02
_VENDOR = {"px4": "PX4", "ardupilot": "ArduPilot"}
"""What `vehicle.kind` says of itself in HEARTBEAT.autopilot."""


def judge(settings: Settings, found: VehicleFindings, is_signing: bool, watched_s: float) -> Iterator[Row]:
    """Every row about the vehicle; `watched_s`: how long it was asked."""
    if found.t_found_ns is None:
        yield _nobody(settings, found, watched_s)
        return
    yield _signing(found, is_signing)
    if not found.refused:  # what is refused leaves gaps as well
        yield _loss(found)
    yield from _others(settings, found)
    yield from _autopilot(settings, found, watched_s)
    if found.estimator is None:
        yield never_came(Part.ESTIMATE, "ESTIMATOR_STATUS", watched_s, WITHOUT["ESTIMATOR_STATUS"])
    else:
        yield from _estimate(settings, found)
    yield from _telemetry(settings, found)
    if found.is_px4:
        yield from parameters.judge(settings, found, watched_s)
    elif found.vendor == "ArduPilot":
        yield from ardupilot.judge(found, watched_s)


# ------------------------------------------------------------------------------------------------ link


def _nobody(settings: Settings, found: VehicleFindings, watched_s: float) -> Row:
    """No autopilot: as near to the reason as what came allows."""
    v = settings.vehicle
    found_text = f"no HEARTBEAT of an autopilot on {v.mavlink} within {watched_s:.1f} s"
    why = "Without it there is nothing to fly."
    if found.refused:
        told = ", ".join(f"{count} {reason}" for reason, count in found.refused.items())
        found_text += f" that could be believed; refused: {told}"
        do = "give both sides the same key, or switch signing off on both"
    elif found.others:
        told = ", ".join(
            f"system {o.system} component {o.component} ({o.kind})" for o in sorted(found.others)
        )
        found_text += f"; heard: {told}"
        do = f"set vehicle.target_system (now {v.target_system}) to the autopilot's system id"
    elif found.bytes_received:
        found_text += f"; {found.bytes_received} bytes came, no HEARTBEAT among them"
        do = "check the baud rate, and that this port speaks MAVLink 2"
    else:
        found_text += "; nothing came at all"
        do = (
            "is the autopilot on? UDP: does it send to this address and port? Serial: device, baud rate, "
            "wiring, MAV_1_CONFIG and the port's baud parameter in PX4"
        )
    return Row(Part.LINK, "autopilot", State.FAIL, found_text, why, do)


def _signing(found: VehicleFindings, is_signing: bool) -> Row:
    """Both sides must agree on signing."""
    config = found.parameters.get("MAV_SIGN_CFG")
    told = "" if config is None else f"; MAV_SIGN_CFG = {config:g}"
    state, why, do = State.OK, "", ""
    if is_signing:
        text = f"on: {found.verified} messages verified{told}"
        refused = ", ".join(f"{n} {reason}" for reason, n in found.refused.items())
        if refused:
            text += f"; refused: {refused}"
            state, why = State.WARN, "Somebody without the key, or with another one, is on this link."
            do = "if that is not the autopilot before it heard us, find out who"
        if WRONG_SIGNATURE in found.refused and not found.verified:
            state, why, do = State.FAIL, "The autopilot has another key.", "give both sides the same key"
        elif NOT_SIGNED in found.refused and not found.verified:
            state, why = State.FAIL, "The autopilot does not sign: none of its modes would be believed."
            do = "give it the key (SETUP_SIGNING, over USB), or switch signing off here"
    elif found.signs:
        state, text = State.FAIL, f"off, but the autopilot signs{told}"
        why = "It ignores unsigned messages but HEARTBEAT: no setpoint would be flown."
        do = "give this side the key as well (vehicle.signing_key_file)"
    else:
        text = f"off: whoever reaches this link can command the vehicle{told}"
    return Row(Part.LINK, "signing", state, text, why, do)


def _loss(found: VehicleFindings) -> Row:
    share = found.packets_lost / max(found.packets + found.packets_lost, 1)
    text = f"{share * 100:.1f} % of the autopilot's packets"
    if share <= _MUCH_LOST:
        return Row(Part.LINK, "packets lost", State.OK, text)
    why = "As many of our setpoints may be lost."
    do = "check cable, radio and baud rate; ask for less (vehicle.telemetry_rate_hz)"
    return Row(Part.LINK, "packets lost", State.WARN, text, why, do)


def _others(settings: Settings, found: VehicleFindings) -> Iterator[Row]:
    """Another autopilot, another one like us, or one that steers."""
    for o in sorted(found.commanders):
        yield Row(
            Part.LINK,
            "second commander",
            State.FAIL,
            f"system {o.system}, component {o.component} sends {o.kind}",
            "Two streams of setpoints would mix: the flight does not begin beside it.",
            "stop the other one",
        )
    for o in sorted(found.others):
        who = f"system {o.system}, component {o.component} ({o.kind})"
        if (o.system, o.component) == (found.system_id, settings.vehicle.component_id):
            yield Row(
                Part.LINK,
                "second companion",
                State.FAIL,
                f"{who} uses our own ids",
                "Two streams of setpoints would mix.",
                "stop the other one, or change vehicle.component_id",
            )
        elif o.component == 1 and settings.vehicle.target_system in (0, o.system):
            yield Row(
                Part.LINK,
                "second vehicle",
                State.FAIL,
                f"{who} besides system {found.system_id}",
                "Which one is ours is not known: the flight does not begin beside it.",
                "set vehicle.target_system, and give each vehicle an id of its own",
            )


# ------------------------------------------------------------------------------------------- autopilot


def _autopilot(settings: Settings, found: VehicleFindings, watched_s: float) -> Iterator[Row]:
    name = f"{found.vendor} {found.version}" if found.version else found.vendor
    who = f"{name}, {found.kind}, system {found.system_id}"
    wanted = _VENDOR[settings.vehicle.kind]
    if found.vendor != wanted:
        other = next((kind for kind, vendor in _VENDOR.items() if vendor == found.vendor), None)
        yield Row(
            Part.AUTOPILOT,
            "autopilot",
            State.FAIL,
            who,
            f"Its modes are not those of {wanted}: the app would never engage.",
            f'set vehicle.kind = "{other}"' if other else "fly it with a PX4",
        )
    else:
        yield Row(Part.AUTOPILOT, "autopilot", State.OK, who)
    if found.version is None:
        yield never_came(
            Part.AUTOPILOT,
            "AUTOPILOT_VERSION",
            watched_s,
            "Which rules of which version hold is not known.",
        )
    yield _mode(found)
    yield _armed(found)
    if found.health is None:
        yield never_came(Part.AUTOPILOT, "SYS_STATUS", watched_s, "Whether it would arm is not known.")
    else:
        yield from _health(found)
    yield _battery(settings, found, watched_s)


def _mode(found: VehicleFindings) -> Row:
    mode = "unknown" if found.mode is None else found.mode.value
    intended = found.intended
    text = mode if intended is None else f"{mode}, intended {intended.value}"
    if FlightMode.OFFBOARD in (found.mode, intended):
        return Row(
            Part.AUTOPILOT,
            "mode",
            State.FAIL,
            text,
            "OFFBOARD is selected before anybody streams: PX4 would enter it by itself as soon as a stream "
            "comes, so the app stays inhibited and silent. After a landing from OFFBOARD the mode stays.",
            "select another mode, such as Hold; then start the flight, and select OFFBOARD once it stands by",
        )
    return Row(Part.AUTOPILOT, "mode", State.OK, text)


def _armed(found: VehicleFindings) -> Row:
    landed = "" if found.landed in (None, Landed.UNKNOWN) else f", {found.landed.value}"
    if not found.armed:
        return Row(Part.AUTOPILOT, "armed", State.OK, f"no{landed}")
    return Row(
        Part.AUTOPILOT,
        "armed",
        State.WARN,
        f"yes{landed}",
        "A check belongs on the ground, before arming.",
        "",
    )


def _health(found: VehicleFindings) -> Iterator[Row]:
    health = found.health
    assert health is not None
    ill = f"; not healthy: {', '.join(health.unhealthy)}" if health.unhealthy else ""
    if found.armed or health.may_arm:
        text = "passed" if health.may_arm else "armed already"
        state = State.WARN if ill else State.OK
        yield Row(Part.AUTOPILOT, "arming checks", state, text + ill)
    elif found.estimator is not None and not found.estimator.global_position:
        yield Row(
            Part.AUTOPILOT,
            "arming checks",
            State.WARN,
            f"not passed{ill}",
            "Without a global position PX4 arms in OFFBOARD only, while setpoints stream, if at all.",
            "see the arming check in a ground station (QGroundControl) or `commander check` on PX4's console",
        )
    else:
        yield Row(
            Part.AUTOPILOT,
            "arming checks",
            State.FAIL,
            f"not passed in the present mode{ill}",
            "Arming would be refused.",
            "see the arming check in a ground station (QGroundControl) or `commander check` on PX4's console",
        )
    if health.remote_control:
        yield Row(Part.AUTOPILOT, "radio control", State.OK, "there")
    else:
        yield Row(
            Part.AUTOPILOT,
            "radio control",
            State.WARN,
            "none",
            "Nobody can take over with a switch: only a ground station can select another mode.",
            "switch the transmitter on, or keep a ground station connected and somebody at it",
        )


def _battery(settings: Settings, found: VehicleFindings, watched_s: float) -> Row:
    share, volts = found.battery_share, found.battery_v
    told = [] if share is None else [f"{share * 100:.0f} %"]
    told += [] if volts is None else [f"{volts:.1f} V"]
    if found.charge in (Charge.LOW, Charge.CRITICAL):
        told.append(found.charge.value)
    text = ", ".join(told)
    do = "charge it"
    if found.charge in (Charge.LOW, Charge.CRITICAL):
        why = "PX4 will not arm, or lands or returns by itself in flight (COM_LOW_BAT_ACT)."
        return Row(Part.AUTOPILOT, "battery", State.FAIL, text, why, do)
    report = BatteryReport(0, found.charge or Charge.UNKNOWN, share)
    if on_battery(Health(), settings.loss, report).battery_low:
        why = "The flight does not begin with it (loss.battery_hand_over, loss.battery_share)."
        return Row(Part.AUTOPILOT, "battery", State.FAIL, text, why, do)
    if share is None:
        text = text or f"SYS_STATUS and BATTERY_STATUS told nothing within {watched_s:.1f} s"
        why = WITHOUT["BATTERY_STATUS"]
        return Row(Part.AUTOPILOT, "battery", State.WARN, text, why, "calibrate PX4's power module")
    if share < _LOW_SHARE:
        why = "A low battery ends the flight early (COM_LOW_BAT_ACT)."
        return Row(Part.AUTOPILOT, "battery", State.WARN, text, why, do)
    return Row(Part.AUTOPILOT, "battery", State.OK, text)


# -------------------------------------------------------------------------------------------- estimate


def _estimate(settings: Settings, found: VehicleFindings) -> Iterator[Row]:
    e = found.estimator
    assert e is not None
    missing = {lack.subject: lack for lack in shortfalls(settings.vehicle, settings.loss.hand_over_to, e)}
    needless = settings.vehicle.setpoint_frame == "body_ned" and not (e.position and e.height)
    for subject in ("velocity", "local position", "global position"):
        lack = missing.get(subject)
        if lack is not None:
            state = State.FAIL if lack.vital else State.WARN
            yield Row(Part.ESTIMATE, subject, state, lack.found, lack.why, lack.do)
        elif subject == "local position" and needless:
            yield Row(Part.ESTIMATE, subject, State.OK, "not valid; body_ned does not need it")
        else:
            yield Row(Part.ESTIMATE, subject, State.OK, "valid")


def _telemetry(settings: Settings, found: VehicleFindings) -> Iterator[Row]:
    vital = {"ATTITUDE"} | (
        {"LOCAL_POSITION_NED"} if settings.vehicle.setpoint_frame == "local_ned" else set()
    )
    for name, wanted_hz in wanted_rates(settings.vehicle).items():
        rate_hz = found.rates_hz.get(name, 0.0)
        if rate_hz >= 0.7 * wanted_hz:
            yield Row(Part.TELEMETRY, name, State.OK, f"{rate_hz:.0f} Hz of {wanted_hz:g} Hz wanted")
            continue
        yield Row(
            Part.TELEMETRY,
            name,
            State.FAIL if name in vital and not rate_hz else State.WARN,
            f"{rate_hz:.0f} Hz of {wanted_hz:g} Hz wanted"
            if rate_hz
            else f"never came; wanted {wanted_hz:g} Hz",
            WITHOUT[name] if not rate_hz else "Late telemetry makes the flight less exact.",
            "if the estimate is not valid, mend that first; else raise the link's baud rate and MAV_1_RATE"
            if name == "LOCAL_POSITION_NED"
            else "raise the link's baud rate and MAV_1_RATE, or lower vehicle.telemetry_rate_hz",
        )
