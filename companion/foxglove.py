"""What viewers see of a recorded flight: schemas that they can read, and the messages derived for them.

Foxglove and Lichtblick read a small part of JSON Schema only: every field of every object has one plain
`type`; there is no `$ref` and no `anyOf`. PlotJuggler wants a schema on every channel. `viewer_schema` gives
both; a field that may be null is marked `nullable`, as in OpenAPI.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import Meta


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
