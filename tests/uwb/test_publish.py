"""The publishing side: names, sessions and sequences; from a port, a file or a simulation onto the wire."""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import islice
from pathlib import Path

import pytest
import zenoh

from companion import cli_publish
from companion.exits import Exit
from companion.link.zenoh_ranges import RangeLink
from companion.network_settings import RangesSettings
from companion.publish import MOST_PAIRS, Publication, Sender
from companion.types import LineOfSight
from companion.uwb import sources
from companion.uwb.families import Family, open_parser
from companion.uwb.info import BeaconInfo, decode, decode_many, encode, schema
from companion.uwb.measured import LosRule, Measured
from companion.uwb.sources import Recording, SerialPort, Simulated, Source, SourceError, batches
from companion.wire_range import JSON, MSGPACK, RangeMessage
from companion.wire_range import decode as decode_range
from tests.uwb.network import Router, publishing, router, until
from tests.uwb.samples import JSON_LINES, LEC4, LINKTRACK3, NTF_FOUR, TLV_TAG

NOWHERE = ("tcp/127.0.0.1:1",)


class Wire:
    """What a sender gave away."""

    def __init__(self, publication: Publication) -> None:
        self.announced: dict[str, BeaconInfo] = {}
        self.sent: list[tuple[str, str, RangeMessage]] = []
        self.sender = Sender(
            publication,
            lambda beacon, info: self.announced.update({beacon: decode(info)}),
            lambda *sent: self.sent.append(sent),
            clock_ns=lambda: 1_700_000_000_000_000_000,
        )


def module(**options: object) -> Publication:
    return Publication(SerialPort("/dev/null"), Family.QORVO_CLI, connect=NOWHERE, **options)  # type: ignore[arg-type]


# ------------------------------------------------------------------------------------------ the sender


def test_each_pair_counts_for_itself() -> None:
    wire = Wire(module())
    for peer in ("0x0001", "0x0002", "0x0001"):
        wire.sender.send(Measured(peer=peer, range_m=2.0, los=LineOfSight.NLOS, rssi_dbm=-80.0))
    assert [(b, t, m.seq) for b, t, m in wire.sent] == [
        ("0x0001", "drone", 0),
        ("0x0002", "drone", 0),
        ("0x0001", "drone", 1),
    ]
    message = wire.sent[0][2]
    assert (message.los, message.rssi_dbm, message.t_ns) == (
        LineOfSight.NLOS,
        -80.0,
        1_700_000_000_000_000_000,
    )
    assert set(wire.announced) == {"0x0001", "0x0002"}


def test_a_new_start_is_a_new_session() -> None:
    wires = [Wire(module()) for _ in range(2)]
    for wire in wires:
        wire.sender.send(Measured(peer="a", range_m=1.0))
    assert wires[0].sent[0][2].session != wires[1].sent[0][2].session


def test_names_given_are_the_only_ones() -> None:
    wire = Wire(module(names={"0x0001": "b1"}))
    assert set(wire.announced) == {"b1"}
    for peer in ("0x0001", "0x0002", "b1"):
        wire.sender.send(Measured(peer=peer, range_m=2.0))
    assert [b for b, _, _ in wire.sent] == ["b1"]
    assert sum(wire.sender.tally.refused.values()) == 2


def test_the_module_may_be_the_beacon() -> None:
    wire = Wire(module(beacon="b7"))
    wire.sender.send(Measured(peer="0x0001", range_m=2.0))
    assert [(b, t) for b, t, _ in wire.sent] == [("b7", "0x0001")]
    assert set(wire.announced) == {"b7"}


def test_sigma_from_the_module_then_the_command_line_then_the_calibration() -> None:
    calibrated = BeaconInfo(sigma_m=0.3)
    told = [
        Wire(module(info=calibrated, sigma_m=0.2)),
        Wire(module(info=calibrated)),
        Wire(module()),
    ]
    sigmas = []
    for wire in told:
        wire.sender.send(Measured(peer="a", range_m=2.0, sigma_m=0.1))
        wire.sender.send(Measured(peer="a", range_m=2.0))
        sigmas.append([m.sigma_m for _, _, m in wire.sent])
    assert sigmas == [[0.1, 0.2], [0.1, 0.3], [0.1, None]]


def test_what_is_no_range_is_told_and_not_sent() -> None:
    wire = Wire(module())
    parser = open_parser(Family.QORVO_CLI)
    for m in parser.feed(NTF_FOUR):
        wire.sender.send(m)
    assert len(wire.sent) == 3
    assert "TX_FAILED 1×" in wire.sender.tally.text(parser)


