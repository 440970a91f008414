"""The pure core: `step(plan, state, event)` → the next state and what is to leave.

gate → observe → command → phase → limits, on every event. No clock, no I/O, no randomness: the same events
give the same outputs, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from companion import gate, limits, phase
from companion import vehicle as veh
from companion.guidance import schemes
from companion.guidance.scheme import PROBE, UNKNOWN_M, Command, Scheme
from companion.limits import LimitState
from companion.phase import Condition, Facts, Ranges
from companion.settings import BeaconSettings, Settings
from companion.types import (
    Attitude,
    CompanionHeartbeat,
    Estimate,
    Event,
    FlightMode,
    Landed,
    LandedReport,
    LocalMotion,
    Malformed,
    ModeReport,
    ModeRequest,
    Output,
    Phase,
    PhaseChange,
    RangeSample,
    RangeVerdict,
    Setpoint,
    Status,
    StopRequest,
    SystemStatus,
    Tick,
    VehicleHeartbeat,
    Verdict,
)
from companion.vehicle import BodyMotion, Vehicle

_HEARTBEAT_NS = 1_000_000_000
_REQUEST_AGAIN_S = 1.0
_LONGEST_PREDICTION_S = 1.0
"""After a longer pause of the event stream the prediction is worth nothing anyway."""
_HEADING_RESET_RAD = 0.2
"""A larger jump between turn and headings is a reset of the autopilot's yaw, not a turn."""
_POSITION_RESET_M = 0.5
"""A larger jump between moves and positions is a reset of the autopilot's position, not a move."""
_STANDSTILL = Command(0.0, 0.0, PROBE)


class Plan(NamedTuple):
    """What stays the same for a whole flight: the settings and what follows from them."""

    settings: Settings
    scheme: Scheme
    beacons: dict[str, tuple[int, BeaconSettings]]
    """Beacon id → its number in the scheme and what is known of it."""


class Ranging(NamedTuple):
    """What has become of the ranges."""

    tracks: dict[str, gate.Track] = {}  # noqa: RUF012 - never changed in place, as the two below
    rejected: dict[Verdict, int] = {}  # noqa: RUF012
    malformed: dict[str, int] = {}  # noqa: RUF012
    accepted: int = 0
    t_ns: int | None = None
    """When a range was believed last."""
    range_m: float | None = None
    verdict: Verdict = Verdict.ACCEPTED
    """What became of the last range."""


class Observing(NamedTuple):
    """The scheme's own state, the time that it stands at, and the motion that brought it there."""

    guidance: Any
    t_ns: int = 0
    motion: BodyMotion = BodyMotion()
    heading_rad: float = 0.0
    """The heading that the observer's turning so far amounts to; each ATTITUDE corrects it."""
    path_m: float = 0.0
    place: tuple[float, float] | None = None
    """Where the observer's moves lead to, in the autopilot's local frame; None: it tells no position."""
    lag_x_m: float = 0.0
    lag_y_m: float = 0.0
    """What the next prediction moves on top, to be where the autopilot's position says."""


class Steering(NamedTuple):
    """The last command, and what left of it."""

    command: Command = _STANDSTILL
    t_command_ns: int = 0
    hold_height_m: float | None = None
    limits: LimitState = LimitState()
    setpoint: Setpoint | None = None
    t_allowed_ns: int = 0


class Flight(NamedTuple):
    """What has happened so far."""

    stop_asked: bool = False
    was_ready: bool = False
    was_engaged: bool = False
    captured: bool = False
    t_engaged_ns: int = 0
    engaged_s: float = 0.0
    """How long the last engagement lasted, once it is over."""
    t_heartbeat_ns: int | None = None
    t_status_ns: int | None = None
    t_request_ns: int | None = None


class State(NamedTuple):
    """All that the pilot remembers, in groups that change at the same pace."""

    phase: Phase
    reason: str
    t_phase_ns: int | None
    vehicle: Vehicle
    ranging: Ranging
    observing: Observing
    steering: Steering
    flight: Flight


