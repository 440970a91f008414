"""A recorded flight flown again: the same events must give the same outputs, bit for bit.

With changed settings it shows what would have been commanded. The vehicle's answers stay those of the
recorded flight: it is not a simulation of what would have happened.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import groupby
from typing import Any, NamedTuple

import msgspec

from companion.record import versions
from companion.recording import Recording, Step
from companion.run import run
from companion.settings import Settings
from companion.types import Event, Output, Phase, PhaseChange, Setpoint

_HELD_NS = 500_000_000
"""Without a new setpoint for this long, none is being streamed."""
_ROWS = 20
_SHORTEST_ROW_S = 1.0
_TOO_SMALL_TO_SHOW = 1e-6
"""The tables show three decimals; smaller deviations are told in words only."""


class Difference(msgspec.Struct, frozen=True):
    """An event to which the pilot now answers otherwise. `fields`: what differs, one line each."""

    number: int
    t_s: float
    event: Event
    recorded: tuple[Output, ...]
    replayed: tuple[Output, ...]
    fields: tuple[str, ...]


class PhaseAt(msgspec.Struct, frozen=True):
    """A phase change, seconds since the first event."""

    t_s: float
    before: Phase
    after: Phase
    reason: str


class PhaseRow(msgspec.Struct, frozen=True):
    """The same phase change in both flights, or one that only one of them has."""

    recorded: PhaseAt | None
    replayed: PhaseAt | None


class SetpointRow(msgspec.Struct, frozen=True):
    """A stretch of the flight in which the setpoints differ. Means; None: no setpoints were streamed.

    `speed_off_m_s`, `yaw_rate_off_rad_s`: the largest difference at one moment.
    """

    from_s: float
    to_s: float
    recorded_speed_m_s: float | None
    replayed_speed_m_s: float | None
    recorded_yaw_rate_rad_s: float | None
    replayed_yaw_rate_rad_s: float | None
    speed_off_m_s: float
    yaw_rate_off_rad_s: float


class ReplayResult(msgspec.Struct, frozen=True):
    """What a replay came to.

    `differing`: the number of events with other outputs; `deviation`: the largest difference between two
    numbers where everything else was the same, infinite where it was not. `versions`: what was another then,
    and now. `changed`: settings of the record, and now. `stopped`: why it could not be compared to the end.
    """

    name: str
    recorded_at: str
    duration_s: float
    events: int
    outputs: int
    compared: int
    differing: int
    deviation: float
    first: Difference | None
    versions: dict[str, tuple[str, str]]
    changed: dict[str, tuple[Any, Any]]
    problems: tuple[str, ...]
    stopped: str | None
    phases: tuple[PhaseRow, ...]
    setpoints: tuple[SetpointRow, ...]

    @property
    def equal(self) -> bool:
        """Every output that could be compared is the same, bit for bit."""
        return self.differing == 0

    def text(self) -> str:
        """For a person."""
        return "\n".join(_lines(self))


def replay(recording: Recording, settings: Settings | None = None) -> ReplayResult:
    """Fly it again, with the recorded settings or others. Raises RecordError, see `Recording.settings`."""
    flown = recording.settings
    flying = flown if settings is None else _only_settings(settings)
    comparison = _Comparison(recording, flying != flown)
    run(comparison.events(), flying, comparison.send, _unrecorded)
    comparison.end()
    then, here = recording.start.versions, versions()
    was, now = _leaves(flown), _leaves(flying)
    return ReplayResult(
        name=recording.name,
        recorded_at=datetime.fromtimestamp(recording.start.unix_ns * 1e-9, UTC).isoformat(" ", "seconds"),
        duration_s=recording.duration_s,
        events=len(recording.steps),
        outputs=sum(len(step.outputs) for step in recording.steps),
        compared=comparison.compared,
        differing=comparison.differing,
        deviation=comparison.deviation,
        first=comparison.first,
        versions={
            name: (then.get(name, "none"), here.get(name, "none"))
            for name in sorted(then.keys() | here.keys())
            if then.get(name) != here.get(name)
        },
        changed={
            key: (was.get(key), now.get(key))
            for key in sorted(was.keys() | now.keys())
            if was.get(key) != now.get(key)
        },
        problems=recording.problems,
        stopped=comparison.stopped,
        phases=_side_by_side(comparison.phases[0], comparison.phases[1]),
        setpoints=_rows(comparison.moments),
    )


def _only_settings(settings: Settings) -> Settings:
    """Without what a configuration may hold besides: the simulated world is none of the pilot's business."""
    return Settings(**{name: getattr(settings, name) for name in Settings.__struct_fields__})


