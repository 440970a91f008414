"""A whole flight on this machine: mock autopilot, operator and companion, each a process of its own.

This process starts them, shows what they say, and judges the flight by the mock's truth, which the companion
never sees. Nothing it started is left behind.
"""

from __future__ import annotations

import ctypes
import itertools
import math
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import IO, NamedTuple

import msgspec

from companion.config import Config, load
from companion.exits import Exit
from companion.goal import true_goal
from companion.lines import TextLine
from companion.picture import PictureError, Truth, draw_flight, headline
from companion.recording import RecordError, read
from companion.report.page import PageError, write
from companion.summary import FlightReport, Pose, Problem, shortest_from_m, text
from companion.types import FlightMode, PhaseChange, Status
from companion.view import View, ViewKind, open_view

LIMIT_S = 57.0
"""The demo's own flight takes about 40 s; another configuration may add its `sim.limit_s`."""
MOCK_START_S = 15.0
FOLLOW_S = 8.0
"""When operator or companion has ended, the other one ends within this."""
KEPT_S = 8.0
"""At a station the operator lands after this long at rest."""
STOP_S = 3.0
"""Between asking a process to end and ending it."""


class TruthRow(msgspec.Struct, frozen=True):
    """A line of the mock's truth log, as far as it is read here."""

    t_s: float
    x_m: float
    y_m: float
    heading_rad: float
    mode: FlightMode


class Verdict(NamedTuple):
    """The flight by the truth.

    `time_s` and `path_m` run from OFFBOARD to the first moment inside the capture radius, or to the end;
    `rest_m` is the distance at which the vehicle was when OFFBOARD ended; `shortest_m` as in `Summary`, but
    to the true target.
    """

    captured: bool
    time_s: float
    path_m: float
    shortest_m: float
    rest_m: float

    @property
    def path_ratio(self) -> float:
        """Path length ÷ shortest path; 1 where there was nothing to fly."""
        return self.path_m / self.shortest_m if self.shortest_m > 0.0 else 1.0


def demo(
    config_file: Path | None = None,
    *,
    seed: int = 1,
    out: Path | None = None,
    stream: IO[str] = sys.stdout,
    kind: ViewKind = ViewKind.AUTO,
) -> Exit:
    """Fly the demo; OK only if the companion says captured and the truth agrees.

    Without a file the flight of the paper's Section VII is flown, with noisy ranges, dropouts and outliers.
    `out` is the directory for record, summary, picture, report and truth: by default a new one under
    `flights/`.

    Raises `companion.config.ConfigError` where the configuration cannot be used.
    """
    config = load(config_file, os.environ).config
    target = true_goal(config)
    station = config.mission.kind == "station"
    beacons = [(at.x_m, at.y_m) for at in config.sim.beacons] if station else []
    out = out or Path("flights") / time.strftime("demo-%Y%m%d-%H%M%S")
    out.mkdir(parents=True, exist_ok=True)
    limit_s = LIMIT_S + (config.sim.limit_s if config_file is not None else 0.0)
    stream.write("mock autopilot with a UWB beacon, operator and companion, each a process of its own\n")
    stream.flush()
    interrupted = False
    with ExitStack() as stack:
        for number in (signal.SIGTERM, signal.SIGHUP):
            stack.callback(signal.signal, number, signal.signal(number, _interrupt))
        try:
            said = _fly(config, config_file, seed, out, limit_s, open_view(stream, kind))
        except KeyboardInterrupt:
            interrupted, said = True, ["demo: interrupted"]
        except _StartError as error:
            stream.write(f"demo: {error}\n")
            return Exit.LINK
    for line in said:
        stream.write(f"{line}\n")
    if interrupted:
        return Exit.INTERRUPTED
    return _tell(target, beacons, out, stream)


class _StartError(Exception):
    """A process that the others need did not come up."""


def _interrupt(number: int, _: object) -> None:
    raise KeyboardInterrupt


# ------------------------------------------------------------------------------------------ the processes