def plan(settings: Settings) -> Plan:
    """Work out what stays the same for the whole flight."""
    target = settings.mission.target
    return Plan(
        settings=settings,
        scheme=schemes.capture(
            settings.guidance, settings.vehicle.yaw_rate_lag_s, settings.vehicle.velocity_lag_s
        ),
        beacons={target: (0, settings.beacons[target])},
    )


def initial(p: Plan) -> State:
    """Nothing seen, nothing sent."""
    observing = Observing(p.scheme.initial(p.scheme.p))
    return State(Phase.AWAIT, "started", None, Vehicle(), Ranging(), observing, Steering(), Flight())


def step(p: Plan, s: State, event: Event) -> tuple[State, tuple[Output, ...]]:
    """Take in one event; return the next state and what is to leave, in order."""
    t_ns = event.t_ns
    if s.t_phase_ns is None:
        s = s._replace(t_phase_ns=t_ns, observing=s.observing._replace(t_ns=t_ns))
    kind = type(event)
    s = _TAKE_IN[kind](p, s, event)
    if kind in _MERE_TELEMETRY:  # the next range or tick, a moment later, acts on it
        return s, ()
    due = _is_due(p, s, event)
    if due and (s.phase in phase.MOVING or s.phase is Phase.HOLD):
        s = _command(p, s, t_ns)
    s, change = _transit(p, s, t_ns)  # critical: between command and setpoint, so that it has the last word
    outputs: list[Output] = [] if change is None else [change]
    if isinstance(event, RangeSample):
        outputs.append(_verdict(s, event))
    if due and s.phase in phase.STREAMING:
        s, setpoint = _setpoint(p, s, t_ns)
        outputs.append(setpoint)
    return _upkeep(p, s, t_ns, outputs)


_MERE_TELEMETRY = frozenset({Attitude, LocalMotion, Malformed})


# ------------------------------------------------------------------------------------- taking events in


def _on_range(p: Plan, s: State, e: RangeSample) -> State:
    known = p.beacons.get(e.beacon)
    if known is None:
        return _reject(s, Verdict.UNKNOWN_BEACON)
    number, beacon = known
    r = s.ranging
    track, verdict = gate.judge(p.settings.ranges, r.tracks.get(e.beacon), e)
    if track is not None:
        r = r._replace(tracks={**r.tracks, e.beacon: track})
        s = s._replace(ranging=r)
    if verdict is not Verdict.ACCEPTED:
        return _reject(s, verdict)
    o = _predict(p, s, e.t_ns)
    sigma_m = gate.sigma_m(p.settings.ranges, e, beacon.sigma_m)
    cfg = p.settings.vehicle
    height_m = cfg.height_m if s.vehicle.height_m is None else s.vehicle.height_m
    guidance = p.scheme.update(
        p.scheme.p, o.guidance, number, e.range_m, sigma_m, height_m - beacon.height_m, cfg.height_sigma_m
    )
    s = s._replace(observing=o._replace(guidance=guidance))
    if not guidance.accepted:
        return _reject(s, Verdict.OUTLIER)
    r = r._replace(t_ns=e.t_ns, accepted=r.accepted + 1, range_m=e.range_m, verdict=Verdict.ACCEPTED)
    return s._replace(ranging=r)


def _on_attitude(p: Plan, s: State, e: Attitude) -> State:
    v = veh.on_attitude(s.vehicle, e)
    o = _predict(p, s, e.t_ns, turned_to=v.heading_rad)
    return s._replace(observing=o._replace(heading_rad=v.heading_rad), vehicle=v)


