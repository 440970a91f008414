"""ROS 2 ranges: the bytes of the documents, rosbags as the judge, keys of both bridges, hostile bytes."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.uwb import ros2
from companion.uwb.ros2 import Attachment, BeaconName, Bridge, NotAMeasurement, RosRange
from companion.wire_range import decode, encode
from tests.uwb.samples import ATTACHMENT, JAZZY, octets

HUMBLE = JAZZY[:40]
BIG_ENDIAN = octets(
    "00000000 6553f100 0ee6b280 00000007 7577625f613100 01 3f000000 3e800000 42c80000 41480000 3c23d70a"
)
STAMP_NS = 1_700_000_000_250_000_000
READ = RosRange(STAMP_NS, "uwb_a1", 1, 0.5, 0.25, 100.0, 12.5, struct.unpack("<f", JAZZY[40:])[0])
HASH = "RIHS01_b42b62562e93cbfe9d42b82fe5994dfa3d63d7d5c90a317981703f7388adff3a"


@pytest.mark.parametrize("payload", [JAZZY, BIG_ENDIAN])
def test_with_variance(payload: bytes) -> None:
    assert ros2.decode_range(payload) == READ


def test_without_variance() -> None:
    assert ros2.decode_range(HUMBLE) == READ._replace(variance_m2=None)


@pytest.mark.parametrize(
    ("frame", "size"),
    [("02000000 6200 01 00", 36), ("04000000 61626300 01 000000", 40), ("01000000 00 01 0000", 36)],
)
def test_padding_after_frames_of_any_length(frame: str, size: int) -> None:
    payload = JAZZY[:12] + octets(frame, "0000003f 0000803e 0000c842 00004841 0ad7233c")
    assert ros2.decode_range(payload).range_m == 12.5
    assert len(payload) == size + 4
    assert ros2.decode_range(payload[:-4]).variance_m2 is None


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        JAZZY[:3],
        JAZZY[:16],
        JAZZY[:36],
        JAZZY[:43],
        JAZZY + b"\x00",
        JAZZY + bytes(4),
        b"\x00\x07" + JAZZY[2:],
        JAZZY[:12] + octets("ffffffff") + JAZZY[16:],
        JAZZY[:12] + octets("00000000") + JAZZY[16:],
        JAZZY[:16] + b"\xff" + JAZZY[17:],
        JAZZY[:22] + b"x" + JAZZY[23:],
        JAZZY[:8] + octets("ffffffff") + JAZZY[12:],
        JAZZY[:12] + octets("f4010000") + bytes(600),
    ],
)
def test_what_is_no_range_is_refused(payload: bytes) -> None:
    with pytest.raises(ValueError):
        ros2.decode_range(payload)


@given(st.binary(max_size=80), st.integers(0, 44))
@settings(max_examples=500)
def test_no_bytes_raise_anything_else(noise: bytes, keep: int) -> None:
    for payload in (noise, JAZZY[:keep] + noise, JAZZY[:keep] + noise + JAZZY[keep + len(noise) :]):
        try:
            message = ros2.to_message(payload, noise or None)
        except ValueError:
            continue
        assert math.isfinite(message.range_m)


float32 = st.floats(width=32, allow_nan=False)
messages = st.tuples(
    st.integers(0, 2**31 - 1),
    st.integers(0, 999_999_999),
    st.text(st.characters(exclude_characters="\x00", exclude_categories=["Cs"]), max_size=30),
    st.sampled_from([0, 1]),
    st.tuples(float32, float32, float32, float32, float32),
    st.booleans(),
)


@pytest.fixture(scope="module")
def stores() -> tuple[Any, Any]:
    typesys = pytest.importorskip("rosbags.typesys")
    return tuple(typesys.get_typestore(s) for s in (typesys.Stores.ROS2_HUMBLE, typesys.Stores.ROS2_JAZZY))


@given(messages)
@settings(max_examples=200)
def test_rosbags_reads_and_writes_the_same(
    stores: tuple[Any, Any], m: tuple[int, int, str, int, tuple[float, ...], bool]
) -> None:
    seconds, nanoseconds, frame_id, kind, numbers, little = m
    for store, count in zip(stores, (4, 5), strict=True):
        time = store.types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=nanoseconds)
        header = store.types["std_msgs/msg/Header"](stamp=time, frame_id=frame_id)
        names = ("field_of_view", "min_range", "max_range", "range", "variance")
        values = dict(zip(names[:count], numbers, strict=False))
        message = store.types["sensor_msgs/msg/Range"](header=header, radiation_type=kind, **values)
        payload = bytes(store.serialize_cdr(message, "sensor_msgs/msg/Range", little_endian=little))
        read = ros2.decode_range(payload)
        assert (read.stamp_ns, read.frame_id) == (seconds * 10**9 + nanoseconds, frame_id)
        assert (read.radiation_type, *read[3 : 3 + count]) == (kind, *numbers[:count])
        assert (read.variance_m2 is None) == (count == 4)


def test_as_a_message_of_this_project() -> None:
    message = ros2.to_message(JAZZY, ATTACHMENT)
    assert (message.session, message.seq) == ("000102030405060708090a0b0c0d0e0f", 1)
    assert (message.range_m, message.t_ns) == (12.5, STAMP_NS)
    assert message.sigma_m == pytest.approx(0.1)
    assert decode(encode(message), "application/json") == message
    without = ros2.to_message(HUMBLE, None)
    assert (without.session, without.seq, without.sigma_m) == ("ros2", STAMP_NS // 1000, None)
    assert decode(encode(without), "application/json") == without


@pytest.mark.parametrize("range_m", [math.inf, -math.inf, math.nan, 0.0, -1.0, 0.2, 100.5])
def test_nothing_measured(range_m: float) -> None:
    with pytest.raises(NotAMeasurement):
        ros2.to_message(JAZZY[:36] + struct.pack("<f", range_m) + JAZZY[40:], ATTACHMENT)


def test_a_repetition_must_show() -> None:
    with pytest.raises(ValueError, match="repeated"):
        ros2.to_message(JAZZY[:4] + bytes(8) + JAZZY[12:], None)


def test_attachments_of_both_releases() -> None:
    gid = bytes(range(16))
    read = Attachment(1, int.from_bytes(ATTACHMENT[8:16], "little"), gid)
    assert ros2.decode_attachment(ATTACHMENT) == read
    named = (
        b"\x0fsequence_number" + ATTACHMENT[:8] + b"\x10source_timestamp" + ATTACHMENT[8:16]
        + b"\x0asource_gid" + b"\x10" + gid
    )  # fmt: skip
    assert len(named) == 77
    assert ros2.decode_attachment(named) == read
    for wrong in (b"", ATTACHMENT[:-1], named.replace(b"source_gid", b"source_gie"), b"\xff" * 33):
        with pytest.raises(ValueError, match="attachment"):
            ros2.decode_attachment(wrong)


def test_keys_of_both_bridges() -> None:
    rmw = f"0/uwb/a1/sensor_msgs::msg::dds_::Range_/{HASH}"
    assert ros2.topic_of(Bridge.RMW_ZENOH, rmw) == "uwb/a1"
    assert ros2.topic_of(Bridge.RMW_ZENOH, rmw.replace(HASH, "TypeHashNotSupported")) == "uwb/a1"
    assert ros2.topic_of(Bridge.ROS2DDS, "bot1/uwb/a1/range") == "bot1/uwb/a1/range"
    assert ros2.subscription(Bridge.RMW_ZENOH, "/uwb/*") == "0/uwb/*/sensor_msgs::msg::dds_::Range_/*"
    assert ros2.subscription(Bridge.ROS2DDS, "/uwb/*/range") == "uwb/*/range"
    for wrong in ("uwb/a1", "0/uwb/std_msgs::msg::dds_::String_/x", f"x{rmw}"):
        with pytest.raises(ValueError, match="rmw_zenoh key"):
            ros2.topic_of(Bridge.RMW_ZENOH, wrong)
    with pytest.raises(ValueError, match="topic"):
        ros2.subscription(Bridge.ROS2DDS, "/")


def test_the_subscription_meets_the_keys() -> None:
    zenoh = pytest.importorskip("zenoh")
    expression = zenoh.KeyExpr(ros2.subscription(Bridge.RMW_ZENOH, "/uwb/*"))
    for end in (HASH, "TypeHashNotSupported"):
        assert expression.includes(zenoh.KeyExpr(f"0/uwb/a1/{ros2.RANGE_TYPE}/{end}"))


@pytest.mark.parametrize(
    ("topic", "name", "beacon"),
    [
        ("uwb/a1", BeaconName.TOPIC, "a1"),
        ("/bot1/uwb/a1/range", BeaconName.TOPIC, "a1"),
        ("uwb/a1", BeaconName.FRAME, "uwb_a1"),
    ],
)
def test_which_beacon(topic: str, name: BeaconName, beacon: str) -> None:
    assert ros2.beacon_of(topic, "uwb_a1", name) == beacon


@pytest.mark.parametrize(("topic", "frame"), [("range", "x"), ("", "x"), ("uwb", "")])
def test_no_beacon(topic: str, frame: str) -> None:
    name = BeaconName.FRAME if topic == "uwb" else BeaconName.TOPIC
    with pytest.raises(ValueError, match="no beacon"):
        ros2.beacon_of(topic, frame, name)
