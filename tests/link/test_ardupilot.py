"""ArduCopter as the vehicle: GUIDED's own rules, in the link, in the pilot, in the mock, and all together."""

from __future__ import annotations

import select
import socket
import time
from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as mavlink

from companion.check import ardupilot as check
from companion.check.report import State
from companion.config import ConfigError, load
from companion.link.mavlink import VehicleLink, setpoint_message
from companion.link.survey import VehicleFindings
from companion.run import run
from companion.settings import LossSettings, Settings, VehicleSettings
from companion.types import (
    CompanionHeartbeat,
    Defect,
    EstimatorReport,
    Event,
    FlightMode,
    Landed,
    LocalMotion,
    Malformed,
    ModeRequest,
    Phase,
    PhaseChange,
    Setpoint,
    SystemStatus,
    VehicleHeartbeat,
)
from sitl_mock import ardupilot
from sitl_mock.autopilot import Target
from sitl_mock.faults import Faults
from sitl_mock.modes import Mode, Result
from sitl_mock.params import Params
from sitl_mock.scenario import BeaconAt, Scenario
from sitl_mock.vehicle import STEP_S, Vehicle
from sitl_mock.world import World
from tests.core.flights import LOITER, MS, OFFBOARD, Flown, Script, fly
from tests.safety.test_check import Wire
from tests.sitl_mock.process import free_udp_port, running_mock

VEHICLE = VehicleSettings(kind="ardupilot", setpoint_frame="body_ned")
SETTINGS = Settings(vehicle=VEHICLE, loss=LossSettings(hand_over_patience_s=2.0))
FORWARD = Setpoint(0, 0.5, 0.2, 0.0, None, 0.1)
AUTOPILOT = mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA
GUIDED, LAND, BRAKE = 4, 9, 17
HANDLE = {"FS_GCS_ENABLE", "SYSID_MYGCS", "GUID_TIMEOUT"}
BOUND_S = 40.0


# ------------------------------------------------------------------------------------------------- link


def heartbeat(custom_mode: int, vendor: int = AUTOPILOT) -> Any:
    return mavlink.MAVLink_heartbeat_message(2, vendor, 129, custom_mode, 4, 3)


def hear(link: VehicleLink, wire: Wire, message: Any) -> list[Event]:
    wire.incoming.append(bytes(message.pack(mavlink.MAVLink(None, 1, 1))))
    return list(link.receive(lambda: 1))


@pytest.mark.parametrize(
    ("number", "mode"),
    [
        (GUIDED, OFFBOARD),
        (LAND, FlightMode.AUTO_LAND),
        (BRAKE, LOITER),
        (5, FlightMode.POSCTL),
        (99, FlightMode.OTHER),
    ],
)
def test_its_modes_are_read_by_its_numbers(number: int, mode: FlightMode) -> None:
    wire = Wire()
    (event,) = hear(VehicleLink(VEHICLE, wire), wire, heartbeat(number))
    assert isinstance(event, VehicleHeartbeat)
    assert event.mode is mode


def test_an_autopilot_of_the_other_kind_is_not_believed() -> None:
    for kind, vendor in (("px4", AUTOPILOT), ("ardupilot", mavlink.MAV_AUTOPILOT_PX4)):
        wire = Wire()
        link = VehicleLink(VehicleSettings(kind=kind, setpoint_frame="body_ned"), wire)  # type: ignore[arg-type]
        (event,) = hear(link, wire, heartbeat(GUIDED, vendor))
        assert isinstance(event, Malformed)
        assert event.defect is Defect.MAVLINK_VENDOR
        assert not wire.sent


def test_what_it_tells_of_its_estimate_is_read() -> None:
    wire = Wire()
    link = VehicleLink(VEHICLE, wire)
    hear(link, wire, heartbeat(GUIDED))
    flags = mavlink.ESTIMATOR_VELOCITY_HORIZ | mavlink.ESTIMATOR_POS_HORIZ_REL
    told = hear(link, wire, ardupilot.EkfStatusMessage(flags))
    assert told == [EstimatorReport(1, velocity=True, position=True, height=False, global_position=False)]