def _on_motion(p: Plan, s: State, e: LocalMotion) -> State:
    """The autopilot's position strays far less than its velocity, added up: its differences are the moves."""
    o = s.observing
    lag_x_m = lag_y_m = 0.0
    place = None
    if e.x_m is not None and e.y_m is not None and math.isfinite(e.x_m + e.y_m):
        place = (e.x_m, e.y_m)
        if o.place is not None:
            dt_s = (e.t_ns - o.t_ns) * 1e-9
            c, sn = math.cos(o.heading_rad), math.sin(o.heading_rad)
            forward_m, left_m = o.motion.forward_m_s * dt_s, o.motion.left_m_s * dt_s
            x_m = e.x_m - o.place[0] - (forward_m * c - left_m * sn)
            y_m = e.y_m - o.place[1] - (forward_m * sn + left_m * c)
            if math.hypot(x_m, y_m) < _POSITION_RESET_M:
                place, lag_x_m, lag_y_m = o.place, x_m, y_m
    return s._replace(
        vehicle=veh.on_motion(s.vehicle, e),
        observing=o._replace(place=place, lag_x_m=lag_x_m, lag_y_m=lag_y_m),
    )


def _on_heartbeat(p: Plan, s: State, e: VehicleHeartbeat) -> State:
    return s._replace(vehicle=veh.on_heartbeat(s.vehicle, e))


def _on_mode(p: Plan, s: State, e: ModeReport) -> State:
    return s._replace(vehicle=veh.on_mode(s.vehicle, e))


def _on_landed(p: Plan, s: State, e: LandedReport) -> State:
    return s._replace(vehicle=s.vehicle._replace(landed=e.landed))


def _on_malformed(p: Plan, s: State, e: Malformed) -> State:
    r, name = s.ranging, e.defect.value
    return s._replace(ranging=r._replace(malformed={**r.malformed, name: r.malformed.get(name, 0) + 1}))


def _on_stop(p: Plan, s: State, e: StopRequest) -> State:
    return s._replace(flight=s.flight._replace(stop_asked=True))


def _on_tick(p: Plan, s: State, e: Tick) -> State:
    return s


_TAKE_IN: dict[type, Callable[[Plan, State, Any], State]] = {
    RangeSample: _on_range,
    Attitude: _on_attitude,
    LocalMotion: _on_motion,
    VehicleHeartbeat: _on_heartbeat,
    ModeReport: _on_mode,
    LandedReport: _on_landed,
    Malformed: _on_malformed,
    StopRequest: _on_stop,
    Tick: _on_tick,
}


def _reject(s: State, verdict: Verdict) -> State:
    r = s.ranging
    rejected = {**r.rejected, verdict: r.rejected.get(verdict, 0) + 1}
    return s._replace(ranging=r._replace(rejected=rejected, verdict=verdict))


def _verdict(s: State, e: RangeSample) -> RangeVerdict:
    return RangeVerdict(t_ns=e.t_ns, beacon=e.beacon, seq=e.seq, verdict=s.ranging.verdict)


def _predict(p: Plan, s: State, t_ns: int, turned_to: float | None = None) -> Observing:
    """Bring the observer up to t_ns with the motion measured (or modelled) since.

    With the heading measured at t_ns, the whole turn since the last one is that of the two headings: the yaw
    rate, sampled, is good for the moments between them only.
    """
    o = s.observing
    dt_s = min((t_ns - o.t_ns) * 1e-9, _LONGEST_PREDICTION_S)
    if dt_s <= 0.0:
        return o
    cfg, sent = p.settings.vehicle, s.steering.setpoint
    commanded = BodyMotion() if sent is None else BodyMotion(sent.speed_m_s, 0.0, sent.yaw_rate_rad_s)
    motion = veh.body_motion(
        s.vehicle, o.motion, commanded, t_ns, dt_s, cfg.velocity_lag_s, cfg.yaw_rate_lag_s
    )
    turn_rad = motion.yaw_rate_rad_s * dt_s
    if turned_to is not None:
        measured_rad = math.remainder(turned_to - o.heading_rad, 2.0 * math.pi)
        if abs(measured_rad - turn_rad) < _HEADING_RESET_RAD:
            turn_rad = measured_rad
    forward_m_s, left_m_s, place = motion.forward_m_s, motion.left_m_s, o.place
    if place is not None:
        middle = o.heading_rad + 0.5 * turn_rad
        c, sn = math.cos(middle), math.sin(middle)
        place = (
            place[0] + (forward_m_s * c - left_m_s * sn) * dt_s + o.lag_x_m,
            place[1] + (forward_m_s * sn + left_m_s * c) * dt_s + o.lag_y_m,
        )
        forward_m_s += (o.lag_x_m * c + o.lag_y_m * sn) / dt_s
        left_m_s += (o.lag_y_m * c - o.lag_x_m * sn) / dt_s
    guidance = p.scheme.predict(p.scheme.p, o.guidance, dt_s, forward_m_s, left_m_s, turn_rad / dt_s)
    flown_m = math.hypot(motion.forward_m_s, motion.left_m_s) * dt_s if s.phase.is_engaged else 0.0
    return Observing(guidance, t_ns, motion, o.heading_rad + turn_rad, o.path_m + flown_m, place)


