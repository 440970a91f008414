"""The world: the mock as a source of events on a virtual clock."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import hypot

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.types import (
    Attitude,
    BatteryReport,
    CompanionHeartbeat,
    EstimatorReport,
    Event,
    FlightMode,
    Landed,
    LandedReport,
    LocalMotion,
    ModeReport,
    ModeRequest,
    RangeSample,
    Setpoint,
    SystemStatus,
    Tick,
    VehicleHeartbeat,
)
from sitl_mock.faults import Fault, FaultAt
from sitl_mock.scenario import BeaconAt, Scenario
from sitl_mock.world import World, start_pose

Client = Callable[[World, Event], None]


def streaming(speed_m_s: float = 0.5, yaw_rate_rad_s: float = 0.3, until_s: float = 1e9) -> Client:
    """An app that flies a circle, from its first second on, with every tick."""
    heading = 0.0

    def client(world: World, event: Event) -> None:
        nonlocal heading
        if isinstance(event, Attitude):
            heading = event.heading_rad
        elif isinstance(event, Tick) and 1.0 <= world.t_s < until_s:
            world.send(Setpoint(event.t_ns, speed_m_s, yaw_rate_rad_s, heading, 3.0, 0.0))

    return client


def fly(world: World, client: Client | None = None) -> list[Event]:
    """Every event of a flight."""
    events: list[Event] = []
    for event in world.events():
        events.append(event)
        if client is not None:
            client(world, event)
    return events


def modes(events: list[Event]) -> list[tuple[FlightMode, FlightMode | None]]:
    """Actual and intended modes, one entry for every change."""
    found: list[tuple[FlightMode, FlightMode | None]] = []
    for event in events:
        if isinstance(event, ModeReport) and (not found or found[-1] != (event.actual, event.intended)):
            found.append((event.actual, event.intended))
    return found


LOITER = (FlightMode.AUTO_LOITER, FlightMode.AUTO_LOITER)
OFFBOARD = (FlightMode.OFFBOARD, FlightMode.OFFBOARD)


def test_begins_hovering_and_ends_at_its_limit() -> None:
    world = World(Scenario(limit_s=5.0), 1)
    events = fly(world)
    assert modes(events) == [LOITER]
    assert all(e.armed for e in events if isinstance(e, VehicleHeartbeat))
    assert {e.landed for e in events if isinstance(e, LandedReport)} == {Landed.IN_AIR}
    assert world.t_s == pytest.approx(5.0, abs=0.011)
    assert world.vehicle.height_m == pytest.approx(3.0, abs=0.2)
    assert world.engaged_at_s is None


def test_events_come_in_the_order_of_time_at_their_rates() -> None:
    events = fly(World(Scenario(limit_s=10.0, range_dropout=0.0), 1))
    times = [e.t_ns for e in events]
    assert times == sorted(times)
    rates = {
        Attitude: 50, LocalMotion: 30, ModeReport: 20, Tick: 50, VehicleHeartbeat: 1, RangeSample: 20
    }  # fmt: skip
    for kind, rate in rates.items():
        assert sum(isinstance(e, kind) for e in events) == pytest.approx(10 * rate, abs=2), kind


def test_person_selects_offboard_once_setpoints_stream() -> None:
    world = World(Scenario(limit_s=10.0), 1)
    events = fly(world, streaming())
    assert modes(events) == [LOITER, OFFBOARD]
    assert world.engaged_at_s == pytest.approx(1.5, abs=0.05)
    told = next(e.t_ns for e in events if isinstance(e, ModeReport) and e.actual is FlightMode.OFFBOARD)
    assert (told - events[0].t_ns) / 1e9 == pytest.approx(world.engaged_at_s, abs=0.03)
    assert world.path_length_m() == pytest.approx(world.vehicle.path_m, rel=0.01)
    assert world.path_length_m(since_s=5.0) + world.path_length_m(5.0) == pytest.approx(
        world.path_length_m(), rel=0.01
    )


def test_same_seed_same_events_and_another_seed_others() -> None:
    def flight(seed: int) -> list[Event]:
        return fly(World(Scenario(limit_s=6.0, telemetry="stock", random_start=True), seed), streaming())

    assert flight(3) == flight(3)
    assert flight(3) != flight(4)


def test_setpoints_steer_in_the_paper_s_frame() -> None:
    """Heading 0 is East, a positive yaw rate turns to the left, the height is the setpoint's."""
    scenario = Scenario(telemetry="perfect", start_x_m=0.0, start_y_m=0.0, start_heading_rad=0.0, limit_s=8.0)
    world = World(scenario, 1)
    turning = World(scenario, 1)

    def straight(world: World, event: Event) -> None:
        if isinstance(event, Tick):
            world.send(Setpoint(event.t_ns, 0.5, 0.0, 0.0, 4.0, 0.0))

    fly(world, straight)
    assert world.vehicle.x_m > 2.5
    assert abs(world.vehicle.y_m) < 0.01
    assert world.vehicle.height_m == pytest.approx(4.0, abs=0.05)
    fly(turning, streaming(0.5, 0.3))
    assert turning.vehicle.y_m > 0.5


