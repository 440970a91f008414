"""The figures of a recorded flight, as `companion report --json` prints them, and its story in words."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from typing import Literal, NamedTuple

import msgspec

from companion import summary
from companion.recording import RecordError, Recording
from companion.summary import FlightLog, FlightReport, PhaseSpan, Problem, Summary
from companion.types import (
    FlightMode,
    Landed,
    LandedReport,
    Malformed,
    ModeReport,
    ModeRequest,
    Phase,
    PhaseChange,
    RangeSample,
    RangeVerdict,
    Setpoint,
    Severity,
    Status,
    VehicleHeartbeat,
    Verdict,
)

HAPPENINGS = 500
"""Lines of the story kept; more than that no one reads."""
_STREAM_NS = 200_000_000
"""Where no setpoint left for longer than this, none is streamed: a range has no answer."""


class Happening(msgspec.Struct, frozen=True, gc=False):
    """A line of the flight's story: seconds since engagement, who told it, how loudly, in words."""

    t_s: float
    source: str
    severity: Severity
    text: str


class Latency(msgspec.Struct, frozen=True, gc=False):
    """How long something took, seconds; the percentiles by nearest rank."""

    count: int
    median_s: float
    p95_s: float
    p99_s: float
    longest_s: float


class BeaconFigures(msgspec.Struct, frozen=True, gc=False):
    """One beacon: how many ranges came, at which mean rate, and what became of them (reason → count)."""

    beacon: str
    ranges: int
    rate_hz: float | None
    verdicts: dict[str, int]


class Figures(msgspec.Struct, frozen=True):
    """A recorded flight in figures. Times are seconds since engagement (else since the first status).

    `setpoint_latency`: from the arrival of a believed range to the moment the setpoint computed from it was
    handed to the link; None where the record does not tell it (a simulation has no clock). `transport`: what
    a range took from its publisher beyond the quickest one, as both clocks tell. `settings`: those that were
    not left at their defaults, with their sources. `problems`: what is wrong with the file. `ending`:
    why the flight ended.
    """

    file: str
    kind: str
    began_at: str
    duration_s: float
    headline: str
    ending: str
    summary: Summary
    problem: Problem
    phases: tuple[PhaseSpan, ...]
    story: tuple[Happening, ...]
    beacons: tuple[BeaconFigures, ...]
    setpoint_latency: Latency | None
    transport: Latency | None
    settings: dict[str, tuple[str, str]]
    digest: str
    versions: dict[str, str]
    problems: tuple[str, ...]

    def text(self) -> str:
        """For a person: what could be read, what happened, how long it took to answer."""
        lines = [f"{self.file}: {self.kind} of {self.began_at}, {self.duration_s:.1f} s"]
        lines += [f"  record: {problem}" for problem in self.problems]
        lines.append(self.headline)
        if self.setpoint_latency is not None:
            of = self.setpoint_latency
            p95, longest = of.p95_s * 1e3, of.longest_s * 1e3
            lines.append(f"  range → setpoint: {p95:.2f} ms in 95 of 100 cases, {longest:.2f} ms at most")
        return "\n".join(lines)


class RangeMark(NamedTuple):
    """One range: arrival, seconds as everywhere; verdict None where the record lost it.

    `answer_s`: until the setpoint computed from it was handed over; `transport_s`: what it took from its
    publisher, by both clocks, so only differences mean something.
    """

    t_s: float
    beacon: str
    range_m: float
    verdict: Verdict | None
    answer_s: float | None
    transport_s: float | None


class Flight(NamedTuple):
    """Figures, with what they were counted from."""

    figures: Figures
    told: FlightReport
    """The same flight as `companion fly` tells it: for the picture."""
    ranges: tuple[RangeMark, ...]
    zero_ns: int
    """The moment from which `t_s` counts."""


def of(recording: Recording) -> Flight:
    """Read a flight. Raises RecordError, in one line, where its configuration cannot be understood."""
    log = FlightLog()
    for step in recording.steps:
        for output in step.outputs:
            if isinstance(output, Status | PhaseChange):
                log.add(output)
    flown = _flown(recording)
    told = summary.report(log, flown.problem)
    cut = log.last is not None and _in_flight(log.last)
    ending = "the record ends in mid-flight" if cut else told.summary.ending
    first_ns = recording.steps[0].event.t_ns if recording.steps else 0
    zero_ns = summary.axis_begin_ns(log) or first_ns
    in_time = sorted(_ranges(recording, zero_ns), key=lambda r: r.t_s)
    ranges = _with_least_transport(tuple(in_time))
    began = recording.start.unix_of(first_ns) if recording.steps else recording.start.unix_ns
    figures = Figures(
        file=recording.name,
        kind=recording.start.kind,
        began_at=datetime.fromtimestamp(began * 1e-9, UTC).isoformat(" ", "seconds"),
        duration_s=recording.duration_s,
        headline=headline(told.summary, ending, log.last, recording),
        ending=ending,
        summary=told.summary,
        problem=flown.problem,
        phases=told.phases,
        story=tuple(sorted(_story(recording, zero_ns), key=lambda line: line.t_s))[:HAPPENINGS],
        beacons=_beacons(ranges),
        setpoint_latency=latency([r.answer_s for r in ranges if r.answer_s is not None]),
        transport=latency([r.transport_s for r in ranges if r.transport_s is not None]),
        settings=flown.settings,
        digest=recording.start.digest,
        versions=recording.start.versions,
        problems=recording.problems,
    )
    return Flight(figures, told, ranges, zero_ns)


