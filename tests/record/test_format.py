"""What a file holds: every type bit for bit, schemas that viewers read, the views derived for them."""

from __future__ import annotations

import io
from enum import Enum
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

import msgspec
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader

from companion.foxglove import (
    FrameTransform,
    LinkStatistics,
    Log,
    PoseInFrame,
    PosesInFrame,
    View,
    viewer_schema,
)
from companion.foxglove_views import Views
from companion.record import RECORDED, topic_of
from companion.recording import read
from companion.types import (
    Attitude,
    Estimate,
    Event,
    FlightMode,
    Output,
    Phase,
    PhaseChange,
    RangeSample,
    Severity,
    Status,
    Tick,
)
from tests.record.flights import EPOCH_NS, Item, as_bytes, flown, in_file, start


def of_type(kind: Any) -> st.SearchStrategy[Any]:
    """Every value of a field's type that may be recorded."""
    if kind is int:
        return st.integers(-(2**63), 2**63 - 1)
    if kind is float:
        return st.floats(allow_nan=False, allow_infinity=False)
    if kind is str:
        return st.text(max_size=20)
    if kind is bool or kind is NoneType:
        return st.from_type(kind)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return st.sampled_from(list(kind))
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return struct_of(kind)
    if get_origin(kind) in (Union, UnionType):
        return st.one_of(*map(of_type, get_args(kind)))
    if get_origin(kind) is tuple:
        return st.lists(of_type(get_args(kind)[0]), max_size=3).map(tuple)
    assert get_origin(kind) is dict
    return st.dictionaries(*map(of_type, get_args(kind)), max_size=3)


def struct_of(kind: type[msgspec.Struct]) -> st.SearchStrategy[Any]:
    fields = {
        name: of_type(hint) for name, hint in get_type_hints(kind).items() if name in kind.__struct_fields__
    }
    fields |= {"t_ns": st.integers(0, 2**62)} if "t_ns" in fields else {}
    return st.builds(kind, **fields)


ITEMS = st.one_of(*map(struct_of, RECORDED.values()))


@given(st.lists(ITEMS, max_size=12))
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow])
def test_every_event_and_output_reads_back_bit_for_bit(tmp_path: Path, items: list[Item]) -> None:
    items = [Tick(t_ns=0), *items]
    recording = read(in_file(tmp_path / "f.mcap", items))
    back = [item for step in recording.steps for item in (step.event, *step.outputs)]
    assert back == items
    assert [repr(item) for item in back] == [
        repr(item) for item in items
    ]  # −0.0 and 0.0 are equal but not the same
    assert recording.finished and not recording.problems


def leaves(kind: type) -> set[type]:
    below: list[type] = kind.__subclasses__()
    return {leaf for sub in below for leaf in leaves(sub)} if below else {kind}


def test_no_event_and_no_output_is_forgotten() -> None:
    assert set(RECORDED.values()) == leaves(Event) | leaves(Output)
    assert topic_of(RangeSample) == "/event/range"


def test_configuration_versions_and_both_clocks_are_there(tmp_path: Path) -> None:
    begin = start()
    recording = read(in_file(tmp_path / "f.mcap", flown()[:200], begin))
    assert recording.start == begin
    assert recording.settings.guidance.speed_m_s > 0.0
    assert len(begin.digest) == 16 and begin.versions.keys() >= {
        "companion",
        "source",
        "python",
        "machine",
        "mcap",
    }
    assert begin.unix_of(1_000_000_000) == EPOCH_NS + 1_000_000_000


# --------------------------------------------------------------------------------------------- viewers


@pytest.fixture(scope="module")
def flight() -> bytes:
    return as_bytes(enumerate(flown()), start())


PLAIN = {"boolean", "string", "number", "integer", "object", "array"}


def assert_viewable(schema: dict[str, Any]) -> None:
    """The part of JSON Schema that Foxglove's and Lichtblick's reader takes."""
    assert schema["type"] in PLAIN, schema
    assert not {"$ref", "anyOf", "oneOf", "allOf"} & schema.keys()
    if schema["type"] == "object":
        for field in schema["properties"].values():
            assert_viewable(field)
    if schema["type"] == "array":
        assert schema["items"]["type"] != "array"
        assert_viewable(schema["items"])


def test_every_channel_opens_in_viewers_without_a_plug_in(flight: bytes) -> None:
    summary = make_reader(io.BytesIO(flight)).get_summary()
    assert summary is not None
    for channel in summary.channels.values():
        schema = summary.schemas[channel.schema_id]  # PlotJuggler wants one for every channel
        assert (channel.message_encoding, schema.encoding) == ("json", "jsonschema")
        assert_viewable(msgspec.json.decode(schema.data))
    topics = {channel.topic for channel in summary.channels.values()}
    assert topics == RECORDED.keys() | {"/pose", "/target", "/path", "/tf", "/log", "/links"}


def test_every_message_has_the_fields_that_its_schema_requires(flight: bytes) -> None:
    seen = set()
    for schema, channel, message in make_reader(io.BytesIO(flight)).iter_messages():
        assert schema is not None
        rules, content = msgspec.json.decode(schema.data), msgspec.json.decode(message.data)
        assert set(rules["required"]) <= content.keys() <= rules["properties"].keys()
        assert message.log_time > EPOCH_NS - 1
        seen.add(channel.topic)
    assert seen >= {
        "/event/range",
        "/output/setpoint",
        "/output/status",
        "/pose",
        "/target",
        "/path",
        "/tf",
        "/log",
    }


