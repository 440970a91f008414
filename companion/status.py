"""The snapshot of the flight that people see."""

from __future__ import annotations

from collections.abc import Iterator

from companion import phase
from companion.echo import is_foreign
from companion.guidance.scheme import UNKNOWN_M
from companion.health import WITHOUT, battery_words, fresh_estimator, shortfalls
from companion.phase import Company
from companion.state import Plan, State, age_s, height_m
from companion.types import Charge, Estimate, Landed, Phase, Status


def awaited(p: Plan, s: State, t_ns: int) -> tuple[str, ...]:
    """What is missing before the flight can begin, in words, with where it is expected from."""
    cfg, missing = p.settings, []
    if age_s(s.vehicle.t_link_ns, t_ns) > cfg.loss.vehicle_after_s:
        missing.append(f"autopilot HEARTBEAT on {cfg.vehicle.mavlink}")
    elif age_s(s.vehicle.t_attitude_ns, t_ns) > cfg.loss.telemetry_after_s:
        missing.append(f"ATTITUDE on {cfg.vehicle.mavlink}")
    elif cfg.vehicle.setpoint_frame == "local_ned" and height_m(p, s, t_ns) is None:
        missing.append(f"LOCAL_POSITION_NED on {cfg.vehicle.mavlink}")
    elif s.vehicle.intended is None and s.vehicle.armed and s.vehicle.landed is not Landed.ON_GROUND:
        missing.append(f"CURRENT_MODE on {cfg.vehicle.mavlink}, or a start on the ground")
    if missing and cfg.mission.shadow and s.vehicle.t_link_ns is not None:
        missing[-1] += ", which a shadow does not ask for: let the autopilot stream it"
    missing.extend(_unfit(p, s, t_ns))
    if age_s(s.ranging.t_enough_ns, t_ns) > cfg.loss.coast_after_s:
        door = ", ".join(cfg.ranges.connect + cfg.ranges.listen) or "no endpoint configured"
        missing.extend(
            f"ranges of beacon {beacon!r} (Zenoh site {cfg.ranges.site!r}, {door})"
            for beacon in silent(p, s, t_ns)
        )
    return tuple(missing)


def _unfit(p: Plan, s: State, t_ns: int) -> Iterator[str]:
    """What the vehicle lacks for a flight, and who else is there, each with what to do."""
    cfg, h = p.settings, s.health
    if h.battery_low:
        yield f"a charged battery ({battery_words(h)}; [loss] battery_hand_over, battery_share)"
    company = who(p, s, t_ns)
    if company is Company.COMMANDER and h.commander is not None:
        c = h.commander
        ids = f"system {c.system_id} component {c.component_id}"
        yield f"the end of {c.party.value} ({c.message} from {ids}): stop the other one"
    if company is Company.OTHER_VEHICLE and h.other_vehicle is not None:
        other = h.other_vehicle.system_id
        yield (
            f"the choice of an autopilot: system {other} is heard as well; set vehicle.target_system, and "
            "give each vehicle an id of its own"
        )
    e = fresh_estimator(h, t_ns)
    if e is not None:
        lacks = shortfalls(cfg.vehicle, cfg.loss.hand_over_to, e)
        yield from (
            f"a valid {lack.subject} estimate. {lack.why} → {lack.do}" for lack in lacks if lack.vital
        )


def who(p: Plan, s: State, t_ns: int) -> Company:
    """Who else was heard within the time in which a vehicle counts as there."""
    h, after_s = s.health, p.settings.loss.vehicle_after_s
    if h.commander is not None and age_s(h.commander.t_ns, t_ns) <= after_s:
        return Company.COMMANDER
    if h.other_vehicle is not None and age_s(h.other_vehicle.t_ns, t_ns) <= after_s:
        return Company.OTHER_VEHICLE
    return Company.NOBODY


def silent(p: Plan, s: State, t_ns: int) -> list[str]:
    """The beacons of which no range has been believed lately."""
    late_s = p.settings.loss.coast_after_s
    return [beacon for beacon in p.beacons if age_s(s.ranging.heard.get(beacon), t_ns) > late_s]


def with_the_silent(p: Plan, s: State, t_ns: int, reason: str) -> str:
    """The reason of a loss; where some of several beacons are still heard, with those that are not."""
    quiet = silent(p, s, t_ns)
    if len(quiet) == len(p.beacons):
        return reason
    return reason.replace("no ranges", f"too few beacons ({', '.join(quiet)} silent)")


