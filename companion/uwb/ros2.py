"""ROS 2: ranges as `sensor_msgs/msg/Range`, from zenoh-plugin-ros2dds or rmw_zenoh.

The payload is CDR: four bytes that tell the encoding, then stamp, frame_id, radiation_type, field_of_view,
min_range, max_range, range and, from ROS 2 Iron on, variance. All numbers are aligned to four bytes, counted
from after the first four. Whether the variance is there shows in the size.

Decoded here with `struct`: one string and eight numbers. The library rosbags, which the tests hold this
against, brings NumPy into the flying process (0.05 s and 20 MB, and a decoder compiled at the first message,
0.1 to 0.3 s) and five packages more.
"""

from __future__ import annotations

import math
import struct
from enum import Enum
from typing import NamedTuple

from companion.range_message import RangeMessage
from companion.types import LineOfSight

RANGE_TYPE = "sensor_msgs::msg::dds_::Range_"
"""The type's name in a key of rmw_zenoh."""
MAX_PAYLOAD_BYTES = 512
"""44 bytes and a frame_id; more than this is refused unread."""
_NS = 1_000_000_000
_MAX_RANGE_M, _MAX_VARIANCE_M2 = 10_000.0, 1e6
"""As in `RangeMessage`."""


class RosRange(NamedTuple):
    """A `sensor_msgs/msg/Range`. `variance_m2` is None where the message has none, 0 where it is unknown."""

    stamp_ns: int
    frame_id: str
    radiation_type: int
    field_of_view_rad: float
    min_range_m: float
    max_range_m: float
    range_m: float
    variance_m2: float | None


class NotAMeasurement(ValueError):  # noqa: N818 - a well-formed message that tells that there is no range
    """The message is well-formed and says that nothing was measured."""


def decode_range(payload: bytes) -> RosRange:
    """Read a CDR payload, little or big endian, with or without variance.

    Raises ValueError where it is not a whole `sensor_msgs/msg/Range`.
    """
    if not 4 <= len(payload) <= MAX_PAYLOAD_BYTES:
        raise ValueError(f"payload of {len(payload)} bytes is no sensor_msgs/Range")
    if payload[:2] not in (b"\x00\x00", b"\x00\x01"):
        raise ValueError(f"encapsulation {payload[:4].hex()}, expected plain CDR (0000 or 0001)")
    order = "<" if payload[1] else ">"
    body = payload[4:]
    try:
        seconds, nanoseconds, size = struct.unpack_from(order + "iII", body)
        if not 1 <= size <= len(body) - 12 or body[12 + size - 1] != 0:
            raise ValueError("frame_id is cut, or not ended by a zero byte")
        frame_id = body[12 : 12 + size - 1].decode()
        at = 12 + size
        radiation_type = body[at]
        at += -(at + 1) % 4 + 1
        numbers = struct.unpack(order + f"{(len(body) - at) // 4}f", body[at:])
    except (struct.error, IndexError):
        raise ValueError(f"payload of {len(payload)} bytes is cut, or no sensor_msgs/Range") from None
    if len(numbers) not in (4, 5):
        raise ValueError(f"{len(numbers)} numbers after the type of radiation, expected 4 or 5")
    if nanoseconds >= _NS:
        raise ValueError(f"stamp with {nanoseconds} nanoseconds")
    view, nearest, furthest, range_m, *variance = numbers
    stamp_ns = seconds * _NS + nanoseconds
    return RosRange(
        stamp_ns,
        frame_id,
        radiation_type,
        view,
        nearest,
        furthest,
        range_m,
        variance[0] if variance else None,
    )


class Attachment(NamedTuple):
    """What rmw_zenoh says of a sample: publisher's counter, its Unix time, and its identity."""

    sequence: int
    source_ns: int
    gid: bytes


_PLAIN = struct.Struct("<qqB16s")
_NAMED = struct.Struct("<B15sqB16sqB10sB16s")
_NAMES = (15, b"sequence_number", 16, b"source_timestamp", 10, b"source_gid", 16)


