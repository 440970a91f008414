"""What is drawn of a recorded flight: short names, because all of it goes into the page."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import msgspec

from companion.picture import Truth, shortest_path
from companion.recording import Recording
from companion.report.flight import Flight, RangeMark, word
from companion.report.thin import LINE_POINTS, MARKS, Line, line, peaks, stride
from companion.summary import Pose, shortest_from_m
from companion.types import Attitude, Event, LocalMotion, Output, Setpoint, Status, Verdict

_SILENCE_S = 0.5
"""After this long without a value the line is broken."""


class Rows(msgspec.Struct, frozen=True):
    """The statuses, one list a column: the moments that the cursor can stand at.

    Metres, degrees; `sd`, `sb`: one-sigma of distance and bearing; None: not known.
    """

    t: list[float]
    phase: list[str]
    x: list[float | None]
    y: list[float | None]
    h: list[float | None]
    heading: list[float | None]
    range: list[float | None]
    d: list[float | None]
    sd: list[float | None]
    b: list[float | None]
    sb: list[float | None]


class Marks(msgspec.Struct, frozen=True):
    """Ranges with one fate: `count` of them, of which these are shown."""

    verdict: str
    count: int
    t: list[float]
    m: list[float]
    beacon: list[str]


class Delays(msgspec.Struct, frozen=True):
    """Durations in milliseconds, at the time of the range that they belong to."""

    t: list[float]
    ms: list[float]


class Shortest(msgspec.Struct, frozen=True):
    """The shortest path with the turn bound, as points in the local frame."""

    length_m: float
    x: list[float]
    y: list[float]


class TruePath(msgspec.Struct, frozen=True):
    """What a simulation knows besides."""

    x: list[float]
    y: list[float]
    target: tuple[float, float]
    beacons: list[tuple[float, float]]


class Series(msgspec.Struct, frozen=True):
    """Everything that is drawn. Speeds m/s, yaw rates °/s (left positive), heights m, by seconds.

    `thinned`: what is not shown in full, in words; the figures count all of it.
    """

    rows: Rows
    ranges: list[Marks]
    speed_asked: Line
    speed_flown: Line
    yaw_asked: Line
    yaw_flown: Line
    height_asked: Line
    height_flown: Line
    answers: Delays
    transports: Delays
    shortest: Shortest | None
    truth: TruePath | None
    thinned: list[str]


def of(recording: Recording, flight: Flight, truth: Truth | None = None) -> Series:
    """Work out what is drawn."""
    lines = _lines(recording, flight.zero_ns)
    statuses = [o for step in recording.steps for o in step.outputs if isinstance(o, Status)]
    each = stride(len(statuses), LINE_POINTS)
    thinned = [f"every {each}th status"] if each > 1 else []
    if any(len(points) > LINE_POINTS for points in lines):
        thinned.append("speeds, yaw rates and heights by their extremes")
    marks = _marks(flight.ranges)
    if any(len(m.t) < m.count for m in marks):
        shown = sum(len(m.t) for m in marks)
        thinned.append(f"{shown} of {len(flight.ranges)} ranges")
    return Series(
        rows=_rows([*statuses[::each], *statuses[-1:]], flight.zero_ns),
        ranges=marks,
        speed_asked=line(lines.speed_asked, _SILENCE_S),
        speed_flown=line(lines.speed_flown, _SILENCE_S),
        yaw_asked=line(lines.yaw_asked, _SILENCE_S),
        yaw_flown=line(lines.yaw_flown, _SILENCE_S),
        height_asked=line(lines.height_asked, _SILENCE_S),
        height_flown=line(lines.height_flown, _SILENCE_S),
        answers=_delays([(r.t_s, r.answer_s) for r in flight.ranges if r.answer_s is not None]),
        transports=_delays([(r.t_s, r.transport_s) for r in flight.ranges if r.transport_s is not None]),
        shortest=_shortest(flight, truth),
        truth=_truth(truth),
        thinned=thinned,
    )


Points = list[tuple[float, float]]


class _Lines(NamedTuple):
    speed_asked: Points
    speed_flown: Points
    yaw_asked: Points
    yaw_flown: Points
    height_asked: Points
    height_flown: Points


def _lines(recording: Recording, zero_ns: int) -> _Lines:
    lines = _Lines([], [], [], [], [], [])
    heading_rad: float | None = None
    for item in _items(recording):
        t_s = (item.t_ns - zero_ns) * 1e-9
        if isinstance(item, Attitude):
            heading_rad = item.heading_rad
            lines.yaw_flown.append((t_s, math.degrees(item.yaw_rate_rad_s)))
        elif isinstance(item, LocalMotion):
            if heading_rad is not None:
                forward = item.vx_m_s * math.cos(heading_rad) + item.vy_m_s * math.sin(heading_rad)
                lines.speed_flown.append((t_s, forward))
            if item.height_m is not None:
                lines.height_flown.append((t_s, item.height_m))
        elif isinstance(item, Setpoint):
            lines.speed_asked.append((t_s, item.speed_m_s))
            lines.yaw_asked.append((t_s, math.degrees(item.yaw_rate_rad_s)))
            if item.height_m is not None:
                lines.height_asked.append((t_s, item.height_m))
    return lines


def _items(recording: Recording) -> Iterator[Event | Output]:
    for step in recording.steps:
        yield step.event
        yield from step.outputs


def _rows(statuses: Sequence[Status], zero_ns: int) -> Rows:
    es = [s.estimate for s in statuses]
    return Rows(
        t=[round((s.t_ns - zero_ns) * 1e-9, 3) for s in statuses],
        phase=[s.phase.value for s in statuses],
        x=[_short(s.x_m) for s in statuses],
        y=[_short(s.y_m) for s in statuses],
        h=[_short(s.height_m) for s in statuses],
        heading=[_degrees(s.heading_rad) for s in statuses],
        range=[_short(s.range_m) for s in statuses],
        d=[None if e is None else _short(e.distance_m) for e in es],
        sd=[None if e is None else _short(e.distance_sigma_m) for e in es],
        b=[None if e is None else _degrees(e.bearing_rad) for e in es],
        sb=[None if e is None else _degrees(e.bearing_sigma_rad) for e in es],
    )


def _short(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def _degrees(value: float | None) -> float | None:
    return None if value is None else round(math.degrees(value), 2)


def _marks(ranges: Sequence[RangeMark]) -> list[Marks]:
    """By fate, the believed ones first; of a fate with very many every n-th."""
    fates: dict[Verdict | None, list[RangeMark]] = {Verdict.ACCEPTED: []}
    for r in ranges:
        fates.setdefault(r.verdict, []).append(r)
    marks = []
    for verdict, of in fates.items():
        shown = of[:: stride(len(of), MARKS if verdict is Verdict.ACCEPTED else MARKS // 4)]
        marks.append(
            Marks(
                verdict=word(verdict),
                count=len(of),
                t=[round(r.t_s, 3) for r in shown],
                m=[round(r.range_m, 3) for r in shown],
                beacon=[r.beacon for r in shown],
            )
        )
    return [m for m in marks if m.count]


def _delays(points: list[tuple[float, float]]) -> Delays:
    shown = peaks(points, MARKS // 2)
    return Delays([round(t, 3) for t, _ in shown], [round(s * 1e3, 3) for _, s in shown])


def _shortest(flight: Flight, truth: Truth | None) -> Shortest | None:
    s, problem = flight.figures.summary, flight.figures.problem
    aim = truth.target if truth is not None else None
    if aim is None and s.target_x_m is not None and s.target_y_m is not None:
        aim = s.target_x_m, s.target_y_m
    if s.start is None or aim is None:
        return None
    points = shortest_path(Pose(s.start.x_m, s.start.y_m, s.start.heading_rad), aim, problem)
    if not points:
        return None
    x, y = ([round(p[i], 3) for p in points] for i in (0, 1))
    return Shortest(round(shortest_from_m(s.start, *aim, problem), 3), x, y)


def _truth(truth: Truth | None) -> TruePath | None:
    if truth is None:
        return None
    path = truth.path[:: stride(len(truth.path), LINE_POINTS)]
    return TruePath(
        [round(x, 3) for x, _ in path], [round(y, 3) for _, y in path], truth.target, list(truth.beacons)
    )
