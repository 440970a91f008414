"""The mock in a process of its own, on real UDP and real Zenoh."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import zenoh
from pymavlink.dialects.v20 import development as mavlink

from companion.range_message import RangeMessage
from companion.wire_range import JSON, beacon_of, decode
from sitl_mock.__main__ import load_scenario, main
from sitl_mock.scenario import BeaconAt, Scenario
from tests.sitl_mock.process import free_udp_port, running_mock

LIMIT_S = 30.0
"""Whatever takes longer has failed."""


class Peer:
    """A bare MAVLink client on a UDP socket."""

    def __init__(self, port: int = 0) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(("127.0.0.1", port))
        self.socket.settimeout(0.2)
        self.mock: tuple[str, int] | None = None
        self.seen: list[Any] = []
        self._out = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
        self._in = mavlink.MAVLink(None)
        self._in.robust_parsing = True

    @property
    def url(self) -> str:
        """Where the mock is to send."""
        return f"udpout:127.0.0.1:{self.socket.getsockname()[1]}"

    def send(self, message: Any) -> None:
        """Send a message to the mock."""
        assert self.mock is not None
        self.socket.sendto(message.pack(self._out), self.mock)
        self._out.seq = (self._out.seq + 1) % 256

    def until(self, holds: Callable[[Any], bool], limit_s: float = LIMIT_S) -> Any:
        """Receive until a message satisfies this."""
        deadline = time.monotonic() + limit_s
        while time.monotonic() < deadline:
            try:
                data, self.mock = self.socket.recvfrom(65_535)
            except TimeoutError:
                continue
            for message in self._in.parse_buffer(data) or []:
                self.seen.append(message)
                if holds(message):
                    return message
        raise AssertionError("what is waited for does not come")

    def named(self, name: str) -> Any:
        """The next message of this name."""
        return self.until(lambda message: message.get_type() == name)

    def command(self, command: int, *params: float) -> int:
        """COMMAND_LONG and the result of its acknowledgement."""
        fields = [*params, *[0.0] * (7 - len(params))]
        self.send(mavlink.MAVLink_command_long_message(1, 1, command, 0, *fields))
        ack = self.until(lambda m: m.get_type() == "COMMAND_ACK" and m.command == command)
        return int(ack.result)


@contextmanager
def peer_and_mock(*arguments: str) -> Iterator[tuple[Peer, subprocess.Popen[str], dict[str, str]]]:
    """A peer on the onboard link and a mock without ground station."""
    peer = Peer()
    try:
        with running_mock("--mavlink", peer.url, "--gcs", "none", *arguments, endpoints=2) as mock:
            yield peer, mock.process, mock.endpoints
    finally:
        peer.socket.close()


def test_mavlink_2_with_an_unbroken_sequence() -> None:
    with peer_and_mock() as (peer, _, _):
        first = peer.named("HEARTBEAT")
        assert (first.get_srcSystem(), first.get_srcComponent()) == (1, 1)
        peer.until(lambda _: len(peer.seen) > 200)  # fewer than a socket's buffer holds
        assert {m.get_msgbuf()[0] for m in peer.seen} == {mavlink.PROTOCOL_MARKER_V2}
        sequence = [m.get_seq() for m in peer.seen]
        assert all((b - a) % 256 == 1 for a, b in pairwise(sequence))


def test_commands_over_udp_survive_garbage_and_strangers() -> None:
    with peer_and_mock() as (peer, process, _):
        peer.named("HEARTBEAT")
        assert peer.mock is not None
        for garbage in (b"", b"\xfd", b"\xfd" * 300, bytes(range(256)), b"\xfd\x09\x00\x00\x00\x01\x01\x00"):
            peer.socket.sendto(garbage, peer.mock)
        stranger = Peer()
        stranger.mock = peer.mock
        arm = mavlink.MAVLink_command_long_message(1, 1, 400, 0, 1, 0, 0, 0, 0, 0, 0)
        stranger.send(arm)
        assert peer.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 436, 20_000) == 0
        mode = peer.named("CURRENT_MODE")
        assert mode.custom_mode == mode.intended_custom_mode == 50593792
        assert not peer.named("HEARTBEAT").base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        assert peer.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == 0
        stranger.socket.close()
        assert process.poll() is None


def test_link_that_waits_for_its_peer() -> None:
    """`udpin`: the first one that speaks is answered."""
    arguments = ("--mavlink", "udpin:127.0.0.1:0", "--gcs", "none")
    with running_mock(*arguments, endpoints=2) as mock:
        host, port = mock.endpoints["mavlink onboard"].split(":")[1:]
        peer = Peer()
        peer.mock = (host, int(port))
        peer.send(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
        assert peer.named("HEARTBEAT").autopilot == mavlink.MAV_AUTOPILOT_PX4
        peer.socket.close()


def test_two_links_each_with_its_own_peer() -> None:
    onboard, gcs = Peer(), Peer()
    with running_mock("--mavlink", onboard.url, "--gcs", gcs.url):
        onboard.named("HEARTBEAT")
        gcs.named("HEARTBEAT")
        heartbeat = mavlink.MAVLink_heartbeat_message(mavlink.MAV_TYPE_GCS, 8, 0, 0, 4, 3)
        gcs.send(heartbeat)
        assert gcs.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1) == 0
        assert gcs.until(lambda m: m.get_type() == "STATUSTEXT").text.startswith("Armed")
        onboard.until(lambda m: m.get_type() == "HEARTBEAT" and bool(m.base_mode & 128))
        assert not [m for m in onboard.seen if m.get_type() in ("STATUSTEXT", "COMMAND_ACK")]
    onboard.socket.close()
    gcs.socket.close()


def test_ranges_over_zenoh(tmp_path: Path) -> None:
    scenario = tmp_path / "two.toml"
    scenario.write_text(
        "[sim]\nrange_dropout = 0.0\nrange_outliers = 0.0\nstart_x_m = 0.0\nstart_y_m = 0.0\n"
        'beacons = [{ id = "near", x_m = 3.0, y_m = 4.0 }, { id = "far", x_m = 30.0, y_m = 40.0 }]\n'
        "[other]\nsomething = 1\n"
    )
    got: dict[str, list[RangeMessage]] = {"near": [], "far": []}
    enough = threading.Event()

    def take(sample: zenoh.Sample) -> None:
        assert str(sample.encoding) == JSON
        message = decode(sample.payload.to_bytes(), str(sample.encoding))
        got[beacon_of(str(sample.key_expr))].append(message)
        if all(len(messages) >= 20 for messages in got.values()):
            enough.set()

    with peer_and_mock("--scenario", str(scenario), "--site", "hall") as (_, _, endpoints):
        config = {
            "mode": "client",
            "connect": {"endpoints": [endpoints["zenoh"]]},
            "scouting": {"multicast": {"enabled": False}},
        }
        with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session:
            session.declare_subscriber("uwb/v1/hall/*/*/range", take)
            assert enough.wait(LIMIT_S)
    for beacon, distance in (("near", 5.0), ("far", 50.0)):
        messages = got[beacon]
        assert len({m.session for m in messages}) == 1
        sequence = [m.seq for m in messages]
        assert sequence == list(range(sequence[0], sequence[0] + len(sequence)))
        assert all(abs(m.range_m - distance) < 0.5 and m.sigma_m == 0.07 for m in messages)
        assert all(m.t_ns is not None and abs(m.t_ns - time.time_ns()) < 60e9 for m in messages)
    assert got["near"][0].session != got["far"][0].session


def test_truth_log(tmp_path: Path) -> None:
    log = tmp_path / "truth.jsonl"
    with peer_and_mock("--truth-log", str(log)) as (peer, _, _):
        peer.until(lambda m: m.get_type() == "ATTITUDE" and m.time_boot_ms > 1500)
        rows = [json.loads(line) for line in log.read_text().splitlines()]
    assert len(rows) > 60
    assert set(rows[0]) == {
        "t_s", "x_m", "y_m", "height_m", "heading_rad", "vx", "vy", "yaw_rate", "mode", "armed", "d_m",
    }  # fmt: skip
    steps = {round(b["t_s"] - a["t_s"], 3) for a, b in pairwise(rows)}
    assert steps == {0.02}
    assert (rows[0]["mode"], rows[0]["armed"], rows[0]["height_m"]) == ("AUTO.LOITER", False, 0.0)


def test_faults_from_the_command_line() -> None:
    """Silent on the onboard link from 1 to 2.5 s of its clock, and back again."""
    with peer_and_mock("--fault", "link-loss@1:1.5") as (peer, _, _):
        peer.until(lambda m: m.get_type() == "ATTITUDE" and m.time_boot_ms > 3000)
    told = [m.time_boot_ms for m in peer.seen if m.get_type() == "ATTITUDE"]
    assert not [t for t in told if 1000 <= t < 2490]
    assert [t for t in told if t < 1000]


def test_packet_loss_leaves_gaps() -> None:
    """Three in ten are lost, as their sequence numbers tell."""
    with peer_and_mock("--fault", "packet-loss@0") as (peer, _, _):
        peer.until(lambda _: len(peer.seen) > 200)
    sent = sum((b.get_seq() - a.get_seq()) % 256 for a, b in pairwise(peer.seen))
    assert len(peer.seen) / sent == pytest.approx(0.7, abs=0.1)


def test_stall_is_caught_up_by_half_a_second_at_most() -> None:
    """Stopped for 1.5 s and continued: the mock's clock jumps no further than half a second's catching up."""
    with peer_and_mock() as (peer, process, _):
        before = peer.named("ATTITUDE").time_boot_ms
        process.send_signal(signal.SIGSTOP)
        time.sleep(1.5)
        process.send_signal(signal.SIGCONT)
        peer.socket.settimeout(0.05)
        resumed = time.monotonic()
        last = peer.until(lambda m: m.get_type() == "ATTITUDE" and m.time_boot_ms > before + 600)
        elapsed_ms = (time.monotonic() - resumed) * 1e3
        assert last.time_boot_ms - before < 1500 + elapsed_ms
        clock = [m.time_boot_ms for m in peer.seen if m.get_type() == "ATTITUDE"]
        assert all(0 < b - a <= 20 for a, b in pairwise(clock)), "no step is left out"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_it_cleanly(number: signal.Signals) -> None:
    with peer_and_mock() as (peer, process, _):
        peer.named("HEARTBEAT")
        process.send_signal(number)
        assert process.wait(LIMIT_S) == 0
        assert process.stderr is not None
        assert process.stderr.read() == ""


# ------------------------------------------------------------------------------------------- bad input


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[sim]\nwind = 3\n", ["sim.wind", "3", "telemetry"]),
        ("[sim]\nrange_dropout = 1.5\n", ["sim.range_dropout", "1.5", "1.0"]),
        ("[sim]\ntelemetry = 'x'\n", ["sim.telemetry", "'x'", "perfect, quiet, stock, none"]),
        ("[sim]\nbeacons = [{id = 'a', z = 3}]\n", ["sim.beacons[0]", "z", "height_m"]),
        ("[sim]\nbeacons = [{id = 'a'}, {id = 'a'}]\n", ["same id"]),
        ("[sim]\nbeacons = [{id = 'a/b'}]\n", ["sim.beacons[0].id", "'a/b'"]),
        ("[sim]\nbeacons = []\n", ["sim.beacons", "1"]),
        ("sim = 3\n", ["sim", "3"]),
        ("[sim\n", ["line 1"]),
    ],
)
def test_bad_scenario_is_refused_in_one_line(
    text: str, words: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "bad.toml"
    path.write_text(text)
    assert main(["--scenario", str(path)]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert all(word in said for word in [str(path), *words]), said


@pytest.mark.parametrize(
    "arguments",
    [
        ["--fault", "rain@3"], ["--fault", "reboot@x"], ["--param", "NO_SUCH=1"], ["--param", "MPC_Z_P=a"],
        ["--mavlink", "tcp:1:2"], ["--mavlink", "udpout:127.0.0.1:0"], ["--zenoh-listen", "nonsense"],
        ["--scenario", "/no/such/file.toml"], ["--truth-log", "/no/such/directory/log"], ["--site", "a/b"],
    ],
)  # fmt: skip
def test_bad_arguments_are_refused_in_one_line(
    arguments: list[str], capfd: pytest.CaptureFixture[str]
) -> None:
    listen = [] if "--zenoh-listen" in arguments else ["--zenoh-listen", "tcp/127.0.0.1:0"]
    links = [] if "--mavlink" in arguments else ["--mavlink", "udpin:127.0.0.1:0"]
    assert main(["--gcs", "none", *listen, *links, *arguments]) == 2
    said = capfd.readouterr().err
    assert said.startswith("sitl-mock: ")
    assert said.count("\n") == 1


def test_taken_port_is_refused() -> None:
    port = free_udp_port()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", port))
        assert main(["--mavlink", f"udpin:127.0.0.1:{port}", "--gcs", "none"]) == 2


def test_scenario_file_has_defaults_and_other_tables(tmp_path: Path) -> None:
    path = tmp_path / "some.toml"
    path.write_text("[guidance]\nobserver = 'kalman'\n")
    assert load_scenario(path) == Scenario()
    path.write_text("[sim]\ntelemetry = 'stock'\nbeacons = [{ x_m = 1.0 }]\n")
    assert load_scenario(path) == Scenario(telemetry="stock", beacons=(BeaconAt(x_m=1.0),))
