"""What viewers see of a recorded flight: schemas that they can read, and what is derived for them.

Foxglove and Lichtblick read a small part of JSON Schema only: every field of every object has one plain
`type`; there is no `$ref` and no `anyOf`. PlotJuggler wants a schema on every channel. `viewer_schema` gives
both; a field that may be null is marked `nullable`, as in OpenAPI. Replay ignores everything derived here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from companion.types import (
    Attitude,
    Event,
    LocalMotion,
    Malformed,
    Output,
    PhaseChange,
    RangeSample,
    Setpoint,
    Severity,
    Status,
)

LOCAL_FRAME = "local"
"""The autopilot's local frame: x East, y North, z up, metres."""
VEHICLE_FRAME = "vehicle"
"""x forward, y left, z up."""

_PATH_POINTS = 256
"""Points of the path kept; when it is full every second one is dropped and the spacing doubled."""
_PATH_SPACING_M = 0.1
_PATH_PERIOD_NS = 5_000_000_000
_LINKS_PERIOD_NS = 1_000_000_000
_BEACONS_AT_MOST = 64
"""Beacons told in one `LinkStatistics`, so that a flood of made-up ids takes bounded memory."""


class Time(msgspec.Struct, frozen=True, gc=False):
    """Unix time."""

    sec: int
    nsec: int


Stamp = Annotated[Time, Meta(title="time")]
"""Titled as Foxglove titles it."""


class Vector3(msgspec.Struct, frozen=True, gc=False):
    """`foxglove.Vector3`, metres."""

    x: float
    y: float
    z: float


class Quaternion(msgspec.Struct, frozen=True, gc=False):
    """`foxglove.Quaternion`, of length 1."""

    x: float
    y: float
    z: float
    w: float


class Pose(msgspec.Struct, frozen=True):
    """`foxglove.Pose`."""

    position: Vector3
    orientation: Quaternion


class PoseInFrame(msgspec.Struct, frozen=True):
    """`foxglove.PoseInFrame`."""

    timestamp: Stamp
    frame_id: str
    pose: Pose


class PosesInFrame(msgspec.Struct, frozen=True):
    """`foxglove.PosesInFrame`: a path."""

    timestamp: Stamp
    frame_id: str
    poses: tuple[Pose, ...]


class FrameTransform(msgspec.Struct, frozen=True):
    """`foxglove.FrameTransform`: where the child frame is in the parent frame."""

    timestamp: Stamp
    parent_frame_id: str
    child_frame_id: str
    translation: Vector3
    rotation: Quaternion


class Log(msgspec.Struct, frozen=True):
    """`foxglove.Log`. Levels: 2 information, 3 warning, 4 error."""

    timestamp: Stamp
    level: int
    message: str
    name: str = "companion"
    file: str = ""
    line: int = 0


class BeaconStatistics(msgspec.Struct, frozen=True, gc=False):
    """One beacon over the last period.

    `clock_offset_s`: least (reception − publisher's time, both as Unix time) of the period, that is the error
    of the publisher's clock and the shortest transport; `jitter_s`: greatest − least. None: no time was sent.
    """

    beacon: str
    ranges: int
    clock_offset_s: float | None
    jitter_s: float | None


class LinkStatistics(msgspec.Struct, frozen=True):
    """What came and went in the last period; about once a second.

    `vehicle_boot_s`: least (local monotonic time of reception − the autopilot's time since boot) of the
    period: add it to `time_boot_ms` for the local monotonic clock. `vehicle_jitter_s`: greatest − least.
    """

    period_s: float
    attitudes: int
    motions: int
    ranges: int
    malformed: int
    setpoints: int
    vehicle_boot_s: float | None
    vehicle_jitter_s: float | None
    beacons: tuple[BeaconStatistics, ...]


View = PoseInFrame | PosesInFrame | FrameTransform | Log | LinkStatistics