_RIVAL_S = 5.0
"""A second publisher is told for so long after it was heard last."""
_TELL_WITHIN_S = 5.0
"""What an autopilot has not told by then, it will not tell."""
_WORDS_S = 10.0
"""The autopilot's words are shown for so long."""


def _vehicle_warnings(p: Plan, s: State, t_ns: int) -> Iterator[str]:
    """What the vehicle never told and what would not work, by name, and what it says."""
    v, h = s.vehicle, s.health
    if h.words is not None and age_s(h.words.t_ns, t_ns) <= _WORDS_S:
        yield f"the autopilot says: {h.words.text}"
    if is_foreign(s.steering.echo, t_ns):
        yield (
            "the autopilot flies targets that this app did not send: somebody commands it on another link, "
            "or it limits ours (MPC_XY_VEL_MAX)"
        )
    e = fresh_estimator(h, t_ns)
    if e is not None:
        lacks = shortfalls(p.settings.vehicle, p.settings.loss.hand_over_to, e)
        yield from (lack.text() for lack in lacks if not lack.vital)
    if h.t_found_ns is None or age_s(h.t_found_ns, t_ns) <= _TELL_WITHIN_S:
        return
    told = {
        "LOCAL_POSITION_NED": v.t_motion_ns is not None,
        "CURRENT_MODE": v.t_mode_ns is not None or p.settings.vehicle.kind == "ardupilot",
        "EXTENDED_SYS_STATE": v.landed is not Landed.UNKNOWN,
        "ESTIMATOR_STATUS": h.estimator is not None,
        "BATTERY_STATUS": h.share is not None or h.charge is not Charge.UNKNOWN,
    }
    for name, came in told.items():
        if not came:
            yield f"{name} never came within {_TELL_WITHIN_S:g} s. {WITHOUT[name]}"


def warnings(p: Plan, s: State, t_ns: int) -> tuple[str, ...]:
    """What a person should know of ranges and vehicle, a line each."""
    told = [b.contradiction for b in s.ranging.beacons.values() if b.contradiction]
    told.extend(
        f"two publishers of {beacon}: session {t.session[:16]!r} is believed, {t.rival[:16]!r} is not"
        for beacon, t in s.ranging.tracks.items()
        if t.rival and age_s(t.rival_t_ns, t_ns) < _RIVAL_S
    )
    told.extend(_vehicle_warnings(p, s, t_ns))
    return tuple(told)


def snapshot(p: Plan, s: State, t_ns: int) -> Status:
    """The snapshot that people see."""
    v, r, sent = s.vehicle, s.ranging, s.steering.setpoint
    estimate = None
    k = p.scheme.knowledge(p.scheme.p, s.observing.guidance)
    if k.sigma_d_m < UNKNOWN_M:
        estimate = Estimate(k.d_m, k.sigma_d_m, k.theta_rad, k.sigma_theta_rad)
    streaming = sent is not None and s.phase in phase.STREAMING
    engaged_s = age_s(s.flight.t_engaged_ns, t_ns) if s.phase.is_engaged else s.flight.engaged_s
    return Status(
        t_ns=t_ns,
        phase=s.phase,
        reason=s.reason,
        awaited=awaited(p, s, t_ns) if s.phase in (Phase.AWAIT, Phase.ENDED) else (),
        mode=v.actual,
        armed=v.armed,
        range_m=r.range_m,
        range_age_s=None if r.t_ns is None else age_s(r.t_ns, t_ns),
        ranges_accepted=r.accepted,
        rejected={verdict.value: n for verdict, n in r.rejected.items()},
        malformed=r.malformed,
        telemetry_age_s=None if v.t_attitude_ns is None else age_s(v.t_attitude_ns, t_ns),
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
        beacons=_ages(p, s, t_ns),
        warnings=warnings(p, s, t_ns),
    )


def _ages(p: Plan, s: State, t_ns: int) -> dict[str, float | None]:
    if p.settings.mission.kind != "station":
        return {}
    heard = s.ranging.heard
    return {beacon: age_s(heard[beacon], t_ns) if beacon in heard else None for beacon in p.beacons}