# ---------------------------------------------------------------------------------------------- phase


def _transit(p: Plan, s: State, t_ns: int) -> tuple[State, PhaseChange | None]:
    after, condition = phase.step(s.phase, _facts(p, s, t_ns))
    if condition is None:
        return s, None
    reason = condition.value
    if condition is Condition.BUDGET_SPENT:
        reason = limits.spent(p.settings.limits, s.steering.limits, t_ns) or reason
    severity = phase.severity(after, condition)
    change = PhaseChange(t_ns=t_ns, before=s.phase, after=after, reason=reason, severity=severity)
    s = s._replace(phase=after, reason=reason, t_phase_ns=t_ns, flight=s.flight._replace(t_request_ns=None))
    return _enter(p, s, after, condition, t_ns), change


def _enter(p: Plan, s: State, after: Phase, condition: Condition, t_ns: int) -> State:
    """What a transition does besides changing the phase."""
    if s.flight.t_engaged_ns and not after.is_engaged and not s.flight.engaged_s:
        s = s._replace(flight=s.flight._replace(engaged_s=_age_s(s.flight.t_engaged_ns, t_ns)))
    if condition is Condition.ENGAGED:
        return s._replace(
            observing=s.observing._replace(guidance=p.scheme.initial(p.scheme.p), path_m=0.0),
            steering=s.steering._replace(
                command=_STANDSTILL,
                t_command_ns=t_ns,
                hold_height_m=s.vehicle.height_m,
                limits=limits.start(t_ns),
            ),
            flight=s.flight._replace(was_engaged=True, captured=False, t_engaged_ns=t_ns, engaged_s=0.0),
        )
    if condition is Condition.RANGES_STALE:
        # Stale knowledge does not steer again: the bearing is acquired anew.
        return s._replace(
            observing=s.observing._replace(guidance=p.scheme.initial(p.scheme.p)),
            steering=s.steering._replace(command=_STANDSTILL),
        )
    if after is Phase.STANDBY:
        return s._replace(flight=s.flight._replace(was_ready=True))
    if after is Phase.HOLD:
        return s._replace(flight=s.flight._replace(captured=True))
    return s


def _facts(p: Plan, s: State, t_ns: int) -> Facts:
    cfg, v = p.settings.loss, s.vehicle
    range_age_s = _age_s(s.ranging.t_ns, t_ns)
    if range_age_s <= cfg.coast_after_s:
        ranges = Ranges.FRESH
    elif range_age_s <= cfg.stall_after_s:
        ranges = Ranges.LATE
    else:
        ranges = Ranges.STALE if range_age_s <= cfg.hand_over_after_s else Ranges.LOST
    in_phase_s = _age_s(s.t_phase_ns, t_ns)
    return Facts(
        stop_asked=s.flight.stop_asked,
        vehicle_gone=_age_s(v.t_link_ns, t_ns) > cfg.vehicle_after_s,
        actual=v.actual,
        intended=v.intended,
        armed=v.armed,
        grounded=v.landed is Landed.ON_GROUND,
        was_engaged=s.flight.was_engaged,
        waited_out=in_phase_s > cfg.wait_s and not s.flight.was_ready,
        telemetry_late=_age_s(v.t_attitude_ns, t_ns) > cfg.telemetry_after_s,
        ranges=ranges,
        bearing_lost=ranges is Ranges.LATE
        and p.scheme.knowledge(p.scheme.p, s.observing.guidance).sigma_theta_rad
        > cfg.coast_bearing_sigma_rad,
        budget_spent=s.phase.is_engaged
        and limits.spent(p.settings.limits, s.steering.limits, t_ns) is not None,
        hand_over_overdue=s.phase is Phase.HAND_OVER
        and (cfg.hand_over_to == "release" or in_phase_s > cfg.hand_over_patience_s),
        purpose=s.steering.command.purpose,
    )


