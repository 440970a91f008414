"""The pure core: `step(plan, state, event)` → the next state and what is to leave.

gate → observe → command → phase → limits, on every event. No clock, no I/O, no randomness: the same events
give the same outputs, bit for bit.
"""

from __future__ import annotations

from msgspec.structs import replace

from companion import echo, limits, phase, reasons
from companion.beacons import configured
from companion.guidance import schemes
from companion.guidance.scheme import Command
from companion.guidance.station_settings import BEACONS_NEEDED
from companion.health import Health
from companion.intake import predict, take_in
from companion.phase import Company, Condition, Facts, Ranges
from companion.settings import Settings
from companion.state import STANDSTILL, Flight, Observing, Plan, Ranging, State, Steering, age_s, height_m
from companion.status import snapshot, who
from companion.types import (
    Attitude,
    AutopilotWords,
    BatteryReport,
    CompanionHeartbeat,
    EstimatorReport,
    Event,
    FlightMode,
    Landed,
    LocalMotion,
    Malformed,
    ModeRequest,
    Output,
    PartyHeard,
    Phase,
    PhaseChange,
    RangeSample,
    RangeVerdict,
    Setpoint,
    SystemStatus,
    TargetEcho,
    Tick,
    Verdict,
)
from companion.vehicle import Vehicle

_HEARTBEAT_NS = 1_000_000_000
_REQUEST_AGAIN_S = 1.0


def plan(settings: Settings) -> Plan:
    """Work out what stays the same for the whole flight."""
    if settings.mission.kind == "station":
        return _station_plan(settings)
    target = settings.mission.target
    return Plan(
        settings=settings,
        scheme=schemes.capture(
            settings.guidance, settings.vehicle.yaw_rate_lag_s, settings.vehicle.velocity_lag_s
        ),
        beacons={target: configured(0, settings.beacons[target])},
    )


def _station_plan(settings: Settings) -> Plan:
    from companion.guidance import station, station_paper  # not quick to load, and a capture needs neither

    names = sorted(settings.beacons)  # the numbers must not depend on the order in a file: a replay is exact
    beacons = [settings.beacons[name] for name in names]
    distances_m = tuple(b.station_distance_m for b in beacons if b.station_distance_m is not None)
    bearings_rad = tuple(b.station_bearing_rad for b in beacons if b.station_bearing_rad is not None)
    g, k, v = settings.guidance, settings.station, settings.vehicle
    numbered = {name: configured(i, b) for i, (name, b) in enumerate(zip(names, beacons, strict=True))}
    if k.scheme == "station-paper":
        paper = station_paper.from_settings(g, k, distances_m, bearings_rad)
        return Plan(settings, paper, numbered, to_find=len(names), to_keep=BEACONS_NEEDED)
    scheme = station.station(g, k, distances_m, v.yaw_rate_lag_s, v.velocity_lag_s)
    return Plan(settings, scheme, numbered, to_find=BEACONS_NEEDED, to_keep=BEACONS_NEEDED - 1)


def initial(p: Plan) -> State:
    """Nothing seen, nothing sent."""
    observing = Observing(p.scheme.initial(p.scheme.p))
    return State(
        Phase.AWAIT,
        "started",
        None,
        Vehicle(),
        Ranging(p.beacons),
        observing,
        Steering(),
        Flight(),
        Health(),
    )


def step(p: Plan, s: State, event: Event) -> tuple[State, tuple[Output, ...]]:
    """Take in one event; return the next state and what is to leave, in order."""
    t_ns = event.t_ns
    if s.t_phase_ns is None:
        s = replace(s, t_phase_ns=t_ns, observing=replace(s.observing, t_ns=t_ns))
    kind = type(event)
    s = take_in(p, s, event)
    if kind in _MERE_TELEMETRY:  # the next range or tick, a moment later, acts on it
        return s, ()
    due = _is_due(p, s, event)
    if due and s.phase in phase.STEERED:
        s = _command(p, s, t_ns)
    s, change = _transit(p, s, t_ns)  # critical: between command and setpoint, so that it has the last word
    outputs: list[Output] = [] if change is None else [change]
    if due and s.phase in _streaming(p):
        s, setpoint = _setpoint(p, s, t_ns)
        outputs.append(setpoint)
    if isinstance(event, RangeSample):
        outputs.append(_verdict(s, event))
    return _upkeep(p, s, t_ns, outputs)


def _streaming(p: Plan) -> frozenset[Phase]:
    """ArduPilot's GUIDED needs no stream to be entered, and a standstill would break a take-off in it."""
    return _ENGAGED if p.settings.vehicle.kind == "ardupilot" else phase.STREAMING


