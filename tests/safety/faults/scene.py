"""A flight on the wire: `companion fly` and `sitl-mock` as processes, a relay between, a person's acts."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from math import hypot
from pathlib import Path
from types import TracebackType

import msgspec
from pymavlink.dialects.v20 import development as mavlink

from companion.types import FlightMode, Phase, PhaseChange, Status
from tests.safety.faults.rules import Sent, Step
from tests.safety.faults.watch import Limits
from tests.safety.relay import Relay
from tests.sitl_mock.process import running_mock

PATIENCE_S = 40.0
"""For everything that must come before the strike, on a machine under load."""
OFFBOARD, LOITER = (6.0, 0.0), (4.0, 3.0)
_ROUTER = """
import sys
from tests.uwb.network import Router
router = Router(sys.argv[1])
print(router.endpoint, flush=True)
sys.stdin.read()
"""
_SCENARIO = """\
[sim]
beacons = [{ id = "b1", x_m = 20.0, y_m = 10.0, height_m = 1.5 }]
"""
_CONFIG = ("--set", "beacons.b1.height_m=1.5", "--set", "limits.speed_m_s=0.6")
_PIPE_SIZE = 1031
"""F_SETPIPE_SZ."""


class TruthRow(msgspec.Struct, frozen=True):
    """A line of the mock's truth log, as far as it is read here."""

    t_s: float
    x_m: float
    y_m: float
    height_m: float
    vx: float
    vy: float
    yaw_rate: float
    mode: FlightMode
    armed: bool


class NotReadyError(Exception):
    """Something that the fault needs did not come in time."""