@pytest.mark.parametrize("peer", ["*", "a/b", "**", "", "a" * 65, "$*", "b 1", "ü"])
def test_a_peer_cannot_write_to_another_key(peer: str) -> None:
    wire = Wire(module())
    wire.sender.send(Measured(peer=peer, range_m=2.0))
    assert wire.sent == [] and wire.announced == {}


def test_invented_peers_are_bounded() -> None:
    wire = Wire(module())
    for i in range(1000):
        wire.sender.send(Measured(peer=f"p{i}", range_m=2.0))
        wire.sender.send(Measured(peer=f"p{i}", status=f"S{i}"))
    assert len(wire.sent) == len(wire.announced) == MOST_PAIRS
    assert len(wire.sender.tally.refused) <= 65


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"tag": "a/b"}, "'a/b'"),
        ({"names": {"1": "*"}}, "'\\*'"),
        ({"sigma_m": 0.0}, "sigma"),
        ({"encoding": "text/plain"}, "text/plain"),
        ({"los": LosRule.POWER}, "power"),
    ],
)
def test_what_cannot_be_meant_is_refused(options: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        module(**options)


@pytest.mark.parametrize(
    ("source", "family"),
    [
        (SerialPort("/dev/null", baud=0), Family.QORVO_CLI),
        (SerialPort("/dev/null"), None),
        (Recording(None, speed=-1.0), Family.CSV),
        (Simulated(rate_hz=0.0), None),
        (Simulated(dropout=1.5), None),
        (Simulated(), Family.CSV),
    ],
)
def test_a_source_that_cannot_be_meant_is_refused(source: Source, family: Family | None) -> None:
    with pytest.raises(ValueError):
        Publication(source, family, connect=NOWHERE)


def test_nowhere_to_publish_to() -> None:
    with pytest.raises(ValueError, match="endpoint"):
        Publication(Simulated())


def test_each_beacon_may_tell_something_of_its_own(tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    cli_publish.options(parser)
    told = tmp_path / "beacons.json"
    asked = f"--simulate --zenoh-listen tcp/127.0.0.1:0 --info {told}".split()
    told.write_text('{"b1": {"height_m": 1.2}, "b2": {"bias_m": 0.3}}')
    infos = cli_publish.publication(parser.parse_args(asked)).infos
    assert infos == {"b1": BeaconInfo(height_m=1.2), "b2": BeaconInfo(bias_m=0.3)}
    told.write_text('{"b1": {"height_m": "high"}}')
    with pytest.raises(ValueError, match=r"beacons.json: Expected `float"):
        cli_publish.publication(parser.parse_args(asked))
    told.unlink()
    with pytest.raises(ValueError, match=r"beacons.json: No such file"):
        cli_publish.publication(parser.parse_args(asked))


def test_info_is_validated() -> None:
    info = BeaconInfo(height_m=1.2, antenna_delay_ticks=16_405, bias_m=-0.12, sigma_m=0.05)
    assert decode(encode(info)) == info
    assert decode(b'{"height_m":1.2,"more":[1]}') == BeaconInfo(height_m=1.2)
    assert decode_many(b'{"b1":{"height_m":1.2}}') == {"b1": BeaconInfo(height_m=1.2)}
    assert "height_m" in str(schema())
    for wrong in (b'{"height_m":"1"}', b'{"sigma_m":0}', b"x", b"\xff", b'{"x":' + b"[" * 3000):
        with pytest.raises(ValueError):
            decode(wrong)


# ----------------------------------------------------------------------------------------- the sources


def ranges_of(source: Source, count: int) -> list[tuple[float | None, float | None]]:
    read = batches(source, None, open_parser(Family.CSV), threading.Event(), print)
    return [(m.time_s, m.range_m) for m in islice((m for batch in read for m in batch), count)]


def test_a_simulated_beacon_is_seeded() -> None:
    beacons = (Simulated(rate_hz=1000.0, radius_m=3.0, dropout=0.2, seed=seed) for seed in (1, 1, 2))
    a, b, c = (ranges_of(beacon, 50) for beacon in beacons)
    assert a == b != c
    quiet = ranges_of(Simulated(rate_hz=1000.0, radius_m=3.0, period_s=0.1, sigma_m=0.0), 101)
    assert max(r or 0.0 for _, r in quiet) == pytest.approx(13.0)
    assert min(r or 0.0 for _, r in quiet) == pytest.approx(7.0)


def play(path: Path, family: Family, **options: float) -> list[Measured]:
    source = Recording(path, **options)
    read = batches(source, family, open_parser(family), threading.Event(), print)
    return [m for batch in read for m in batch]


def test_a_recording_is_not_played_faster_than_it_was(tmp_path: Path) -> None:
    path = tmp_path / "ranges.csv"
    path.write_text("t_s,beacon,range_m\n100.0,b1,5.0\n100.1,b1,5.1\n100.3,b1,5.2")
    start = time.monotonic()
    assert [m.range_m for m in play(path, Family.CSV)] == [5.0, 5.1, 5.2]
    assert time.monotonic() - start >= 0.3
    start = time.monotonic()
    assert len(play(path, Family.CSV, speed=3.0)) == 3
    assert time.monotonic() - start >= 0.1


def test_a_recording_whose_clock_was_set_back_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "ranges.csv"
    path.write_text("t_s,beacon,range_m\n100.0,b1,5.0\n100.02,b1,5.1\n3.0,b1,5.2\n3.02,b1,5.3\n")
    assert len(play(path, Family.CSV)) == 4


def test_a_recording_without_times_needs_a_rate(tmp_path: Path) -> None:
    path = tmp_path / "module.log"
    path.write_bytes(NTF_FOUR * 3)
    with pytest.raises(SourceError, match="rate"):
        play(path, Family.QORVO_CLI)
    start = time.monotonic()
    assert len(play(path, Family.QORVO_CLI, rate_hz=10.0)) == 12
    assert time.monotonic() - start >= 0.2


# ------------------------------------------------------------------------------------------ on the wire


class Subscriber:
    """Every range on a site, and how it came."""

    def __init__(self, session: zenoh.Session) -> None:
        self.samples: list[zenoh.Sample] = []
        session.declare_subscriber(
            "uwb/v1/lab/*/*/range", zenoh.handlers.Callback(self.samples.append, indirect=False)
        )

    def read(self) -> list[tuple[str, RangeMessage]]:
        return [(str(s.key_expr), decode_range(s.payload.to_bytes(), str(s.encoding))) for s in self.samples]


@pytest.fixture
def network() -> Iterator[Router]:
    with router() as r:
        yield r


class Module:
    """The far end of a pseudo-terminal: what a UWB module would be."""

    def __init__(self, link: Path) -> None:
        self._far, near = os.openpty()
        tty.setraw(near)
        self._near = near
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(near))
        os.set_blocking(self._far, False)
        self.heard = b""

    def write(self, data: bytes) -> None:
        os.write(self._far, data)

    def listen(self) -> bytes:
        with suppress(BlockingIOError):
            self.heard += os.read(self._far, 4096)
        return self.heard

    def close(self) -> None:
        os.close(self._far)
        os.close(self._near)


@contextmanager
def attached(tmp_path: Path) -> Iterator[tuple[Module, str]]:
    link = tmp_path / "uwb"
    unit = Module(link)
    try:
        yield unit, str(link)
    finally:
        unit.close()


def test_from_a_serial_port_to_a_subscriber(network: Router, tmp_path: Path) -> None:
    with ExitStack() as stack:
        unit, device = stack.enter_context(attached(tmp_path))
        subscriber = Subscriber(network.session)
        publication = Publication(
            SerialPort(device),
            Family.QORVO_CLI,
            names={"0x0001": "b1", "0x0004": "b4"},
            infos={"b1": BeaconInfo(height_m=1.2, sigma_m=0.05)},
            connect=(network.endpoint,),
        )
        running = stack.enter_context(publishing(publication))
        until(lambda: any("connected to 1" in line for line in running.said), "connection")

        def more() -> bool:
            unit.write(b"\xff\x00" + NTF_FOUR)
            return len(subscriber.samples) >= 6

        until(more, "six ranges")
        read = subscriber.read()
        b1 = [m for key, m in read if key == "uwb/v1/lab/b1/drone/range"]
        b4 = [m for key, m in read if key == "uwb/v1/lab/b4/drone/range"]
        assert {m.range_m for m in b1} == {2.45} and {m.range_m for m in b4} == {4.03}
        assert len(b1) + len(b4) == len(read)
        assert [m.seq for m in b1] == list(range(b1[0].seq, b1[0].seq + len(b1)))
        assert len({m.session for m in b1 + b4}) == 1
        assert (b1[0].sigma_m, b4[0].sigma_m) == (0.05, None)
        first = subscriber.samples[0]
        assert str(first.encoding) == JSON
        assert first.priority == zenoh.Priority.REAL_TIME
        assert first.congestion_control == zenoh.CongestionControl.DROP
        (reply,) = network.session.get("uwb/v1/lab/b1/info")
        assert reply.ok is not None
        assert decode(reply.ok.payload.to_bytes()) == BeaconInfo(height_m=1.2, sigma_m=0.05)
        alive = [str(r.ok.key_expr) for r in network.session.liveliness().get("uwb/v1/lab/*/alive") if r.ok]
        assert sorted(alive) == ["uwb/v1/lab/b1/alive", "uwb/v1/lab/b4/alive"]
    assert running.ended == [Exit.OK]
    assert any("TX_FAILED" in line for line in running.said)
    until(lambda: not list(network.session.liveliness().get("uwb/v1/lab/*/alive")), "tokens gone")


def test_the_shell_of_a_silent_module_is_opened(network: Router, tmp_path: Path) -> None:
    with ExitStack() as stack:
        unit, device = stack.enter_context(attached(tmp_path))
        subscriber = Subscriber(network.session)
        source = SerialPort(device)
        running = stack.enter_context(
            publishing(Publication(source, Family.DWM1001_SHELL, connect=(network.endpoint,)))
        )
        until(lambda: unit.listen().endswith(b"\r\rlec\r"), "lec")

        def more() -> bool:
            unit.write(b"dwm> " + LEC4)
            return len(subscriber.samples) >= 4

        until(more, "ranges")
        assert unit.listen() == b"\r\rlec\r"  # typed once: a second `lec` would stop the stream
    assert running.ended == [Exit.OK]


def test_a_module_that_measures_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "_QUIET_S", 0.2)
    with attached(tmp_path) as (unit, device):
        stop = threading.Event()
        read = batches(
            SerialPort(device), Family.DWM1001_SHELL, open_parser(Family.DWM1001_SHELL), stop, print
        )
        next(read)  # opens the port
        unit.write(LEC4)
        deadline = time.monotonic() + 0.5
        measured = 0
        while time.monotonic() < deadline:
            measured += len(next(read))
        assert measured == 4 and unit.listen() == b""
        stop.set()
        assert list(read) == []