def _age_s(then_ns: int | None, now_ns: int) -> float:
    return math.inf if then_ns is None else (now_ns - then_ns) * 1e-9


# -------------------------------------------------------------------------------------------- control


def _is_due(p: Plan, s: State, event: Event) -> bool:
    """A believed range steers at once, a tick keeps the minimum rate; neither beyond the maximum rate."""
    cfg, sent = p.settings.stream, s.steering.setpoint
    t_ns = event.t_ns
    fresh = type(event) is RangeSample and s.ranging.t_ns == t_ns
    overdue = sent is None or t_ns - sent.t_ns >= 1e9 / cfg.min_rate_hz
    return (fresh or overdue) and t_ns >= s.steering.t_allowed_ns - 1e9 / cfg.max_rate_hz


def _command(p: Plan, s: State, t_ns: int) -> State:
    """What the guidance asks for now."""
    o, g = _predict(p, s, t_ns), s.steering
    dt_s = (t_ns - g.t_command_ns) * 1e-9
    guidance, command = p.scheme.command(p.scheme.p, o.guidance, dt_s, o.motion.yaw_rate_rad_s)
    return s._replace(
        observing=o._replace(guidance=guidance), steering=g._replace(command=command, t_command_ns=t_ns)
    )


def _setpoint(p: Plan, s: State, t_ns: int) -> tuple[State, Setpoint]:
    """What leaves of the command: by the phase, then by the limits."""
    cfg, v, g = p.settings.vehicle, s.vehicle, s.steering
    moving = s.phase in phase.MOVING
    steering = moving or s.phase is Phase.HOLD
    hold_m = g.hold_height_m if s.phase.is_engaged else v.height_m
    climb_m_s = 0.0
    if cfg.setpoint_frame == "body_ned" and hold_m is not None and v.height_m is not None:
        climb_m_s = cfg.height_gain_1_s * (hold_m - v.height_m)
    wanted = Setpoint(
        t_ns=t_ns,
        speed_m_s=g.command.v_m_s if moving else 0.0,  # critical: no speed in any other phase
        yaw_rate_rad_s=g.command.omega_rad_s if steering else 0.0,
        heading_rad=v.heading_rad,
        height_m=hold_m if cfg.setpoint_frame == "local_ned" else None,
        climb_m_s=climb_m_s,
    )
    state, setpoint = limits.apply(p.settings.limits, g.limits, wanted, v.height_m)
    t_allowed_ns = max(g.t_allowed_ns, t_ns) + int(1e9 / p.settings.stream.max_rate_hz)
    return s._replace(
        steering=g._replace(limits=state, setpoint=setpoint, t_allowed_ns=t_allowed_ns)
    ), setpoint


# --------------------------------------------------------------------------------------------- upkeep


_HAND_OVER_MODE = {"land": FlightMode.AUTO_LAND, "hold": FlightMode.AUTO_LOITER}


