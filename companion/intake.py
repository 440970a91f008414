"""Taking events in: what each of them changes in the state, before anything is decided."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final

from msgspec.structs import replace

from companion import beacons, echo, gate, health
from companion import vehicle as veh
from companion.guidance.scheme import UNKNOWN_M
from companion.health import Health
from companion.state import Observing, Plan, Ranging, State
from companion.types import (
    Attitude,
    AutopilotWords,
    BatteryReport,
    BeaconTold,
    EstimatorReport,
    Event,
    LandedReport,
    LocalMotion,
    Malformed,
    ModeReport,
    Party,
    PartyHeard,
    RangeSample,
    StopRequest,
    TargetEcho,
    Tick,
    VehicleHeartbeat,
    Verdict,
)
from companion.vehicle import BodyMotion, Vehicle

_LONGEST_PREDICTION_S = 1.0
"""After a longer pause of the event stream the prediction is worth nothing anyway."""
_HEADING_RESET_RAD = 0.2
"""A larger jump between turn and headings is a reset of the autopilot's yaw, not a turn."""
_POSITION_RESET_M = 0.5
"""A larger jump between moves and positions is a reset of the autopilot's position, not a move."""
_CLOCK_BACK_MS = 1000
"""A message whose time lies further back than this came very late, or the autopilot restarted."""
_CLOCK_BACK_TIMES = 3
"""So many of them in a row: it restarted."""


def take_in(p: Plan, s: State, event: Event) -> State:
    """The state with the event in it."""
    return _TAKE_IN[type(event)](p, s, event)


def _on_range(p: Plan, s: State, e: RangeSample) -> State:
    r = s.ranging
    beacon = r.beacons.get(e.beacon)
    if beacon is None:
        return replace(s, ranging=_rejected(r, r.tracks, Verdict.UNKNOWN_BEACON))
    cfg = p.settings.vehicle
    range_m = beacons.range_m(beacon, e)
    sigma_m = beacons.sigma_m(p.settings.ranges, e, beacon.sigma_m)
    speed_m_s = veh.speed_m_s(s.vehicle, e.t_ns)
    rate_m_s = cfg.speed_max_m_s
    if speed_m_s is not None:
        rate_m_s = min(rate_m_s, speed_m_s + p.settings.ranges.own_motion_error_m_s)
    track, verdict = gate.judge(p.settings.ranges, r.tracks.get(e.beacon), e, range_m, sigma_m, rate_m_s)
    tracks = r.tracks if track is None else {**r.tracks, e.beacon: track}
    if verdict is not Verdict.ACCEPTED:
        return replace(s, ranging=_rejected(r, tracks, verdict))
    o = predict(p, s, e.t_ns)
    # an old height too: it is nearer than the configured one, and only corrects the slant
    height_m = cfg.height_m if s.vehicle.height_m is None else s.vehicle.height_m
    guidance = p.scheme.update(
        p.scheme.p,
        o.guidance,
        beacon.number,
        range_m,
        sigma_m,
        height_m - beacon.height_m,
        cfg.height_sigma_m,
    )
    o = replace(o, guidance=guidance)
    if not guidance.accepted:
        return replace(s, ranging=_rejected(r, tracks, Verdict.OUTLIER), observing=o)
    heard = {**r.heard, e.beacon: e.t_ns}
    r = replace(
        r,
        tracks=tracks,
        t_ns=e.t_ns,
        heard=heard,
        t_enough_ns=_enough(r.t_enough_ns, heard, beacons_needed(p, o)),
        accepted=r.accepted + 1,
        range_m=range_m,
        verdict=Verdict.ACCEPTED,
    )
    return replace(s, ranging=r, observing=o)


def _enough(before: int | None, heard: dict[str, int], needed: int) -> int | None:
    """One silent beacon of many is no loss: the time of the newest range but as many as are needed."""
    if len(heard) < needed:
        return before
    enough = max(heard.values()) if needed == 1 else sorted(heard.values())[-needed]
    return enough if before is None or enough > before else before


def beacons_needed(p: Plan, o: Observing) -> int:
    """So many beacons must be heard now."""
    if p.to_find == p.to_keep:
        return p.to_find
    is_located = p.scheme.knowledge(p.scheme.p, o.guidance).sigma_d_m < UNKNOWN_M
    return p.to_keep if is_located else p.to_find