def test_tlv_is_asked_for(tmp_path: Path) -> None:
    with attached(tmp_path) as (unit, device):
        stop = threading.Event()
        source = SerialPort(device, poll_hz=50.0)
        read = batches(source, Family.DWM1001_TLV, open_parser(Family.DWM1001_TLV), stop, print)
        measured: list[Measured] = []
        answered = 0

        def more() -> bool:
            nonlocal answered
            measured.extend(next(read))
            asked = unit.listen().count(b"\x0c\x00")
            unit.write(TLV_TAG * (asked - answered))
            answered = asked
            return len(measured) >= 6

        until(more, "three answers")
        stop.set()


def test_a_port_that_goes_away_is_taken_up_again(tmp_path: Path) -> None:
    link = tmp_path / "uwb"
    unit = Module(link)
    stop = threading.Event()
    said: list[str] = []
    read = batches(SerialPort(str(link)), Family.LINKTRACK, open_parser(Family.LINKTRACK), stop, said.append)
    next(read)  # opens the port, which throws away what had come before
    unit.write(LINKTRACK3)
    until(lambda: bool(next(read)), "a range")
    unit.close()
    until(lambda: next(read) == [] and bool(said), "loss noticed")
    unit = Module(link)
    until(lambda: next(read) == [] and len(said) == 2, "port is back")
    unit.write(LINKTRACK3)
    until(lambda: bool(next(read)), "a range")
    stop.set()
    unit.close()
    assert "lost" in said[0] and "back" in said[1]