def test_the_modes_that_it_is_asked_for_have_its_numbers() -> None:
    for mode, number in ((FlightMode.AUTO_LAND, LAND), (LOITER, BRAKE)):
        wire = Wire()
        link = VehicleLink(VEHICLE, wire)
        hear(link, wire, heartbeat(GUIDED))
        wire.sent.clear()
        link.send(ModeRequest(0, mode))
        (command,) = mavlink.MAVLink(None).parse_buffer(wire.sent[0])
        assert (command.command, command.param1, command.param2) == (mavlink.MAV_CMD_DO_SET_MODE, 1, number)


def test_setpoints_are_such_as_it_can_use() -> None:
    message = setpoint_message(FORWARD, 1)
    assert ardupilot.usable(message)
    assert (message.coordinate_frame, message.vx, message.vz) == (mavlink.MAV_FRAME_BODY_NED, 0.5, -0.1)
    held = Setpoint(0, 0.5, 0.2, 0.0, 3.0, 0.0)
    assert not ardupilot.usable(setpoint_message(held, 1)), "a held height: that is PX4's"


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("vehicle.setpoint_frame=local_ned", "set it to 'body_ned'"),
        ("loss.hand_over_to=release", "stays in GUIDED"),
        ("loss.battery_to=release", "loss.battery_to = 'release'"),
    ],
)
def test_what_its_guided_mode_makes_dangerous_refuses_to_start(override: str, words: str) -> None:
    base = ["vehicle.kind=ardupilot", "vehicle.setpoint_frame=body_ned"]
    load(None, {}, base)
    with pytest.raises(ConfigError, match=words):
        load(None, {}, [*base, override])


# ------------------------------------------------------------------------------------------------ pilot


def flown_by_guided(script: Script) -> Flown:
    """Ready on the ground, then armed and up in GUIDED; the mode is told by HEARTBEAT alone."""
    script.tells_mode = False
    script.armed, script.landed = False, Landed.ON_GROUND
    ready = fly(script.run(2.0), SETTINGS)
    assert ready.state.phase is Phase.STANDBY
    assert not ready.of(Setpoint), "a standstill would break a take-off in GUIDED"
    script.actual, script.armed, script.landed = OFFBOARD, True, Landed.TAKING_OFF
    climbing = fly(script.run(2.0), before=ready)
    assert climbing.state.phase is Phase.STANDBY
    assert not climbing.of(Setpoint)
    script.landed = Landed.IN_AIR
    up = fly(script.run(1.0), before=climbing)
    assert up.state.phase.is_engaged
    return up


def test_it_neither_streams_nor_engages_before_it_is_up() -> None:
    up = flown_by_guided(Script())
    assert any(isinstance(o, Setpoint) and o.height_m is None for o in up.outputs)


def test_a_hand_over_insists_since_silence_is_no_way_out() -> None:
    script = Script()
    before = flown_by_guided(script)
    script.range_m = None
    lost = fly(script.run(25.0), before=before)
    assert lost.state.phase is Phase.HAND_OVER, "it would hover in GUIDED for ever"
    asked = [o.mode for o in lost.outputs if isinstance(o, ModeRequest)]
    assert asked[0] is LOITER
    assert asked[-1] is FlightMode.AUTO_LAND
    assert lost.of(Setpoint)[-1].t_ns > (script.t_ms - 200) * MS, "and streams standstill"
    script.actual = FlightMode.AUTO_LAND
    assert fly(script.run(1.0), before=lost).state.phase is Phase.RELEASED


def test_held_up_it_hands_over() -> None:
    script = Script()
    before = flown_by_guided(script)
    script.t_ms += 6000
    after = fly(script.run(0.5), before=before)
    change = next(c for c in after.outputs if isinstance(c, PhaseChange))
    assert (change.after, change.reason) == (Phase.HAND_OVER, "this app did not run for a while")


def test_woken_it_asks_for_no_mode_before_it_has_read_that_a_pilot_took_over() -> None:
    script = Script()
    before = flown_by_guided(script)
    script.t_ms += 6000
    t_ns = script.t_ms * MS
    waited: list[Event] = [  # the first was told before the takeover, and both are read now
        VehicleHeartbeat(t_ns, 1, OFFBOARD, True),
        VehicleHeartbeat(t_ns + 1, 1, FlightMode.POSCTL, True),
    ]
    script.actual = FlightMode.POSCTL
    after = fly([*waited, *script.run(3.0)], before=before)
    assert after.state.phase is Phase.RELEASED
    assert not after.of(ModeRequest)


