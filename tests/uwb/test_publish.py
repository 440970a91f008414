"""Publishing over real Zenoh: from a port, a file, standard input or a simulation to a subscriber."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from companion.exits import Exit
from companion.link.zenoh_ranges import RangeLink
from companion.network_settings import RangesSettings
from companion.publish import Publication
from companion.range_message import RangeMessage
from companion.uwb.families import Family
from companion.uwb.info import BeaconInfo, decode
from companion.uwb.sources import Recording, SerialPort, Simulated, Source
from companion.wire_range import JSON, MSGPACK
from companion.wire_range import decode as decode_range
from tests.uwb.network import LIMIT_S, Router, publishing, router, until
from tests.uwb.samples import JSON_LINES, LEC4, NTF_FOUR
from tests.uwb.sources import attached, play


class Subscriber:
    """Every range on a site, and how it came."""

    def __init__(self, session: zenoh.Session) -> None:
        self.samples: list[zenoh.Sample] = []
        session.declare_subscriber(
            "uwb/v1/lab/*/*/range", zenoh.handlers.Callback(self.samples.append, indirect=False)
        )

    def read(self) -> list[tuple[str, RangeMessage]]:
        return [(str(s.key_expr), decode_range(s.payload.to_bytes(), str(s.encoding))) for s in self.samples]


def infos(session: zenoh.Session, beacon: str) -> list[BeaconInfo]:
    """What a beacon tells of itself, once for each who answers."""
    replies = session.get(f"uwb/v1/lab/{beacon}/info")
    return [decode(reply.ok.payload.to_bytes()) for reply in replies if reply.ok]


def alive(session: zenoh.Session) -> list[str]:
    """The tokens that are held."""
    replies = session.liveliness().get("uwb/v1/lab/*/alive")
    return sorted(str(reply.ok.key_expr) for reply in replies if reply.ok)


@pytest.fixture
def network() -> Iterator[Router]:
    with router() as r:
        yield r


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
        told = BeaconInfo(height_m=1.2, sigma_m=0.05)
        until(lambda: infos(network.session, "b1") == [told], "what b1 tells of itself")
        tokens = ["uwb/v1/lab/b1/alive", "uwb/v1/lab/b4/alive"]
        until(lambda: alive(network.session) == tokens, "the tokens of both")
    assert running.ended == [Exit.OK]
    assert any("TX_FAILED" in line for line in running.said)
    until(lambda: not alive(network.session), "tokens gone")


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


def test_a_full_disk_ends_the_keeping_and_not_the_ranges(network: Router, tmp_path: Path) -> None:
    path = tmp_path / "in.jsonl"
    path.write_bytes(JSON_LINES * 20)
    subscriber = Subscriber(network.session)
    publication = Publication(
        Recording(path, speed=100.0),
        Family.JSON_LINES,
        connect=(network.endpoint,),
        save=Path("/dev/full"),
    )
    with publishing(publication) as running:
        until(lambda: bool(running.ended), "the end of the file")
    assert running.ended == [Exit.OK]
    assert sum("No space left" in line for line in running.said) == 1
    until(lambda: len(subscriber.samples) >= 20, "ranges")


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
        assert process.wait(LIMIT_S) == Exit.OK
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
                until(lambda s=network.session: len(infos(s, "b1")) == 1, "info")  # type: ignore[misc]
                until(lambda s=network.session: len(alive(s)) == 1, "token")  # type: ignore[misc]


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
    with publishing(Publication(Simulated(rate_hz=100.0), connect=("tcp/127.0.0.1:1",))) as running:
        until(lambda: any("nobody" in line for line in running.said), "that it is alone")
    assert running.ended == [Exit.OK]
