"""What came over Zenoh as events: this project's ranges, ROS 2's, and what beacons tell of themselves.

Nothing here raises for what the bytes hold: they become an event, or the reason why they are none.
"""

from __future__ import annotations

import msgspec

from companion import wire_range
from companion.network_settings import Ros2Settings
from companion.range_message import RangeMessage
from companion.types import BeaconTold, Defect, Event, Malformed, RangeSample
from companion.uwb import info, ros2

MAX_ATTACHMENT_BYTES = 128
"""rmw_zenoh's has 33 or 77 bytes."""
_GOOD = frozenset({"ok", "success"})


class Raw(msgspec.Struct, frozen=True, gc=False):
    """A sample or a reply as it came."""

    t_ns: int
    key: str
    payload: bytes
    """Empty where it was too long to look at."""
    size: int
    encoding: str
    attachment: bytes | None = None


class RangeReader:
    """`range_event` for one subscription, whose ranges mostly come on one key: it remembers whose that is."""

    def __init__(self) -> None:
        self._key = self._beacon = ""

    def event(self, raw: Raw) -> Event:
        """One sample as a range, or as the reason why it is none. Never raises."""
        if raw.key != self._key:
            self._key, self._beacon = raw.key, wire_range.beacon_of(raw.key)
        return range_event(raw, self._beacon)


def range_event(raw: Raw, beacon: str | None = None) -> Event:
    """One sample as a range, or as the reason why it is none. `beacon`, if it is known. Never raises."""
    if raw.size > wire_range.MAX_PAYLOAD_BYTES:
        return _malformed(raw, Defect.RANGE_TOO_LONG, f"{raw.size} bytes")
    try:
        m = wire_range.decode(raw.payload, raw.encoding)
    except msgspec.ValidationError as error:
        return _malformed(raw, Defect.RANGE_FIELD, error)
    except msgspec.DecodeError as error:
        return _malformed(raw, Defect.RANGE_PAYLOAD, error)
    except ValueError as error:
        return _malformed(raw, Defect.RANGE_ENCODING, error)
    status = m.status
    if status is not None and status.lower() not in _GOOD:
        return _malformed(raw, Defect.RANGE_STATUS, status)
    return _sample(raw.t_ns, wire_range.beacon_of(raw.key) if beacon is None else beacon, m)


def ros2_event(topic: Ros2Settings, raw: Raw) -> Event:
    """One `sensor_msgs/msg/Range` as a range, or as the reason why it is none. Never raises."""
    if raw.size > ros2.MAX_PAYLOAD_BYTES:
        return _malformed(raw, Defect.RANGE_TOO_LONG, f"{raw.size} bytes")
    try:
        m = ros2.to_message(raw.payload, raw.attachment)
        beacon = topic.beacon
        if beacon is None:
            name = ros2.BeaconName(topic.named_by)
            frame_id = ros2.decode_range(raw.payload).frame_id if name is ros2.BeaconName.FRAME else ""
            beacon = ros2.beacon_of(ros2.topic_of(ros2.Bridge(topic.bridge), raw.key), frame_id, name)
    except ros2.NotAMeasurement as error:
        return _malformed(raw, Defect.RANGE_STATUS, error)
    except ValueError as error:
        return _malformed(raw, Defect.RANGE_ROS2, error)
    return _sample(raw.t_ns, beacon, m)


def info_event(raw: Raw) -> Event:
    """A beacon's answer to the query for its info. Never raises."""
    if raw.size > wire_range.MAX_PAYLOAD_BYTES:
        return _malformed(raw, Defect.BEACON_INFO, f"{raw.size} bytes")
    try:
        told = info.decode(raw.payload)
    except ValueError as error:
        return _malformed(raw, Defect.BEACON_INFO, error)
    beacon = raw.key.split("/")[-2]
    return BeaconTold(t_ns=raw.t_ns, beacon=beacon, height_m=told.height_m, bias_m=told.bias_m)


def _sample(t_ns: int, beacon: str, m: RangeMessage) -> RangeSample:
    return RangeSample(
        t_ns=t_ns,
        beacon=beacon,
        session=m.session,
        seq=m.seq,
        range_m=m.range_m,
        sigma_m=m.sigma_m,
        los=m.los,
        rssi_dbm=m.rssi_dbm,
        sent_t_ns=m.t_ns,
    )


def _malformed(raw: Raw, defect: Defect, why: object) -> Malformed:
    return Malformed(t_ns=raw.t_ns, defect=defect, detail=f"{raw.key}: {why}"[:200])