class Scene:
    """The processes of a flight. `strike` marks the moment from which times count."""

    def __init__(
        self, directory: Path, mock: Sequence[str] = (), app: Sequence[str] = (), routed: bool = False
    ) -> None:
        self._stack = ExitStack()
        self._directory = directory
        self._app_options = tuple(app)
        self.changes: list[PhaseChange] = []
        self.reading = threading.Event()
        self.reading.set()
        self._truth_file = directory / "truth.jsonl"
        scenario = directory / "scenario.toml"
        scenario.write_text(_SCENARIO)
        try:
            zenoh = ["--zenoh-listen", "tcp/127.0.0.1:0"]
            self.router: subprocess.Popen[str] | None = None
            self.router_endpoint = "tcp/127.0.0.1:0"
            if routed:
                self.start_router()
                zenoh = ["--zenoh-connect", self.router_endpoint]
            running = self._stack.enter_context(
                running_mock(
                    "--mavlink", "udpin:127.0.0.1:0", "--gcs", "none", "--scenario", str(scenario),
                    "--truth-log", str(self._truth_file), "--param", "COM_OBL_RC_ACT=5", *zenoh, *mock,
                    endpoints=2,
                )
            )  # fmt: skip
            self.mock = running.process
            self.zenoh = self.router_endpoint if routed else running.endpoints["zenoh"]
            self.relay = Relay(int(running.endpoints["mavlink onboard"].rpartition(":")[2]))
            self._stack.callback(self.relay.close)
            self.app = self.start_app()
        except BaseException:
            self._stack.close()
            raise

    def __enter__(self) -> Scene:
        return self

    def __exit__(self, *_: type[BaseException] | BaseException | TracebackType | None) -> None:
        self._stack.close()

    # --------------------------------------------------------------------------------------- processes

    def start_app(self) -> subprocess.Popen[str]:
        """Start the app, or start it anew."""
        self.app = subprocess.Popen(
            [
                sys.executable, *(self._app_options or ("-m", "companion")), "fly",
                "--mavlink", f"udpout:127.0.0.1:{self.relay.port}", "--zenoh-connect", self.zenoh,
                "--view", "json", "--record", str(self._directory / f"{time.monotonic_ns()}.mcap"), *_CONFIG,
            ],
            stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
            env={key: value for key, value in os.environ.items() if not key.startswith("COMPANION_")},
        )  # fmt: skip
        assert self.app.stdout is not None
        fcntl.fcntl(self.app.stdout, _PIPE_SIZE, 4096)  # what nobody reads is soon full
        reader = threading.Thread(target=self._read, args=(self.app.stdout,), daemon=True)
        reader.start()
        self._stack.callback(self._end, self.app)
        return self.app

    def start_router(self) -> None:
        """Start the Zenoh router, or start it anew where it was."""
        self.router = subprocess.Popen(
            [sys.executable, "-c", _ROUTER, self.router_endpoint],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.router.stdout is not None
        self.router_endpoint = self.router.stdout.readline().strip()
        self._stack.callback(self._end, self.router)

    def _end(self, process: subprocess.Popen[str]) -> None:
        self.reading.set()
        with suppress(ProcessLookupError):
            process.send_signal(signal.SIGCONT)
            process.kill()
        process.wait(10.0)

    def _read(self, stream: object) -> None:
        decode = msgspec.json.Decoder(PhaseChange | Status).decode
        for line in stream:  # type: ignore[attr-defined]
            self.reading.wait()
            with suppress(msgspec.DecodeError):  # the summary at the end
                told = decode(line)
                if isinstance(told, PhaseChange):
                    self.changes.append(told)

    # ------------------------------------------------------------------------------------------- people

    def command(self, command: int, *params: float) -> None:
        """A person's command to the autopilot."""
        values = [*params, *[0.0] * (7 - len(params))]
        self.relay.command(mavlink.MAVLink_command_long_message(1, 1, command, 0, *values))

    def select(self, mode: tuple[float, float]) -> None:
        """A person selects a mode (main, sub)."""
        self.command(mavlink.MAV_CMD_DO_SET_MODE, 1.0, *mode)

    def take_off_and_engage(self) -> None:
        """From the ground to the approach. Raises NotReadyError."""
        self.wait(lambda: self.phase is Phase.STANDBY, "the app is ready")
        self.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, float("nan"))
        self.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1.0)
        self.wait(lambda: self._is_up(self.truth()[-1:]), "the vehicle is up")
        self.select(OFFBOARD)
        self.wait(lambda: self.phase is Phase.APPROACH, "the app approaches the target")

    @staticmethod
    def _is_up(last: list[TruthRow]) -> bool:
        return bool(last) and last[0].height_m > 1.5 and last[0].mode is FlightMode.AUTO_LOITER

    # -------------------------------------------------------------------------------------- what was seen

    @property
    def phase(self) -> Phase:
        """Where the app said last that it stands."""
        return self.changes[-1].after if self.changes else Phase.AWAIT

    def truth(self) -> list[TruthRow]:
        """What the mock has written so far."""
        decode = msgspec.json.Decoder(TruthRow).decode
        return [decode(line) for line in self._truth_file.read_bytes().splitlines() if line.endswith(b"}")]

    def wait(self, condition: Callable[[], bool], what: str, patience_s: float = PATIENCE_S) -> None:
        """Until it is so. Raises NotReadyError."""
        deadline = time.monotonic() + patience_s
        while not condition():
            if time.monotonic() > deadline:
                raise NotReadyError(f"not within {patience_s:g} s: {what}; the app is in {self.phase.value}")
            time.sleep(0.02)

    def steps(self, since_s: float) -> list[Step]:
        """The app's transitions since then."""
        told = [(change.t_ns * 1e-9 - since_s, change) for change in self.changes]
        return [Step(t, change.after, change.reason) for t, change in told if t > 0.0]

    def sent(self, since_s: float) -> list[Sent]:
        """The setpoints that the relay has seen since then."""
        return [
            Sent(t - since_s, hypot(m.vx, m.vy))
            for t, m in list(self.relay.log)
            if t > since_s and m.get_type() == "SET_POSITION_TARGET_LOCAL_NED"
        ]


def limits_of(rows: Sequence[TruthRow]) -> Limits:
    """The most that the vehicle did in OFFBOARD."""
    worst = Limits()
    for row in rows:
        if row.mode is FlightMode.OFFBOARD and row.armed:
            away = hypot(row.x_m - rows[0].x_m, row.y_m - rows[0].y_m)
            now = Limits(hypot(row.vx, row.vy), abs(row.yaw_rate), row.height_m, row.height_m, away)
            worst = worst.and_also(now)
    return worst
