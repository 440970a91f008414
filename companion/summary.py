"""What a flight came to: fed with the pilot's outputs while it flies, told as figures at the end.

Everything here is what the app itself knew; a simulation judges by its own truth besides.
"""

from __future__ import annotations

import bisect
import math
from typing import Literal

import msgspec

from companion.guidance.model import shortest_path_m, wrap
from companion.settings import Settings
from companion.types import AnyOutput, Phase, PhaseChange, Status

TRAIL_LIMIT = 4096
"""Points of the trail kept; when it is full every second one is dropped and the spacing doubled."""
KNOWN_RAD = 0.5
"""The bearing is known once its standard deviation is below this."""
TRAIL_SPACING_S = 0.05
"""Least time between two points of the trail, at first."""


class TrailPoint(msgspec.Struct, frozen=True, gc=False):
    """One moment of the flight: seconds since engagement (negative before it), else as in `Status`.

    `speed_m_s` and `yaw_rate_rad_s` are the commanded ones.
    """

    t_s: float
    phase: Phase
    x_m: float | None
    y_m: float | None
    height_m: float | None
    heading_rad: float | None
    range_m: float | None
    distance_m: float | None
    distance_sigma_m: float | None
    bearing_rad: float | None
    bearing_sigma_rad: float | None
    speed_m_s: float | None
    yaw_rate_rad_s: float | None


class PhaseSpan(msgspec.Struct, frozen=True, gc=False):
    """A phase with its times, in seconds since engagement, and the reason for which it was entered."""

    phase: Phase
    from_s: float
    to_s: float
    reason: str


class Pose(msgspec.Struct, frozen=True, gc=False):
    """Position and heading in the local frame."""

    x_m: float
    y_m: float
    heading_rad: float


class Problem(msgspec.Struct, frozen=True, gc=False):
    """What the flight is held against: what it goes to, how near, and the vehicle's limits."""

    radius_m: float
    speed_m_s: float
    yaw_rate_rad_s: float
    kind: Literal["capture", "station"] = "capture"


def problem_of(settings: Settings) -> Problem:
    """The problem that is flown with these settings."""
    g = settings.guidance
    return Problem(settings.aim[1], g.speed_m_s, g.yaw_rate_max_rad_s, settings.mission.kind)


class Summary(msgspec.Struct, frozen=True, gc=False):
    """The flight in figures. None: not reached, or not known.

    `time_s` and `path_m` run from engagement to rest, i.e. to the last entry into HOLD (at a station: KEEP),
    where the target was captured, else to the end of the engagement. `shortest_m` is the shortest path to the
    disc with the turn bound, from the pose at engagement to the target as estimated last; `path_ratio` =
    path_m / shortest_m.
    """

    captured: bool
    ending: str
    time_s: float | None = None
    path_m: float | None = None
    shortest_m: float | None = None
    path_ratio: float | None = None
    extra_path_m: float | None = None
    final_distance_m: float | None = None
    final_distance_sigma_m: float | None = None
    final_range_m: float | None = None
    start: Pose | None = None
    target_x_m: float | None = None
    target_y_m: float | None = None
    ranges_accepted: int = 0
    rejected: dict[str, int] = msgspec.field(default_factory=dict)
    malformed: dict[str, int] = msgspec.field(default_factory=dict)
    kind: Literal["capture", "station"] = "capture"
    bearing_known_s: float | None = None
    """From engagement until one sigma of the bearing was below `KNOWN_RAD` first."""
    kept_s: float | None = None
    kept_rms_m: float | None = None
    kept_worst_m: float | None = None
    """Station: time in KEEP, and rms and greatest of the distances estimated in it."""


class FlightReport(msgspec.Struct, frozen=True):
    """All that is kept of a flight without a record: what `--json` writes and a picture is drawn from."""

    summary: Summary
    problem: Problem
    phases: tuple[PhaseSpan, ...]
    trail: tuple[TrailPoint, ...]


class FlightLog:
    """Collects outputs as they come. `add` costs a few comparisons; memory is bounded by `TRAIL_LIMIT`."""

    def __init__(self) -> None:
        self.changes: list[PhaseChange] = []
        self.trail: list[Status] = []
        self.last: Status | None = None
        self._spacing_ns = round(TRAIL_SPACING_S * 1e9)

    def add(self, output: AnyOutput) -> None:
        """Keep what the summary needs of this output; the others pass."""
        if isinstance(output, Status):
            self.last = output
            if not self.trail or output.t_ns - self.trail[-1].t_ns >= self._spacing_ns:
                self.trail.append(output)
                if len(self.trail) >= TRAIL_LIMIT:
                    del self.trail[1::2]
                    self._spacing_ns *= 2
        elif isinstance(output, PhaseChange) and len(self.changes) < TRAIL_LIMIT:
            self.changes.append(output)