def test_without_a_height_the_climb_rate_is_flown() -> None:
    world = World(Scenario(telemetry="perfect", limit_s=6.0), 1)

    def climbing(world: World, event: Event) -> None:
        if isinstance(event, Tick):
            world.send(Setpoint(event.t_ns, 0.0, 0.0, 0.0, None, 0.2))

    fly(world, climbing)
    assert world.vehicle.climb_m_s == pytest.approx(0.2, abs=0.01)
    assert 3.7 < world.vehicle.height_m < 4.2


def test_stream_that_stops_meets_the_autopilot_s_rules() -> None:
    world = World(Scenario(limit_s=12.0), 1, params={"COM_OBL_RC_ACT": 5})
    events = fly(world, streaming(until_s=6.0))
    assert modes(events) == [LOITER, OFFBOARD, (FlightMode.AUTO_LOITER, FlightMode.OFFBOARD)]


def test_mode_request_is_obeyed_and_the_rest_ignored() -> None:
    world = World(Scenario(limit_s=30.0), 1)
    steer = streaming(until_s=5.0)

    def client(world: World, event: Event) -> None:
        steer(world, event)
        if isinstance(event, Tick) and 4.9 < world.t_s < 4.93:
            world.send(ModeRequest(event.t_ns, FlightMode.AUTO_LAND))
            world.send(CompanionHeartbeat(event.t_ns, SystemStatus.ACTIVE))

    events = fly(world, client)
    assert modes(events)[:3] == [LOITER, OFFBOARD, (FlightMode.AUTO_LAND, FlightMode.AUTO_LAND)]
    assert not world.px4.armed
    heartbeats = [e for e in events if isinstance(e, VehicleHeartbeat)]
    assert not heartbeats[-1].armed
    assert [e for e in events if isinstance(e, LandedReport)][-1].landed is Landed.ON_GROUND


def test_telemetry_that_is_never_told() -> None:
    events = fly(World(Scenario(limit_s=3.0, telemetry="none"), 1))
    kinds = {type(e) for e in events}
    assert kinds == {
        VehicleHeartbeat, ModeReport, LandedReport, BatteryReport, EstimatorReport, RangeSample, Tick
    }  # fmt: skip


@given(st.integers(0, 10_000))
@settings(max_examples=30)
def test_random_start_is_in_the_ring_around_the_first_beacon(seed: int) -> None:
    scenario = Scenario(random_start=True, beacons=(BeaconAt(x_m=7.0, y_m=-3.0), BeaconAt(id="b2")))
    x, y, _ = start_pose(scenario, seed)
    assert 3.0 <= hypot(x - 7.0, y + 3.0) <= 30.0
    assert start_pose(scenario, seed) == start_pose(scenario, seed)


def test_several_beacons_take_turns() -> None:
    scenario = Scenario(
        beacons=(BeaconAt(id="a"), BeaconAt(id="b", x_m=0.0), BeaconAt(id="c", y_m=0.0)),
        range_dropout=0.0,
        limit_s=2.0,
    )
    samples = [e for e in fly(World(scenario, 1)) if isinstance(e, RangeSample)]
    assert {e.beacon for e in samples} == {"a", "b", "c"}
    times = [e.t_ns for e in samples]
    assert len(set(times)) == len(times)


def test_faults_on_the_virtual_clock() -> None:
    faults = (
        FaultAt(Fault.RANGE_LOSS, 2.0, 1.0),
        FaultAt(Fault.TELEMETRY_STOP, 4.0, 1.0),
        FaultAt(Fault.LINK_LOSS, 6.0, 1.0),
        FaultAt(Fault.REBOOT, 8.0),
    )
    world = World(Scenario(limit_s=12.0), 1, faults)
    events = fly(world)

    def kinds(since: float, until: float) -> set[type[Event]]:
        begin = 1_000_000_000
        return {type(e) for e in events if since < (e.t_ns - begin) / 1e9 <= until}

    assert RangeSample not in kinds(2.05, 3.0)
    assert RangeSample in kinds(3.0, 4.0)
    assert kinds(4.05, 5.0) <= {RangeSample, Tick, VehicleHeartbeat}
    assert kinds(6.05, 7.0) == {RangeSample, Tick}
    assert kinds(8.05, 9.9) == {RangeSample, Tick}
    clocks = [e.boot_ms for e in events if isinstance(e, Attitude)]
    assert not all(a <= b for a, b in pairwise(clocks))


def test_link_loss_cuts_the_stream_as_well() -> None:
    """The fallback is seen when the link is back, just before the stream brings OFFBOARD back."""
    world = World(Scenario(limit_s=9.0), 1, (FaultAt(Fault.LINK_LOSS, 4.0, 3.0),), {"COM_OBL_RC_ACT": 5})
    events = fly(world, streaming())
    assert modes(events) == [LOITER, OFFBOARD, (FlightMode.AUTO_LOITER, FlightMode.OFFBOARD), OFFBOARD]
    seen = [e.t_ns for e in events if isinstance(e, ModeReport) and e.actual is not FlightMode.OFFBOARD]
    assert (max(seen) - 1_000_000_000) / 1e9 == pytest.approx(7.0, abs=0.05)