def _on_told(p: Plan, s: State, e: BeaconTold) -> State:
    r, known = s.ranging, p.beacons.get(e.beacon)
    if known is None:
        return s
    beacon = beacons.told(known, p.settings.beacons[e.beacon], e)
    return replace(s, ranging=replace(r, beacons={**r.beacons, e.beacon: beacon}))


def _on_attitude(p: Plan, s: State, e: Attitude) -> State:
    if e.boot_ms < s.vehicle.boot_ms - _CLOCK_BACK_MS:
        return _on_clock_back(s, e)
    if s.health.clock_back:
        s = replace(s, health=replace(s.health, clock_back=0))
    v = veh.on_attitude(s.vehicle, e)
    o = predict(p, s, e.t_ns, turned_to=v.heading_rad)
    return replace(s, observing=replace(o, heading_rad=v.heading_rad), vehicle=v)


def _on_motion(p: Plan, s: State, e: LocalMotion) -> State:
    """The autopilot's position strays far less than its velocity, added up: its differences are the moves."""
    o, x_m, y_m = s.observing, e.x_m, e.y_m
    lag_x_m = lag_y_m = 0.0
    place = None
    if x_m is not None and y_m is not None and math.isfinite(x_m + y_m):
        place = (x_m, y_m)
        if o.place is not None:
            dt_s = (e.t_ns - o.t_ns) * 1e-9
            c, sn = math.cos(o.heading_rad), math.sin(o.heading_rad)
            forward_m, left_m = o.motion.forward_m_s * dt_s, o.motion.left_m_s * dt_s
            off_x_m = x_m - o.place[0] - (forward_m * c - left_m * sn)
            off_y_m = y_m - o.place[1] - (forward_m * sn + left_m * c)
            if math.hypot(off_x_m, off_y_m) < _POSITION_RESET_M:
                place, lag_x_m, lag_y_m = o.place, off_x_m, off_y_m
    return replace(
        s,
        vehicle=veh.on_motion(s.vehicle, e),
        observing=replace(o, place=place, lag_x_m=lag_x_m, lag_y_m=lag_y_m),
    )


def _on_clock_back(s: State, e: Attitude) -> State:
    """Late packets are dropped; a clock that stays back is a restart: nothing known before counts any more.

    Only `armed` stays as it was told last: a flight is not over because nothing is known.
    """
    times = s.health.clock_back + 1
    if times < _CLOCK_BACK_TIMES:
        return replace(s, health=replace(s.health, clock_back=times))
    v = Vehicle(t_link_ns=s.vehicle.t_link_ns, t_beat_ns=s.vehicle.t_beat_ns, armed=s.vehicle.armed)
    return replace(
        s,
        vehicle=veh.on_attitude(v, e),
        observing=replace(s.observing, place=None),
        health=Health(t_found_ns=e.t_ns, t_reboot_ns=e.t_ns),
    )


def _on_heartbeat(p: Plan, s: State, e: VehicleHeartbeat) -> State:
    if s.health.t_found_ns is None:
        s = replace(s, health=replace(s.health, t_found_ns=e.t_ns))
    return replace(s, vehicle=veh.on_heartbeat(s.vehicle, e))


def _on_mode(p: Plan, s: State, e: ModeReport) -> State:
    s = replace(s, vehicle=veh.on_mode(s.vehicle, e))
    if s.steering.echo.pending:
        s = replace(s, steering=replace(s.steering, echo=echo.confirmed(s.steering.echo, e)))
    return s


def _on_target(p: Plan, s: State, e: TargetEcho) -> State:
    told = echo.heard(s.steering.echo, e) if s.phase.is_engaged else s.steering.echo
    return s if told is s.steering.echo else replace(s, steering=replace(s.steering, echo=told))


def _on_landed(p: Plan, s: State, e: LandedReport) -> State:
    return replace(s, vehicle=replace(s.vehicle, landed=e.landed))


def _on_battery(p: Plan, s: State, e: BatteryReport) -> State:
    return replace(s, health=health.on_battery(s.health, p.settings.loss, e))