@pytest.mark.parametrize("mode", [OFFBOARD, FlightMode.POSCTL])
def test_a_vehicle_that_is_not_heard_is_handed_over_once_it_is_heard_and_nobody_took_over(
    mode: FlightMode,
) -> None:
    script = Script()
    before = flown_by_guided(script)
    script.tells_heartbeat = False
    gone = fly(script.run(1.0), before=before)
    gone = fly(script.run(5.0), before=gone)
    change = next(c for c in gone.outputs if isinstance(c, PhaseChange) and c.after is Phase.HAND_OVER)
    assert change.reason == "no heartbeat from the vehicle"
    assert gone.state.phase is Phase.HAND_OVER
    assert not gone.of(ModeRequest), "a pilot may fly it by now"
    script.tells_heartbeat, script.actual = True, mode
    heard = fly(script.run(2.0), before=gone)
    assert bool(heard.of(ModeRequest)) is (mode is OFFBOARD)


def test_after_a_takeover_it_stays_silent_until_a_restart_on_the_ground() -> None:
    script = Script()
    before = flown_by_guided(script)
    script.actual = FlightMode.POSCTL
    taken = fly(script.run(5.0), before=before)
    script.actual = OFFBOARD
    again = fly(script.run(5.0), before=taken)
    assert again.state.phase is Phase.RELEASED
    assert not again.of(Setpoint)


def test_a_whole_flight_in_simulation() -> None:
    scenario = Scenario(
        beacons=(BeaconAt(x_m=2.0, y_m=4.0, height_m=1.5),), telemetry="perfect", limit_s=60.0
    )
    loaded = load(
        None, {}, ["vehicle.kind=ardupilot", "vehicle.setpoint_frame=body_ned", "beacons.b1.height_m=1.5"]
    )
    world = World(scenario, 3, autopilot="ardupilot")
    final = run(world.events(), loaded.config, world.send, lambda _: None)
    assert final.flight.captured
    assert world.truth[-1].distance_m < 0.5
    heights = [sample.height_m for sample in world.truth if sample.t_s > (world.engaged_at_s or 0.0)]
    assert max(heights) - min(heights) < 0.5, "the app holds the height here"
    assert world.px4.mode is Mode.OFFBOARD


# ------------------------------------------------------------------------------------------------ check


@pytest.mark.parametrize(
    ("parameters", "warned"),
    [
        ({"FS_GCS_ENABLE": 5, "SYSID_MYGCS": 1, "GUID_TIMEOUT": 3.0}, set()),
        ({"FS_GCS_ENABLE": 0, "SYSID_MYGCS": 255, "GUID_TIMEOUT": 10.0}, HANDLE),
        ({"FS_GCS_ENABLE": 1, "SYSID_MYGCS": 1, "GUID_TIMEOUT": 3.0}, {"FS_GCS_ENABLE"}),
        ({}, HANDLE),
    ],
)
def test_the_failsafe_that_stands_in_for_the_app_is_checked(
    parameters: dict[str, float], warned: set[str]
) -> None:
    found = VehicleFindings(vendor="ArduPilot", system_id=1, parameters=parameters)
    rows = list(check.judge(found, 5.0))
    assert {row.subject for row in rows} == HANDLE
    assert {row.subject for row in rows if row.state is not State.OK} == warned
    assert all(row.do for row in rows if row.state is not State.OK)


# ------------------------------------------------------------------------------------------------- mock


def guided(**params: int) -> tuple[ardupilot.ArduPilot, Vehicle]:
    """Up in GUIDED."""
    scenario = Scenario(telemetry="perfect")
    vehicle = Vehicle(scenario, 0.0, 0.0, 3.0, 0.0)
    px4 = ardupilot.ArduPilot(scenario, 1, vehicle, Params(dict(params), ardupilot=True), Faults())
    px4.start_in_air()
    assert px4.set_mode(Mode.OFFBOARD) is Result.ACCEPTED, "without a stream"
    return px4, vehicle