_ENGAGED = phase.STREAMING - {Phase.STANDBY}
_MERE_TELEMETRY = frozenset(
    {Attitude, LocalMotion, Malformed, BatteryReport, EstimatorReport, PartyHeard, AutopilotWords, TargetEcho}
)


def _verdict(s: State, e: RangeSample) -> RangeVerdict:
    return RangeVerdict(t_ns=e.t_ns, beacon=e.beacon, seq=e.seq, verdict=s.ranging.verdict)


# ---------------------------------------------------------------------------------------------- phase


def _transit(p: Plan, s: State, t_ns: int) -> tuple[State, PhaseChange | None]:
    facts = _facts(p, s, t_ns)
    after, condition = phase.step(s.phase, facts)
    if condition is None:
        is_stale = s.phase is Phase.STALL and facts.ranges in (Ranges.STALE, Ranges.LOST)
        has_heard = s.ranging.accepted_before_loss != s.ranging.accepted  # since it was done last
        return (_forgetting(p, s) if is_stale and has_heard else s), None
    reason = reasons.reason(p, s, after, condition, t_ns)
    severity = phase.severity(after, condition)
    change = PhaseChange(t_ns=t_ns, before=s.phase, after=after, reason=reason, severity=severity)
    s = replace(s, phase=after, reason=reason, t_phase_ns=t_ns, flight=replace(s.flight, t_request_ns=None))
    return _enter(p, s, after, condition, t_ns), change


def _enter(p: Plan, s: State, after: Phase, condition: Condition, t_ns: int) -> State:
    """What a transition does besides changing the phase."""
    if s.flight.t_engaged_ns and not after.is_engaged and not s.flight.engaged_s:
        s = replace(s, flight=replace(s.flight, engaged_s=age_s(s.flight.t_engaged_ns, t_ns)))
    if after is Phase.HAND_OVER:
        to = reasons.hand_over_to(p, s, condition, t_ns)
        return replace(s, flight=replace(s.flight, hand_over_to=to))
    if condition is Condition.ENGAGED:
        return replace(
            s,
            observing=replace(s.observing, guidance=p.scheme.initial(p.scheme.p), path_m=0.0),
            steering=replace(
                s.steering,
                command=STANDSTILL,
                t_command_ns=t_ns,
                hold_height_m=height_m(p, s, t_ns),
                limits=limits.start(t_ns),
            ),
            flight=replace(s.flight, was_engaged=True, captured=False, t_engaged_ns=t_ns, engaged_s=0.0),
            ranging=replace(s.ranging, accepted_before_loss=None),
        )
    if condition is Condition.RANGES_STALE:
        return _forgetting(p, s)
    if after is Phase.STALL:
        # critical: the first setpoint after it would be what was commanded before it
        stand = Command(0.0, 0.0, s.steering.command.purpose)
        return replace(s, steering=replace(s.steering, command=stand))
    if after is Phase.STANDBY:
        return replace(s, flight=replace(s.flight, was_ready=True))
    if after in (Phase.HOLD, Phase.KEEP):
        return replace(s, flight=replace(s.flight, captured=True))
    return s


def _forgetting(p: Plan, s: State) -> State:
    """Stale knowledge does not steer again, whatever the standstill began with: it is acquired anew."""
    r = s.ranging
    t_lost_ns = r.t_lost_ns if _is_lost(s) else r.t_enough_ns  # stray ranges begin no new loss
    return replace(
        s,
        observing=replace(s.observing, guidance=p.scheme.initial(p.scheme.p)),
        steering=replace(s.steering, command=STANDSTILL),
        ranging=replace(r, accepted_before_loss=r.accepted, t_lost_ns=t_lost_ns),
    )


def _is_lost(s: State) -> bool:
    """The ranges were lost in flight, and too few have been believed since."""
    before = s.ranging.accepted_before_loss
    return s.phase is Phase.STALL and before is not None and s.ranging.accepted < before + _RANGES_BACK


_RANGES_BACK = 5
"""So many ranges believed end a loss: a stray one alone moves nothing."""
_GROUNDED = frozenset({Landed.ON_GROUND})
_NOT_UP = frozenset({Landed.ON_GROUND, Landed.TAKING_OFF, Landed.UNKNOWN})
"""ArduPilot takes off in GUIDED: there only a vehicle that is known to be up is engaged."""


