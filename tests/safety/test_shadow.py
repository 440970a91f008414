"""`companion fly --shadow`: the whole flight is computed, and nothing but the heartbeat reaches the wire."""

from __future__ import annotations

import json
import math
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import development as mavlink

from companion.exits import Exit
from companion.link.mavlink import VehicleLink
from companion.recording import read
from companion.settings import MissionSettings, Settings, VehicleSettings
from companion.types import CompanionHeartbeat, FlightMode, ModeRequest, Phase, Setpoint, SystemStatus
from tests.core.flights import Script, fly
from tests.link.test_zenoh_ranges import Beacon
from tests.safety.test_check import Wire
from tests.sitl_mock.process import free_udp_port

ROOT = Path(__file__).parents[2]
BOUND_S = 80.0
POSCTL = 3 << 16
SETPOINT = Setpoint(0, 0.5, 0.2, 0.0, 3.0, 0.0)


def test_only_the_heartbeat_passes_the_link() -> None:
    wire = Wire()
    link = VehicleLink(VehicleSettings(), wire, heartbeat_only=True)
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    beat = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 128, POSCTL, 4, 3)
    wire.incoming.append(bytes(beat.pack(mav)))
    assert list(link.receive(lambda: 10**9))  # an autopilot is there: its rates would be asked for now
    link.send(SETPOINT)
    link.send(ModeRequest(0, FlightMode.AUTO_LAND))
    assert not wire.sent
    link.send(CompanionHeartbeat(0, SystemStatus.ACTIVE))
    assert len(wire.sent) == 1


def test_a_shadow_flies_along_in_any_mode_from_take_off_until_it_is_disarmed() -> None:
    script = Script()
    script.actual = script.intended = FlightMode.POSCTL
    script.armed = False
    waiting = fly(script.run(2.0), Settings(mission=MissionSettings(shadow=True)))
    assert waiting.state.phase is Phase.STANDBY
    script.armed = True
    flying = fly(script.run(2.0), before=waiting)
    assert flying.state.phase in (Phase.ACQUIRE, Phase.APPROACH)
    assert any(isinstance(o, Setpoint) and o.speed_m_s > 0.0 for o in flying.outputs)
    assert flying.state.reason.startswith("shadow: ")
    script.armed = False
    assert fly(script.run(1.0), before=flying).state.phase is Phase.ENDED


class HandFlown:
    """A vehicle that a pilot circles by hand around a beacon, and everything that is said to it."""

    def __init__(self, port: int, beacon: Beacon) -> None:
        self.heard: list[Any] = []
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
        self._beacon = beacon
        self.over = threading.Event()
        self.ranging = True
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self.over.set()
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        seq, start = 0, time.monotonic()
        parser = mavlink.MAVLink(None)
        while not self.over.wait(0.02):
            t = time.monotonic() - start
            yaw, boot_ms = 0.3 * t, int(t * 1e3)
            north, east = 10.0 + math.sin(yaw) / 0.6, (1.0 - math.cos(yaw)) / 0.6
            self._say(mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 128, POSCTL, 4, 3))
            self._say(mavlink.MAVLink_current_mode_message(0, POSCTL, POSCTL))
            self._say(mavlink.MAVLink_extended_sys_state_message(0, mavlink.MAV_LANDED_STATE_IN_AIR))
            self._say(mavlink.MAVLink_attitude_message(boot_ms, 0, 0, yaw, 0, 0, 0.3))
            velocity = (0.5 * math.cos(yaw), 0.5 * math.sin(yaw), 0.0)
            self._say(mavlink.MAVLink_local_position_ned_message(boot_ms, north, east, -3.0, *velocity))
            if self.ranging:
                seq += 1
                range_m = math.hypot(north, east, 3.0)
                self._beacon.put(json.dumps({"session": "s", "seq": seq, "range_m": range_m}).encode())
            while True:
                try:
                    self.heard += parser.parse_buffer(self._socket.recv(4096)) or []
                except (BlockingIOError, ConnectionRefusedError):
                    break

    def _say(self, message: Any) -> None:
        data = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256
        try:
            self._socket.send(data)
        except ConnectionRefusedError:  # the app is not there yet, or has ended
            return


def test_on_the_wire_nothing_leaves_but_the_heartbeat(tmp_path: Path) -> None:
    """A flight that engages, steers, loses its ranges and hands over, while every message is listened to."""
    port, record, beacon = free_udp_port(), tmp_path / "shadow.mcap", Beacon()
    vehicle = HandFlown(port, beacon)
    app = subprocess.Popen(
        [
            sys.executable, "-m", "companion", "fly", "--shadow", "--view", "json",
            "--mavlink", f"udpin:127.0.0.1:{port}", "--zenoh-connect", beacon.endpoint,
            "--record", str(record), "--set", "loss.stall_after_s=0.8", "--set", "loss.hand_over_after_s=1.2",
            "--set", "loss.hand_over_patience_s=0.5",
            "--set", "loss.held_up_after_s=10",  # a loaded machine may hold it up for a second
        ],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    kill = threading.Timer(BOUND_S, app.kill)
    kill.start()
    try:
        assert app.stdout is not None
        phases: set[str] = set()
        for line in app.stdout:
            said = json.loads(line) if line.startswith("{") else {}
            phases.add(str(said.get("phase") or said.get("after")))
            if "approach" in phases:
                vehicle.ranging = False
            if "released" in phases:
                break
        app.send_signal(signal.SIGINT)
        out, err = app.communicate()
    finally:
        kill.cancel()
        app.kill()
        vehicle.close()
        beacon.session.close()  # type: ignore[no-untyped-call]
    assert {"acquire", "approach", "stall", "hand over", "released"} <= phases, err
    assert app.returncode in (Exit.INTERRUPTED, Exit.NOT_CAPTURED), out + err
    assert "nothing of this was sent" in out
    heard = {message.get_type() for message in vehicle.heard}
    assert heard == {"HEARTBEAT"}
    computed = [output for step in read(record).steps for output in step.outputs]
    assert any(isinstance(o, Setpoint) and o.speed_m_s > 0.0 for o in computed)
    assert any(isinstance(o, ModeRequest) for o in computed)
