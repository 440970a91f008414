"""The flight in figures: right numbers, bounded memory, and no flight too odd to be told."""

from __future__ import annotations

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance.model import shortest_path_m
from companion.summary import (
    TRAIL_LIMIT,
    FlightLog,
    FlightReport,
    Problem,
    report,
    summarise,
    target_of,
    text,
)
from companion.types import AnyOutput, Estimate, Phase, Setpoint, Severity, Status
from tests.people.flights import RADIUS_M, SPEED_M_S, TARGET, YAW_RATE_RAD_S, change, flight, status

PROBLEM = Problem(RADIUS_M, SPEED_M_S, YAW_RATE_RAD_S)


def log_of(outputs: list[AnyOutput]) -> FlightLog:
    log = FlightLog()
    for output in outputs:
        log.add(output)
    return log


def test_a_capture_in_figures() -> None:
    outputs = flight()
    s = summarise(log_of(outputs), PROBLEM)
    hold = next(o for o in outputs if isinstance(o, Status) and o.phase is Phase.HOLD)
    assert s.captured
    assert s.time_s == pytest.approx(hold.engaged_s, abs=0.02)
    assert s.path_m == pytest.approx(hold.path_m, abs=0.02)
    assert s.start is not None
    assert (s.start.x_m, s.start.y_m) == (-2.0, 0.5)
    # the target is where the last estimate says, which is near the true one
    assert s.target_x_m == pytest.approx(TARGET[0], abs=0.2)
    assert s.target_y_m == pytest.approx(TARGET[1], abs=0.2)
    bound = shortest_path_m(math.hypot(5.5, 4.5), math.pi / 2 - math.atan2(4.5, 5.5), 0.5, 0.5, 1.0)
    assert s.shortest_m == pytest.approx(bound, abs=0.25)
    assert s.path_m is not None and s.shortest_m is not None
    assert s.path_ratio == pytest.approx(s.path_m / s.shortest_m)
    assert s.extra_path_m == pytest.approx(s.path_m - s.shortest_m)
    assert s.ending == "the vehicle left OFFBOARD"


def test_a_flight_that_leaves_the_target_again_counts_to_the_last_rest() -> None:
    outputs: list[AnyOutput] = [
        status(0.0, phase=Phase.STANDBY, path_m=0.0),
        change(1.0, Phase.STANDBY, Phase.ACQUIRE, "OFFBOARD selected"),
        status(1.0, path_m=0.0),
        change(5.0, Phase.APPROACH, Phase.HOLD, "inside"),
        status(5.0, path_m=2.0),
        change(6.0, Phase.HOLD, Phase.APPROACH, "out again"),
        change(8.0, Phase.APPROACH, Phase.HOLD, "inside"),
        status(9.0, path_m=4.0, captured=True, phase=Phase.HOLD),
    ]
    s = summarise(log_of(outputs), PROBLEM)
    assert s.time_s == pytest.approx(7.0)
    assert s.path_m == pytest.approx(3.5)  # linear between the statuses at 5 s and 9 s


def test_a_hand_over_tells_its_reason_not_what_followed() -> None:
    outputs: list[AnyOutput] = [
        change(1.0, Phase.STANDBY, Phase.ACQUIRE, "OFFBOARD selected"),
        status(1.0),
        change(9.0, Phase.STALL, Phase.HAND_OVER, "no ranges for too long", Severity.CRITICAL),
        change(9.5, Phase.HAND_OVER, Phase.RELEASED, "the vehicle left OFFBOARD"),
        change(20.0, Phase.RELEASED, Phase.ENDED, "disarmed: the flight is over"),
        status(20.0, phase=Phase.ENDED),
    ]
    s = summarise(log_of(outputs), PROBLEM)
    assert not s.captured
    assert s.ending == "no ranges for too long"
    assert s.time_s == pytest.approx(8.5)
    assert text(s).startswith("target NOT captured\n")


