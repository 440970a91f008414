"""What systemd is told, over real datagram sockets, and the unit that it runs us by."""

from __future__ import annotations

import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from uuid import uuid4

import pytest

from companion.cli import _parser
from companion.exits import Exit
from companion.link.systemd import Notifier
from companion.settings import LossSettings
from companion.types import CompanionHeartbeat, Phase, PhaseChange, Severity, SystemStatus, Tick

ROOT = Path(__file__).parents[2]
UNIT = ROOT / "config" / "companion.service"
BEAT = CompanionHeartbeat(t_ns=1, system_status=SystemStatus.STANDBY)


@pytest.fixture(params=["path", "abstract"])
def systemd(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[socket.socket, str]]:
    """The manager's end, and what it would put into $NOTIFY_SOCKET."""
    name = str(tmp_path / "notify") if request.param == "path" else f"@companion-test-{uuid4().hex}"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(name.replace("@", "\0", 1) if name.startswith("@") else name)
        manager.settimeout(5.0)
        yield manager, name


def test_ready_and_alive_with_each_heartbeat_the_phase_as_status(systemd: tuple[socket.socket, str]) -> None:
    manager, name = systemd
    notifier = Notifier({"NOTIFY_SOCKET": name})
    for _ in range(2):
        notifier.send(BEAT)
        assert manager.recv(4096) == b"READY=1\nWATCHDOG=1"
    reason = "vehicle and ranges are there:\nwaiting for OFFBOARD " + "x" * 1000
    notifier.send(PhaseChange(2, Phase.AWAIT, Phase.STANDBY, reason, Severity.INFO))
    status = manager.recv(4096)
    assert status.startswith(b"STATUS=standby: vehicle and ranges are there: waiting for OFFBOARD")
    assert b"\n" not in status
    assert len(status) < 300
    notifier.close()
    assert manager.recv(4096) == b"STOPPING=1"


def test_nothing_is_told_without_a_heartbeat_of_the_loop(systemd: tuple[socket.socket, str]) -> None:
    manager, name = systemd
    notifier = Notifier({"NOTIFY_SOCKET": name})
    notifier.send(Tick(t_ns=1))  # type: ignore[arg-type]
    manager.setblocking(False)
    with pytest.raises(BlockingIOError):
        manager.recv(4096)
    notifier.close()


@pytest.mark.parametrize("name", ["", "@", "relative/path", "/nowhere/at/all", "@nobody-is-there", "/" * 300])
def test_outside_systemd_and_with_nobody_there_it_does_nothing(name: str) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": name} if name else {})
    notifier.send(BEAT)
    notifier.status("up")
    notifier.close()
    notifier.send(BEAT)
    notifier.close()


def test_a_manager_that_does_not_read_cannot_hold_up_the_loop(systemd: tuple[socket.socket, str]) -> None:
    notifier = Notifier({"NOTIFY_SOCKET": systemd[1]})
    for _ in range(5000):  # far more than the socket's buffer holds; a blocking send would never return
        notifier.send(BEAT)
    notifier.close()


# ----------------------------------------------------------------------------------------------- unit


def unit() -> dict[str, list[str]]:
    """Every key of the unit with all its values."""
    keys: dict[str, list[str]] = {}
    for line in UNIT.read_text().splitlines():
        key, separator, value = line.partition("=")
        if separator and not line.startswith("#"):
            keys.setdefault(key, []).append(value)
    return keys


def test_the_unit_restarts_what_may_come_right_and_nothing_else() -> None:
    keys = unit()
    assert keys["Type"] == ["notify"]
    assert keys["Restart"] == ["on-failure"]
    assert set(keys["RestartPreventExitStatus"][0].split()) == {str(int(Exit.USAGE))}
    ended_well = {str(int(e)) for e in (Exit.NOT_CAPTURED, Exit.INTERRUPTED)}
    assert set(keys["SuccessExitStatus"][0].split()) == ended_well
    assert keys["StartLimitIntervalSec"] == ["0"]


def test_the_units_times_fit_the_apps() -> None:
    keys = unit()
    heartbeat_s = 1.0
    assert float(keys["WatchdogSec"][0]) >= 2.0 * heartbeat_s
    assert float(keys["TimeoutStopSec"][0]) > LossSettings().hand_over_patience_s + 2.0


def test_the_units_command_line_is_understood() -> None:
    _, *arguments = unit()["ExecStart"][0].split()
    assert _parser().parse_args(arguments).command.__name__ == "fly"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd here")
def test_systemd_finds_nothing_wrong_with_the_unit(tmp_path: Path) -> None:
    copy = tmp_path / "companion.service"
    program = unit()["ExecStart"][0].split()[0]
    copy.write_text(UNIT.read_text().replace(program, sys.executable))  # it looks whether it can be run
    done = subprocess.run(
        ["systemd-analyze", "verify", str(copy)], capture_output=True, text=True, timeout=60, check=False
    )
    assert "companion.service" not in done.stderr
    assert done.returncode == 0