def _unrecorded(_: object) -> None:
    """A replay is not recorded."""


# ------------------------------------------------------------------------------------------- comparison


class _Moment(NamedTuple):
    """The setpoints in force, whenever one of them is new or gone."""

    t_s: float
    recorded: Setpoint | None
    replayed: Setpoint | None


class _Comparison:
    """Hands the recorded events to the loop, and holds what comes out against what came out then."""

    def __init__(self, recording: Recording, changed: bool) -> None:
        self._recording = recording
        self._changed = changed
        self._step: Step | None = None
        self._replayed: list[Output] = []
        self._encode = msgspec.json.Encoder().encode
        self._decoders: dict[type, msgspec.json.Decoder[Output]] = {}
        self._held: tuple[Setpoint | None, Setpoint | None] = (None, None)
        self.compared = 0
        self.differing = 0
        self.deviation = 0.0
        self.first: Difference | None = None
        self.stopped: str | None = None
        self.phases: tuple[list[PhaseAt], list[PhaseAt]] = ([], [])
        self.moments: list[_Moment] = []

    def events(self) -> Iterator[Event]:
        """The recorded events, as far as none is missing."""
        if self._recording.lost_at_first:
            self.stopped = "the record lacks its beginning"
            return
        for step in self._recording.steps:
            self.end()
            if self.stopped:
                return
            self._step = step
            yield step.event

    def send(self, output: Output) -> None:
        """Take what the pilot decides now."""
        self._replayed.append(output)

    def end(self) -> None:
        """The step under way is over: compare it."""
        step, self._step = self._step, None
        if step is None:
            return
        replayed = tuple(map(self._plain, self._replayed))
        self._replayed.clear()
        self._note(step, replayed)
        is_last = step is self._recording.steps[-1]
        places = len(step.outputs) + step.lost
        if step.lost and len(replayed) < places and not self._changed:
            self.stopped = f"from {self._recording.t_s(step.event.t_ns):.3f} s on the record lacks events"
        placed = list(zip(step.slots, step.outputs, strict=True))
        if step.lost:  # what lies beyond this event's own outputs is a lost event's
            placed = [(slot, was) for slot, was in placed if slot < len(replayed)]
        self.compared += len(placed)
        same = all(
            slot < len(replayed) and self._encode(was) == self._encode(replayed[slot]) for slot, was in placed
        )
        if not same or (len(replayed) > places and not is_last):
            self._differ(step, replayed)
        if not is_last and replayed and _is_over(replayed) and self.stopped is None:
            self.stopped = "the replayed flight was over, the recorded one went on"

    def _plain(self, output: Output) -> Output:
        """As it would read back: a whole number in a float field becomes a float."""
        decoder = self._decoders.setdefault(type(output), msgspec.json.Decoder(type(output)))
        try:
            return decoder.decode(self._encode(output))
        except msgspec.ValidationError:  # a number that is not finite has no place in a record: it differs
            return output

    def _differ(self, step: Step, replayed: tuple[Output, ...]) -> None:
        self.differing += 1
        fields, deviation = _fields(step.outputs, replayed)
        self.deviation = max(self.deviation, deviation)
        if self.first is None:
            self.first = Difference(
                number=step.number,
                t_s=self._recording.t_s(step.event.t_ns),
                event=step.event,
                recorded=step.outputs,
                replayed=replayed,
                fields=fields,
            )

    def _note(self, step: Step, replayed: tuple[Output, ...]) -> None:
        """Keep phase changes and setpoints of both flights."""
        recorded, now = (
            self._take(phases, held, outputs, step.event.t_ns)
            for phases, held, outputs in zip(self.phases, self._held, (step.outputs, replayed), strict=True)
        )
        if recorded is not self._held[0] or now is not self._held[1]:
            self._held = recorded, now
            self.moments.append(_Moment(self._recording.t_s(step.event.t_ns), recorded, now))

    def _take(
        self, phases: list[PhaseAt], held: Setpoint | None, outputs: tuple[Output, ...], t_ns: int
    ) -> Setpoint | None:
        """Keep the phase changes among the outputs; the setpoint that is in force after them."""
        for output in outputs:
            if isinstance(output, PhaseChange):
                t_s = self._recording.t_s(output.t_ns)
                phases.append(PhaseAt(t_s, output.before, output.after, output.reason))
            elif isinstance(output, Setpoint):
                held = output
        return None if held is None or t_ns - held.t_ns > _HELD_NS else held