def report(log: FlightLog, problem: Problem) -> FlightReport:
    """The summary together with the phases and the trail, on one time axis that begins at engagement."""
    zero_ns = axis_begin_ns(log)
    return FlightReport(
        summary=summarise(log, problem),
        problem=problem,
        phases=_spans(log, zero_ns),
        trail=tuple(_point(status, zero_ns) for status in _statuses(log)),
    )


def summarise(log: FlightLog, problem: Problem) -> Summary:
    """The flight in figures, see `Summary`. Works on a flight that never began, too."""
    last = log.last
    if last is None:
        return Summary(captured=False, ending="nothing was heard")
    statuses = _statuses(log)
    final = next((s for s in reversed(statuses) if s.phase.is_engaged and s.estimate is not None), None)
    estimate = final.estimate if final is not None else None
    target = target_of(final) if final is not None else None
    begin_ns, end_ns = _engagement_ns(log)
    start = time_s = path_m = shortest_m = None
    if begin_ns is not None and end_ns is not None:
        time_s = (end_ns - begin_ns) * 1e-9
        path_m = _path_at_m(statuses, end_ns) - _path_at_m(statuses, begin_ns)
        start = _pose_at(statuses, begin_ns)
    if start is not None and target is not None:
        shortest_m = shortest_from_m(start, *target, problem)
    kept = [s for s in statuses if s.phase is Phase.KEEP]
    away_m = [s.estimate.distance_m for s in kept if s.estimate is not None]
    return Summary(
        kind=problem.kind,
        bearing_known_s=_bearing_known_s(statuses, begin_ns),
        kept_s=_time_in_s(log, Phase.KEEP) if away_m else None,
        kept_rms_m=math.sqrt(sum(d * d for d in away_m) / len(away_m)) if away_m else None,
        kept_worst_m=max(away_m, default=None),
        captured=last.captured,
        ending=_ending(log, last),
        time_s=time_s,
        path_m=path_m,
        shortest_m=shortest_m,
        path_ratio=path_m / shortest_m if path_m is not None and shortest_m else None,
        extra_path_m=path_m - shortest_m if path_m is not None and shortest_m is not None else None,
        final_distance_m=estimate.distance_m if estimate else None,
        final_distance_sigma_m=estimate.distance_sigma_m if estimate else None,
        final_range_m=final.range_m if final else None,
        start=start,
        target_x_m=target[0] if target else None,
        target_y_m=target[1] if target else None,
        ranges_accepted=last.ranges_accepted,
        rejected=last.rejected,
        malformed=last.malformed,
    )


def _bearing_known_s(statuses: list[Status], begin_ns: int | None) -> float | None:
    if begin_ns is None:
        return None
    for s in statuses:
        if s.t_ns >= begin_ns and s.estimate is not None and s.estimate.bearing_sigma_rad < KNOWN_RAD:
            return (s.t_ns - begin_ns) * 1e-9
    return None


def _time_in_s(log: FlightLog, phase: Phase) -> float:
    return sum(span.to_s - span.from_s for span in _spans(log, 0) if span.phase is phase)


def target_of(status: Status) -> tuple[float, float] | None:
    """Where the target is in the local frame, by this status: position + d (cos, sin)(heading − θ)."""
    e = status.estimate
    if e is None or status.x_m is None or status.y_m is None or status.heading_rad is None:
        return None
    azimuth_rad = status.heading_rad - e.bearing_rad
    return (
        status.x_m + e.distance_m * math.cos(azimuth_rad),
        status.y_m + e.distance_m * math.sin(azimuth_rad),
    )


def shortest_from_m(start: Pose, target_x_m: float, target_y_m: float, problem: Problem) -> float:
    """Length of the shortest path from this pose to the disc around the target, with the turn bound."""
    dx, dy = target_x_m - start.x_m, target_y_m - start.y_m
    theta_rad = wrap(start.heading_rad - math.atan2(dy, dx))
    return shortest_path_m(
        math.hypot(dx, dy), theta_rad, problem.radius_m, problem.speed_m_s, problem.yaw_rate_rad_s
    )