def _facts(p: Plan, s: State, t_ns: int) -> Facts:
    cfg, is_engaged = p.settings.loss, s.phase.is_engaged
    ardupilot = p.settings.vehicle.kind == "ardupilot"
    v = _as_if_selected(s) if p.settings.mission.shadow else s.vehicle
    range_age_s = age_s(s.ranging.t_enough_ns, t_ns)
    bearing_lost = False
    lost = _is_lost(s)
    if lost and age_s(s.ranging.t_lost_ns, t_ns) > cfg.hand_over_after_s:
        ranges = Ranges.LOST  # critical: stray ranges must not keep it standing in the air
    elif range_age_s <= cfg.coast_after_s and not lost:
        ranges = Ranges.FRESH
    elif range_age_s <= cfg.stall_after_s:
        ranges = Ranges.LATE
        known = p.scheme.knowledge(p.scheme.p, s.observing.guidance)
        bearing_lost = known.sigma_theta_rad > cfg.coast_bearing_sigma_rad
    else:
        ranges = Ranges.STALE if range_age_s <= cfg.hand_over_after_s else Ranges.LOST
    in_phase_s, sent = age_s(s.t_phase_ns, t_ns), s.steering.setpoint
    held_up = (
        age_s(None if sent is None else sent.t_ns, t_ns) > cfg.held_up_after_s
        and in_phase_s > cfg.held_up_after_s
        and s.phase in _streaming(p)
    )
    h = s.health
    facts = Facts(
        stop_asked=s.flight.stop_asked,
        vehicle_gone=age_s(v.t_link_ns, t_ns) > cfg.vehicle_after_s,
        actual=v.actual,
        intended=v.intended,
        armed=v.armed,
        grounded=v.landed in (_NOT_UP if ardupilot else _GROUNDED),
        was_engaged=s.flight.was_engaged,
        waited_out=in_phase_s > cfg.wait_s and not s.flight.was_ready,
        telemetry_late=age_s(v.t_attitude_ns, t_ns) > cfg.telemetry_after_s,
        ranges=ranges,
        bearing_lost=bearing_lost,
        budget_spent=is_engaged and limits.spent(p.settings.limits, s.steering.limits, t_ns) is not None,
        hand_over_overdue=s.phase in phase.ASKING
        and (s.flight.hand_over_to == "release" or in_phase_s > cfg.hand_over_patience_s),
        purpose=s.steering.command.purpose,
        held_up=held_up,
        rebooted=h.t_reboot_ns is not None and h.t_reboot_ns > (s.t_phase_ns or 0),
        company=who(p, s, t_ns) if h.commander or h.other_vehicle else Company.NOBODY,
        battery_low=h.battery_low,
        # A height is needed to begin with; once engaged the one to hold is known.
        estimate_invalid=t_ns < h.unfit_until_ns or (not is_engaged and _lacks_height(p, s, t_ns)),
    )
    return _insisting(facts) if ardupilot and is_engaged else facts


def _insisting(f: Facts) -> Facts:
    """ArduCopter stops without setpoints and stays in GUIDED: silence is no way out for it.

    What silences the app with a PX4 hands over here, and a hand-over goes on until another mode is in effect.
    """
    spent = f.budget_spent or f.vehicle_gone or f.held_up
    return replace(f, vehicle_gone=False, held_up=False, hand_over_overdue=False, budget_spent=spent)


def _lacks_height(p: Plan, s: State, t_ns: int) -> bool:
    return p.settings.vehicle.setpoint_frame == "local_ned" and height_m(p, s, t_ns) is None


def _as_if_selected(s: State) -> Vehicle:
    """A shadow's view of the vehicle: once it stands by OFFBOARD is as good as selected, before that not."""
    v = s.vehicle
    if v.actual is None:
        return v
    mode = FlightMode.OFFBOARD if s.phase in phase.STREAMING else FlightMode.AUTO_LOITER
    return replace(v, actual=mode, intended=mode)


# -------------------------------------------------------------------------------------------- control


def _is_due(p: Plan, s: State, event: Event) -> bool:
    """A believed range steers at once, a tick keeps the minimum rate; neither beyond the maximum rate."""
    cfg, sent = p.settings.stream, s.steering.setpoint
    t_ns = event.t_ns
    if type(event) is RangeSample:
        if s.ranging.verdict is not Verdict.ACCEPTED:
            return False
    elif type(event) is not Tick or (sent is not None and t_ns - sent.t_ns < 1e9 / cfg.min_rate_hz):
        return False
    return t_ns >= s.steering.t_allowed_ns - 1e9 / cfg.max_rate_hz


