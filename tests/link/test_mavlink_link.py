"""The vehicle's link: signs, masks, telemetry requests, bad bytes. Over real UDP on loopback."""

from __future__ import annotations

import math
import select
import socket
import time
from collections.abc import Iterator
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as mavlink

from companion.link.decode import heading_from_yaw
from companion.link.mavlink import VehicleLink, setpoint_message
from companion.link.modes import px4_mode
from companion.link.transport import open_transport, parse_url
from companion.settings import VehicleSettings
from companion.types import (
    Attitude,
    CompanionHeartbeat,
    Defect,
    Event,
    FlightMode,
    Landed,
    LandedReport,
    LocalMotion,
    Malformed,
    ModeReport,
    ModeRequest,
    Party,
    PartyHeard,
    Setpoint,
    SystemStatus,
    VehicleHeartbeat,
)

OFFBOARD = 6 << 16
LOITER = 4 << 16 | 3 << 24


class Autopilot:
    """The other end: a plain socket and a MAVLink encoder, as system 7."""

    def __init__(self, port: int) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", port))
        self.socket.settimeout(5.0)
        self.mav = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)

    def say(self, message: Any) -> None:
        self.socket.send(bytes(message.pack(self.mav)))
        self.mav.seq = (self.mav.seq + 1) % 256

    def heartbeat(self, armed: bool = True, mode: int = LOITER) -> None:
        base = 128 if armed else 0
        self.say(mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, base, mode, 4, 3))

    def hear(self) -> Any:
        (message,) = mavlink.MAVLink(None).parse_buffer(self.socket.recv(2048))
        return message


@pytest.fixture
def link() -> Iterator[VehicleLink]:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    settings = VehicleSettings(mavlink=f"udpin:127.0.0.1:{port}")
    opened = VehicleLink.open(settings)
    yield opened
    opened.close()


@pytest.fixture
def autopilot(link: VehicleLink) -> Iterator[Autopilot]:
    peer = Autopilot(int(link._settings.mavlink.rsplit(":", 1)[1]))
    yield peer
    peer.socket.close()


def heard(link: VehicleLink) -> list[Event]:
    ready, _, _ = select.select([link], [], [], 5.0)
    assert ready
    return list(link.receive())


def next_heard(link: VehicleLink) -> list[Event]:
    """The next events that there are."""
    end = time.monotonic() + 20.0
    while time.monotonic() < end:
        if events := heard(link):
            return events
    raise AssertionError("nothing was heard")


def test_telemetry_arrives_with_our_signs(link: VehicleLink, autopilot: Autopilot) -> None:
    autopilot.heartbeat()
    heard(link)
    autopilot.say(mavlink.MAVLink_attitude_message(1000, 0.0, 0.0, math.pi / 2, 0.0, 0.0, 0.25))
    autopilot.say(mavlink.MAVLink_local_position_ned_message(1000, 1.0, 2.0, -3.0, 0.1, 0.2, -0.3))
    events: list[Event] = []
    while len(events) < 2:
        events += heard(link)
    attitude, motion = events
    assert isinstance(attitude, Attitude)
    assert attitude.heading_rad == pytest.approx(0.0, abs=1e-6)  # NED yaw π/2 is East
    assert attitude.yaw_rate_rad_s == pytest.approx(-0.25)
    assert isinstance(motion, LocalMotion)
    assert (motion.x_m, motion.y_m, motion.height_m) == pytest.approx((2.0, 1.0, 3.0))
    assert (motion.vx_m_s, motion.vy_m_s, motion.climb_m_s) == pytest.approx((0.2, 0.1, 0.3))


