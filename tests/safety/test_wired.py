"""Signing, systemd and check where they meet the flying process and the command line."""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as mavlink

from companion.exits import Exit
from companion.link.mavlink import VehicleLink
from companion.link.signing import Key, SignedMavlink, Timestamps, Unsigned
from companion.settings import VehicleSettings
from companion.types import (
    Attitude,
    Defect,
    Event,
    FlightMode,
    Malformed,
    ModeReport,
    PartyHeard,
    VehicleHeartbeat,
)
from tests.safety.test_check import Stage, Wire, plain, stage
from tests.sitl_mock.process import free_udp_port

ROOT = Path(__file__).parents[2]
KEY = Key(bytes(range(32)))
OFFBOARD = 6 << 16
HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 129, OFFBOARD, 4, 3)
MODE = mavlink.MAVLink_current_mode_message(0, OFFBOARD, OFFBOARD)
ATTITUDE = mavlink.MAVLink_attitude_message(1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


@pytest.fixture
def autopilot(tmp_path: Path) -> Iterator[SignedMavlink]:
    mav = SignedMavlink(KEY, Timestamps(tmp_path / "autopilot"), source_component=1)
    yield mav
    mav.close()


def heard(link: VehicleLink, wire: Wire, mav: Any, *messages: Any) -> list[Event]:
    for message in messages:
        wire.incoming.append(bytes(message.pack(mav)))
        mav.seq = (mav.seq + 1) % 256
    return list(link.receive(lambda: 1))


@pytest.mark.parametrize("unsigned", Unsigned)
def test_on_a_signed_link_modes_are_believed_from_signed_messages_only(
    tmp_path: Path, autopilot: SignedMavlink, unsigned: Unsigned
) -> None:
    ours = SignedMavlink(KEY, Timestamps(tmp_path / "ours"), unsigned=unsigned)
    wire = Wire()
    link = VehicleLink(VehicleSettings(), wire, ours)
    told = heard(link, wire, plain(), HEARTBEAT, MODE)
    assert [e.defect for e in told if isinstance(e, Malformed)] == [Defect.MAVLINK_SIGNATURE] * 2
    told = heard(link, wire, autopilot, HEARTBEAT, MODE, ATTITUDE)
    assert [type(e) for e in told] == [VehicleHeartbeat, ModeReport, Attitude]
    told = heard(link, wire, plain(), HEARTBEAT, MODE, ATTITUDE)
    believed = [type(e) for e in told if not isinstance(e, Malformed)]
    assert believed == ([Attitude] if unsigned is Unsigned.ACCEPT else [])
    ours.close()


def test_on_a_signed_link_nobody_without_the_key_counts_as_another_commander(
    tmp_path: Path, autopilot: SignedMavlink
) -> None:
    ours = SignedMavlink(KEY, Timestamps(tmp_path / "ours"), unsigned=Unsigned.ACCEPT)
    wire = Wire()
    link = VehicleLink(VehicleSettings(), wire, ours)
    heard(link, wire, autopilot, HEARTBEAT)
    twin = mavlink.MAVLink_heartbeat_message(18, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3)
    assert not heard(link, wire, mavlink.MAVLink(None, 1, 191), twin)
    with_the_key = SignedMavlink(KEY, Timestamps(tmp_path / "twin"), source_component=191)
    told = heard(link, wire, with_the_key, twin)
    assert [type(event) for event in told] == [PartyHeard]
    ours.close()
    with_the_key.close()


def test_on_a_plain_link_nothing_needs_a_signature() -> None:
    wire = Wire()
    link = VehicleLink(VehicleSettings(), wire)
    told = heard(link, wire, plain(), HEARTBEAT, MODE)
    assert [type(e) for e in told] == [VehicleHeartbeat, ModeReport]
    assert isinstance(told[1], ModeReport)
    assert told[1].intended is FlightMode.OFFBOARD


# ------------------------------------------------------------------------------------------- processes


def companion(*arguments: str, **environment: str) -> subprocess.Popen[str]:
    clean = {key: value for key, value in os.environ.items() if not key.startswith("COMPANION_")}
    return subprocess.Popen(
        [sys.executable, "-m", "companion", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env=clean | environment,
    )


def test_a_flight_tells_systemd_that_it_is_ready_alive_and_over(tmp_path: Path) -> None:
    name = str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as systemd:
        systemd.bind(name)
        systemd.settimeout(20.0)
        url = f"udpin:127.0.0.1:{free_udp_port()}"
        process = companion("fly", "--mavlink", url, "--view", "none", NOTIFY_SOCKET=name)
        try:
            for _ in range(3):  # once a second, by the loop
                assert systemd.recv(4096) == b"READY=1\nWATCHDOG=1"
        finally:
            process.terminate()
            process.communicate(timeout=30.0)
        rest = [systemd.recv(4096)]
        while rest[-1] != b"STOPPING=1":
            rest.append(systemd.recv(4096))
    assert any(line.startswith(b"STATUS=ended") for line in rest)


def checked(at: Stage, patience_s: float, *more: str) -> tuple[int, str, str]:
    process = companion(
        "check", "--mavlink", at.settings.vehicle.mavlink,
        "--zenoh-connect", at.settings.ranges.connect[0], "--patience", str(patience_s), *more,
    )  # fmt: skip
    out, err = process.communicate(timeout=60.0)
    return process.returncode, out, err


def test_the_command_says_ready_or_not_and_speaks_json() -> None:
    with stage("--param", "COM_OBL_RC_ACT=5") as mock:
        status, out, err = checked(mock, 20.0, "--json")
        assert status == Exit.OK, out + err
        assert json.loads(out)["ready"] is True
        status, out, err = checked(
            mock, 5.0, "--set", "mission.target='b9'", "--set", "beacons.b9.height_m=1.5"
        )
    assert status == Exit.NOT_READY
    assert "no range on uwb/v1/lab/b9/*/range" in out
    assert "NOT READY: 1 to mend" in out
    assert "Traceback" not in err


def test_a_key_that_others_can_read_is_said_in_the_table(tmp_path: Path) -> None:
    key = tmp_path / "key"
    key.write_text(KEY.hex())
    key.chmod(0o644)
    process = companion(
        "check", "--mavlink", f"udpin:127.0.0.1:{free_udp_port()}", "--patience", "1",
        "--set", f"vehicle.signing_key_file={key}", "--set", f"vehicle.signing_state_file={tmp_path}/state",
    )  # fmt: skip
    out, err = process.communicate(timeout=60.0)
    assert process.returncode == Exit.NOT_READY
    assert f"chmod 600 {key}" in " ".join(out.split())
    assert KEY.hex() not in out + err