def latency(values: Sequence[float]) -> Latency | None:
    """The percentiles of these durations, None where there are none."""
    if not values:
        return None
    ordered = sorted(values)
    median, p95, p99 = (ordered[max(0, math.ceil(q * len(ordered)) - 1)] for q in (0.5, 0.95, 0.99))
    return Latency(len(ordered), median, p95, p99, ordered[-1])


# --------------------------------------------------------------------------------------- configuration


class _Guidance(msgspec.Struct):
    """What a report needs of `[guidance]`, whatever else this or another version has in it."""

    capture_radius_m: float
    speed_m_s: float
    yaw_rate_max_rad_s: float


class _Mission(msgspec.Struct, frozen=True):
    kind: Literal["capture", "station"] = "capture"


class _Station(msgspec.Struct, frozen=True):
    radius_m: float


class _Config(msgspec.Struct):
    guidance: _Guidance
    mission: _Mission = _Mission()
    station: _Station | None = None

    @property
    def problem(self) -> Problem:
        g, kind = self.guidance, self.mission.kind
        radius_m = g.capture_radius_m
        if kind == "station" and self.station is not None:
            radius_m = self.station.radius_m
        return Problem(radius_m, g.speed_m_s, g.yaw_rate_max_rad_s, kind)


class _Flown(NamedTuple):
    problem: Problem
    settings: dict[str, tuple[str, str]]


def _flown(recording: Recording) -> _Flown:
    try:
        config = msgspec.json.decode(recording.start.config, type=_Config)
        raw = msgspec.json.decode(recording.start.config, type=dict[str, object])
    except msgspec.DecodeError as error:
        raise RecordError(f"{recording.name}: its configuration cannot be used here: {error}") from error
    values = dict(_leaves(raw))
    settings = {
        key: (msgspec.json.encode(values[key]).decode(), source)
        for key, source in sorted(recording.start.sources.items())
        if key in values and source != "default"
    }
    return _Flown(config.problem, settings)


def _leaves(value: object, prefix: str = "") -> Iterator[tuple[str, object]]:
    """Dotted key → value."""
    if not isinstance(value, dict):
        yield prefix, value
        return
    for key, below in value.items():
        yield from _leaves(below, f"{prefix}.{key}" if prefix else str(key))


# ---------------------------------------------------------------------------------------------- ranges


def _ranges(recording: Recording, zero_ns: int) -> Iterator[RangeMark]:
    """Every range with its verdict and, where setpoints were streamed, how long its own took."""
    waiting: list[tuple[int, RangeMark]] = []
    streamed_ns: int | None = None
    for step in recording.steps:
        event, t_ns = step.event, step.event.t_ns
        if isinstance(event, RangeSample):
            verdict = next((o.verdict for o in step.outputs if isinstance(o, RangeVerdict)), None)
            sent_ns = event.sent_t_ns
            mark = RangeMark(
                t_s=(t_ns - zero_ns) * 1e-9,
                beacon=event.beacon,
                range_m=event.range_m,
                verdict=verdict,
                answer_s=None,
                transport_s=None if sent_ns is None else (recording.start.unix_of(t_ns) - sent_ns) * 1e-9,
            )
            streaming = streamed_ns is not None and t_ns - streamed_ns <= _STREAM_NS
            if streaming and verdict is Verdict.ACCEPTED:
                waiting.append((t_ns, mark))
            else:
                yield mark
        for output, delay_s in zip(step.outputs, step.delays_s, strict=True):
            if isinstance(output, Setpoint):
                streamed_ns = t_ns
                yield from _answered(waiting, t_ns, delay_s)
                waiting.clear()
        while waiting and t_ns - waiting[0][0] > _STREAM_NS:
            yield waiting.pop(0)[1]
    yield from (mark for _, mark in waiting)


def _answered(waiting: list[tuple[int, RangeMark]], t_ns: int, delay_s: float) -> Iterator[RangeMark]:
    """A setpoint answers every range believed since the one before; 0: no clock was read."""
    for came_ns, mark in waiting:
        yield mark._replace(answer_s=(t_ns - came_ns) * 1e-9 + delay_s if delay_s > 0.0 else None)