def test_guided_forgets_setpoints_from_before_and_flies_those_of_now() -> None:
    px4, vehicle = guided()
    px4.set_mode(Mode.LOITER)
    px4.setpoint(Target(vx_m_s=0.5, vy_m_s=0.0, climb_m_s=0.0))
    px4.set_mode(Mode.OFFBOARD)
    run_for(px4, 2.0)
    assert abs(vehicle.vx_m_s) < 0.05
    px4.setpoint(Target(vx_m_s=0.5, vy_m_s=0.0, climb_m_s=0.0))
    run_for(px4, 2.5)
    assert vehicle.vx_m_s > 0.4
    run_for(px4, 4.0)
    assert abs(vehicle.vx_m_s) < 0.05
    assert (px4.mode, px4.armed) == (Mode.OFFBOARD, True)


@pytest.mark.parametrize(("enabled", "mode"), [(5, Mode.LAND), (0, Mode.OFFBOARD)])
def test_the_heartbeat_of_the_configured_system_is_its_dead_mans_handle(enabled: int, mode: Mode) -> None:
    px4, _ = guided(FS_GCS_ENABLE=enabled, SYSID_MYGCS=1)
    px4.hear(1)
    run_for(px4, 4.0)
    assert px4.mode is Mode.OFFBOARD
    px4.hear(255)
    run_for(px4, 2.0)
    assert px4.mode is mode


def run_for(px4: ardupilot.ArduPilot, seconds: float) -> None:
    for _ in range(round(seconds / STEP_S)):
        px4.step()


# ------------------------------------------------------------------------------------------------- wire


class Flight:
    """The link of the app to a mock, and a person's at the ground station."""

    def __init__(self, onboard: int, gcs: str) -> None:
        self.link = VehicleLink.open(
            VehicleSettings(kind="ardupilot", setpoint_frame="body_ned", mavlink=f"udpin:127.0.0.1:{onboard}")
        )
        self.gcs = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.gcs.connect(("127.0.0.1", int(gcs.rpartition(":")[2])))
        self._mav = mavlink.MAVLink(None, 255, 190)
        self.mode: FlightMode | None = None
        self.armed = False
        self.speed = self.height = 0.0

    def command(self, number: int, *params: float) -> None:
        fields = [*params, *[0.0] * (7 - len(params))]
        self.gcs.send(mavlink.MAVLink_command_long_message(1, 1, number, 0, *fields).pack(self._mav))

    def until(self, done: Callable[[], bool], setpoint: Setpoint | None = None) -> None:
        """Go on until it is so, streaming where asked to."""
        end = time.monotonic() + BOUND_S
        while not done():
            assert time.monotonic() < end, (self.mode, self.armed, self.height, self.speed)
            select.select([self.link], [], [], 0.05)
            for event in self.link.receive():
                if isinstance(event, VehicleHeartbeat):
                    self.mode, self.armed = event.mode, event.armed
                elif isinstance(event, LocalMotion):
                    self.speed, self.height = (
                        (event.vx_m_s**2 + event.vy_m_s**2) ** 0.5,
                        event.height_m or 0.0,
                    )
            self.link.send(CompanionHeartbeat(0, SystemStatus.ACTIVE))
            if setpoint is not None:
                self.link.send(setpoint)


def test_on_the_wire_it_flies_stops_by_itself_stays_in_guided_and_lands_when_asked() -> None:
    onboard = free_udp_port()
    arguments = (
        "--autopilot",
        "ardupilot",
        "--mavlink",
        f"udpout:127.0.0.1:{onboard}",
        "--gcs",
        "udpin:127.0.0.1:0",
    )
    with running_mock(*arguments, "--param", "MPC_TKO_RAMP_T=0.5") as mock:
        flight = Flight(onboard, mock.endpoints["mavlink ground station"])
        try:
            flight.until(lambda: flight.mode is LOITER)
            flight.command(mavlink.MAV_CMD_DO_SET_MODE, 1, GUIDED)
            flight.until(lambda: flight.mode is OFFBOARD)
            flight.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
            flight.until(lambda: flight.armed)
            flight.command(mavlink.MAV_CMD_NAV_TAKEOFF, 0, 0, 0, 0, 0, 0, 2.0)
            flight.until(lambda: flight.height > 1.8)
            flight.until(lambda: flight.speed > 0.4, FORWARD)
            flight.until(lambda: flight.speed < 0.1)
            assert flight.mode is OFFBOARD, "no failsafe: GUIDED goes on without anybody"
            flight.link.send(ModeRequest(0, FlightMode.AUTO_LAND))
            flight.until(lambda: flight.mode is FlightMode.AUTO_LAND)
        finally:
            flight.link.close()
            flight.gcs.close()
