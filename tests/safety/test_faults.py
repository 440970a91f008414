"""The fault matrix in a short form, and that it notices what it is there to notice."""

from __future__ import annotations

import math
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from msgspec.structs import replace

from companion.settings import LossSettings
from companion.types import (
    Attitude,
    Event,
    FlightMode,
    ModeReport,
    ModeRequest,
    Phase,
    RangeSample,
    Setpoint,
    VehicleHeartbeat,
)
from sitl_mock.scenario import Scenario
from sitl_mock.world import World
from tests.safety.faults import report, wire
from tests.safety.faults.__main__ import main
from tests.safety.faults.batch import flights
from tests.safety.faults.flight import SETTINGS, Fault, Flight
from tests.safety.faults.matrix import FAULTS
from tests.safety.faults.rules import APPROACH, EVERY, HOLD, STALL, Rule, Sent, Step, judge
from tests.safety.faults.watch import Limits, Watch

SHORT = [
    ("range-loss", Phase.HOLD),
    ("range-loss-8s", Phase.ACQUIRE),
    ("range-absurd", Phase.APPROACH),
    ("range-backlog", Phase.COAST),
    ("telemetry-stop", Phase.APPROACH),
    ("link-loss", Phase.APPROACH),
    ("link-loss-6s", Phase.STANDBY),
    ("uplink-loss", Phase.ACQUIRE),
    ("packet-loss", Phase.APPROACH),
    ("rc-switch", Phase.HOLD),
    ("flick", Phase.APPROACH),
    ("stop", Phase.COAST),
    ("disarm", Phase.APPROACH),
    ("reboot", Phase.STALL),
    ("publisher-clock-back", Phase.APPROACH),
    ("killed", Phase.APPROACH),
    ("held-up-1500ms", Phase.APPROACH),
    ("held-up-3s", Phase.HOLD),
    ("slow-loop", Phase.RELEASED),
    ("engage-blind", Phase.AWAIT),
    ("uplink-loss", Phase.KEEP),
    ("ardupilot-takeover", Phase.APPROACH),
]


@pytest.mark.parametrize(("name", "phase"), SHORT)
def test_the_rule_for_the_fault_holds(name: str, phase: Phase) -> None:
    outcome = Flight(FAULTS[name], phase, 1).fly()
    assert outcome.held, (outcome.judgement.broken, outcome.law_broken, outcome.not_struck)


def test_killed_and_started_anew_in_the_air_the_real_process_stays_silent() -> None:
    outcome = wire.fly(wire.WIRE["wire/restart"])
    assert outcome.held, (outcome.judgement.broken, outcome.law_broken, outcome.not_struck)
    assert [step.phase for step in outcome.steps] == [Phase.INHIBITED]


def test_a_message_that_is_repeated_is_the_same_to_its_stamp() -> None:
    flight = Flight(FAULTS["range-frozen"], Phase.COAST, 1)
    told, stamps = flight.watch.told, Counter[tuple[int, int | None]]()

    def noted(event: Event) -> None:
        if isinstance(event, RangeSample):
            stamps[event.seq, event.sent_t_ns] += 1
        told(event)

    flight.watch.told = noted  # type: ignore[method-assign]
    assert flight.fly().held
    assert len(stamps) == len({seq for seq, _ in stamps})
    assert max(stamps.values()) > 50


def test_the_matrix_is_as_large_as_it_says() -> None:
    assert len(FAULTS) >= 30
    assert {f.family for f in FAULTS.values()} == {
        "range", "link", "person", "vehicle", "clock", "process", "load",
    }  # fmt: skip
    assert len(flights(list(FAULTS), [p.value for p in EVERY], [1])) > 9 * 50


def unruly(name: str, **loss: float) -> Fault:
    """The fault, and an app in which one of the safety rules is set aside."""
    settings = replace(SETTINGS, loss=LossSettings(**loss))  # type: ignore[arg-type]
    return FAULTS[name]._replace(settings=settings)


def test_an_app_that_streams_again_after_a_stop_is_found_out() -> None:
    outcome = Flight(unruly("held-up-1500ms", held_up_after_s=10.0), APPROACH, 1).fly()
    assert "a setpoint 1.50 s after the strike" in outcome.judgement.broken


def test_an_app_that_does_not_let_go_of_a_lost_vehicle_is_found_out() -> None:
    outcome = Flight(unruly("link-loss", vehicle_after_s=30.0), APPROACH, 1).fly()
    assert any(what.startswith("released never") for what in outcome.judgement.broken)