WELL_KNOWN: dict[type, set[str]] = {
    PoseInFrame: {"timestamp", "frame_id", "pose"},
    PosesInFrame: {"timestamp", "frame_id", "poses"},
    FrameTransform: {"timestamp", "parent_frame_id", "child_frame_id", "translation", "rotation"},
    Log: {"timestamp", "level", "message", "name", "file", "line"},
}
"""Required fields of Foxglove's well-known schemas."""


@pytest.mark.parametrize("kind", WELL_KNOWN, ids=lambda kind: kind.__name__)
def test_derived_messages_have_foxgloves_fields(kind: type) -> None:
    schema = viewer_schema(kind, "")
    assert schema["properties"].keys() == WELL_KNOWN[kind]
    assert schema["properties"]["timestamp"]["properties"].keys() == {"sec", "nsec"}


def status(t_s: float, x_m: float, y_m: float, heading_rad: float, estimate: Estimate | None) -> Status:
    return Status(
        t_ns=round(t_s * 1e9),
        phase=Phase.APPROACH,
        reason="",
        awaited=(),
        mode=FlightMode.OFFBOARD,
        armed=True,
        range_m=None,
        range_age_s=None,
        ranges_accepted=0,
        rejected={},
        malformed={},
        telemetry_age_s=None,
        estimate=estimate,
        speed_m_s=0.0,
        yaw_rate_rad_s=0.0,
        x_m=x_m,
        y_m=y_m,
        height_m=3.0,
        heading_rad=heading_rad,
        path_m=0.0,
        engaged_s=0.0,
        captured=False,
    )


def of(views: Views, item: Item) -> list[tuple[str, View]]:
    return views.of(item, EPOCH_NS + item.t_ns)


def test_the_target_on_the_right_is_drawn_on_the_right() -> None:
    estimate = Estimate(distance_m=2.0, distance_sigma_m=0.1, bearing_rad=1.5707963, bearing_sigma_rad=0.1)
    drawn = dict(of(Views(), status(1.0, 1.0, 1.0, 0.0, estimate)))  # looking East: right is South
    target = drawn["/target"]
    assert isinstance(target, PoseInFrame)
    assert (target.pose.position.x, target.pose.position.y) == pytest.approx((1.0, -1.0), abs=1e-3)
    assert target.timestamp.sec == EPOCH_NS // 10**9 + 1


def test_the_path_is_bounded_and_keeps_its_beginning() -> None:
    v = Views()
    path = None
    for i in range(20_000):
        path = dict(of(v, status(i * 0.1, i * 0.2, 0.0, 0.0, None))).get("/path", path)
    assert isinstance(path, PosesInFrame)
    assert 64 <= len(path.poses) <= 256
    assert path.poses[0].position.x == 0.0 and path.poses[-1].position.x > 3_900.0


def test_without_a_position_nothing_is_drawn() -> None:
    nowhere = msgspec.structs.replace(status(1.0, 0.0, 0.0, 0.0, None), x_m=None)
    assert of(Views(), nowhere) == []


def test_a_phase_change_is_a_line_in_the_log() -> None:
    change = PhaseChange(
        t_ns=0, before=Phase.APPROACH, after=Phase.STALL, reason="why", severity=Severity.WARNING
    )
    ((topic, log),) = of(Views(), change)
    assert topic == "/log" and isinstance(log, Log)
    assert (log.level, log.message) == (3, "approach → stall: why")


def test_link_statistics_tell_rates_and_clock_offsets() -> None:
    v, told = Views(), []
    for i in range(401):
        t_ns = i * 5_000_000
        sent = EPOCH_NS + t_ns - 40_000_000 - (i % 4) * 1_000_000  # its clock and transport: 40 to 43 ms
        sample = RangeSample(t_ns=t_ns, beacon="b1", session="s", seq=i, range_m=5.0, sent_t_ns=sent)
        attitude = Attitude(t_ns=t_ns, heading_rad=0.0, yaw_rate_rad_s=0.0, boot_ms=7_000 + i * 5)
        told += [view for item in (sample, attitude) for _, view in of(v, item)]
    first = told[0]
    assert len(told) == 2 and isinstance(first, LinkStatistics)
    assert (first.ranges, first.attitudes, first.period_s) == (200, 200, 1.0)
    assert first.vehicle_boot_s == pytest.approx(-7.0)
    (beacon,) = first.beacons
    assert (beacon.clock_offset_s, beacon.jitter_s) == pytest.approx((0.040, 0.003))


def test_a_flood_of_made_up_beacons_takes_bounded_memory() -> None:
    v, told = Views(), []
    for i in range(2_001):
        item = RangeSample(t_ns=i * 500_000, beacon=f"b{i}", session="s", seq=0, range_m=1.0)
        told += [view for _, view in of(v, item)]
    assert isinstance(told[0], LinkStatistics)
    assert len(told[0].beacons) == 64 and told[0].ranges == 2_000


def test_a_type_that_viewers_cannot_read_is_refused() -> None:
    class Odd(msgspec.Struct):
        value: int | str

    with pytest.raises(ValueError, match="cannot be viewed"):
        viewer_schema(Odd, "odd")
