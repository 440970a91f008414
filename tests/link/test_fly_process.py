"""`companion fly` as a process: what it waits for, how it ends, and with which status."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

import pytest

from companion.cli import main
from companion.exits import Exit
from tests.uwb.network import until

ROOT = Path(__file__).parents[2]
BOUND_S = 60.0


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def start(*arguments: str, stdout: Path | None = None, group: int | None = None) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "companion", *arguments],
        stdout=subprocess.PIPE if stdout is None else stdout.open("w"),
        stderr=subprocess.PIPE,
        text=True,
        process_group=group,
        cwd=tempfile.mkdtemp(),  # the flight's record goes there
        env={key: value for key, value in os.environ.items() if not key.startswith("COMPANION_")},
    )


def run(*arguments: str) -> tuple[int, str, str]:
    process = start(*arguments)
    out, err = process.communicate(timeout=BOUND_S)
    return process.returncode, out, err


def status_of(arguments: tuple[str, ...]) -> int | str | None:
    """The same without a process, for what ends before it begins."""
    try:
        return main(arguments)
    except SystemExit as ended:  # argparse's way out
        return ended.code


def fly(*more: str) -> tuple[str, ...]:
    return (
        "fly",
        "--config",
        str(ROOT / "config/capture.toml"),
        "--mavlink",
        f"udpin:127.0.0.1:{free_port()}",
        *more,
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (fly("--set", "guidance.speed_m_s=9"), "guidance.speed_m_s = 9"),
        (fly("--set", "guidance.spede_m_s=0.4"), "did you mean speed_m_s"),
        (("fly", "--config", "nowhere.toml"), "nowhere.toml"),
        (("fly", "--mavlink", "carrier-pigeon"), "carrier-pigeon"),
        (fly("--record", str(ROOT / "README.md")), "File exists; name another file"),
        (("sim", "--runs", "0"), "must be at least 1"),
        (("sim", "--runs", "many"), "'many': must be a whole number"),
        (("nonsense",), "nonsense"),
    ],
)
def test_wrong_input_is_refused_in_words(
    arguments: tuple[str, ...], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert status_of(arguments) == Exit.USAGE
    assert words in capsys.readouterr().err


def test_without_a_vehicle_it_says_so_and_gives_up() -> None:
    status, out, err = run(*fly("--set", "loss.wait_s=1.5"))
    assert status == Exit.NO_VEHICLE
    assert "HEARTBEAT" in out
    assert "Traceback" not in err


def test_where_nothing_can_be_told_any_more_the_exit_status_is_still_the_flights() -> None:
    """A log on a full disk, and a summary in a directory that is not there."""
    process = start(
        *fly("--set", "loss.wait_s=0.5", "--json", "/nowhere/flight.json"), stdout=Path("/dev/full")
    )
    _, err = process.communicate(timeout=BOUND_S)
    assert process.returncode == Exit.NO_VEHICLE
    assert "Traceback" not in err


def test_an_endpoint_that_cannot_be_listened_on_is_told() -> None:
    status, _, err = run(*fly("--zenoh-listen", "tcp/203.0.113.1:7447"))
    assert status == Exit.LINK
    assert "203.0.113.1" in err
    assert "Traceback" not in err


def test_a_port_that_is_taken_is_told() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        taken_port = taken.getsockname()[1]
        status, _, err = run("fly", "--mavlink", f"udpin:127.0.0.1:{taken_port}")
    assert status == Exit.LINK
    assert "in use" in err
    assert f"udpin:127.0.0.1:{taken_port}" in err


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_it_in_an_orderly_way(number: signal.Signals) -> None:
    process = start(*fly())
    assert process.stdout is not None
    assert process.stdout.readline()  # it is up once it says what it waits for
    process.send_signal(number)
    out, err = process.communicate(timeout=BOUND_S)
    assert process.returncode == Exit.INTERRUPTED
    assert "target NOT captured" in out
    assert "Traceback" not in err


def test_systemd_hears_of_it_from_the_loop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(BOUND_S)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        process = start(*fly())
        told = [manager.recv(4096) for _ in range(2)]
        process.send_signal(signal.SIGSTOP)  # the loop hangs: its watchdog must hear nothing
        manager.settimeout(1.5)
        with pytest.raises(TimeoutError):
            while True:
                told.append(manager.recv(4096))
        process.kill()
        process.communicate(timeout=BOUND_S)
    assert b"READY=1\nWATCHDOG=1" in told


def group(leader: int) -> list[int]:
    """The processes of a process group."""
    members = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            with suppress(OSError):  # gone meanwhile
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
                members += [int(entry.name)] if int(fields[2]) == leader else []
    return members


def test_a_simulation_that_is_stopped_leaves_no_workers_behind() -> None:
    arguments = (
        "sim",
        "--config",
        str(ROOT / "config/capture.toml"),
        "--runs",
        "9000",
        "--set",
        "sim.limit_s=3",
    )
    process = start(*arguments, group=0)
    try:
        until(lambda: len(group(process.pid)) > 3, "workers, beside what starts them")
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=BOUND_S)
        assert process.returncode == Exit.INTERRUPTED
        assert "Traceback" not in err
        until(lambda: not group(process.pid), "their end")
    finally:
        with suppress(ProcessLookupError):  # nobody is left, as it should be
            os.killpg(process.pid, signal.SIGKILL)


def test_the_end_of_a_process_does_not_take_the_interpreter_down() -> None:
    """On its way down it can be aborted by a thread of Zenoh's, and an orderly end looked like a crash."""
    code = (
        "import atexit, sys\n"
        "from companion.__main__ import run\n"
        "atexit.register(print, 'down')\n"
        "sys.argv[1:] = ['ranges', 'schema']\n"
        "run()"
    )
    ended = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert ended.stdout.endswith("}\n")  # all of it, and nothing after it


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_output_that_is_lost_is_told(unbuffered: str) -> None:
    """At once, or even where it waited in the buffer until the end."""
    command = [sys.executable, "-m", "companion", "ranges", "schema"]
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(
            command, cwd=ROOT, env=environment, stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert ended.stderr == "companion: its output could not be written: No space left on device\n"
    assert ended.returncode == Exit.USAGE


@pytest.mark.parametrize("arguments", [("--help",), ("fly", "--help"), ("sim", "--help"), ("--version",)])
def test_help_and_version(arguments: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert status_of(arguments) == Exit.OK
    assert "companion" in capsys.readouterr().out
