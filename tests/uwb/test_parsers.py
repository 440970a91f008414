"""The parsers, on the bytes that modules send, on damaged bytes and on bytes cut anywhere."""

from __future__ import annotations

from random import Random

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.types import LineOfSight
from companion.uwb.families import Family, open_parser
from companion.uwb.measured import LosRule, Measured, ParseDefect
from tests.uwb import fuzz
from tests.uwb.samples import (
    LEC3,
    LEC4,
    LINKTRACK3,
    NTF,
    NTF_FOUR,
    SAMPLES,
    TLV_TAG,
    UCI,
    Sample,
    linktrack2,
    octets,
    with_sum,
)

each_sample = pytest.mark.parametrize("sample", SAMPLES, ids=lambda s: s.name)


@each_sample
def test_a_sample_is_read_exactly(sample: Sample) -> None:
    parser = open_parser(sample.family)
    assert parser.feed(sample.data) == sample.measured
    assert not parser.defects


@each_sample
def test_byte_by_byte_it_is_the_same(sample: Sample) -> None:
    parser = open_parser(sample.family)
    measured = [m for i in range(len(sample.data)) for m in parser.feed(sample.data[i : i + 1])]
    assert measured == sample.measured
    assert not parser.defects


@each_sample
@pytest.mark.parametrize(
    "garbage", [b"\x00\xff\x55\x05", b"SESSION_INFO_NTF: {", b"40 01\n", UCI[:20], NTF[:60]]
)
def test_it_is_read_again_after_garbage(sample: Sample, garbage: bytes) -> None:
    parser = open_parser(sample.family)
    parser.feed(garbage + b"\n")
    parser.feed(sample.data * (parser.limit_bytes // len(sample.data) + 2))
    assert parser.feed(sample.data) == sample.measured


cut_streams = st.tuples(
    st.sampled_from(SAMPLES),
    st.integers(0, 2**32),
    st.lists(st.integers(1, 400), max_size=40),
)


@given(cut_streams)
@settings(max_examples=200)
def test_the_result_does_not_depend_on_how_the_stream_is_cut(
    stream: tuple[Sample, int, list[int]],
) -> None:
    sample, seed, sizes = stream
    random = Random(seed)
    data = b"".join(fuzz.damaged(random, sample.family) for _ in range(3))
    whole, cut = open_parser(sample.family), open_parser(sample.family)
    at, measured = 0, []
    for size in [*sizes, len(data)]:
        measured += cut.feed(data[at : at + size])
        at += size
    assert whole.feed(data) == measured
    assert (whole.defects, whole.skipped_bytes, whole.held_bytes) == (
        cut.defects,
        cut.skipped_bytes,
        cut.held_bytes,
    )


@given(st.sampled_from(list(Family)), st.lists(st.binary(max_size=300), max_size=10))
@settings(max_examples=300)
def test_no_bytes_raise_and_little_is_kept(family: Family, chunks: list[bytes]) -> None:
    parser = open_parser(family)
    for chunk in chunks:
        fuzz.check(parser, parser.feed(chunk))


def test_a_short_run_of_the_fuzzer() -> None:
    figures = fuzz.run(3_000, seed=2)
    for family in Family:
        assert figures[f"{family.value}: measurements"] > 100


@pytest.mark.parametrize(
    ("family", "endless"),
    [
        (Family.QORVO_CLI, b"SESSION_INFO_NTF: {session_handle=" + b"1" * 100_000),
        (Family.QORVO_CLI, b'{"Block":' + b"1" * 100_000),
        (Family.DWM1001_SHELL, b"DIST,4" + b",AN0" * 50_000),
        (Family.JSON_LINES, b'{"beacon":' + b"[" * 100_000),
        (Family.CSV, b"a," * 50_000),
        (Family.FIRA_UCI, octets("720000ff") + bytes(255) + octets("720000ff") * 60_000),
        (Family.LINKTRACK, octets("5505ffff") * 50_000),
    ],
)
def test_a_message_without_end_is_given_up(family: Family, endless: bytes) -> None:
    parser = open_parser(family)
    for at in range(0, len(endless), 1000):
        assert parser.feed(endless[at : at + 1000]) == []
        assert parser.held_bytes <= parser.limit_bytes
    assert parser.defects
    good = next(s for s in SAMPLES if s.family is family and s.measured)
    parser.feed(b"\n" + good.data * (parser.limit_bytes // len(good.data) + 2))
    assert parser.feed(good.data) == good.measured


def test_a_record_nested_too_deep_is_a_defect() -> None:
    parser = open_parser(Family.JSON_LINES)
    assert parser.feed(b'{"beacon":"a","range_m":1.0,"x":' + b"[" * 3000 + b"\n") == []
    assert parser.defects == {ParseDefect.FIELD: 1}


# -------------------------------------------------------------------------------------------- DWM3001CDK


@pytest.mark.parametrize(
    ("damage", "defect"),
    [
        ((b"n_measurements=4", b"n_measurements=5"), ParseDefect.LENGTH),
        ((b"0x0002", b"0x0001"), ParseDefect.DUPLICATE),
        ((b"distance[cm]=312", b"dist"), ParseDefect.FIELD),
        ((b", distance[cm]=312", b""), ParseDefect.FIELD),
        ((b"=312", b"=9999999"), ParseDefect.FIELD),
        ((b'"TX_FAILED"];\r\n', b'"TX_'), ParseDefect.FIELD),
    ],
)
def test_a_notification_that_is_not_whole_gives_nothing(
    damage: tuple[bytes, bytes], defect: ParseDefect
) -> None:
    parser = open_parser(Family.QORVO_CLI)
    assert parser.feed(NTF_FOUR.replace(*damage)) == []
    assert parser.defects == {defect: 1}


def test_a_cut_notification_does_not_swallow_the_next() -> None:
    parser = open_parser(Family.QORVO_CLI)
    assert [m.range_m for m in parser.feed(NTF_FOUR[:150] + NTF)] == [0.71]
    assert parser.defects == {ParseDefect.LENGTH: 1}


def test_other_output_of_the_firmware_is_skipped() -> None:
    other = (
        b'SESSION_STATUS_NTF: {state="ACTIVE", reason="State change with session management commands"}\r\n'
        b'ok\r\nJS0042{"Info":{"Device":"DWM3001CDK"}}\r\n'
        b"RANGE_DIAGNOSTICS_NTF: {n_reports=1\r\n\r [msg_id=CONTROL, action=TX, antenna_set=0, "
        b"frame_status={SUCCESS: 1, WIFI_COEX: 0, GRANT_DURATION_EXCEEDED: 0}, cfo_present=0]}\r\n"
    )
    parser = open_parser(Family.QORVO_CLI)
    assert [m.range_m for m in parser.feed(other + NTF + other + NTF)] == [0.71, 0.71]
    assert not parser.defects
    assert parser.skipped_bytes > 2 * len(other) - 20


# -------------------------------------------------------------------------------------------------- UCI


@pytest.mark.parametrize(
    ("rule", "byte", "los"),
    [
        (LosRule.UNKNOWN, 0, LineOfSight.UNKNOWN),
        (LosRule.ZERO_IS_LOS, 0, LineOfSight.LOS),
        (LosRule.ZERO_IS_LOS, 1, LineOfSight.NLOS),
        (LosRule.ZERO_IS_LOS, 255, LineOfSight.UNKNOWN),
        (LosRule.ONE_IS_LOS, 0, LineOfSight.NLOS),
        (LosRule.ONE_IS_LOS, 1, LineOfSight.LOS),
        (LosRule.ONE_IS_LOS, 255, LineOfSight.UNKNOWN),
    ],
)
def test_the_line_of_sight_byte_is_read_as_told(rule: LosRule, byte: int, los: LineOfSight) -> None:
    data = bytearray(UCI)
    data[32] = byte
    assert open_parser(Family.FIRA_UCI, rule).feed(bytes(data))[0].los is los


def test_segments_are_joined() -> None:
    payload = UCI[4:]
    cut = octets("72000030") + payload[:48] + octets("62000027") + payload[48:]
    assert open_parser(Family.FIRA_UCI).feed(cut) == open_parser(Family.FIRA_UCI).feed(UCI)


def test_long_addresses_and_vendor_data() -> None:
    block = octets("0807060504030201 00 ff 3930 0000 00 0000 00 0000 00 0000 00 00 00 0000000000")
    payload = UCI[4:19] + b"\x01" + UCI[20:28] + b"\x01" + block + b"vendor"
    measured = open_parser(Family.FIRA_UCI).feed(octets("620000") + bytes([len(payload)]) + payload)
    assert measured == [Measured(peer="0x0102030405060708", range_m=123.45, sequence=7)]


@pytest.mark.parametrize(
    ("code", "distance", "status"),
    [("1b", "8900", "NEGATIVE_DISTANCE"), ("00", "ffff", "NO_DISTANCE"), ("51", "8900", "STATUS_0x51")],
)
def test_what_is_no_distance_has_a_status(code: str, distance: str, status: str) -> None:
    data = UCI[:31] + octets(code, "00", distance) + UCI[35:]
    first = open_parser(Family.FIRA_UCI).feed(data)[0]
    assert (first.range_m, first.status) == (None, status)


def test_sessions_that_measure_no_distance_are_skipped() -> None:
    parser = open_parser(Family.FIRA_UCI)
    assert parser.feed(UCI[:17] + b"\x03" + UCI[18:] + octets("6102000601000000 0200")) == []
    assert not parser.defects


# ---------------------------------------------------------------------------------------------- DWM1001


@pytest.mark.parametrize(
    "line",
    [
        # As captured: a piece of the last anchor was printed twice.
        LEC4.replace(b"AN3,1150,0.00,0.00,2.25,3.19", b"AN3,15BA,0.00,0,AN3,15BA,0.00,0.00,0.00,0.00"),
        LEC3.replace(b"DIST,3", b"DIST,4"),
        LEC3.replace(b"AN2,2BA2,0.00,0.00,0.00,3.13", b"AN2,2ED0,0.00,0.00,0.00,3.13"),
        LEC3.replace(b"3.13", b"3.1"),
        LEC3.replace(b"2.20", b"2..20"),
        LEC3.replace(b",POS,1.76,1.59", b",POS,1.76"),
        LEC3.replace(b"2F2F", b"2F2"),
        LEC3[5:],
        b"022E[7.94,8.03,0.00]=3.38 9280[7.95,0.0]=5.49\r\n",
        b"022E[7.94,8.03,0.00]=3.38 022E[7.94,8.03,0.00]=3.38\r\n",
    ],
)
def test_a_broken_line_gives_nothing(line: bytes) -> None:
    parser = open_parser(Family.DWM1001_SHELL)
    assert parser.feed(line) == []
    assert sum(parser.defects.values()) == 1
    assert len(parser.feed(LEC4)) == 4


def test_prompts_echoes_and_positions_are_skipped() -> None:
    parser = open_parser(Family.DWM1001_SHELL)
    lines = b"\r\ndwm> lec\r\ndwm> " + LEC3 + b"dwm> POS,7.10,5.24,-2.03,53\r\n usage: lec\r\n"
    assert len(parser.feed(lines)) == 3
    assert not parser.defects


def test_no_position_solution_yet() -> None:
    parser = open_parser(Family.DWM1001_SHELL)
    assert [m.range_m for m in parser.feed(b"DIST,1,AN0,1151,5.00,8.00,2.25,6.44\r\nDIST,0\r\n")] == [6.44]
    assert not parser.defects


def test_other_firmware_on_the_same_module_is_refused() -> None:
    """LEAPS puts a time and flags before the count: 0x56 bytes for four anchors."""
    leaps = TLV_TAG[:18] + octets("4956 01020304 00 04") + bytes(80)
    parser = open_parser(Family.DWM1001_TLV)
    assert parser.feed(leaps) == []
    assert parser.defects == {ParseDefect.LENGTH: 1}
    assert parser.feed(TLV_TAG[:30]) == []
    assert len(parser.feed(TLV_TAG[30:])) == 2


# -------------------------------------------------------------------------------------------- LinkTrack


@pytest.mark.parametrize(
    ("frame", "defect"),
    [
        (LINKTRACK3[:-1] + b"\x00", ParseDefect.CHECKSUM),
        (with_sum(LINKTRACK3[:20] + b"\x01" + LINKTRACK3[21:-1]), ParseDefect.LENGTH),
        (with_sum(LINKTRACK3[:29] + b"\x00" + LINKTRACK3[30:-1]), ParseDefect.DUPLICATE),
        (with_sum(LINKTRACK3[:21] + b"\x09" + LINKTRACK3[22:-1]), ParseDefect.FIELD),
        (with_sum(LINKTRACK3[:2] + b"\x25" + LINKTRACK3[3:-1]), ParseDefect.LENGTH),
    ],
)
def test_a_frame_that_contradicts_itself_gives_nothing(frame: bytes, defect: ParseDefect) -> None:
    parser = open_parser(Family.LINKTRACK)
    assert parser.feed(frame) == []
    assert parser.defects == {defect: 1}
    assert len(parser.feed(LINKTRACK3)) == 2


def test_line_of_sight_from_the_two_powers() -> None:
    hints = [m.los for m in open_parser(Family.LINKTRACK, LosRule.POWER).feed(linktrack2())]
    assert hints == [LineOfSight.LOS, LineOfSight.NLOS]


@pytest.mark.parametrize(
    ("family", "rule"),
    [
        (Family.FIRA_UCI, LosRule.POWER),
        (Family.LINKTRACK, LosRule.ONE_IS_LOS),
        (Family.QORVO_CLI, LosRule.ZERO_IS_LOS),
    ],
)
def test_a_rule_that_cannot_apply_is_refused(family: Family, rule: LosRule) -> None:
    with pytest.raises(ValueError, match=rule.value):
        open_parser(family, rule)


# ---------------------------------------------------------------------------------------------- records


def test_measurements_written_as_lines_are_read_back() -> None:
    everything = [m for s in SAMPLES for m in s.measured]
    lines = b"".join(msgspec.json.encode(m) + b"\n" for m in everything)
    assert open_parser(Family.JSON_LINES).feed(lines) == everything


@pytest.mark.parametrize(
    "line",
    [
        b'{"range_m":1.0}',
        b'{"beacon":"b1"}',
        b'{"beacon":"b1","range_m":-1.0}',
        b'{"beacon":"b1","range_m":0}',
        b'{"beacon":"b1","range_m":1e400}',
        b'{"beacon":"b1","range_m":NaN}',
        b'{"beacon":"b1","range_m":20000.0}',
        b'{"beacon":"b1","range_m":"1.0"}',
        b'{"beacon":"b1","range_m":1.0,"los":"yes"}',
        b'{"beacon":"b1","range_m":1.0,"status":"RX_TIMEOUT"}',
        b'{"beacon":"\xff","range_m":1.0}',
        b"[1, 2]",
        b"hello",
    ],
)
def test_a_line_that_is_no_range_is_counted(line: bytes) -> None:
    parser = open_parser(Family.JSON_LINES)
    assert parser.feed(line + b"\n") == []
    assert parser.defects == {ParseDefect.FIELD: 1}


def test_csv_needs_its_header_and_its_columns() -> None:
    parser = open_parser(Family.CSV)
    assert parser.feed(b"12.4,b1,5.0\n") == []
    assert parser.defects == {ParseDefect.FIELD: 1}
    assert parser.feed(b"beacon,range_m,extra\nb1,5.0,x\nb1,5.0\nb1,nan,x\nb1,5.5,\n") == [
        Measured(peer="b1", range_m=5.0),
        Measured(peer="b1", range_m=5.5),
    ]
    assert parser.defects == {ParseDefect.FIELD: 2, ParseDefect.LENGTH: 1}


def test_recordings_joined_end_to_end() -> None:
    parser = open_parser(Family.CSV)
    data = b"t_s,beacon,range_m\n1.0,b1,5.0\nbeacon,t_s,range_m\nb1,1.5,6.0\n"
    assert [(m.time_s, m.range_m) for m in parser.feed(data)] == [(1.0, 5.0), (1.5, 6.0)]
