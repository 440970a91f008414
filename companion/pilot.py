"""The pure core: `step(plan, state, event)` → the next state and what is to leave.

gate → observe → phase → control → limits, on every event. No clock, no I/O, no randomness: the same events
give the same outputs, bit for bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from companion import gate, limits, phase
from companion import vehicle as veh
from companion.guidance import schemes
from companion.guidance.scheme import PROBE, Command, Scheme
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
    Setpoint,
    Status,
    StopRequest,
    SystemStatus,
    Tick,
    VehicleHeartbeat,
)
from companion.vehicle import BodyMotion, Vehicle

_HEARTBEAT_NS = 1_000_000_000
_REQUEST_AGAIN_NS = 1_000_000_000
_LONGEST_PREDICTION_S = 1.0
"""After a longer pause of the event stream the prediction is worth nothing anyway."""
_STANDSTILL = Command(0.0, 0.0, PROBE)


class Plan(NamedTuple):
    """What stays the same for a whole flight: the settings and what follows from them."""

    settings: Settings
    scheme: Scheme
    beacons: dict[str, tuple[int, BeaconSettings]]
    """Beacon id → its number in the scheme and what is known of it."""


class State(NamedTuple):
    """All that the pilot remembers."""

    phase: Phase = Phase.AWAIT
    reason: str = "started"
    t_first_ns: int | None = None
    t_phase_ns: int = 0
    vehicle: Vehicle = Vehicle()
    tracks: dict[str, gate.Track] = {}  # noqa: RUF012 - never changed in place
    rejected: dict[gate.Verdict, int] = {}  # noqa: RUF012
    malformed: dict[str, int] = {}  # noqa: RUF012
    accepted: int = 0
    t_range_ns: int | None = None
    range_m: float | None = None
    guidance: Any = None
    t_guidance_ns: int = 0
    motion: BodyMotion = BodyMotion()
    command: Command = _STANDSTILL
    t_command_ns: int = 0
    hold_height_m: float | None = None
    limits: LimitState = LimitState()
    setpoint: Setpoint | None = None
    t_allowed_ns: int = 0
    t_heartbeat_ns: int | None = None
    t_status_ns: int | None = None
    t_request_ns: int | None = None
    stop_asked: bool = False
    was_ready: bool = False
    was_engaged: bool = False
    captured: bool = False
    t_engaged_ns: int = 0
    engaged_s: float = 0.0
    path_m: float = 0.0


def plan(settings: Settings) -> Plan:
    """Work out what stays the same for the whole flight."""
    target = settings.mission.target
    return Plan(
        settings=settings,
        scheme=schemes.capture(settings.guidance, settings.vehicle.yaw_rate_lag_s),
        beacons={target: (0, settings.beacons[target])},
    )


def initial(p: Plan) -> State:
    """Nothing seen, nothing sent."""
    return State(guidance=p.scheme.initial(p.scheme.p))


def step(p: Plan, s: State, event: Event) -> tuple[State, tuple[Output, ...]]:
    """Take in one event; return the next state and what is to leave, in order."""
    if s.t_first_ns is None:
        s = s._replace(t_first_ns=event.t_ns, t_phase_ns=event.t_ns, t_guidance_ns=event.t_ns)
    s = _TAKE_IN[type(event)](p, s, event)
    s, change = _transit(p, s, event.t_ns)
    outputs: list[Output] = [] if change is None else [change]
    if s.phase in phase.STREAMING and _is_due(p, s, event):
        s = _control(p, s, event.t_ns)
        if s.setpoint is not None:
            outputs.append(s.setpoint)
    return _upkeep(p, s, event.t_ns, outputs)


# ------------------------------------------------------------------------------------- taking events in


def _on_range(p: Plan, s: State, e: RangeSample) -> State:
    known = p.beacons.get(e.beacon)
    if known is None:
        return _reject(s, gate.Verdict.UNKNOWN_BEACON)
    number, beacon = known
    track, verdict = gate.judge(p.settings.ranges, s.tracks.get(e.beacon), e)
    if track is not None:
        s = s._replace(tracks={**s.tracks, e.beacon: track})
    if verdict is not gate.Verdict.ACCEPTED:
        return _reject(s, verdict)
    s = _predict(p, s, e.t_ns)
    sigma_m = gate.sigma_m(p.settings.ranges, e, beacon.sigma_m)
    cfg = p.settings.vehicle
    height_m = cfg.height_m if s.vehicle.height_m is None else s.vehicle.height_m
    guidance = p.scheme.update(
        p.scheme.p, s.guidance, number, e.range_m, sigma_m, height_m - beacon.height_m, cfg.height_sigma_m
    )
    s = s._replace(guidance=guidance, range_m=e.range_m)
    if not guidance.accepted:
        return _reject(s, gate.Verdict.OUTLIER)
    return s._replace(t_range_ns=e.t_ns, accepted=s.accepted + 1)


def _on_attitude(p: Plan, s: State, e: Attitude) -> State:
    s = _predict(p, s, e.t_ns)
    return s._replace(vehicle=veh.on_attitude(s.vehicle, e))


def _on_motion(p: Plan, s: State, e: LocalMotion) -> State:
    s = _predict(p, s, e.t_ns)
    return s._replace(vehicle=veh.on_motion(s.vehicle, e))


def _on_heartbeat(p: Plan, s: State, e: VehicleHeartbeat) -> State:
    return s._replace(vehicle=veh.on_heartbeat(s.vehicle, e))


def _on_mode(p: Plan, s: State, e: ModeReport) -> State:
    return s._replace(vehicle=veh.on_mode(s.vehicle, e))


def _on_landed(p: Plan, s: State, e: LandedReport) -> State:
    return s._replace(vehicle=s.vehicle._replace(landed=e.landed))


def _on_malformed(p: Plan, s: State, e: Malformed) -> State:
    name = e.defect.value
    return s._replace(malformed={**s.malformed, name: s.malformed.get(name, 0) + 1})


def _on_stop(p: Plan, s: State, e: StopRequest) -> State:
    return s._replace(stop_asked=True)


def _on_tick(p: Plan, s: State, e: Event) -> State:
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


def _reject(s: State, verdict: gate.Verdict) -> State:
    return s._replace(rejected={**s.rejected, verdict: s.rejected.get(verdict, 0) + 1})


def _predict(p: Plan, s: State, t_ns: int) -> State:
    """Bring the observer up to t_ns with the motion measured (or modelled) since."""
    dt_s = min((t_ns - s.t_guidance_ns) * 1e-9, _LONGEST_PREDICTION_S)
    if dt_s <= 0.0:
        return s
    cfg = p.settings.vehicle
    sent = s.setpoint
    commanded = BodyMotion() if sent is None else BodyMotion(sent.speed_m_s, 0.0, sent.yaw_rate_rad_s)
    motion = veh.body_motion(
        s.vehicle, s.motion, commanded, t_ns, dt_s, cfg.velocity_lag_s, cfg.yaw_rate_lag_s
    )
    guidance = p.scheme.predict(
        p.scheme.p, s.guidance, dt_s, motion.forward_m_s, motion.left_m_s, motion.yaw_rate_rad_s
    )
    if not s.phase.is_engaged:
        return s._replace(guidance=guidance, t_guidance_ns=t_ns, motion=motion)
    path_m = s.path_m + math.hypot(motion.forward_m_s, motion.left_m_s) * dt_s
    return s._replace(
        guidance=guidance,
        t_guidance_ns=t_ns,
        motion=motion,
        path_m=path_m,
        engaged_s=(t_ns - s.t_engaged_ns) * 1e-9,
    )


# ---------------------------------------------------------------------------------------------- phase


def _transit(p: Plan, s: State, t_ns: int) -> tuple[State, PhaseChange | None]:
    after, condition = phase.step(s.phase, _facts(p, s, t_ns))
    if condition is None:
        return s, None
    reason = condition.value
    if condition is Condition.BUDGET_SPENT:
        reason = limits.spent(p.settings.limits, s.limits, t_ns) or reason
    severity = phase.severity(after, condition)
    change = PhaseChange(t_ns=t_ns, before=s.phase, after=after, reason=reason, severity=severity)
    return _enter(p, s, after, condition, reason, t_ns), change


def _enter(p: Plan, s: State, after: Phase, condition: Condition, reason: str, t_ns: int) -> State:
    """What a transition does besides changing the phase."""
    s = s._replace(phase=after, reason=reason, t_phase_ns=t_ns, t_request_ns=None)
    if condition is Condition.ENGAGED:
        return s._replace(
            guidance=p.scheme.initial(p.scheme.p),
            command=_STANDSTILL,
            limits=limits.start(t_ns),
            hold_height_m=s.vehicle.height_m,
            t_engaged_ns=t_ns,
            t_command_ns=t_ns,
            was_engaged=True,
            captured=False,
            path_m=0.0,
            engaged_s=0.0,
        )
    if after is Phase.STALL and condition is Condition.RANGES_STALE:
        # Stale knowledge does not steer again: the bearing is acquired anew.
        return s._replace(guidance=p.scheme.initial(p.scheme.p), command=_STANDSTILL)
    if after is Phase.STANDBY:
        return s._replace(was_ready=True)
    if after is Phase.HOLD:
        return s._replace(captured=True)
    return s


def _facts(p: Plan, s: State, t_ns: int) -> Facts:
    cfg, v = p.settings.loss, s.vehicle
    range_age_s = _age_s(s.t_range_ns, t_ns)
    if range_age_s > cfg.hand_over_after_s:
        ranges = Ranges.LOST
    elif range_age_s > cfg.stall_after_s:
        ranges = Ranges.STALE
    else:
        ranges = Ranges.LATE if range_age_s > cfg.coast_after_s else Ranges.FRESH
    in_phase_s = (t_ns - s.t_phase_ns) * 1e-9
    engaged = s.phase.is_engaged
    return Facts(
        stop_asked=s.stop_asked,
        vehicle_gone=_age_s(v.t_link_ns, t_ns) > cfg.vehicle_after_s,
        actual=v.actual,
        intended=v.intended,
        armed=v.armed,
        grounded=v.landed is Landed.ON_GROUND,
        was_engaged=s.was_engaged,
        waited_out=not s.was_ready and in_phase_s > cfg.wait_s,
        telemetry_late=_age_s(v.t_attitude_ns, t_ns) > cfg.telemetry_after_s,
        ranges=ranges,
        bearing_lost=ranges is Ranges.LATE
        and p.scheme.knowledge(p.scheme.p, s.guidance).sigma_theta_rad > cfg.coast_bearing_sigma_rad,
        budget_spent=engaged and limits.spent(p.settings.limits, s.limits, t_ns) is not None,
        hand_over_overdue=s.phase is Phase.HAND_OVER
        and (cfg.hand_over_to == "release" or in_phase_s > cfg.hand_over_patience_s),
        purpose=s.command.purpose,
    )


def _age_s(then_ns: int | None, now_ns: int) -> float:
    return math.inf if then_ns is None else (now_ns - then_ns) * 1e-9


# -------------------------------------------------------------------------------------------- control


def _is_due(p: Plan, s: State, event: Event) -> bool:
    """A believed range steers at once, a tick keeps the minimum rate; neither beyond the maximum rate."""
    cfg = p.settings.stream
    t_ns = event.t_ns
    fresh = type(event) is RangeSample and s.t_range_ns == t_ns
    overdue = s.setpoint is None or t_ns - s.setpoint.t_ns >= 1e9 / cfg.min_rate_hz
    return (fresh or overdue) and t_ns >= s.t_allowed_ns - 1e9 / cfg.max_rate_hz


def _control(p: Plan, s: State, t_ns: int) -> State:
    """Command, limits, and the setpoint that leaves."""
    s = _predict(p, s, t_ns)
    cfg, v = p.settings.vehicle, s.vehicle
    command = _STANDSTILL._replace(purpose=s.command.purpose)
    if s.phase in phase.MOVING or s.phase is Phase.HOLD:
        dt_s = (t_ns - s.t_command_ns) * 1e-9
        guidance, command = p.scheme.command(p.scheme.p, s.guidance, dt_s, s.motion.yaw_rate_rad_s)
        s = s._replace(guidance=guidance, command=command)
    hold_m = s.hold_height_m if s.phase.is_engaged else v.height_m
    climb_m_s = 0.0
    if cfg.setpoint_frame == "body_ned" and hold_m is not None and v.height_m is not None:
        climb_m_s = cfg.height_gain_1_s * (hold_m - v.height_m)
    wanted = Setpoint(
        t_ns=t_ns,
        speed_m_s=command.v_m_s if s.phase in phase.MOVING else 0.0,  # critical: no speed in any other phase
        yaw_rate_rad_s=command.omega_rad_s,
        heading_rad=v.heading_rad,
        height_m=hold_m if cfg.setpoint_frame == "local_ned" else None,
        climb_m_s=climb_m_s,
    )
    state, setpoint = limits.apply(p.settings.limits, s.limits, wanted, v.height_m)
    period_ns = int(1e9 / p.settings.stream.max_rate_hz)
    return s._replace(
        limits=state,
        setpoint=setpoint,
        t_command_ns=t_ns,
        t_allowed_ns=max(s.t_allowed_ns, t_ns) + period_ns,
    )


# --------------------------------------------------------------------------------------------- upkeep


_HAND_OVER_MODE = {"land": FlightMode.AUTO_LAND, "hold": FlightMode.AUTO_LOITER}


def _upkeep(p: Plan, s: State, t_ns: int, outputs: list[Output]) -> tuple[State, tuple[Output, ...]]:
    """Heartbeat, mode request and status, each at its pace."""
    if s.t_heartbeat_ns is None or t_ns - s.t_heartbeat_ns >= _HEARTBEAT_NS:
        outputs.append(CompanionHeartbeat(t_ns=t_ns, system_status=_system_status(s.phase)))
        s = s._replace(t_heartbeat_ns=t_ns)
    mode = _HAND_OVER_MODE.get(p.settings.loss.hand_over_to)
    if (
        s.phase is Phase.HAND_OVER
        and mode is not None
        and (s.t_request_ns is None or t_ns - s.t_request_ns >= _REQUEST_AGAIN_NS)
    ):
        outputs.append(ModeRequest(t_ns=t_ns, mode=mode))
        s = s._replace(t_request_ns=t_ns)
    period_ns = 1e9 / p.settings.stream.status_rate_hz
    if s.t_status_ns is None or t_ns - s.t_status_ns >= period_ns or s.phase.is_final:
        s = s._replace(t_status_ns=t_ns)
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
    if _age_s(s.t_range_ns, t_ns) > cfg.loss.coast_after_s:
        door = ", ".join(cfg.ranges.connect + cfg.ranges.listen) or "no endpoint configured"
        missing.extend(
            f"ranges of beacon {beacon!r} (Zenoh site {cfg.ranges.site!r}, {door})" for beacon in p.beacons
        )
    return tuple(missing)


def status(p: Plan, s: State, t_ns: int) -> Status:
    """The snapshot that people see."""
    v, sent = s.vehicle, s.setpoint
    estimate = None
    if s.accepted:
        k = p.scheme.knowledge(p.scheme.p, s.guidance)
        estimate = Estimate(k.d_m, k.sigma_d_m, k.theta_rad, k.sigma_theta_rad)
    streaming = sent is not None and s.phase in phase.STREAMING
    return Status(
        t_ns=t_ns,
        phase=s.phase,
        reason=s.reason,
        awaited=awaited(p, s, t_ns) if s.phase in (Phase.AWAIT, Phase.ENDED) else (),
        mode=v.actual,
        armed=v.armed,
        range_m=s.range_m,
        range_age_s=None if s.t_range_ns is None else _age_s(s.t_range_ns, t_ns),
        ranges_accepted=s.accepted,
        rejected={verdict.value: n for verdict, n in s.rejected.items()},
        malformed=s.malformed,
        telemetry_age_s=None if v.t_attitude_ns is None else _age_s(v.t_attitude_ns, t_ns),
        estimate=estimate,
        speed_m_s=sent.speed_m_s if sent is not None and streaming else None,
        yaw_rate_rad_s=sent.yaw_rate_rad_s if sent is not None and streaming else None,
        x_m=v.x_m,
        y_m=v.y_m,
        height_m=v.height_m,
        heading_rad=None if v.t_attitude_ns is None else v.heading_rad,
        path_m=s.path_m,
        engaged_s=s.engaged_s,
        captured=s.captured,
    )