def test_a_rule_names_what_broke_it() -> None:
    rule = Rule("", ((STALL, 1.0),), still=(1.0, 5.0), silent=(3.0, math.inf), ends_in=frozenset({HOLD}))
    steps = [Step(1.5, STALL, "late"), Step(2.0, APPROACH, "why")]
    sent = [Sent(0.5, 0.5), Sent(2.5, 0.3), Sent(6.0, 0.0)]
    assert judge(rule, APPROACH, steps, sent).broken == (
        "stall after 1.50 s, not within 1 s",
        "a forward speed 2.50 s after the strike",
        "a setpoint 6.00 s after the strike",
        "ends in approach",
    )
    kept = judge(rule, STALL, [Step(0.4, HOLD, "")], sent[:1])
    assert kept.broken == ()
    assert kept.took_s == 0.5


# ---------------------------------------------------------------------------------------------- the law

T = 10**9
MOVING = Setpoint(T, 0.3, 0.1, 0.0, 3.0, 0.0)


def told(**without: bool) -> Watch:
    """A watch of a flight in order, without some of the grounds for a speed."""
    watch = Watch(SETTINGS, World(Scenario(), 1))
    watch.begin()
    if "armed" not in without:
        watch.told(VehicleHeartbeat(T, 1, FlightMode.OFFBOARD, True))
    if "mode" not in without:
        watch.told(ModeReport(T, FlightMode.OFFBOARD, FlightMode.OFFBOARD))
    if "heading" not in without:
        watch.told(Attitude(T, 0.0, 0.0))
    if "range" not in without:
        watch.told(RangeSample(T, "b1", "s", 1, 5.0))
    return watch


def breaches(watch: Watch, setpoint: Setpoint) -> str:
    watch.sent(setpoint, APPROACH)
    return "; ".join(watch.broken)


def test_a_flight_in_order_breaks_no_law() -> None:
    assert not breaches(told(), MOVING)


@pytest.mark.parametrize(
    ("missing", "words"),
    [("armed", "armed: False"), ("mode", "a speed while"), ("heading", "a heading"), ("range", "ranges")],
)
def test_a_speed_without_grounds_is_seen(missing: str, words: str) -> None:
    watch = told(**{missing: True, **({"armed": True} if missing == "mode" else {})})
    assert words in breaches(watch, MOVING)


@pytest.mark.parametrize(
    ("setpoint", "words"),
    [
        (replace(MOVING, t_ns=T + 1), "no event caused"),
        (replace(MOVING, speed_m_s=0.7), "beyond the limits"),
        (replace(MOVING, yaw_rate_rad_s=-1.1), "beyond the limits"),
        (replace(MOVING, heading_rad=math.nan), "not finite"),
        (replace(MOVING, height_m=9.0), "out of its band"),
        (replace(MOVING, speed_m_s=0.55), "jumps"),
    ],
)
def test_a_setpoint_against_the_law_is_seen(setpoint: Setpoint, words: str) -> None:
    assert words in breaches(told(), setpoint)


def test_a_setpoint_after_offboard_was_left_is_seen() -> None:
    watch = told()
    watch.sent(MOVING, APPROACH)
    watch.told(ModeReport(T + 1, FlightMode.AUTO_LOITER, FlightMode.OFFBOARD))
    assert "after OFFBOARD was left" in breaches(watch, replace(MOVING, t_ns=T + 1, speed_m_s=0.0))


def test_a_mode_that_it_may_not_ask_for_is_seen() -> None:
    watch = told()
    watch.sent(ModeRequest(T, FlightMode.OFFBOARD), Phase.HAND_OVER)
    assert watch.broken == ["asked for OFFBOARD in hand over"]


def test_the_true_motion_is_held_against_the_limits() -> None:
    well = Limits(0.55, 0.9, 2.9, 3.1, 15.0)
    assert not well.exceeded(SETTINGS)
    ill = well.and_also(Limits(0.8, 1.4, 1.0, 5.0, 30.0))
    assert len(ill.exceeded(SETTINGS)) == 5
    assert not Limits().exceeded(SETTINGS)


def test_the_table_merges_what_came_to_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    status = main(["--only", "rc-switch", "--phase", "approach", "hold", "--seeds", "1", "--jobs", "1"])
    assert status == 0
    shown = capsys.readouterr().out
    assert "approach, hold" in shown
    assert "every rule held" in shown
    fault = FAULTS["held-up-1500ms"]
    bad = Flight(unruly(fault.name, held_up_after_s=10.0), APPROACH, 1).fly()
    table = report.rows(FAULTS, [bad])
    assert "BROKEN" in report.markdown(table, "")
    assert "seed 1, approach" in table[0].broken[0]


def test_the_command_flies_on_several_cores(tmp_path: Path) -> None:
    words = [
        "--only",
        "range-loss",
        "--phase",
        "approach",
        "--seeds",
        "2",
        "--jobs",
        "2",
        "--out",
        str(tmp_path),
    ]
    command = [sys.executable, "-m", "tests.safety.faults", *words]
    ended = subprocess.run(
        command, cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=100
    )
    assert ended.returncode == 0, ended.stderr
    assert "every rule held" in ended.stdout
