"""`companion check` against the mock, in its own process and over real UDP and Zenoh."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as mavlink

from companion.check import CheckReport, Row, State, check, text
from companion.link.mavlink import setpoint_message
from companion.link.signing import Key, SignedMavlink, Timestamps
from companion.link.survey import VehicleSurvey
from companion.network_settings import RangesSettings
from companion.settings import LimitSettings, Settings, VehicleSettings
from companion.types import Setpoint
from tests.safety.relay import Relay
from tests.sitl_mock.process import free_udp_port, running_mock

PATIENCE_S = 20.0
"""Where everything comes; it ends as soon as it has."""
IN_VAIN_S = 5.0
"""Where something never comes."""
HOLD, OFFBOARD = (4.0, 3.0), (6.0, 0.0)


class Stage:
    """A mock, the relay before it, and settings that lead there."""

    def __init__(self, relay: Relay, zenoh: str) -> None:
        self.relay = relay
        self.settings = Settings(
            vehicle=VehicleSettings(mavlink=f"udpout:127.0.0.1:{relay.port}"),
            ranges=RangesSettings(connect=(zenoh,)),
        )

    def select(self, mode: tuple[float, float]) -> None:
        """A person selects a mode (main, sub)."""
        self.relay.command(
            mavlink.MAVLink_command_long_message(
                1, 1, mavlink.MAV_CMD_DO_SET_MODE, 0, 1.0, *mode, 0.0, 0.0, 0.0, 0.0
            )
        )


@contextmanager
def stage(*arguments: str) -> Iterator[Stage]:
    with running_mock("--mavlink", "udpin:127.0.0.1:0", "--gcs", "none", *arguments, endpoints=2) as mock:
        relay = Relay(int(mock.endpoints["mavlink onboard"].rpartition(":")[2]))
        try:
            yield Stage(relay, mock.endpoints["zenoh"])
        finally:
            relay.close()


@pytest.fixture(scope="module")
def healthy() -> Iterator[Stage]:
    with stage("--param", "COM_OBL_RC_ACT=5") as ready:
        yield ready


def row(report: CheckReport, subject: str) -> Row:
    (found,) = [r for r in report.rows if r.subject == subject]
    return found


def failed(report: CheckReport) -> set[str]:
    return {r.subject for r in report.rows if r.state is State.FAIL}


QUESTIONS = {mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAV_CMD_REQUEST_MESSAGE}


def test_a_healthy_vehicle_is_ready_and_nothing_was_actuated(healthy: Stage) -> None:
    healthy.relay.sent.clear()
    report = check(healthy.settings, PATIENCE_S)
    assert report.ready, text(report)
    assert "PX4 1.17.0 alpha, quadrotor, system 1" in row(report, "autopilot").found
    assert row(report, "radio control").state is State.WARN
    assert "7." in row(report, "b1 (target)").found
    sent = healthy.relay.sent
    assert {m.get_type() for m in sent} == {"HEARTBEAT", "PARAM_REQUEST_READ", "COMMAND_LONG"}
    assert {m.command for m in sent if m.get_type() == "COMMAND_LONG"} == QUESTIONS


def test_offboard_selected_too_early(healthy: Stage) -> None:
    healthy.select(OFFBOARD)
    try:
        report = check(healthy.settings, PATIENCE_S)
    finally:
        healthy.select(HOLD)
    assert not report.ready
    assert "intended OFFBOARD" in row(report, "mode").found
    assert "select another mode" in row(report, "mode").do


def test_ranges_of_another_site_and_limits_below_the_speed(healthy: Stage) -> None:
    elsewhere = Settings(
        vehicle=healthy.settings.vehicle,
        ranges=RangesSettings(connect=healthy.settings.ranges.connect, site="hangar"),
        limits=LimitSettings(speed_m_s=0.2),
    )
    report = check(elsewhere, IN_VAIN_S)
    assert failed(report) == {"b1 (target)", "contradiction"}
    assert "uwb/v1/hangar/b1/*/range" in row(report, "b1 (target)").found
    assert "limits.speed_m_s" in row(report, "contradiction").found


def test_battery_low() -> None:
    with stage("--param", "COM_OBL_RC_ACT=5", "--fault", "battery-low@0") as mock:
        report = check(mock.settings, PATIENCE_S)
    assert failed(report) == {"battery", "arming checks"}


def test_velocity_estimate_invalid() -> None:
    with stage("--param", "COM_OBL_RC_ACT=4", "--fault", "velocity-invalid@0") as mock:
        report = check(mock.settings, IN_VAIN_S)
    assert failed(report) == {"velocity", "local position", "LOCAL_POSITION_NED"}
    assert "no offboard signal" in row(report, "velocity").why
    assert "never came" in row(report, "LOCAL_POSITION_NED").found


def test_wrong_endpoints_are_named() -> None:
    port = free_udp_port()
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as nobody:  # bound, not listening: refused
        nobody.bind(("127.0.0.1", 0))
        zenoh = f"tcp/127.0.0.1:{nobody.getsockname()[1]}"
        report = check(
            Settings(
                vehicle=VehicleSettings(mavlink=f"udpin:127.0.0.1:{port}"),
                ranges=RangesSettings(connect=(zenoh,)),
            ),
            1.0,
        )
    assert failed(report) == {"autopilot", "Zenoh", "b1 (target)"}
    assert f"udpin:127.0.0.1:{port} within 1." in row(report, "autopilot").found
    assert "nothing came at all" in row(report, "autopilot").found
    assert zenoh in row(report, "Zenoh").found


def test_endpoints_that_cannot_be_opened_are_named() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        report = check(
            Settings(
                vehicle=VehicleSettings(mavlink=f"udpin:127.0.0.1:{taken.getsockname()[1]}"),
                ranges=RangesSettings(listen=("tcp/203.0.113.1:7447",)),
            ),
            1.0,
        )
    assert failed(report) == {"autopilot", "Zenoh"}
    assert "in use" in row(report, "autopilot").found
    assert "203.0.113.1" in row(report, "Zenoh").found
    assert ".rs:" not in row(report, "Zenoh").found


# ------------------------------------------------------------------------------- survey, without a mock


class Wire:
    """A transport in memory."""

    def __init__(self) -> None:
        self.incoming: list[bytes] = []
        self.sent: list[bytes] = []

    def fileno(self) -> int:
        return -1

    def receive(self) -> bytes:
        return self.incoming.pop(0) if self.incoming else b""

    def send(self, data: bytes) -> None:
        self.sent.append(data)

    def close(self) -> None:
        pass


KEY = Key(bytes(range(32)))


def px4(mav: Any) -> bytes:
    message = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 1, 4 << 16 | 3 << 24, 3, 3)
    data = bytes(message.pack(mav))
    mav.seq = (mav.seq + 1) % 256
    return data


def plain(system: int = 1) -> Any:
    return mavlink.MAVLink(None, srcSystem=system, srcComponent=1)


@pytest.fixture
def signed(tmp_path: Path) -> Iterator[SignedMavlink]:
    mav = SignedMavlink(KEY, Timestamps(tmp_path / "ours"))
    yield mav
    mav.close()


@pytest.fixture
def signing_autopilot(tmp_path: Path) -> Iterator[SignedMavlink]:
    mav = SignedMavlink(KEY, Timestamps(tmp_path / "autopilot"), source_component=1)
    yield mav
    mav.close()


def test_on_a_signed_link_only_the_holder_of_the_key_is_found(
    signed: SignedMavlink, signing_autopilot: SignedMavlink
) -> None:
    wire = Wire()
    survey = VehicleSurvey(VehicleSettings(), wire, signed)
    wire.incoming = [px4(plain())]
    survey.receive(lambda: 1)
    assert survey.found.t_found_ns is None
    assert sum(survey.found.refused.values()) == 1
    wire.incoming = [px4(signing_autopilot)]
    survey.receive(lambda: 2)
    assert survey.found.verified == 1
    survey.ask(2_000_000_000)
    reader = mavlink.MAVLink(None)
    reader.signing.secret_key = bytes(KEY)
    messages = [m for data in wire.sent for m in reader.parse_buffer(data)]
    assert len(messages) > 5
    assert all(m.get_signed() for m in messages)


def test_an_autopilot_that_signs_is_noticed_without_a_key(signing_autopilot: SignedMavlink) -> None:
    wire = Wire()
    survey = VehicleSurvey(VehicleSettings(), wire)
    wire.incoming = [px4(signing_autopilot)]
    survey.receive(lambda: 1)
    assert survey.found.signs
    assert survey.found.verified == 0


def test_it_waits_for_the_configured_system_and_names_the_other() -> None:
    wire = Wire()
    survey = VehicleSurvey(VehicleSettings(target_system=3), wire)
    wire.incoming = [px4(plain(7)), b"garbage"]
    survey.receive(lambda: 1)
    assert survey.missing() == ["HEARTBEAT"]
    assert [o.system for o in survey.found.others] == [7]
    assert survey.found.not_mavlink == 1
    survey.ask(2_000_000_000)
    assert len(wire.sent) == 1  # our HEARTBEAT, and no questions to a stranger


@pytest.mark.parametrize(("target", "counts"), [(1, True), (9, False)])
def test_who_steers_our_vehicle_is_noticed(target: int, counts: bool) -> None:
    wire, other = Wire(), mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
    survey = VehicleSurvey(VehicleSettings(), wire)
    setpoint = setpoint_message(Setpoint(0, 0.5, 0.0, 0.0, 3.0, 0.0), target)
    wire.incoming = [px4(plain()), bytes(setpoint.pack(other))]
    survey.receive(lambda: 1)
    assert {o.system for o in survey.found.commanders} == ({255} if counts else set())


def test_lost_packets_are_counted_by_the_gaps() -> None:
    wire, mav = Wire(), plain()
    survey = VehicleSurvey(VehicleSettings(), wire)
    packets = [px4(mav) for _ in range(300)]
    wire.incoming = [p for i, p in enumerate(packets) if i % 3] + [packets[1]]  # and one twice, late
    survey.receive(lambda: 1)
    assert survey.found.packets == 201
    assert 98 <= survey.found.packets_lost <= 100
