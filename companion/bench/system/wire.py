"""The flying process beside the floor, on the rig: latency, jitter, CPU and how soon it is there."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from companion.bench.system.rig import Beacon, Heard, Rig, precede

ONE = (Beacon("b1", 14.0, 14.0),)
THREE = (Beacon("b1", 12.0, 3.0), Beacon("b2", 4.0, 14.0), Beacon("b3", -3.0, 4.0))
_STATION = (8.0, 6.0)
_ENGAGED_S = 2.5
"""From the first setpoint on: by then OFFBOARD has been selected, and the first turn begun."""
_START_LIMIT_S = 20.0
_MODULE = "companion.bench.system"


class Segment(NamedTuple):
    """What was measured of one process for some seconds. Latencies in s; `cpu` is the share of a core."""

    latencies_s: list[float]
    lost: int
    gaps_s: list[float]
    cpu: float
    rss_mib: float


class Contender(NamedTuple):
    """Something that flies: its command for a configuration file and a rig."""

    name: str
    command: Callable[[Path, Rig, Path], list[str]]


def _floor(_config: Path, rig: Rig, _scratch: Path) -> list[str]:
    return [sys.executable, "-m", f"{_MODULE}.floor", rig.zenoh, f"127.0.0.1:{rig.mavlink_port}"]


def _bare(config: Path, _rig: Rig, _scratch: Path) -> list[str]:
    return [sys.executable, "-m", f"{_MODULE}.bare", str(config)]


def _whole(config: Path, _rig: Rig, scratch: Path) -> list[str]:
    record = scratch / f"flight-{time.monotonic_ns()}.mcap"
    return [sys.executable, "-m", "companion", "fly", "--config", str(config), "--record", str(record)]


def _unseen(config: Path, rig: Rig, scratch: Path) -> list[str]:
    return [*_whole(config, rig, scratch), "--view", "none"]


FLOOR = Contender("floor", _floor)
BARE = Contender("companion", _bare)
"""The loop alone."""
WHOLE = Contender("companion, all on", _whole)
"""`companion fly` as it stands: recording, status on Zenoh, ground station's messages, live view."""
UNSEEN = Contender("companion, no view", _unseen)
"""The same without a person who watches."""


def configuration(rig: Rig, beacons: tuple[Beacon, ...]) -> str:
    """The default but for the links, and limits that a long measurement does not reach.

    A tick's setpoint between a range and its answer would be taken for the answer: ticks are left to 10 Hz.
    """
    lines = [
        "[mission]",
        'kind = "station"' if len(beacons) > 1 else f'target = "{beacons[0].name}"',
        "[ranges]",
        f'connect = ["{rig.zenoh}"]',
        "[vehicle]",
        f'mavlink = "udpout:127.0.0.1:{rig.mavlink_port}"',
        "[stream]",
        "min_rate_hz = 10.0",
        "[limits]",
        "flight_time_s = 36000.0",
        "distance_m = 100000.0",
        "from_start_m = 100000.0",
    ]
    for b in beacons:
        lines += [f"[beacons.{b.name}]", "height_m = 1.5"]
        if len(beacons) > 1:
            away_m = ((b.x_m - _STATION[0]) ** 2 + (b.y_m - _STATION[1]) ** 2) ** 0.5
            lines.append(f"station_distance_m = {away_m:.3f}")
    return "\n".join(lines) + "\n"


def measure(
    rig: Rig, contender: Contender, beacons: tuple[Beacon, ...], rate_hz: float, seconds: float, warm_s: float
) -> Segment:
    """Let it fly, and measure for so many seconds, `warm_s` after it was engaged."""
    with tempfile.TemporaryDirectory() as scratch, _running(rig, contender, beacons, Path(scratch)) as pid:
        rig.begin(rate_hz)
        _wait_for(lambda: rig.count() > 5, f"{contender.name} sends no setpoints")
        time.sleep(_ENGAGED_S + warm_s)
        cpu_s, began_ns = cpu_of(pid), time.monotonic_ns()
        time.sleep(seconds)
        cpu_s, ended_ns = cpu_of(pid) - cpu_s, time.monotonic_ns()
        rss_mib = rss_of(pid)
        puts, heard = rig.end()
    puts = [t for t in puts if began_ns <= t < ended_ns - 200_000_000]
    latencies_s, lost = matched(puts, heard)
    if not latencies_s:
        raise RuntimeError(f"{contender.name} answered none of {len(puts)} ranges")
    inside = [h.t_ns for h in heard if began_ns <= h.t_ns < ended_ns]
    gaps_s = [(b - a) * 1e-9 for a, b in pairwise(inside)]
    return Segment(latencies_s, lost, gaps_s, cpu_s / ((ended_ns - began_ns) * 1e-9), rss_mib)