def _with_least_transport(ranges: tuple[RangeMark, ...]) -> tuple[RangeMark, ...]:
    """Transport counted from each beacon's quickest range: the clocks need not agree."""
    least: dict[str, float] = {}
    for r in ranges:
        if r.transport_s is not None:
            least[r.beacon] = min(r.transport_s, least.get(r.beacon, math.inf))
    return tuple(
        r if r.transport_s is None else r._replace(transport_s=r.transport_s - least[r.beacon])
        for r in ranges
    )


def _beacons(ranges: Sequence[RangeMark]) -> tuple[BeaconFigures, ...]:
    by_beacon: dict[str, list[RangeMark]] = {}
    for r in ranges:
        by_beacon.setdefault(r.beacon, []).append(r)
    return tuple(
        BeaconFigures(
            beacon=beacon,
            ranges=len(of),
            rate_hz=(len(of) - 1) / (of[-1].t_s - of[0].t_s) if of[-1].t_s > of[0].t_s else None,
            verdicts=dict(Counter(word(r.verdict) for r in of).most_common()),
        )
        for beacon, of in sorted(by_beacon.items())
    )


def word(verdict: Verdict | None) -> str:
    """A verdict for people; None: the record lost it."""
    return "not told" if verdict is None else verdict.value


# ----------------------------------------------------------------------------------------------- story


def _story(recording: Recording, zero_ns: int) -> Iterator[Happening]:
    """Phase changes, what the vehicle told of itself, and everything that went wrong."""
    mode: FlightMode | None = None
    armed: bool | None = None
    landed = Landed.UNKNOWN
    warned: tuple[str, ...] = ()
    spoilt: dict[str, int] = {}
    first_spoilt: dict[str, float] = {}
    for step in recording.steps:
        event = step.event
        t_s = (event.t_ns - zero_ns) * 1e-9
        if isinstance(event, ModeReport) and event.actual is not mode:
            mode = event.actual
            yield Happening(t_s, "vehicle", Severity.INFO, f"mode {mode.value}")
        elif isinstance(event, VehicleHeartbeat) and event.armed is not armed:
            was, armed = armed, event.armed
            if was is not None or armed:
                yield Happening(t_s, "vehicle", Severity.INFO, "armed" if armed else "disarmed")
        elif isinstance(event, LandedReport) and event.landed is not landed:
            landed = event.landed
            yield Happening(t_s, "vehicle", Severity.INFO, landed.value)
        elif isinstance(event, Malformed):
            name = event.defect.value
            spoilt[name] = spoilt.get(name, 0) + 1
            first_spoilt.setdefault(name, t_s)
        for output in step.outputs:
            if isinstance(output, PhaseChange):
                text = f"{output.before.value} → {output.after.value}: {output.reason}"
                yield Happening(t_s, "companion", output.severity, text)
            elif isinstance(output, ModeRequest):
                yield Happening(t_s, "companion", Severity.WARNING, f"asks for {output.mode.value}")
            elif isinstance(output, Status) and output.warnings != warned:
                fresh = [line for line in output.warnings if line not in warned]
                warned = output.warnings
                yield from (Happening(t_s, "companion", Severity.WARNING, line) for line in fresh)
        if step.lost:
            yield Happening(t_s, "record", Severity.WARNING, f"{step.lost} records are missing from here on")
    for name, count in spoilt.items():
        text = f"{name} × {count}, for the first time"
        yield Happening(first_spoilt[name], "link", Severity.WARNING, text)


def headline(s: Summary, ending: str, last: Status | None, recording: Recording) -> str:
    """What happened, in one sentence."""
    aim = "station" if s.kind == "station" else "target"
    if last is None:
        return "The record is empty" if not recording.steps else "The record ends before anything was decided"
    reached, missed = (
        ("Station reached", "Station not reached")
        if s.kind == "station"
        else ("Target captured", "Target not captured")
    )
    if s.time_s is None and last.engaged_s > 0.0:
        return f"{reached if s.captured else missed}; how it was engaged is missing in the record"
    if s.time_s is None:
        return f"Never engaged: {ending}"
    flown = f"{s.time_s:.1f} s" if s.path_m is None else f"{s.time_s:.1f} s and {s.path_m:.2f} m"
    if s.captured:
        ratio = f", {s.path_ratio:.2f} × the shortest path" if s.path_ratio is not None else ""
        return f"{reached} after {flown}{ratio}"
    left = f", {s.final_distance_m:.1f} m from the {aim}" if s.final_distance_m is not None else ""
    if _in_flight(last):
        return f"The record ends in mid-flight ({last.phase.value}) after {flown}{left}"
    return f"{missed}: {ending} after {flown}{left}"


def _in_flight(last: Status) -> bool:
    """The record stops while the flight goes on."""
    return last.phase.is_engaged and last.phase is not Phase.HAND_OVER