def test_from_a_file_as_messagepack_and_kept(network: Router, tmp_path: Path) -> None:
    path, kept = tmp_path / "in.jsonl", tmp_path / "kept.jsonl"
    path.write_bytes(JSON_LINES * 20)
    subscriber = Subscriber(network.session)
    publication = Publication(
        Recording(path, speed=100.0),
        Family.JSON_LINES,
        encoding=MSGPACK,
        connect=(network.endpoint,),
        save=kept,
    )
    with publishing(publication) as running:
        until(lambda: bool(running.ended), "the end of the file")
    assert running.ended == [Exit.OK]
    until(lambda: bool(subscriber.samples), "ranges")
    assert str(subscriber.samples[0].encoding) == MSGPACK
    assert subscriber.read()[-1][1].seq == 19
    assert play(kept, Family.JSON_LINES, speed=100.0) == play(path, Family.JSON_LINES, speed=100.0)


def test_from_standard_input(network: Router) -> None:
    subscriber = Subscriber(network.session)
    code = (
        "from companion.publish import *\n"
        f"p = Publication(Recording(None), Family.CSV, connect=({network.endpoint!r},))\n"
        "raise SystemExit(publish(p, lambda line: print(line, flush=True)))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1
    )
    try:
        assert process.stdin is not None
        process.stdin.write("beacon,range_m\n")

        def more() -> bool:
            assert process.stdin is not None
            process.stdin.write("b1,5.5\n")
            return len(subscriber.samples) >= 3

        until(more, "three ranges")
        process.stdin.close()
        assert process.wait(20.0) == Exit.OK
    finally:
        process.kill()
        process.wait()
    assert {(key, m.range_m) for key, m in subscriber.read()} == {("uwb/v1/lab/b1/drone/range", 5.5)}


