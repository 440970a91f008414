"""The demo: its verdict is the truth's, and nothing that it starts is left behind."""

from __future__ import annotations

import os
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from companion.demo import TruthRow, in_offboard, judge, show
from companion.lines import json_lines
from companion.summary import Problem
from companion.types import FlightMode, Phase, PhaseChange, Status
from companion.view import View
from tests.people.flights import change, status
from tests.people.parties import spawn

PROBLEM = Problem(0.5, 0.5, 1.0)
TARGET = (10.0, 0.0)


def row(t_s: float, x_m: float, mode: FlightMode = FlightMode.OFFBOARD) -> TruthRow:
    return TruthRow(t_s, x_m, 0.0, 0.0, mode)


def track(until_m: float) -> list[TruthRow]:
    """Straight at the target at 0.5 m/s, to this far along, between a hover and a landing."""
    flown = [row(10.0 + 0.02 * i, 0.01 * i) for i in range(round(until_m * 100) + 1)]
    before = [row(0.02 * i, 0.0, FlightMode.AUTO_LOITER) for i in range(5)]
    after = [row(flown[-1].t_s + 1.0, until_m, FlightMode.AUTO_LAND), row(flown[-1].t_s + 9.0, until_m + 3.0)]
    return before + flown + after


def test_a_capture_is_judged_by_the_truth() -> None:
    verdict = judge(track(9.7), TARGET, PROBLEM)
    assert verdict is not None and verdict.captured
    assert verdict.time_s == pytest.approx(19.0, abs=0.05)  # to the capture radius, not to rest
    assert verdict.path_m == pytest.approx(9.5, abs=0.02)
    assert verdict.shortest_m == pytest.approx(9.5)
    assert verdict.path_ratio == pytest.approx(1.0, abs=0.005)
    assert verdict.rest_m == pytest.approx(0.3)


def test_rest_outside_the_radius_is_no_capture() -> None:
    verdict = judge(track(9.4), TARGET, PROBLEM)
    assert verdict is not None and not verdict.captured
    assert verdict.rest_m == pytest.approx(0.6)
    through = judge(track(10.8), TARGET, PROBLEM)  # flown through it and come to rest beyond
    assert through is not None and not through.captured


def test_what_px4_shows_after_the_landing_is_no_flight() -> None:
    rows = track(9.7)
    assert rows[-1].mode is FlightMode.OFFBOARD
    assert in_offboard(rows)[-1].x_m == pytest.approx(9.7)
    assert judge([row(0.0, 0.0, FlightMode.AUTO_LOITER)], TARGET, PROBLEM) is None


def test_whatever_the_companion_says_is_shown() -> None:
    heard: list[Status | PhaseChange | str] = []
    view = SimpleNamespace(show=heard.append, note=heard.append, tell=heard.append)
    noted = change(4.0, Phase.ACQUIRE, Phase.APPROACH, "bearing known")
    for line in json_lines([noted, "Zenoh: connected to nobody; it keeps trying."], status()):
        show(cast(View, view), line)
    assert heard == [noted, "companion Zenoh: connected to nobody; it keeps trying.", status()]


def children_of(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def is_running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False


@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_nothing_is_left_behind(by: signal.Signals, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    demo = spawn("companion", "demo")
    started: list[int] = []
    try:
        assert demo.stdout is not None
        said = [demo.stdout.readline()]
        while "operator" not in said[-1] or len(children_of(demo.pid)) < 3:
            assert said[-1], f"the demo ended by itself: {said}"
            said.append(demo.stdout.readline())
        started = children_of(demo.pid)
        demo.send_signal(by)
        demo.stdout.read()
        assert demo.wait(30.0) == (-signal.SIGKILL if by is signal.SIGKILL else 130)
        end = time.monotonic() + 30.0
        while any(is_running(pid) for pid in started):
            assert time.monotonic() < end, "still running"
            time.sleep(0.05)
    finally:
        demo.kill()
        for pid in filter(is_running, started):
            os.kill(pid, signal.SIGKILL)