TOPICS: dict[str, tuple[type[View], str]] = {
    "/pose": (PoseInFrame, "foxglove.PoseInFrame"),
    "/target": (PoseInFrame, "foxglove.PoseInFrame"),
    "/path": (PosesInFrame, "foxglove.PosesInFrame"),
    "/tf": (FrameTransform, "foxglove.FrameTransform"),
    "/log": (Log, "foxglove.Log"),
    "/links": (LinkStatistics, "companion.LinkStatistics"),
}
"""Topic → type and schema name of what is derived."""


# -------------------------------------------------------------------------------------------- schemas


def viewer_schema(kind: type, title: str) -> dict[str, Any]:
    """The JSON Schema of a Struct, flattened for viewers. Raises ValueError where they could not read it."""
    (reference,), definitions = msgspec.json.schema_components([kind], ref_template="{name}")
    return {**_plain(reference, definitions), "title": title}


def _plain(schema: dict[str, Any], definitions: dict[str, Any]) -> dict[str, Any]:
    """One node of a schema without references and alternatives."""
    if "$ref" in schema:
        return _plain(
            {**definitions[schema["$ref"]], **{k: v for k, v in schema.items() if k != "$ref"}}, definitions
        )
    if "anyOf" in schema:
        some = [branch for branch in schema["anyOf"] if branch.get("type") != "null"]
        if len(some) != 1:
            raise ValueError(f"a field of several types cannot be viewed: {schema}")
        return {**_plain(some[0], definitions), "nullable": True}
    plain = dict(schema)
    if "enum" in plain and "type" not in plain:
        plain["type"] = "integer" if all(isinstance(value, int) for value in plain["enum"]) else "string"
    if plain.get("type") == "object":
        plain["properties"] = {k: _plain(v, definitions) for k, v in plain.get("properties", {}).items()}
    elif plain.get("type") == "array":
        plain["items"] = _plain(plain["items"], definitions)
    elif plain.get("type") not in ("boolean", "string", "number", "integer"):
        raise ValueError(f"a field without a plain type cannot be viewed: {schema}")
    return plain


# ---------------------------------------------------------------------------------------------- views


def time_of(unix_ns: int) -> Time:
    """Nanoseconds since 1970 as Foxglove writes them."""
    return Time(*divmod(unix_ns, 1_000_000_000))


class Views:
    """Derives, from a flight's events and outputs in their order, what `TOPICS` lists."""

    def __init__(self, unix_of: Callable[[int], int]) -> None:
        """`unix_of`: local monotonic ns → Unix ns."""
        self._unix_of = unix_of
        self._path: list[Pose] = []
        self._spacing_m = _PATH_SPACING_M
        self._t_path_ns: int | None = None
        self._links = _Links(unix_of)

    def of(self, item: Event | Output) -> Iterator[tuple[str, View]]:
        """The topics and messages that follow from the next event or output."""
        if isinstance(item, Status):
            yield from self._status(item)
        elif isinstance(item, PhaseChange):
            yield (
                "/log",
                self.log(
                    item.t_ns, item.severity, f"{item.before.value} → {item.after.value}: {item.reason}"
                ),
            )
        links = self._links.take(item)
        if links is not None:
            yield "/links", links

    def log(self, t_ns: int, severity: Severity, message: str) -> Log:
        """One line of Foxglove's log panel."""
        level = 4 if severity <= Severity.CRITICAL else 3 if severity <= Severity.WARNING else 2
        return Log(time_of(self._unix_of(t_ns)), level, message)

    def _status(self, s: Status) -> Iterator[tuple[str, View]]:
        if s.x_m is None or s.y_m is None or s.heading_rad is None:
            return
        time = time_of(self._unix_of(s.t_ns))
        pose = _pose(s.x_m, s.y_m, s.height_m or 0.0, s.heading_rad)
        yield "/pose", PoseInFrame(time, LOCAL_FRAME, pose)
        yield "/tf", FrameTransform(time, LOCAL_FRAME, VEHICLE_FRAME, pose.position, pose.orientation)
        if s.estimate is not None:
            azimuth_rad = s.heading_rad - s.estimate.bearing_rad
            x_m = s.x_m + s.estimate.distance_m * math.cos(azimuth_rad)
            y_m = s.y_m + s.estimate.distance_m * math.sin(azimuth_rad)
            yield "/target", PoseInFrame(time, LOCAL_FRAME, _pose(x_m, y_m, 0.0, 0.0))
        self._extend(pose)
        if self._t_path_ns is None or s.t_ns - self._t_path_ns >= _PATH_PERIOD_NS or s.phase.is_final:
            self._t_path_ns = s.t_ns
            yield "/path", PosesInFrame(time, LOCAL_FRAME, tuple(self._path))

    def _extend(self, pose: Pose) -> None:
        if self._path:
            a, b = self._path[-1].position, pose.position
            if math.dist((a.x, a.y, a.z), (b.x, b.y, b.z)) < self._spacing_m:
                return
        self._path.append(pose)
        if len(self._path) >= _PATH_POINTS:
            del self._path[1::2]
            self._spacing_m *= 2.0


