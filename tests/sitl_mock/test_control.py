"""A signed link of the mock, and faults switched on its standard input while it runs."""

from __future__ import annotations

import os
import select
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as mavlink

from companion.link.mavlink import VehicleLink
from companion.link.signing import Key, SignedMavlink, Timestamps
from companion.settings import VehicleSettings
from companion.types import Defect, Event, Malformed, VehicleHeartbeat
from sitl_mock.__main__ import main
from sitl_mock.control import Control
from sitl_mock.faults import Fault, Faults
from sitl_mock.udp import Udp, read_key
from tests.sitl_mock.process import free_udp_port

KEY = bytes(range(32))
HEARTBEAT = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 1, 4 << 16 | 3 << 24, 3, 3)
SETPOINT = mavlink.MAVLink_set_position_target_local_ned_message(0, 1, 1, 8, 1479, *([0.0] * 11))


class Line:
    """The mock's signed end, and the app's link with the same key."""

    def __init__(self, tmp_path: Path) -> None:
        port = free_udp_port()
        self.mock = Udp(f"udpout:127.0.0.1:{port}", 1, KEY)
        self.signed = SignedMavlink(Key(KEY), Timestamps(tmp_path / "app"))
        self.app = VehicleLink.open(VehicleSettings(mavlink=f"udpin:127.0.0.1:{port}"), self.signed)

    def heard_by_app(self) -> list[Event]:
        assert select.select([self.app], [], [], 5.0)[0]
        events = list(self.app.receive())
        self.mock.receive()  # the app asks for telemetry
        return events

    def heard_by_mock(self, message: Any, mav: Any) -> list[str]:
        self.app._transport.send(bytes(message.pack(mav)))
        mav.seq = (mav.seq + 1) % 256
        assert select.select([self.mock], [], [], 5.0)[0]
        return [m.get_type() for m in self.mock.receive()]


@pytest.fixture
def line(tmp_path: Path) -> Iterator[Line]:
    opened = Line(tmp_path)
    yield opened
    opened.app.close()
    opened.mock.close()
    opened.signed.close()


def test_what_the_mock_signs_is_believed_and_what_it_does_not_is_not(line: Line) -> None:
    line.mock.send(HEARTBEAT)
    (event,) = line.heard_by_app()
    assert isinstance(event, VehicleHeartbeat)
    line.mock.sign(False)
    line.mock.send(HEARTBEAT)
    (event,) = line.heard_by_app()
    assert isinstance(event, Malformed)
    assert event.defect is Defect.MAVLINK_SIGNATURE


def test_the_mock_hears_signed_messages_only_but_for_heartbeats(line: Line, tmp_path: Path) -> None:
    line.mock.send(HEARTBEAT)
    line.heard_by_app()
    other = SignedMavlink(Key(bytes(32)), Timestamps(tmp_path / "other"))
    plain = mavlink.MAVLink(None, 1, 191)
    assert line.heard_by_mock(SETPOINT, plain) == []
    assert line.heard_by_mock(SETPOINT, other) == []
    assert line.heard_by_mock(HEARTBEAT, plain) == ["HEARTBEAT"]
    assert line.heard_by_mock(SETPOINT, line.signed) == ["SET_POSITION_TARGET_LOCAL_NED"]
    other.close()


def test_a_replayed_setpoint_is_not_heard_again(line: Line) -> None:
    line.mock.send(HEARTBEAT)
    line.heard_by_app()
    packet = bytes(SETPOINT.pack(line.signed))
    for expected in (1, 0):
        line.app._transport.send(packet)
        assert select.select([line.mock], [], [], 5.0)[0]
        assert len(line.mock.receive()) == expected


@pytest.mark.parametrize("text", [KEY, KEY.hex().encode(), KEY.hex().upper().encode() + b"\n"])
def test_a_key_is_raw_or_hexadecimal(text: bytes) -> None:
    assert read_key(text) == KEY


def test_a_bad_key_file_is_refused_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "key"
    file.write_text("secret")
    for path, words in ((file, "32 bytes"), (tmp_path / "none", "No such file")):
        assert main(["--sign-key", str(path)]) == 2
        said = capsys.readouterr().err
        assert words in said
        assert "secret" not in said


def test_faults_are_switched_by_lines() -> None:
    reader, writer = os.pipe()
    said: list[str] = []
    control, faults = Control(reader, said.append), Faults()
    os.write(writer, b"gps-lost on\nbattery-")
    assert control.read(faults)
    assert faults.active(Fault.GPS_LOST)
    os.write(writer, b"low on\n\ngps-lost off\nrain on\nreboot\nreboot@3 on\n")
    assert control.read(faults)
    assert faults.active(Fault.BATTERY_LOW)
    assert not faults.active(Fault.GPS_LOST)
    assert not faults.active(Fault.REBOOT)
    assert said[:3] == ["control: gps-lost on", "control: battery-low on", "control: gps-lost off"]
    assert ["must be" in line for line in said[3:]] == [True, True, True]
    os.close(writer)
    assert not control.read(faults)
    os.close(reader)