class _Child:
    """A process, its output in lines, and its end."""

    def __init__(self, name: str, arguments: Sequence[str]) -> None:
        self.name = name
        self.process = subprocess.Popen(
            [sys.executable, "-m", *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
            start_new_session=True,  # Ctrl-C reaches this process only, which then ends the others in order
            preexec_fn=_die_with_parent(),
        )
        assert self.process.stdout is not None
        self.stdout = self.process.stdout
        self._partial = b""

    def lines(self) -> list[str] | None:
        """The complete lines that have come, None at the end of its output; for when it is readable."""
        data = os.read(self.stdout.fileno(), 65_536)
        if not data:
            return None
        *whole, self._partial = (self._partial + data).split(b"\n")
        return [line.decode(errors="replace") for line in whole]

    def ask_to_end(self) -> None:
        """SIGINT, as Ctrl-C."""
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)

    def ending(self) -> str:
        """How it ended, in words; a process that has closed its output is given a moment to do so."""
        try:
            return f"ended with exit status {self.process.wait(0.5)}"
        except subprocess.TimeoutExpired:
            return "has not ended in time, and is stopped"

    def end(self) -> None:
        """Ask, wait for `STOP_S`, then kill."""
        self.ask_to_end()
        try:
            self.process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self.stdout.close()


def _die_with_parent() -> Callable[[], object] | None:
    """On Linux, a call for the child that ties its life to ours, even if we are killed (PR_SET_PDEATHSIG)."""
    if sys.platform != "linux":
        return None
    prctl = ctypes.CDLL(None).prctl
    return lambda: prctl(1, signal.SIGKILL)


def _fly(
    config: Config, config_file: Path | None, seed: int, out: Path, limit_s: float, view: View
) -> list[str]:
    """Start the three, show what they say until they have ended or the time is up; what is left to say."""
    deadline = time.monotonic() + limit_s
    file = [] if config_file is None else [str(config_file)]
    children: list[_Child] = []
    with ExitStack() as stack:
        stack.callback(view.close)

        def start(name: str, *arguments: str) -> _Child:
            child = _Child(name, arguments)
            stack.callback(child.end)
            children.append(child)
            return child

        mock = start(
            "mock", "sitl_mock",
            "--mavlink", "udpin:127.0.0.1:0", "--gcs", "udpin:127.0.0.1:0",
            "--zenoh-listen", "tcp/127.0.0.1:0",
            "--site", config.ranges.site, "--seed", str(seed), "--truth-log", str(out / "truth.jsonl"),
            *itertools.chain.from_iterable(("--scenario", f) for f in file),
        )  # fmt: skip
        onboard, ground, zenoh = _endpoints(mock)
        operator = start(
            "operator", "companion", "operator", "--mavlink", ground,
            "--height", str(config.vehicle.height_m), "--timeout", str(limit_s - 15.0),
            *(("--rest", str(KEPT_S)) if config.mission.kind == "station" else ()),
        )  # fmt: skip
        companion = start(
            "companion", "companion", "fly", "--mavlink", onboard, "--zenoh-connect", zenoh, "--view", "json",
            "--json", str(out / "flight.json"), "--record", str(out / "flight.mcap"),
            *itertools.chain.from_iterable(("--config", f) for f in file),
        )  # fmt: skip
        stack.callback(_ask_to_end, children)  # all of them, before each is waited for
        said = []
        for child, line in _lines([mock, operator, companion], deadline):
            if child is not companion:
                view.tell(f"{child.name:9} {line}")
            elif line.startswith("{"):
                show(view, line)
            else:
                said.append(line)  # its own summary, by what it knew
        for child in (companion, operator):
            view.tell(f"{child.name:9} {child.ending()}")
        return [] if (out / "flight.json").exists() else said


def _ask_to_end(children: Sequence[_Child]) -> None:
    for child in children:
        child.ask_to_end()


def _endpoints(mock: _Child) -> tuple[str, str, str]:
    """Where the mock can be reached, from its own lines: onboard link, ground station's link, Zenoh."""
    found: dict[str, str] = {}
    line = "it said nothing"
    for _, line in _lines([mock], time.monotonic() + MOCK_START_S):
        if line.startswith("listening: "):
            what, _, where = line.removeprefix("listening: ").rpartition(" ")
            found[what] = where
        if len(found) == 3:
            links = (found["mavlink onboard"], found["mavlink ground station"])
            onboard, ground = (url.replace("udpin:", "udpout:") for url in links)
            return onboard, ground, found["zenoh"]
    raise _StartError(f"the mock did not start: {line}")