def text(summary: Summary) -> str:
    """The summary for a person: a headline and a few aligned lines."""
    s = summary
    done = (
        ("target captured", "station reached")
        if s.captured
        else ("target NOT captured", "station NOT reached")
    )
    lines = [done[s.kind == "station"], f"  ending         {s.ending}"]
    if s.time_s is not None:
        lines.append(
            f"  time           {s.time_s:.1f} s from engagement to {'rest' if s.captured else 'its end'}"
        )
    if s.path_m is not None:
        lines.append(f"  path           {s.path_m:.2f} m")
    if s.shortest_m is not None and s.path_ratio is not None:
        what = "station" if s.kind == "station" else "target"
        lines.append(f"  shortest       {s.shortest_m:.2f} m to the {what} as estimated last")
        lines.append(f"  ratio          {s.path_ratio:.3f}")
    if s.final_distance_m is not None and s.final_distance_sigma_m is not None:
        lines.append(
            f"  distance left  {s.final_distance_m:.2f} m ± {s.final_distance_sigma_m:.2f} estimated"
        )
    if s.bearing_known_s is not None:
        lines.append(
            f"  bearing        known to ± {math.degrees(KNOWN_RAD):.0f}° after {s.bearing_known_s:.1f} s"
        )
    if s.kept_s is not None and s.kept_rms_m is not None and s.kept_worst_m is not None:
        lines.append(
            f"  kept           {s.kept_s:.1f} s, {s.kept_rms_m:.2f} m rms, {s.kept_worst_m:.2f} m at most, "
            "as estimated"
        )
    refused = sum(s.rejected.values())
    lines.append(f"  ranges         {s.ranges_accepted} believed, {refused} refused{_reasons(s.rejected)}")
    if s.malformed:
        lines.append(f"  malformed      {sum(s.malformed.values())}{_reasons(s.malformed)}")
    return "\n".join(lines)


def _reasons(counts: dict[str, int]) -> str:
    named = ", ".join(f"{reason} {n}" for reason, n in sorted(counts.items()) if n)
    return f" ({named})" if named else ""


def _statuses(log: FlightLog) -> list[Status]:
    """The trail with the very last status at its end."""
    if log.last is None or (log.trail and log.trail[-1] is log.last):
        return log.trail
    return [*log.trail, log.last]


def axis_begin_ns(log: FlightLog) -> int:
    """The time axis begins at engagement, else with the first status."""
    begin_ns, _ = _engagement_ns(log)
    if begin_ns is not None:
        return begin_ns
    return log.trail[0].t_ns if log.trail else 0


def _engagement_ns(log: FlightLog) -> tuple[int | None, int | None]:
    """Begin of the last engagement; its end: the last entry into HOLD if captured, else where it was left."""
    begin = end = hold = None
    for change in log.changes:
        if change.after.is_engaged and not change.before.is_engaged:
            begin, end, hold = change.t_ns, None, None
        elif change.before.is_engaged and not change.after.is_engaged:
            end = change.t_ns
        if change.after in (Phase.HOLD, Phase.KEEP):
            hold = change.t_ns
    if begin is None or log.last is None:
        return None, None
    if log.last.captured and hold is not None:
        return begin, hold
    return begin, end if end is not None else max(begin, log.last.t_ns)


def _ending(log: FlightLog, last: Status) -> str:
    """Why the last engagement ended; where there was none, what was told last."""
    steering = [c for c in log.changes if c.before.is_engaged and c.before is not Phase.HAND_OVER]
    for change in reversed(steering):
        if change.after is Phase.HAND_OVER or not change.after.is_engaged:
            return change.reason
    return last.reason


def _path_at_m(statuses: list[Status], t_ns: int) -> float:
    """The path flown until then, linear between two statuses."""
    i = bisect.bisect_left(statuses, t_ns, key=lambda s: s.t_ns)
    if i == 0:
        return statuses[0].path_m
    if i == len(statuses):
        return statuses[-1].path_m
    a, b = statuses[i - 1], statuses[i]
    return a.path_m + (b.path_m - a.path_m) * (t_ns - a.t_ns) / (b.t_ns - a.t_ns)


def _pose_at(statuses: list[Status], t_ns: int) -> Pose | None:
    """The pose of the status nearest to that time, or None where position or heading were not known."""
    s = min(statuses, key=lambda s: abs(s.t_ns - t_ns))
    if s.x_m is None or s.y_m is None or s.heading_rad is None:
        return None
    return Pose(s.x_m, s.y_m, s.heading_rad)


def _spans(log: FlightLog, zero_ns: int) -> tuple[PhaseSpan, ...]:
    if not log.changes or log.last is None:
        return ()
    ends_ns = [*(c.t_ns for c in log.changes[1:]), max(log.last.t_ns, log.changes[-1].t_ns)]
    return tuple(
        PhaseSpan(c.after, (c.t_ns - zero_ns) * 1e-9, (end_ns - zero_ns) * 1e-9, c.reason)
        for c, end_ns in zip(log.changes, ends_ns, strict=True)
    )


def _point(s: Status, zero_ns: int) -> TrailPoint:
    e = s.estimate
    return TrailPoint(
        t_s=(s.t_ns - zero_ns) * 1e-9,
        phase=s.phase,
        x_m=s.x_m,
        y_m=s.y_m,
        height_m=s.height_m,
        heading_rad=s.heading_rad,
        range_m=s.range_m,
        distance_m=e.distance_m if e else None,
        distance_sigma_m=e.distance_sigma_m if e else None,
        bearing_rad=e.bearing_rad if e else None,
        bearing_sigma_rad=e.bearing_sigma_rad if e else None,
        speed_m_s=s.speed_m_s,
        yaw_rate_rad_s=s.yaw_rate_rad_s,
    )