def _upkeep(p: Plan, s: State, t_ns: int, outputs: list[Output]) -> tuple[State, tuple[Output, ...]]:
    """Heartbeat, mode request and status, each at its pace."""
    f = s.flight
    if f.t_heartbeat_ns is None or t_ns - f.t_heartbeat_ns >= _HEARTBEAT_NS:
        outputs.append(CompanionHeartbeat(t_ns=t_ns, system_status=_system_status(s.phase)))
        s = s._replace(flight=f._replace(t_heartbeat_ns=t_ns))
    if s.phase is Phase.HAND_OVER and _age_s(f.t_request_ns, t_ns) >= _REQUEST_AGAIN_S:
        mode = _HAND_OVER_MODE.get(p.settings.loss.hand_over_to)
        if mode is not None:
            outputs.append(ModeRequest(t_ns=t_ns, mode=mode))
            s = s._replace(flight=s.flight._replace(t_request_ns=t_ns))
    period_ns = 1e9 / p.settings.stream.status_rate_hz
    if f.t_status_ns is None or t_ns - f.t_status_ns >= period_ns or s.phase.is_final:
        s = s._replace(flight=s.flight._replace(t_status_ns=t_ns))
        outputs.append(status(p, s, t_ns))
    return s, tuple(outputs)


def _system_status(of: Phase) -> SystemStatus:
    if of in (Phase.STALL, Phase.HAND_OVER):
        return SystemStatus.CRITICAL
    if of.is_engaged:
        return SystemStatus.ACTIVE
    return SystemStatus.BOOT if of is Phase.AWAIT else SystemStatus.STANDBY


def awaited(p: Plan, s: State, t_ns: int) -> tuple[str, ...]:
    """What is missing before the flight can begin, in words, with where it is expected from."""
    cfg, missing = p.settings, []
    if _age_s(s.vehicle.t_link_ns, t_ns) > cfg.loss.vehicle_after_s:
        missing.append(f"autopilot HEARTBEAT on {cfg.vehicle.mavlink}")
    elif _age_s(s.vehicle.t_attitude_ns, t_ns) > cfg.loss.telemetry_after_s:
        missing.append(f"ATTITUDE on {cfg.vehicle.mavlink}")
    if _age_s(s.ranging.t_ns, t_ns) > cfg.loss.coast_after_s:
        door = ", ".join(cfg.ranges.connect + cfg.ranges.listen) or "no endpoint configured"
        missing.extend(
            f"ranges of beacon {beacon!r} (Zenoh site {cfg.ranges.site!r}, {door})" for beacon in p.beacons
        )
    return tuple(missing)


def status(p: Plan, s: State, t_ns: int) -> Status:
    """The snapshot that people see."""
    v, r, sent = s.vehicle, s.ranging, s.steering.setpoint
    estimate = None
    k = p.scheme.knowledge(p.scheme.p, s.observing.guidance)
    if k.sigma_d_m < UNKNOWN_M:
        estimate = Estimate(k.d_m, k.sigma_d_m, k.theta_rad, k.sigma_theta_rad)
    streaming = sent is not None and s.phase in phase.STREAMING
    engaged_s = _age_s(s.flight.t_engaged_ns, t_ns) if s.phase.is_engaged else s.flight.engaged_s
    return Status(
        t_ns=t_ns,
        phase=s.phase,
        reason=s.reason,
        awaited=awaited(p, s, t_ns) if s.phase in (Phase.AWAIT, Phase.ENDED) else (),
        mode=v.actual,
        armed=v.armed,
        range_m=r.range_m,
        range_age_s=None if r.t_ns is None else _age_s(r.t_ns, t_ns),
        ranges_accepted=r.accepted,
        rejected={verdict.value: n for verdict, n in r.rejected.items()},
        malformed=r.malformed,
        telemetry_age_s=None if v.t_attitude_ns is None else _age_s(v.t_attitude_ns, t_ns),
        estimate=estimate,
        speed_m_s=sent.speed_m_s if sent is not None and streaming else None,
        yaw_rate_rad_s=sent.yaw_rate_rad_s if sent is not None and streaming else None,
        x_m=v.x_m,
        y_m=v.y_m,
        height_m=v.height_m,
        heading_rad=None if v.t_attitude_ns is None else v.heading_rad,
        path_m=s.observing.path_m,
        engaged_s=engaged_s,
        captured=s.flight.captured,
    )
