"""The parties of a flight with the operator: the mock, a stand-in for the companion, the operator itself."""

from __future__ import annotations

import math
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

BODY_VELOCITY_AND_YAW_RATE = 1479
DO_SET_MODE, POSCTL, OFFBOARD = 176, 3, 6


class Ended(NamedTuple):
    """How the operator ended, and what it said."""

    status: int
    lines: list[str]

    def said(self, words: str) -> bool:
        return any(words in line for line in self.lines)


def spawn(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"},
    )


class Mock:
    """`sitl-mock` in its own process on free ports."""

    def __init__(self, *arguments: str) -> None:
        self.process = spawn(
            "sitl_mock", "--mavlink", "udpin:127.0.0.1:0", "--gcs", "udpin:127.0.0.1:0",
            "--zenoh-listen", "tcp/127.0.0.1:0", *arguments,
        )  # fmt: skip
        assert self.process.stdout is not None
        ports: dict[str, int] = {}
        while len(ports) < 2:
            line = self.process.stdout.readline()
            assert line, "the mock ended"
            if line.startswith("listening: mavlink"):
                ports[line.split()[2]] = int(line.rstrip().rpartition(":")[2])
        self.onboard_port, self.ground_port = ports["onboard"], ports["ground"]

    def __enter__(self) -> Mock:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.communicate()


class StandIn:
    """Streams forward speed and yaw rate at 20 Hz, by the seconds since OFFBOARD; None for silence."""

    def __init__(
        self,
        port: int,
        plan: Callable[[float | None], tuple[float, float] | None],
        pilot_after_s: float = math.inf,
    ) -> None:
        """`pilot_after_s` after OFFBOARD a pilot takes over: POSCTL is commanded, once."""
        self._plan = plan
        self._pilot_after_s = pilot_after_s
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.setblocking(False)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> StandIn:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=191)
        reader = mavlink.MAVLink(None)
        reader.robust_parsing = True
        since: float | None = None
        while not self._over.wait(0.05):
            since = self._offboard_since(reader, since)
            messages = [mav.heartbeat_encode(18, 8, 0, 0, 4)]
            flown_s = None if since is None else time.monotonic() - since
            if flown_s is not None and flown_s > self._pilot_after_s:
                self._pilot_after_s = math.inf
                messages.append(mav.command_long_encode(1, 1, DO_SET_MODE, 0, 1, POSCTL, 0, 0, 0, 0, 0))
            command = self._plan(flown_s)
            if command is not None:
                messages.append(
                    mav.set_position_target_local_ned_encode(
                        0, 1, 1, mavlink.MAV_FRAME_BODY_NED, BODY_VELOCITY_AND_YAW_RATE,
                        0, 0, 0, command[0], 0, 0, 0, 0, 0, 0, command[1],
                    )
                )  # fmt: skip
            for message in messages:
                try:
                    self._socket.send(message.pack(mav))
                except OSError:
                    return  # the mock has ended
                mav.seq = (mav.seq + 1) % 256

    def _offboard_since(self, reader: mavlink.MAVLink, since: float | None) -> float | None:
        while True:
            try:
                data = self._socket.recv(4096)
            except BlockingIOError:
                return since
            except OSError:
                return since
            for m in reader.parse_buffer(data) or ():
                if m.get_type() == "HEARTBEAT" and m.get_srcComponent() == 1:
                    if m.custom_mode >> 16 & 0xFF != OFFBOARD:
                        since = None
                    elif since is None:
                        since = time.monotonic()


class Operator:
    """`companion operator` in its own process."""

    def __init__(self, url: str, *arguments: str) -> None:
        self.process = spawn("companion", "operator", "--mavlink", url, "--height", "1.5", *arguments)
        self._lines: list[str] = []
        self._new: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._new.put(line.rstrip("\n"))
        self._new.put(None)

    def wait_for(self, words: str, limit_s: float = 60.0) -> None:
        """Until it says so."""
        end = time.monotonic() + limit_s
        while True:
            line = self._new.get(timeout=max(end - time.monotonic(), 0.01))
            assert line is not None, f"{words!r} was never said: {self._lines}"
            self._lines.append(line)
            if words in line:
                return

    def interrupt(self) -> None:
        self.process.send_signal(signal.SIGINT)

    def ended(self, limit_s: float = 90.0) -> Ended:
        """Wait for its end; one that does not come is status −9."""
        with suppress(subprocess.TimeoutExpired):
            self.process.wait(limit_s)
        self.process.kill()
        self._reader.join()
        while (line := self._new.get()) is not None:
            self._lines.append(line)
        return Ended(self.process.wait(), self._lines)