def _lines(children: Sequence[_Child], deadline: float) -> Iterator[tuple[_Child, str]]:
    """Every line of every child, until the deadline, or `FOLLOW_S` after the first but the mock has ended."""
    with selectors.DefaultSelector() as selector:
        for child in children:
            selector.register(child.stdout, selectors.EVENT_READ, child)
        while len(selector.get_map()) > (1 if len(children) > 1 else 0):
            left_s = deadline - time.monotonic()
            if left_s <= 0.0:
                return
            for key, _ in selector.select(left_s):
                child = key.data
                lines = child.lines()
                if lines is None:
                    selector.unregister(child.stdout)
                    deadline = min(deadline, time.monotonic() + FOLLOW_S)
                for line in lines or ():
                    yield child, line


_decode = msgspec.json.Decoder(Status | PhaseChange | TextLine).decode


def show(view: View, line: str) -> None:
    """Show what the companion says in a line of `--view json`."""
    match _decode(line):
        case Status() as status:
            view.show(status)
        case PhaseChange() as change:
            view.note(change)
        case TextLine(line=text):
            view.tell(f"companion {text}")


# -------------------------------------------------------------------------------------------- the verdict


def judge(rows: Sequence[TruthRow], target: tuple[float, float], problem: Problem) -> Verdict | None:
    """The flight by the truth; None where OFFBOARD never began."""
    flown = in_offboard(rows)
    if not flown:
        return None
    start = flown[0]
    away = [math.dist((row.x_m, row.y_m), target) for row in flown]
    inside = next((i for i, d in enumerate(away) if d <= problem.radius_m), len(flown) - 1)
    path = itertools.pairwise((row.x_m, row.y_m) for row in flown[: inside + 1])
    return Verdict(
        captured=away[-1] <= problem.radius_m,
        time_s=flown[inside].t_s - start.t_s,
        path_m=sum(math.dist(a, b) for a, b in path),
        shortest_m=shortest_from_m(Pose(start.x_m, start.y_m, start.heading_rad), *target, problem),
        rest_m=away[-1],
    )


def in_offboard(rows: Sequence[TruthRow]) -> list[TruthRow]:
    """From the first moment in OFFBOARD until it was left. (Having landed, PX4 shows OFFBOARD again.)"""
    before = itertools.dropwhile(lambda row: row.mode is not FlightMode.OFFBOARD, rows)
    return list(itertools.takewhile(lambda row: row.mode is FlightMode.OFFBOARD, before))


def _tell(
    target: tuple[float, float], beacons: Sequence[tuple[float, float]], out: Path, stream: IO[str]
) -> Exit:
    """The summary, the picture, the report and the exit status."""
    try:
        flight = msgspec.json.decode((out / "flight.json").read_bytes(), type=FlightReport)
        truth_lines = (out / "truth.jsonl").read_bytes().splitlines()
    except FileNotFoundError as error:
        stream.write(f"demo: no flight to tell of: {error.filename} was not written\n")
        return Exit.NOT_CAPTURED
    rows = [msgspec.json.decode(line, type=TruthRow) for line in truth_lines if line.endswith(b"}")]
    verdict = judge(rows, target, flight.problem)
    stream.write(f"\nby what the companion knew: {text(flight.summary)}\n")
    if verdict is None:
        stream.write("\nby the truth: OFFBOARD never began\n")
        return Exit.NOT_CAPTURED
    captured = verdict.captured and flight.summary.captured
    truth = Truth([(row.x_m, row.y_m) for row in in_offboard(rows)], target, beacons)
    what, done = ("station", "reached") if flight.problem.kind == "station" else ("target", "captured")
    try:
        title = headline(captured, verdict.time_s, verdict.path_m, verdict.path_ratio, flight.problem.kind)
        draw_flight(out / "flight.png", flight, truth, title)
        picture = str(out / "flight.png")
    except PictureError as error:
        picture = f"none: {error}"
    try:
        page = out / "flight.html"
        write(page, read(out / "flight.mcap"), truth)
        report = str(page)
    except (PageError, RecordError) as error:
        report = f"none: {error}"
    stream.write(
        f"\nby the truth: {what} {done if verdict.captured else f'NOT {done}'}\n"
        f"  time           {verdict.time_s:.1f} s from OFFBOARD to the radius\n"
        f"  path           {verdict.path_m:.2f} m\n"
        f"  shortest       {verdict.shortest_m:.2f} m\n"
        f"  ratio          {verdict.path_ratio:.3f}\n"
        f"  at rest        {verdict.rest_m:.2f} m from the {what}; {done} is within "
        f"{flight.problem.radius_m:.2f} m\n"
        f"  picture        {picture}\n"
        f"  report         {report}\n"
    )
    return Exit.OK if captured else Exit.NOT_CAPTURED