def _command(p: Plan, s: State, t_ns: int) -> State:
    """What the guidance asks for now."""
    o, g = predict(p, s, t_ns), s.steering
    # after a stall the time that nothing was commanded does not count as a turn flown
    dt_s = min((t_ns - g.t_command_ns) * 1e-9, 2.0 / p.settings.stream.min_rate_hz)
    guidance, command = p.scheme.command(p.scheme.p, o.guidance, dt_s, o.motion.yaw_rate_rad_s)
    return replace(
        s, observing=replace(o, guidance=guidance), steering=replace(g, command=command, t_command_ns=t_ns)
    )


def _setpoint(p: Plan, s: State, t_ns: int) -> tuple[State, Setpoint]:
    """What leaves of the command: by the phase, then by the limits."""
    cfg, v, g = p.settings.vehicle, s.vehicle, s.steering
    moving = s.phase in phase.MOVING
    now_m = height_m(p, s, t_ns)
    hold_m = g.hold_height_m if s.phase.is_engaged else now_m
    climb_m_s = 0.0
    if cfg.setpoint_frame == "body_ned" and hold_m is not None and now_m is not None:
        climb_m_s = cfg.height_gain_1_s * (hold_m - now_m)
    wanted = Setpoint(
        t_ns=t_ns,
        speed_m_s=g.command.v_m_s if moving else 0.0,  # critical: no speed in any other phase
        yaw_rate_rad_s=g.command.omega_rad_s if s.phase in phase.STEERED else 0.0,
        heading_rad=v.heading_rad,
        height_m=hold_m if cfg.setpoint_frame == "local_ned" else None,
        climb_m_s=climb_m_s,
    )
    # an old height too: what was held outside the band is not left because nobody tells it any more
    state, setpoint = limits.apply(p.settings.limits, g.limits, wanted, v.height_m)
    t_allowed_ns = max(g.t_allowed_ns, t_ns) + int(1e9 / p.settings.stream.max_rate_hz)
    return replace(
        s,
        steering=replace(
            g,
            limits=state,
            setpoint=setpoint,
            t_allowed_ns=t_allowed_ns,
            echo=echo.sent(g.echo, setpoint),
        ),
    ), setpoint


# --------------------------------------------------------------------------------------------- upkeep


_HAND_OVER_MODE = {"land": FlightMode.AUTO_LAND, "hold": FlightMode.AUTO_LOITER}


def _upkeep(p: Plan, s: State, t_ns: int, outputs: list[Output]) -> tuple[State, tuple[Output, ...]]:
    """Heartbeat, mode request and status, each at its pace."""
    f = s.flight
    if f.t_heartbeat_ns is None or t_ns - f.t_heartbeat_ns >= _HEARTBEAT_NS:
        outputs.append(CompanionHeartbeat(t_ns=t_ns, system_status=_system_status(s.phase)))
        s = replace(s, flight=replace(f, t_heartbeat_ns=t_ns))
    asking = s.phase in phase.ASKING and age_s(f.t_request_ns, t_ns) >= _REQUEST_AGAIN_S
    if asking and _may_ask(p, s, t_ns):
        mode = _HAND_OVER_MODE.get(s.flight.hand_over_to)
        insists = p.settings.vehicle.kind == "ardupilot"
        if insists and age_s(s.t_phase_ns, t_ns) > p.settings.loss.hand_over_patience_s:
            mode = FlightMode.AUTO_LAND  # what was asked for did not come
        if mode is not None:
            outputs.append(ModeRequest(t_ns=t_ns, mode=mode))
            s = replace(s, flight=replace(s.flight, t_request_ns=t_ns))
    period_ns = 1e9 / p.settings.stream.status_rate_hz
    if f.t_status_ns is None or t_ns - f.t_status_ns >= period_ns or s.phase.is_final:
        s = replace(s, flight=replace(s.flight, t_status_ns=t_ns))
        outputs.append(snapshot(p, s, t_ns))
    return s, tuple(outputs)


_MODE_KNOWN_S = 1.5
_BACKLOG_S = 0.3
"""When the loop wakes it reads what has waited; an ArduPilot's mode may be an old one until then."""


def _may_ask(p: Plan, s: State, t_ns: int) -> bool:
    """Only a vehicle heard just now to be in OFFBOARD: else a pilot may have taken over unheard."""
    woken = p.settings.vehicle.kind == "ardupilot" and age_s(s.t_phase_ns, t_ns) < _BACKLOG_S
    return age_s(s.vehicle.t_link_ns, t_ns) <= _MODE_KNOWN_S and not woken


def _system_status(of: Phase) -> SystemStatus:
    if of in (Phase.STALL, Phase.HAND_OVER):
        return SystemStatus.CRITICAL
    if of.is_engaged:
        return SystemStatus.ACTIVE
    return SystemStatus.BOOT if of is Phase.AWAIT else SystemStatus.STANDBY
