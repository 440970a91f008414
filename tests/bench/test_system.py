"""The benchmark of the whole app: what it matches, what it calls a failure, and that it measures at all."""

from __future__ import annotations

import json

import pytest

from companion.bench.system import wire
from companion.bench.system.figures import Figure, Machine, Report, markdown, table
from companion.bench.system.rig import Heard, Rig
from companion.cli import main
from companion.exits import Exit

MS = 1_000_000


def test_a_setpoint_answers_the_range_before_it_and_only_once() -> None:
    puts = [100 * MS, 150 * MS, 200 * MS]
    heard = [
        Heard(99 * MS, 99),
        Heard(101 * MS, 99),  # computed before the first range
        Heard(102 * MS, 100),
        Heard(203 * MS, 201),  # the second range was never answered
    ]
    latencies_s, lost = wire.matched(puts, heard)
    assert latencies_s == pytest.approx([0.002, 0.003])
    assert lost == 1


def test_a_ratio_fails_at_twice_its_goal_in_every_turn() -> None:
    def figure(value: float, least: float) -> Figure:
        return Figure("k", "what", "µs", value, 1.3, 100.0, is_ratio=True, least_ratio=least)

    assert figure(125.0, 1.2).reached
    assert not figure(250.0, 2.4).reached and not figure(250.0, 2.4).failed
    assert not figure(300.0, 1.4).failed, "a neighbour may have been there in the other turns"
    assert figure(300.0, 2.7).failed
    assert not Figure("k", "what", "ms", 90.0, 10.0, 1.0).failed, "an absolute figure is the machine's matter"
    assert not Figure("k", "what", "1/s", 3.0, 20.0, at_least=True).reached


def test_what_is_missed_shows() -> None:
    figures = (Figure("a", "good", "s", 0.2, 0.5, 0.1), Figure("b", "bad", "1/s", 3.0, 20.0, at_least=True))
    report = Report(False, Machine("3", "x", 2, 0.1), figures, {"zenoh": 30.0}, {}, ("moon",))
    good, bad = table(report).splitlines()[2:4]
    assert "missed" in bad and "missed" not in good and "2.00" in good
    assert "**≥ 20 1/s**" in markdown(report) and "**≤ 0.5 s**" not in markdown(report)


def test_the_app_is_measured_on_the_rig() -> None:
    with Rig(wire.ONE) as rig:
        segment = wire.measure(rig, wire.BARE, wire.ONE, 50.0, 1.0, 0.0)
    assert len(segment.latencies_s) + segment.lost >= 20
    assert segment.rss_mib > 5.0 and segment.cpu > 0.0


def test_the_command_prints_figures(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "system", "--only", "size", "--json"]) == Exit.OK
    assert json.loads(capsys.readouterr().out)["sizes_mib"]["msgspec"] > 0.1
    assert main(["bench", "system", "--only", "moon"]) == Exit.USAGE
    assert "latency" in capsys.readouterr().err