@pytest.mark.parametrize(
    ("source", "ending"),
    [
        (SerialPort("/dev/no-such-port"), Exit.LINK),
        (Recording(Path("/no/such/file"), speed=1.0), Exit.LINK),
    ],
)
def test_what_cannot_be_opened(network: Router, source: Source, ending: Exit) -> None:
    with publishing(Publication(source, Family.QORVO_CLI, connect=(network.endpoint,))) as running:
        until(lambda: bool(running.ended), "its end")
    assert running.ended == [ending]


def test_endings_of_a_file(network: Router, tmp_path: Path) -> None:
    path = tmp_path / "module.log"
    for content, ending in ((NTF_FOUR, Exit.USAGE), (b"nothing here\n", Exit.NO_RANGES)):
        path.write_bytes(content)
        with publishing(
            Publication(Recording(path), Family.QORVO_CLI, connect=(network.endpoint,))
        ) as running:
            until(lambda r=running: bool(r.ended), "its end")  # type: ignore[misc]
        assert running.ended == [ending]


def test_an_endpoint_that_is_none() -> None:
    with publishing(Publication(Simulated(), connect=("nonsense",))) as running:
        until(lambda: bool(running.ended), "its end")
    assert running.ended == [Exit.LINK]


def test_a_router_that_comes_late_and_goes_and_comes_again() -> None:
    with router() as once:
        endpoint = once.endpoint
    publication = Publication(Simulated(rate_hz=50.0), connect=(endpoint,))
    with publishing(publication) as running:
        until(lambda: any("nobody" in line for line in running.said), "that it is alone")
        for _ in range(2):
            with router(endpoint) as network:
                subscriber = Subscriber(network.session)
                until(lambda s=subscriber: len(s.samples) > 3, "ranges")  # type: ignore[misc]
                session = network.session
                until(lambda s=session: bool(list(s.get("uwb/v1/lab/b1/info"))), "info")  # type: ignore[misc]
                assert len(list(session.liveliness().get("uwb/v1/lab/b1/alive"))) == 1


def test_vehicles_may_connect_to_the_beacon() -> None:
    with router() as probe:
        endpoint = probe.endpoint  # a port that is free once the router is gone
    with publishing(Publication(Simulated(rate_hz=50.0), listen=(endpoint,))):
        link: list[RangeLink] = []
        for _ in range(2):
            link.append(RangeLink(RangesSettings(connect=(endpoint,)), lambda: None))
        try:
            for each in link:
                until(lambda e=each: bool(list(e.receive())), "ranges")  # type: ignore[misc]
        finally:
            for each in link:
                each.close()


def test_a_vehicle_behind_a_router(network: Router) -> None:
    with publishing(Publication(Simulated(rate_hz=50.0), connect=(network.endpoint,))):
        link = RangeLink(RangesSettings(connect=(network.endpoint,)), lambda: None)
        try:
            until(lambda: bool(list(link.receive())), "ranges")
        finally:
            link.close()


def test_nobody_there_is_said() -> None:
    with publishing(Publication(Simulated(rate_hz=100.0), connect=NOWHERE)) as running:
        until(lambda: any("nobody" in line for line in running.said), "that it is alone")
    assert running.ended == [Exit.OK]