def _pose(x_m: float, y_m: float, z_m: float, heading_rad: float) -> Pose:
    """Millimetres are enough for the eye, and the file stays small."""
    half = heading_rad / 2.0
    return Pose(
        Vector3(round(x_m, 3), round(y_m, 3), round(z_m, 3)),
        Quaternion(0.0, 0.0, round(math.sin(half), 4), round(math.cos(half), 4)),
    )


class _Links:
    """Counts and clock offsets, begun anew every period."""

    def __init__(self, unix_of: Callable[[int], int]) -> None:
        self._unix_of = unix_of
        self._since_ns: int | None = None
        self._reset()

    def _reset(self) -> None:
        self._counts: dict[type, int] = {}
        self._boot = _Span()
        self._beacons: dict[str, tuple[int, _Span]] = {}

    def take(self, item: Event | Output) -> LinkStatistics | None:
        """Count one event or output; the statistics when a period is over."""
        result = None
        if self._since_ns is None:
            self._since_ns = item.t_ns
        elif item.t_ns - self._since_ns >= _LINKS_PERIOD_NS:
            result = self._statistics((item.t_ns - self._since_ns) * 1e-9)
            self._since_ns = item.t_ns
            self._reset()
        self._counts[type(item)] = self._counts.get(type(item), 0) + 1
        if isinstance(item, RangeSample):
            if item.beacon in self._beacons or len(self._beacons) < _BEACONS_AT_MOST:
                count, span = self._beacons.get(item.beacon, (0, _Span()))
                if item.sent_t_ns is not None:
                    span = span.with_((self._unix_of(item.t_ns) - item.sent_t_ns) * 1e-9)
                self._beacons[item.beacon] = (count + 1, span)
        elif isinstance(item, Attitude | LocalMotion):
            self._boot = self._boot.with_((item.t_ns - item.boot_ms * 1_000_000) * 1e-9)
        return result

    def _statistics(self, period_s: float) -> LinkStatistics:
        return LinkStatistics(
            period_s=period_s,
            attitudes=self._counts.get(Attitude, 0),
            motions=self._counts.get(LocalMotion, 0),
            ranges=self._counts.get(RangeSample, 0),
            malformed=self._counts.get(Malformed, 0),
            setpoints=self._counts.get(Setpoint, 0),
            vehicle_boot_s=self._boot.least,
            vehicle_jitter_s=self._boot.width,
            beacons=tuple(
                BeaconStatistics(beacon, count, span.least, span.width)
                for beacon, (count, span) in sorted(self._beacons.items())
            ),
        )


class _Span(msgspec.Struct, frozen=True, gc=False):
    """The least and the greatest of some values; None before the first."""

    least: float | None = None
    greatest: float | None = None

    def with_(self, value: float) -> _Span:
        if self.least is None or self.greatest is None:
            return _Span(value, value)
        return _Span(min(self.least, value), max(self.greatest, value))

    @property
    def width(self) -> float | None:
        return None if self.least is None or self.greatest is None else self.greatest - self.least
