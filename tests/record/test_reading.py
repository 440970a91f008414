"""Files that are cut, damaged or foreign: one clear line, and what could be read."""

from __future__ import annotations

import io
import re
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer

from companion.flight_writer import FlightWriter
from companion.record import METADATA, _checksum
from companion.recording import RecordError, Recording, read
from companion.replay import replay
from companion.types import Tick
from tests.record.flights import flown, start

MANY = settings(
    max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow]
)


BEGIN = start()
ITEMS = flown()[:900]


def chunked() -> bytes:
    """A flight in chunks of a hundred records, as a recorder leaves them."""
    stream = io.BytesIO()
    writer = FlightWriter(stream, BEGIN)
    for number, item in enumerate(ITEMS):
        writer.write(item)
        if number % 100 == 99:
            writer.flush()
    writer.finish()
    return stream.getvalue()


WHOLE = chunked()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return read_bytes(tmp_path_factory.mktemp("whole"), WHOLE)


def read_bytes(directory: Path, data: bytes) -> Recording:
    path = directory / "f.mcap"
    path.write_bytes(data)
    return read(path)


def test_the_whole_file_is_sound(whole: Recording) -> None:
    assert whole.finished and not whole.problems and whole.lost == 0
    assert replay(whole).equal


@given(cut=st.integers(0, len(WHOLE) - 1))
@MANY
def test_a_file_cut_anywhere_gives_what_came_before(tmp_path: Path, cut: int) -> None:
    try:
        recording = read_bytes(tmp_path, WHOLE[:cut])
    except RecordError as error:
        assert "\n" not in str(error) and cut < 14_000, "only the first of its chunks is indispensable"
        return
    assert recording.problems or cut >= len(WHOLE) - 8, (
        "a cut is told, but for the magic bytes at the very end"
    )
    back = [item for step in recording.steps for item in (step.event, *step.outputs)]
    assert back == ITEMS[: len(back)]
    result = replay(recording)
    assert result.equal and result.stopped is None


@given(at=st.integers(0, len(WHOLE) - 1), flip=st.integers(1, 255))
@MANY
def test_a_damaged_byte_never_passes_as_something_else(tmp_path: Path, at: int, flip: int) -> None:
    data = bytearray(WHOLE)
    data[at] ^= flip
    try:
        recording = read_bytes(tmp_path, bytes(data))
    except RecordError as error:
        assert "\n" not in str(error)
        return
    for step in recording.steps:
        assert step.event == ITEMS[step.number]
        assert list(step.outputs) == [ITEMS[step.number + 1 + slot] for slot in step.slots]
    assert recording.start == BEGIN
    assert recording.lost == 0 or recording.problems


@given(st.binary(max_size=300))
@MANY
def test_random_bytes_are_refused_in_one_line(tmp_path: Path, noise: bytes) -> None:
    for data in (noise, WHOLE[:8] + noise):
        with pytest.raises(RecordError) as refused:
            read_bytes(tmp_path, data)
        assert "\n" not in str(refused.value)


def test_a_flight_of_which_nothing_is_left_is_not_the_same_bit_for_bit(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"nothing of the flight can be read: the end is missing"):
        read_bytes(tmp_path, WHOLE[:10_000])


def test_a_damaged_chunk_costs_only_itself(tmp_path: Path, whole: Recording) -> None:
    data = bytearray(WHOLE)
    chunks = [found.start() for found in re.finditer(b"zstd", WHOLE)]  # then once more in the index
    data[chunks[len(chunks) // 4] + 200] ^= 0xFF
    recording = read_bytes(tmp_path, bytes(data))
    assert 50 <= recording.lost <= 150
    assert recording.steps[-1] == whole.steps[-1]
    assert recording.problems[0].startswith("damaged at byte ")
    result = replay(recording)
    assert result.equal and 0 < result.compared < result.outputs
    assert result.stopped is not None and result.stopped.endswith("the record lacks events")


def test_a_file_without_its_channels_is_read_by_the_summarys(tmp_path: Path, whole: Recording) -> None:
    data = bytearray(WHOLE)
    data[WHOLE.index(b"zstd") + 200] ^= 0xFF  # in the first chunk, which holds the channels
    recording = read_bytes(tmp_path, bytes(data))
    assert recording.problems and recording.steps == whole.steps


# -------------------------------------------------------------------------------------------- foreign


def foreign() -> bytes:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start(profile="ros2")
    channel = writer.register_channel("/imu", "json", writer.register_schema("Imu", "jsonschema", b"{}"))
    writer.add_message(channel, 1, b"{}", 1)
    writer.finish()  # type: ignore[no-untyped-call]
    return stream.getvalue()


@pytest.mark.parametrize(
    ("data", "says"),
    [
        (b"", "the file is empty"),
        (b"time,range\n0,1\n", "not an MCAP file"),
        (b"\x89PNG\r\n\x1a\n", "not an MCAP file"),
        (foreign(), "an MCAP file, but not a flight of this app; topics: /imu"),
        (WHOLE[:8], "no flight can be read: the end is missing: it stops at byte 8 of 8"),
    ],
)
def test_foreign_files_are_named(tmp_path: Path, data: bytes, says: str) -> None:
    with pytest.raises(RecordError) as refused:
        read_bytes(tmp_path, data)
    assert str(refused.value).startswith(f"{tmp_path / 'f.mcap'}: {says}")
    assert "\n" not in str(refused.value)


def test_no_file_and_a_directory_are_named(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match="No such file"):
        read(tmp_path / "none.mcap")
    with pytest.raises(RecordError, match="Is a directory"):
        read(tmp_path)


def with_metadata(directory: Path, **values: str) -> Path:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    fields = {**BEGIN.as_metadata(), **values}
    fields["checksum"] = _checksum({key: value for key, value in fields.items() if key != "checksum"})
    writer.add_metadata(METADATA, fields)
    writer.finish()  # type: ignore[no-untyped-call]
    path = directory / "f.mcap"
    path.write_bytes(stream.getvalue())
    return path


def test_a_newer_format_is_refused(tmp_path: Path) -> None:
    with pytest.raises(RecordError, match=r"f\.mcap: a flight in format 2; this version reads 1$"):
        read(with_metadata(tmp_path, format="2"))


def test_settings_of_another_version_are_named(tmp_path: Path) -> None:
    recording = read(with_metadata(tmp_path, config='{"guidance":{"telepathy":true}}'))
    with pytest.raises(
        RecordError, match=r"contains unknown field `telepathy`.*recorded by companion"
    ) as refused:
        replay(recording)
    assert "\n" not in str(refused.value)


def test_an_event_of_another_version_is_counted(tmp_path: Path) -> None:
    stream = io.BytesIO()
    writer = Writer(stream)
    writer.start()
    writer.add_metadata(METADATA, BEGIN.as_metadata())
    schema = writer.register_schema("any", "jsonschema", b"{}")
    channel = writer.register_channel("/event/tick", "json", schema)
    for number, data in enumerate((b'{"event":"tick","t_ns":1}', b'{"event":"tick","t_ns":"now"}')):
        writer.add_message(channel, 1, data, 1, number)
    writer.finish()  # type: ignore[no-untyped-call]
    recording = read_bytes(tmp_path, stream.getvalue())
    assert [step.event for step in recording.steps] == [Tick(t_ns=1)]
    assert recording.problems == ("1 × unreadable /event/tick: Expected `int`, got `str` - at `$.t_ns`",)