def test_mode_arming_and_landed_state_arrive(link: VehicleLink, autopilot: Autopilot) -> None:
    autopilot.heartbeat(armed=True, mode=LOITER)
    (beat,) = heard(link)
    assert isinstance(beat, VehicleHeartbeat)
    assert (beat.system_id, beat.mode, beat.armed) == (7, FlightMode.AUTO_LOITER, True)
    autopilot.say(mavlink.MAVLink_current_mode_message(0, LOITER, OFFBOARD))
    (mode,) = heard(link)
    assert isinstance(mode, ModeReport)
    assert (mode.actual, mode.intended) == (FlightMode.AUTO_LOITER, FlightMode.OFFBOARD)
    autopilot.say(mavlink.MAVLink_extended_sys_state_message(0, mavlink.MAV_LANDED_STATE_IN_AIR))
    (landed,) = heard(link)
    assert isinstance(landed, LandedReport)
    assert landed.landed is Landed.IN_AIR


def test_an_autopilot_that_does_not_tell_its_intention_is_not_misread(
    link: VehicleLink, autopilot: Autopilot
) -> None:
    autopilot.heartbeat()
    heard(link)
    autopilot.say(mavlink.MAVLink_current_mode_message(0, LOITER, 0))
    (mode,) = heard(link)
    assert isinstance(mode, ModeReport)
    assert mode.intended is None


def test_what_is_not_finite_and_what_is_not_mavlink_is_named(link: VehicleLink, autopilot: Autopilot) -> None:
    autopilot.heartbeat()
    heard(link)
    autopilot.say(mavlink.MAVLink_attitude_message(0, 0.0, 0.0, math.nan, 0.0, 0.0, 0.0))
    (event,) = heard(link)
    assert isinstance(event, Malformed)
    assert (event.defect, event.detail) == (Defect.MAVLINK_FIELD, "ATTITUDE")
    autopilot.socket.send(b"\x00garbage\xff" * 20)
    assert all(isinstance(e, Malformed) and e.defect is Defect.MAVLINK_BYTES for e in heard(link))
    autopilot.heartbeat()
    assert isinstance(heard(link)[-1], VehicleHeartbeat)


def test_a_ground_station_on_the_same_link_is_not_the_vehicle(
    link: VehicleLink, autopilot: Autopilot
) -> None:
    autopilot.mav.srcSystem, autopilot.mav.srcComponent = 255, 190
    autopilot.say(mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3))
    autopilot.mav.srcSystem, autopilot.mav.srcComponent = 7, 1
    autopilot.heartbeat()
    (event,) = next_heard(link)
    assert isinstance(event, VehicleHeartbeat)
    assert event.system_id == 7


def setpoint_reaches(link: VehicleLink, peer: Autopilot) -> bool:
    """Whether a setpoint sent now is the next that this one hears, but for requests."""
    link.send(Setpoint(5_000_000, 0.5, 0.3, 0.0, 3.0, 0.0))
    while True:
        ready, _, _ = select.select([peer.socket], [], [], 0.3)
        if not ready:
            return False
        if peer.hear().get_type() == "SET_POSITION_TARGET_LOCAL_NED":
            return True


def test_a_stranger_does_not_lead_the_setpoints_astray(link: VehicleLink, autopilot: Autopilot) -> None:
    autopilot.heartbeat()
    heard(link)
    stranger = Autopilot(int(link._settings.mavlink.rsplit(":", 1)[1]))
    try:
        stranger.socket.send(b"anything")
        heard(link)
        stranger.say(mavlink.MAVLink_attitude_message(1, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0))
        assert not heard(link)
        stranger.heartbeat(armed=False)
        (told,) = heard(link)
        assert isinstance(told, PartyHeard)
        assert (told.party, told.system_id) == (Party.AUTOPILOT, 7)
        assert not setpoint_reaches(link, stranger)
        assert setpoint_reaches(link, autopilot)
        later = time.monotonic_ns() + 3_000_000_000  # the vehicle has been silent for so long
        stranger.heartbeat()
        assert select.select([link], [], [], 5.0)[0]
        assert isinstance(next(link.receive(lambda: later)), VehicleHeartbeat)
        assert setpoint_reaches(link, stranger)
    finally:
        stranger.socket.close()