def _is_over(outputs: tuple[Output, ...]) -> bool:
    return any(isinstance(output, PhaseChange) and output.after.is_final for output in outputs)


def _leaves(value: Any, prefix: str = "") -> dict[str, Any]:
    """Dotted name → plain value."""
    plain = msgspec.to_builtins(value)
    if not isinstance(plain, dict):
        return {prefix: plain}
    dot = f"{prefix}." if prefix else ""
    return {name: leaf for key, sub in plain.items() for name, leaf in _leaves(sub, f"{dot}{key}").items()}


def _fields(recorded: tuple[Output, ...], replayed: tuple[Output, ...]) -> tuple[tuple[str, ...], float]:
    """What differs, in words, and by how much: infinite where it is not only numbers."""
    lines, deviation = [], 0.0
    was_by, now_by = ({type(output): output for output in outputs} for outputs in (recorded, replayed))
    for kind in dict.fromkeys((*was_by, *now_by)):
        was, now = was_by.get(kind), now_by.get(kind)
        name = kind.__struct_config__.tag
        if was is None or now is None:
            lines.append(f"{name}: {_json(was)} → {_json(now)}")
            deviation = math.inf
            continue
        a, b = _leaves(was), _leaves(now)
        for key in dict.fromkeys((*a, *b)):
            x, y = a.get(key), b.get(key)
            if repr(x) != repr(y):
                lines.append(f"{name}.{key}: {x!r} → {y!r}")
                deviation = max(deviation, _apart(x, y))
    if not lines:
        lines.append("the order of the outputs")
        deviation = math.inf
    return tuple(lines), deviation


def _apart(x: object, y: object) -> float:
    """The difference of two numbers; of anything else, infinite."""
    if isinstance(x, float | int) and isinstance(y, float | int):
        return float(abs(x - y))
    return math.inf


def _side_by_side(recorded: list[PhaseAt], replayed: list[PhaseAt]) -> tuple[PhaseRow, ...]:
    a, b = ([(p.before, p.after) for p in phases] for phases in (recorded, replayed))
    rows: list[PhaseRow] = []
    for kind, i1, i2, j1, j2 in difflib.SequenceMatcher(None, a, b, autojunk=False).get_opcodes():
        if kind == "equal":
            rows += map(PhaseRow, recorded[i1:i2], replayed[j1:j2])
        else:
            only = [PhaseRow(p, None) for p in recorded[i1:i2]] + [PhaseRow(None, p) for p in replayed[j1:j2]]
            rows += sorted(only, key=lambda row: next(p.t_s for p in (row.recorded, row.replayed) if p))
    return tuple(rows)


def _rows(moments: list[_Moment]) -> tuple[SetpointRow, ...]:
    """The stretches in which the setpoints in force differ."""
    width_s = max(_SHORTEST_ROW_S, moments[-1].t_s / _ROWS) if moments else _SHORTEST_ROW_S
    rows = []
    for n, group in groupby(moments, lambda moment: int(moment.t_s / width_s)):
        stretch = tuple(group)
        if any(m.recorded != m.replayed for m in stretch):
            rows.append(_row(n * width_s, (n + 1) * width_s, stretch))
    return tuple(rows)