def decode_attachment(data: bytes) -> Attachment:
    """Read an attachment of rmw_zenoh: 33 bytes, or 77 with the names of the fields (Jazzy 0.2.0 to 0.2.3).

    Raises ValueError where it is neither.
    """
    if len(data) == _PLAIN.size:
        sequence, source_ns, size, gid = _PLAIN.unpack(data)
        if size == len(gid) and sequence >= 0:
            return Attachment(sequence, source_ns, gid)
    elif len(data) == _NAMED.size:
        *fields, gid = _NAMED.unpack(data)
        sequence, source_ns = fields.pop(2), fields.pop(4)
        if tuple(fields) == _NAMES and sequence >= 0:
            return Attachment(sequence, source_ns, gid)
    raise ValueError(f"attachment of {len(data)} bytes is not rmw_zenoh's")


class Bridge(Enum):
    """How ROS 2 reached Zenoh, which decides the form of the keys."""

    ROS2DDS = "ros2dds"
    """zenoh-plugin-ros2dds: the topic without its leading `/`, after the bridge's namespace if it has one."""
    RMW_ZENOH = "rmw_zenoh"
    """rmw_zenoh: `domain/topic/type/hash of the type`; the hash differs between releases."""


def subscription(bridge: Bridge, topic: str, domain: int = 0) -> str:
    """The key expression for a topic, such as `/uwb/*/range`. Raises ValueError for an empty topic."""
    name = topic.strip("/")
    if not name:
        raise ValueError(f"{topic!r} is no topic")
    return name if bridge is Bridge.ROS2DDS else f"{domain}/{name}/{RANGE_TYPE}/*"


def topic_of(bridge: Bridge, key: str) -> str:
    """The topic in a key, without its leading `/`. Raises ValueError where the key is not of this bridge."""
    if bridge is Bridge.ROS2DDS:
        return key
    parts = key.split("/")
    if len(parts) < 4 or not parts[0].isdecimal() or parts[-2] != RANGE_TYPE:
        raise ValueError(f"{key[:100]!r} is no rmw_zenoh key of a sensor_msgs/Range")
    return "/".join(parts[1:-2])


class BeaconName(Enum):
    """What names the beacon."""

    TOPIC = "topic"
    """The last part of the topic, or the one before a last part `range`: `/uwb/a1/range` is a1."""
    FRAME = "frame"
    """The header's frame_id."""


def beacon_of(topic: str, frame_id: str, name: BeaconName) -> str:
    """The beacon's id. Raises ValueError where there is none."""
    parts = topic.strip("/").split("/")
    if name is BeaconName.TOPIC and parts[-1] == "range":
        parts.pop()
    beacon = frame_id.strip("/") if name is BeaconName.FRAME else parts[-1] if parts else ""
    if not beacon:
        raise ValueError(f"no beacon in the {name.value} of {topic[:100]!r}")
    return beacon


def to_message(payload: bytes, attachment: bytes | None) -> RangeMessage:
    """The range as this project's own message.

    Session and sequence are rmw_zenoh's publisher id and counter. Without an attachment, as it comes from
    zenoh-plugin-ros2dds, the stamp in microseconds counts, which rises but not by one. Raises NotAMeasurement
    (infinite, or outside min_range..max_range) or ValueError (unreadable, or a repetition would not show).
    """
    m = decode_range(payload)
    if not 0.0 < m.range_m <= _MAX_RANGE_M:
        raise NotAMeasurement(f"range {m.range_m}: nothing measured")
    if m.max_range_m > 0.0 and not m.min_range_m <= m.range_m <= m.max_range_m:
        raise NotAMeasurement(f"range {m.range_m:g} outside {m.min_range_m:g}..{m.max_range_m:g}")
    if attachment is not None:
        told = decode_attachment(attachment)
        session, seq = told.gid.hex(), told.sequence
    else:
        session, seq = "ros2", m.stamp_ns // 1000
    if seq <= 0:
        raise ValueError("neither a counter nor a stamp: a repeated range could not be told")
    variance = m.variance_m2 if m.variance_m2 is not None else 0.0
    return RangeMessage(
        session=session,
        seq=seq,
        range_m=m.range_m,
        sigma_m=math.sqrt(variance) if 0.0 < variance <= _MAX_VARIANCE_M2 else None,
        los=LineOfSight.UNKNOWN,
        t_ns=m.stamp_ns if m.stamp_ns > 0 else None,
    )