def matched(puts: list[int], heard: list[Heard]) -> tuple[list[float], int]:
    """From each put to the first setpoint that was computed and received after it; and how many had none
    before the next put."""
    latencies_s: list[float] = []
    lost, k = 0, 0
    for put_ns, next_ns in zip(puts, [*puts[1:], puts[-1] + 100_000_000], strict=True):
        stamp_ms = put_ns // 1_000_000 & 0xFFFFFFFF
        while k < len(heard) and (heard[k].t_ns <= put_ns or heard[k].stamp_ms < stamp_ms):
            k += 1
        if k < len(heard) and heard[k].t_ns < next_ns:
            latencies_s.append((heard[k].t_ns - put_ns) * 1e-9)
            k += 1
        else:
            lost += 1
    return latencies_s, lost


@contextmanager
def _running(rig: Rig, contender: Contender, beacons: tuple[Beacon, ...], scratch: Path) -> Iterator[int]:
    config = scratch / "bench.toml"
    config.write_text(configuration(rig, beacons), encoding="utf-8")
    ours, theirs = pty.openpty()  # the live view wants a terminal
    process = subprocess.Popen(
        contender.command(config, rig, scratch), stdin=subprocess.DEVNULL, stdout=theirs, stderr=theirs
    )
    precede(process.pid)
    os.close(theirs)
    reader = threading.Thread(target=_drain, args=(ours,), daemon=True)
    reader.start()
    try:
        yield process.pid
        if process.poll() is not None:
            raise RuntimeError(f"{contender.name} ended by itself with status {process.returncode}")
    finally:
        process.kill()  # a measurement needs no orderly landing
        process.wait()
        reader.join(5.0)
        os.close(ours)


def _drain(terminal: int) -> None:
    with suppress(OSError):  # the other end has gone
        while os.read(terminal, 65536):
            pass


def _wait_for(there: Callable[[], bool], otherwise: str) -> None:
    limit = time.monotonic() + _START_LIMIT_S
    while not there():
        if time.monotonic() > limit:
            raise RuntimeError(f"{otherwise} within {_START_LIMIT_S:g} s")
        time.sleep(0.02)


def start_s(rig: Rig, contender: Contender) -> float:
    """From the command to the first HEARTBEAT on the wire."""
    rig.begin(20.0)
    with tempfile.TemporaryDirectory() as scratch:
        began_ns = time.monotonic_ns()
        with _running(rig, contender, ONE, Path(scratch)):
            _wait_for(lambda: rig.first_heartbeat_ns() is not None, f"{contender.name} sends no heartbeat")
            heartbeat_ns = rig.first_heartbeat_ns()
    rig.end()
    return ((heartbeat_ns or began_ns) - began_ns) * 1e-9


def cpu_of(pid: int) -> float:
    """CPU time that a process has used, all its threads, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def rss_of(pid: int) -> float:
    """Resident memory, MiB. Not by pathlib: it interns every part of a path, and the interpreter's table of
    such strings grows by half a MiB when it has been filled."""
    with open(f"/proc/{pid}/statm", "rb") as statm:  # noqa: PTH123
        pages = int(statm.read().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


@contextmanager
def loaded_cores() -> Iterator[None]:
    """Another process on every core, busy."""
    code = "while True: pass"
    busy = [subprocess.Popen([sys.executable, "-c", code]) for _ in range(os.cpu_count() or 1)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()