def _row(from_s: float, to_s: float, stretch: tuple[_Moment, ...]) -> SetpointRow:
    was = [m.recorded for m in stretch if m.recorded is not None]
    now = [m.replayed for m in stretch if m.replayed is not None]
    both = [(m.recorded, m.replayed) for m in stretch if m.recorded is not None and m.replayed is not None]
    return SetpointRow(
        from_s=from_s,
        to_s=to_s,
        recorded_speed_m_s=_mean([s.speed_m_s for s in was]),
        replayed_speed_m_s=_mean([s.speed_m_s for s in now]),
        recorded_yaw_rate_rad_s=_mean([s.yaw_rate_rad_s for s in was]),
        replayed_yaw_rate_rad_s=_mean([s.yaw_rate_rad_s for s in now]),
        speed_off_m_s=max((abs(a.speed_m_s - b.speed_m_s) for a, b in both), default=0.0),
        yaw_rate_off_rad_s=max((abs(a.yaw_rate_rad_s - b.yaw_rate_rad_s) for a, b in both), default=0.0),
    )


def _mean(values: list[float]) -> float | None:
    return sum(values) / len(values) if values else None


# ------------------------------------------------------------------------------------------------ text


def _lines(r: ReplayResult) -> Iterator[str]:
    yield f"{r.name}: {r.recorded_at}, {r.duration_s:.1f} s, {r.events} events, {r.outputs} outputs"
    yield from (f"  record: {problem}" for problem in r.problems)
    yield from (f"  version: {name} {then} then, {now} now" for name, (then, now) in r.versions.items())
    yield from (f"  setting: {key} = {was!r} → {now!r}" for key, (was, now) in r.changed.items())
    if r.stopped is not None and not r.compared:
        yield "nothing could be compared"
    elif r.equal:
        yield f"the same, bit for bit: {r.compared} outputs"
    else:
        kind = "other numbers only" if math.isfinite(r.deviation) else "not only other numbers"
        size = f", by {r.deviation:.3g} at most" if math.isfinite(r.deviation) else ""
        yield f"different: the outputs of {r.differing} of {r.events} events, {kind}{size}"
    if r.stopped is not None:
        yield f"not compared to the end: {r.stopped}"
    if r.first is not None:
        yield from _first(r.first)
    if r.deviation > _TOO_SMALL_TO_SHOW:
        yield from _phases(r.phases)
        yield from _setpoints(r.setpoints)


def _first(d: Difference) -> Iterator[str]:
    yield f"first difference: {d.t_s:.3f} s, record {d.number}, recorded → replayed"
    yield f"  after {_json(d.event)}"
    yield from (f"  {field}" for field in d.fields)


def _json(item: Event | Output | None) -> str:
    return "nothing" if item is None else msgspec.json.encode(item).decode()


def _phases(rows: tuple[PhaseRow, ...]) -> Iterator[str]:
    if all(row.recorded == row.replayed for row in rows):
        yield "phases: the same"
        return
    yield "phases (* where they differ), s:"
    yield f"    {'recorded':>9} {'replayed':>9}"
    for row in rows:
        both = [f"{p.t_s:9.3f}" if p is not None else f"{'–':>9}" for p in (row.recorded, row.replayed)]
        some = row.recorded or row.replayed
        assert some is not None
        mark = " " if row.recorded == row.replayed else "*"
        yield f"  {mark} {' '.join(both)}  {some.before.value} → {some.after.value}: {some.reason}"


def _setpoints(rows: tuple[SetpointRow, ...]) -> Iterator[str]:
    if not rows:
        yield "setpoints: the same"
        return
    yield "setpoints where they differ: mean recorded → replayed (largest difference at one moment)"
    yield f"  {'s':^13}{'speed, m/s':^27}{'yaw rate, rad/s':^27}".rstrip()
    for row in rows:
        speed = _change(row.recorded_speed_m_s, row.replayed_speed_m_s, row.speed_off_m_s)
        rate = _change(row.recorded_yaw_rate_rad_s, row.replayed_yaw_rate_rad_s, row.yaw_rate_off_rad_s)
        yield f"  {row.from_s:5.1f} –{row.to_s:6.1f}{speed}{rate}"


def _change(was: float | None, now: float | None, off: float) -> str:
    a, b = (f"{'silent' if value is None else f'{value:.3f}':>7}" for value in (was, now))
    return f"  {a} → {b} ({off:.3f})"