def _on_estimator(p: Plan, s: State, e: EstimatorReport) -> State:
    return replace(s, health=health.on_estimator(s.health, p.settings.vehicle, e))


def _on_party(p: Plan, s: State, e: PartyHeard) -> State:
    if e.party is Party.AUTOPILOT:
        return replace(s, health=replace(s.health, other_vehicle=e))
    return replace(s, health=replace(s.health, commander=e))


def _on_words(p: Plan, s: State, e: AutopilotWords) -> State:
    return replace(s, health=replace(s.health, words=e))


def _on_malformed(p: Plan, s: State, e: Malformed) -> State:
    r, name = s.ranging, e.defect.value
    return replace(s, ranging=replace(r, malformed={**r.malformed, name: r.malformed.get(name, 0) + 1}))


def _on_stop(p: Plan, s: State, e: StopRequest) -> State:
    return replace(s, flight=replace(s.flight, stop_asked=True))


def _on_tick(p: Plan, s: State, e: Tick) -> State:
    return s


_TAKE_IN: Final[dict[type, Callable[[Plan, State, Any], State]]] = {
    RangeSample: _on_range,
    BeaconTold: _on_told,
    Attitude: _on_attitude,
    LocalMotion: _on_motion,
    VehicleHeartbeat: _on_heartbeat,
    ModeReport: _on_mode,
    LandedReport: _on_landed,
    BatteryReport: _on_battery,
    EstimatorReport: _on_estimator,
    PartyHeard: _on_party,
    AutopilotWords: _on_words,
    TargetEcho: _on_target,
    Malformed: _on_malformed,
    StopRequest: _on_stop,
    Tick: _on_tick,
}


def _rejected(r: Ranging, tracks: dict[str, gate.Track], verdict: Verdict) -> Ranging:
    rejected = {**r.rejected, verdict: r.rejected.get(verdict, 0) + 1}
    return replace(r, tracks=tracks, rejected=rejected, verdict=verdict)


def predict(p: Plan, s: State, t_ns: int, turned_to: float | None = None) -> Observing:
    """Bring the observer up to t_ns with the motion measured (or modelled) since.

    With the heading measured at t_ns, the whole turn since the last one is that of the two headings: the yaw
    rate, sampled, is good for the moments between them only.
    """
    o = s.observing
    dt_s = min((t_ns - o.t_ns) * 1e-9, _LONGEST_PREDICTION_S)
    if dt_s <= 0.0:
        return o
    v = s.vehicle
    if veh.is_measured(v, t_ns):
        motion = meanwhile = BodyMotion(v.forward_m_s, v.left_m_s, v.yaw_rate_rad_s)
    else:  # where it is modelled, the motion in the middle is nearest to the mean
        motion, meanwhile = _modelled(p, s, t_ns, dt_s), _modelled(p, s, t_ns, 0.5 * dt_s)
    turn_rad = meanwhile.yaw_rate_rad_s * dt_s
    if turned_to is not None:
        measured_rad = math.remainder(turned_to - o.heading_rad, 2.0 * math.pi)
        if abs(measured_rad - turn_rad) < _HEADING_RESET_RAD:
            turn_rad = measured_rad
    forward_m_s, left_m_s, place = meanwhile.forward_m_s, meanwhile.left_m_s, o.place
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
    flown_m = math.hypot(meanwhile.forward_m_s, meanwhile.left_m_s) * dt_s if s.phase.is_engaged else 0.0
    return Observing(guidance, t_ns, motion, o.heading_rad + turn_rad, o.path_m + flown_m, place)


def _modelled(p: Plan, s: State, t_ns: int, dt_s: float) -> BodyMotion:
    """The motion dt_s after the observer's own: by the setpoint sent last, as far as it is not measured."""
    cfg = p.settings.vehicle
    sent = None if p.settings.mission.shadow else s.steering.setpoint
    commanded = BodyMotion() if sent is None else BodyMotion(sent.speed_m_s, 0.0, sent.yaw_rate_rad_s)
    return veh.body_motion(
        s.vehicle, s.observing.motion, commanded, t_ns, dt_s, cfg.velocity_lag_s, cfg.yaw_rate_lag_s
    )