@pytest.mark.parametrize(
    "outputs",
    [
        [],
        [status(0.0, phase=Phase.AWAIT, estimate=None, reason="waited long enough")],
        [change(0.0, Phase.AWAIT, Phase.ENDED, "stop asked for")],
        [change(0.0, Phase.STANDBY, Phase.ACQUIRE, "OFFBOARD selected")],
        [change(0.0, Phase.STANDBY, Phase.ACQUIRE, "go"), status(0.0, x_m=None, y_m=None, heading_rad=None)],
        [change(0.0, Phase.STANDBY, Phase.ACQUIRE, "go"), status(0.0, estimate=Estimate(0.2, 0.1, 0.0, 0.1))],
        [status(0.0), status(0.0)],
    ],
)
def test_no_flight_is_too_short_to_be_told(outputs: list[AnyOutput]) -> None:
    r = report(log_of(outputs), PROBLEM)
    assert "target" in text(r.summary)
    assert msgspec.json.decode(msgspec.json.encode(r), type=FlightReport) == r


def test_the_report_survives_json() -> None:
    r = report(log_of(flight()), PROBLEM)
    assert msgspec.json.decode(msgspec.json.encode(r), type=FlightReport) == r
    assert r.phases[0].phase is Phase.STANDBY
    assert [p.phase for p in r.phases[1:3]] == [Phase.ACQUIRE, Phase.APPROACH]
    assert r.phases[1].from_s == pytest.approx(0.0)


def test_memory_is_bounded_and_the_ends_are_kept() -> None:
    log = FlightLog()
    for i in range(5 * TRAIL_LIMIT):
        log.add(status(0.1 * i))
        log.add(Setpoint(status(0.1 * i).t_ns, 0.5, 0.1, 0.0, 3.0, 0.0))
        log.add(change(0.1 * i, Phase.COAST, Phase.APPROACH, "again"))
    assert len(log.trail) < TRAIL_LIMIT
    assert len(log.changes) <= TRAIL_LIMIT
    trail = report(log, PROBLEM).trail
    assert trail[-1].t_s - trail[0].t_s == pytest.approx(0.1 * (5 * TRAIL_LIMIT - 1))


@given(
    x=st.floats(-50, 50), y=st.floats(-50, 50), heading=st.floats(-math.pi, math.pi),
    tx=st.floats(-50, 50), ty=st.floats(-50, 50),
)  # fmt: skip
def test_the_target_is_found_where_it_is(x: float, y: float, heading: float, tx: float, ty: float) -> None:
    d = math.hypot(tx - x, ty - y)
    theta = math.remainder(heading - math.atan2(ty - y, tx - x), math.tau)
    found = target_of(status(x_m=x, y_m=y, heading_rad=heading, estimate=Estimate(d, 0.1, theta, 0.1)))
    assert found == pytest.approx((tx, ty), abs=1e-6)


def test_a_station_is_told_as_one_with_how_well_it_was_kept() -> None:
    problem = Problem(0.3, SPEED_M_S, YAW_RATE_RAD_S, "station")
    unsure, sure = Estimate(8.0, 2.0, 0.3, 2.0), Estimate(7.0, 0.5, 0.3, 0.2)
    outputs: list[AnyOutput] = [
        status(0.0, phase=Phase.STANDBY, estimate=None),
        change(1.0, Phase.STANDBY, Phase.ACQUIRE, "OFFBOARD selected"),
        status(1.5, phase=Phase.ACQUIRE, estimate=unsure),
        status(3.0, phase=Phase.ACQUIRE, estimate=sure),
        change(4.0, Phase.ACQUIRE, Phase.APPROACH, "bearing known"),
        change(9.0, Phase.APPROACH, Phase.KEEP, "at the station"),
        status(9.0, phase=Phase.KEEP, estimate=Estimate(0.03, 0.02, 0.0, 0.1)),
        status(19.0, phase=Phase.KEEP, estimate=Estimate(0.04, 0.02, 0.0, 0.1), captured=True),
    ]
    s = summarise(log_of(outputs), problem)
    assert s.bearing_known_s == pytest.approx(2.0)
    assert s.time_s == pytest.approx(8.0)
    assert s.kept_s == pytest.approx(10.0)
    assert s.kept_rms_m == pytest.approx(math.sqrt(0.00125))
    assert s.kept_worst_m == 0.04
    told = text(s)
    assert told.startswith("station reached\n")
    assert "target" not in told
    assert "known to ± 29° after 2.0 s" in told
    assert "10.0 s, 0.04 m rms" in told