@pytest.mark.parametrize("component", [191, 154])
def test_telemetry_of_other_components_is_none_of_our_business(
    link: VehicleLink, autopilot: Autopilot, component: int
) -> None:
    autopilot.heartbeat()
    heard(link)
    autopilot.mav.srcComponent = component  # a gimbal's, or one like us that tells its own
    autopilot.say(mavlink.MAVLink_attitude_message(1000, 0.0, 0.0, 1.0, 0.0, 0.0, 0.25))
    autopilot.say(mavlink.MAVLink_local_position_ned_message(1000, 1.0, 2.0, -3.0, 0.1, 0.2, -0.3))
    autopilot.mav.srcComponent = 1
    autopilot.heartbeat()
    events: list[Event] = []
    while not events:
        events += heard(link)
    assert [type(event) for event in events] == [VehicleHeartbeat]


def test_what_a_bridge_sends_back_is_no_second_companion(link: VehicleLink, autopilot: Autopilot) -> None:
    autopilot.heartbeat()
    heard(link)
    link.send(CompanionHeartbeat(0, SystemStatus.ACTIVE))
    link.send(Setpoint(5_000_000, 0.5, 0.3, 0.0, 3.0, 0.0))
    for _ in range(6):  # four requests before them
        autopilot.socket.send(autopilot.socket.recv(2048))
    autopilot.heartbeat()
    (event,) = next_heard(link)
    assert isinstance(event, VehicleHeartbeat)
    autopilot.mav.srcSystem, autopilot.mav.srcComponent = 7, 191
    autopilot.say(mavlink.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    (twin,) = heard(link)
    assert isinstance(twin, PartyHeard)
    assert twin.party is Party.TWIN


def test_telemetry_is_asked_for_until_it_comes(link: VehicleLink, autopilot: Autopilot) -> None:
    autopilot.heartbeat()
    heard(link)
    asked = {}
    for _ in range(4):
        message = autopilot.hear()
        assert message.get_type() == "COMMAND_LONG"
        assert message.command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        assert message.target_system == 7
        asked[int(message.param1)] = message.param2
    assert asked[mavlink.MAVLINK_MSG_ID_ATTITUDE] == pytest.approx(20_000)
    assert asked[mavlink.MAVLINK_MSG_ID_CURRENT_MODE] == pytest.approx(50_000)


def test_setpoints_heartbeat_and_hand_over_leave_as_mavlink_2(
    link: VehicleLink, autopilot: Autopilot
) -> None:
    autopilot.heartbeat()
    heard(link)
    for _ in range(4):
        autopilot.hear()
    link.send(Setpoint(5_000_000, 0.5, 0.3, 0.0, 3.0, 0.0))
    message = autopilot.hear()
    assert message.get_type() == "SET_POSITION_TARGET_LOCAL_NED"
    assert (message.get_srcSystem(), message.get_srcComponent()) == (7, 191)
    assert message.get_msgbuf()[0] == 0xFD
    link.send(CompanionHeartbeat(0, SystemStatus.ACTIVE))
    beat = autopilot.hear()
    assert (beat.get_type(), beat.type, beat.autopilot, beat.system_status) == ("HEARTBEAT", 18, 8, 4)
    link.send(ModeRequest(0, FlightMode.AUTO_LAND))
    request = autopilot.hear()
    assert (request.command, request.param1, request.param2, request.param3) == (176, 1.0, 4.0, 6.0)
    assert request.get_seq() == (message.get_seq() + 2) % 256


@given(heading=st.floats(-math.pi, math.pi), speed=st.floats(0.0, 2.0), yaw_rate=st.floats(-1.0, 1.0))
def test_a_setpoint_turns_into_ned(heading: float, speed: float, yaw_rate: float) -> None:
    m = setpoint_message(Setpoint(0, speed, yaw_rate, heading, 3.0, 0.0), 1)
    assert (m.coordinate_frame, m.type_mask, m.z) == (mavlink.MAV_FRAME_LOCAL_NED, 1507, -3.0)
    north, east = speed * math.sin(heading), speed * math.cos(heading)
    assert (m.vx, m.vy) == pytest.approx((north, east), abs=1e-9)
    assert m.yaw_rate == -yaw_rate


def test_without_a_height_the_setpoint_is_in_the_body_frame() -> None:
    m = setpoint_message(Setpoint(0, 0.5, 0.1, 1.0, None, 0.2), 1)
    assert (m.coordinate_frame, m.type_mask) == (mavlink.MAV_FRAME_BODY_NED, 1479)
    assert (m.vx, m.vy, m.vz, m.yaw_rate) == (0.5, 0.0, -0.2, -0.1)


@given(st.floats(-math.pi, math.pi))
def test_heading_and_yaw_are_each_others_inverse(angle: float) -> None:
    there_and_back = heading_from_yaw(heading_from_yaw(angle))
    assert math.cos(there_and_back - angle) == pytest.approx(1.0)
    assert -math.pi < there_and_back <= math.pi


@pytest.mark.parametrize(
    ("custom_mode", "mode"),
    [
        (393216, FlightMode.OFFBOARD),
        (50593792, FlightMode.AUTO_LOITER),
        (33816576, FlightMode.AUTO_TAKEOFF),
        (196608, FlightMode.POSCTL),
        (0, FlightMode.OTHER),
        (99 << 16, FlightMode.OTHER),
    ],
)
def test_px4_modes_are_read(custom_mode: int, mode: FlightMode) -> None:
    assert px4_mode(custom_mode) is mode


@pytest.mark.parametrize(
    ("url", "parts"),
    [
        ("udpin:0.0.0.0:14540", ("udpin", "0.0.0.0", 14540)),
        ("udpout://10.0.0.2:14550", ("udpout", "10.0.0.2", 14550)),
        ("tcp:localhost:5760", ("tcp", "localhost", 5760)),
        ("serial:/dev/ttyAMA0:921600", ("serial", "/dev/ttyAMA0", 921600)),
    ],
)
def test_urls_are_read(url: str, parts: tuple[str, str, int]) -> None:
    assert parse_url(url) == parts


@pytest.mark.parametrize(
    "url", ["", "udp:1.2.3.4:5", "udpin::14540", "udpin:0.0.0.0", "udpin:h:0", "tcp:h:x", "serial:/dev/x:-1"]
)
def test_what_is_no_url_is_refused_with_the_forms_that_are(url: str) -> None:
    with pytest.raises(ValueError, match=r"udpin:HOST:PORT|is not between"):
        parse_url(url)


def test_tcp_and_serial_carry_bytes_both_ways() -> None:
    import os
    import pty

    with socket.create_server(("127.0.0.1", 0)) as server:
        tcp = open_transport(f"tcp:127.0.0.1:{server.getsockname()[1]}")
        peer, _ = server.accept()
        with peer:
            tcp.send(b"up")
            assert peer.recv(10) == b"up"
            peer.send(b"down")
            assert select.select([tcp], [], [], 5.0)[0]
            assert tcp.receive() == b"down"
            assert tcp.receive() == b""
        assert select.select([tcp], [], [], 5.0)[0]
        with pytest.raises(ConnectionError, match="closed"):
            tcp.receive()
        tcp.close()
    ours, theirs = pty.openpty()
    port = open_transport(f"serial:{os.ttyname(theirs)}:921600")
    port.send(b"up")
    assert os.read(ours, 10) == b"up"
    os.write(ours, b"down")
    assert select.select([port], [], [], 5.0)[0]
    assert port.receive() == b"down"
    port.close()
    os.close(ours)
    os.close(theirs)
