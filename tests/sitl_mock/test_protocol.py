"""The autopilot's end of the MAVLink links, sans I/O."""

from __future__ import annotations

import struct
from math import inf, nan

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as mavlink

from sitl_mock.faults import Fault, FaultAt
from sitl_mock.modes import Mode, Result
from sitl_mock.protocol import Link
from sitl_mock.scenario import Scenario
from tests.sitl_mock.recordings import Bench, received

GCS_HEARTBEAT = mavlink.MAVLink_heartbeat_message(
    mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 0, 3
)


def setpoint(frame: int, mask: int, *fields: float) -> mavlink.MAVLink_message:
    """SET_POSITION_TARGET_LOCAL_NED: x y z, vx vy vz, ax ay az, yaw, yaw rate."""
    return mavlink.MAVLink_set_position_target_local_ned_message(0, 1, 1, frame, mask, *fields)


def in_air() -> Bench:
    """A bench whose vehicle hovers at 3 m."""
    bench = Bench(Scenario(telemetry="perfect", start_x_m=0.0, start_y_m=0.0, start_heading_rad=0.0))
    bench.vehicle.height_m = 3.0
    bench.px4.start_in_air()
    return bench


def offboard(bench: Bench, message: mavlink.MAVLink_message, duration_s: float) -> None:
    """Stream this setpoint in OFFBOARD."""
    end = bench.t + duration_s
    while bench.t < end:
        bench.send(message)
        if bench.px4.mode is not Mode.OFFBOARD:
            bench.command(mavlink.MAV_CMD_DO_SET_MODE, 1, 6)
        bench.run(bench.t + 0.05)


# ------------------------------------------------------------------------------------------- setpoints


def test_frames_and_signs() -> None:
    """NED to the local frame: North is +y, East +x, down −height, clockwise −yaw rate."""
    local = in_air()
    offboard(local, setpoint(1, 1507, 0, 0, -4.0, 0.5, 0.25, 0, 0, 0, 0, 0, 0.2), 8.0)
    v = local.vehicle
    assert (v.vx_m_s, v.vy_m_s) == pytest.approx((0.25, 0.5), abs=0.01)
    assert v.height_m == pytest.approx(4.0, abs=0.02)
    assert v.yaw_rate_rad_s == pytest.approx(-0.2, abs=0.01)
    position, attitude = local.last("LOCAL_POSITION_NED"), local.last("ATTITUDE")
    assert (position["vx"], position["vy"]) == pytest.approx((0.5, 0.25), abs=0.01)
    assert position["z"] == pytest.approx(-4.0, abs=0.02)
    assert attitude["yawspeed"] == pytest.approx(0.2, abs=0.01)


def test_body_frame_turns_with_the_vehicle() -> None:
    """Forward along the nose, right of it negative left; the nose points East here."""
    bench = in_air()
    offboard(bench, setpoint(8, 1479, 0, 0, 0, 0.5, 0.2, -0.1, 0, 0, 0, 0, 0), 5.0)
    v = bench.vehicle
    assert (v.vx_m_s, v.vy_m_s, v.climb_m_s) == pytest.approx((0.5, -0.2, 0.1), abs=0.01)


def test_fixed_yaw_is_held() -> None:
    bench = in_air()
    offboard(bench, setpoint(1, 2496 | 0, nan, nan, -3.0, 0, 0, 0, 0, 0, 0, 0.7, 0), 10.0)
    assert bench.last("ATTITUDE")["yaw"] == pytest.approx(0.7, abs=0.001)


def test_position_is_flown_to() -> None:
    bench = in_air()
    offboard(bench, setpoint(1, 0xDF8, 2.0, 1.0, -3.0, 0, 0, 0, 0, 0, 0, 0, 0), 15.0)
    position = bench.last("LOCAL_POSITION_NED")
    assert (position["x"], position["y"], position["z"]) == pytest.approx((2.0, 1.0, -3.0), abs=0.03)


@pytest.mark.parametrize("target", [(2, 1), (1, 2)])
def test_setpoints_for_others_are_not_for_me(target: tuple[int, int]) -> None:
    bench = in_air()
    message = setpoint(1, 1507, 0, 0, -3.0, 0, 0, 0, 0, 0, 0, 0, 0)
    message.target_system, message.target_component = target
    bench.send(message)
    assert not bench.px4.streaming


numbers = st.floats(allow_nan=True, allow_infinity=True, width=32)


@given(
    frame=st.integers(0, 21), mask=st.integers(0, 65535), fields=st.lists(numbers, min_size=11, max_size=11)
)
@settings(max_examples=150)
def test_no_setpoint_breaks_the_autopilot(frame: int, mask: int, fields: list[float]) -> None:
    bench = in_air()
    bench.px4.intended = Mode.OFFBOARD
    for _ in range(5):
        bench.send(setpoint(frame, mask, *fields))
        bench.run(bench.t + 0.05)
    v = bench.vehicle
    assert all(abs(x) < 100.0 for x in (v.x_m, v.y_m, v.height_m, v.vx_m_s, v.vy_m_s, v.yaw_rate_rad_s))


@given(st.integers(0, 600), st.lists(numbers, min_size=7, max_size=7))
@settings(max_examples=150)
def test_no_command_breaks_the_autopilot(command: int, fields: list[float]) -> None:
    bench = Bench()
    bench.command(command, *fields)
    bench.run(0.05)
    if command != mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN:
        assert bench.last("COMMAND_ACK")["command"] == command


# ---------------------------------------------------------------------------------------------- streams


def test_message_interval() -> None:
    bench = Bench()
    name = mavlink.MAVLINK_MSG_ID_CURRENT_MODE
    bench.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, name, 20_000)
    bench.run(4.0)
    rows = [row for row in received(bench.rows, "CURRENT_MODE") if row["t"] > 1.0]
    assert len([r for r in rows if r["link"] is Link.ONBOARD]) == pytest.approx(150, abs=3)
    assert len([r for r in rows if r["link"] is Link.GCS]) <= 2, "a rate is its own link's"
    bench.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, name, -1)
    bench.run(5.0)
    count = len(list(received(bench.rows, "CURRENT_MODE")))
    bench.run(8.0)
    assert len(list(received(bench.rows, "CURRENT_MODE"))) - count <= 2
    bench.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, 4711, 20_000)
    bench.run(8.1)
    assert bench.last("COMMAND_ACK")["result"] == Result.FAILED


def test_heartbeat_cannot_be_sped_up() -> None:
    bench = Bench()
    bench.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_HEARTBEAT, 10_000)
    bench.run(10.0)
    beats = [row for row in received(bench.rows, "HEARTBEAT") if row["link"] is Link.ONBOARD]
    assert len(beats) == 10


def test_requested_message_comes() -> None:
    bench = Bench()
    bench.command(mavlink.MAV_CMD_REQUEST_MESSAGE, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
    bench.run(0.1)
    assert bench.last("COMMAND_ACK")["result"] == Result.ACCEPTED
    assert bench.last("AUTOPILOT_VERSION")["capabilities"] & mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
    bench.command(mavlink.MAV_CMD_REQUEST_MESSAGE, 4711)
    bench.run(0.2)
    assert bench.last("COMMAND_ACK")["result"] == Result.DENIED


def test_unknown_commands_are_answered() -> None:
    bench = Bench()
    bench.command(mavlink.MAV_CMD_DO_DIGICAM_CONTROL)
    bench.run(0.1)
    assert bench.last("COMMAND_ACK")["result"] == Result.UNSUPPORTED


def test_words_reach_ground_stations_only() -> None:
    bench = Bench()
    bench.send(GCS_HEARTBEAT, Link.GCS)
    bench.command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, 1)
    bench.run(0.5)
    words = list(received(bench.rows, "STATUSTEXT"))
    assert words
    assert all(row["link"] is Link.GCS for row in words)


def test_time_and_ping_are_answered() -> None:
    bench = Bench()
    bench.run(2.0)
    bench.send(mavlink.MAVLink_timesync_message(0, 123456789))
    bench.send(mavlink.MAVLink_ping_message(77, 5, 0, 0))
    bench.run(2.05)
    answer = next(row for row in received(bench.rows, "TIMESYNC") if row["ts1"] == 123456789)
    assert answer["tc1"] == pytest.approx(2e9, rel=0.01)
    pong = next(row for row in received(bench.rows, "PING") if row["seq"] == 5)
    assert (pong["time_usec"], pong["target_system"], pong["target_component"]) == (77, 1, 191)


def test_telemetry_that_is_not_told() -> None:
    """Scenario telemetry "none": mode and health are told, position and motion are not."""
    bench = Bench(Scenario(telemetry="none"))
    bench.run(5.0)
    names = {row["msg"] for row in bench.rows}
    assert {"HEARTBEAT", "CURRENT_MODE", "EXTENDED_SYS_STATE", "SYS_STATUS"} <= names
    assert not names & {"ATTITUDE", "LOCAL_POSITION_NED", "ODOMETRY", "GLOBAL_POSITION_INT", "HIGHRES_IMU"}


# ------------------------------------------------------------------------------------------- parameters


def as_int32(value: float) -> int:
    """PX4's integers travel bit for bit in the float field."""
    return int(struct.unpack("<i", struct.pack("<f", value))[0])


def test_parameters_are_read_listed_and_set() -> None:
    bench = Bench()
    bench.send(mavlink.MAVLink_param_request_read_message(1, 1, b"COM_OBL_RC_ACT", -1))
    bench.run(0.1)
    row = bench.last("PARAM_VALUE")
    assert (row["param_id"], as_int32(row["param_value"])) == ("COM_OBL_RC_ACT", 0)
    four = struct.unpack("<f", struct.pack("<i", 4))[0]
    int32, real32 = mavlink.MAV_PARAM_TYPE_INT32, mavlink.MAV_PARAM_TYPE_REAL32
    bench.send(mavlink.MAVLink_param_set_message(1, 1, b"COM_OBL_RC_ACT", four, int32))
    bench.send(mavlink.MAVLink_param_set_message(1, 1, b"MIS_TAKEOFF_ALT", 3.5, real32))
    bench.send(mavlink.MAVLink_param_set_message(1, 1, b"MPC_LAND_SPEED", nan, real32))
    bench.send(mavlink.MAVLink_param_set_message(1, 1, b"MPC_TKO_SPEED", four, int32))
    bench.run(0.2)
    params = bench.px4.params
    assert [params[n] for n in ("COM_OBL_RC_ACT", "MIS_TAKEOFF_ALT")] == [4, 3.5]
    assert [params[n] for n in ("MPC_LAND_SPEED", "MPC_TKO_SPEED")] == [0.7, 1.5], "not a number; wrong type"
    before = len(bench.rows)
    bench.send(mavlink.MAVLink_param_request_list_message(1, 1), Link.GCS)
    bench.run(1.0)
    listed = list(received(bench.rows[before:], "PARAM_VALUE"))
    assert [row["param_index"] for row in listed] == list(range(listed[0]["param_count"]))
    assert {row["link"] for row in listed} == {Link.GCS}


# ----------------------------------------------------------------------------------------------- faults


def test_faults_that_show_in_telemetry() -> None:
    bench = Bench(faults=(FaultAt(Fault.VELOCITY_INVALID, 2.0, 2.0), FaultAt(Fault.GPS_LOST, 6.0, 2.0)))
    bench.run(9.0)

    def count(name: str, since: float, until: float) -> int:
        return sum(since < row["t"] <= until for row in received(bench.rows, name))

    assert count("LOCAL_POSITION_NED", 2.0, 4.0) == 0
    assert count("LOCAL_POSITION_NED", 4.0, 6.0) > 30
    assert count("ATTITUDE", 2.0, 4.0) > 100
    assert count("GLOBAL_POSITION_INT", 6.0, 8.0) == 0
    assert count("LOCAL_POSITION_NED", 6.0, 8.0) > 30
    fix = next(row for row in received(bench.rows, "GPS_RAW_INT") if row["t"] > 6.5)
    assert fix["fix_type"] < mavlink.GPS_FIX_TYPE_3D_FIX


def test_stopped_telemetry_and_heartbeat() -> None:
    bench = Bench(faults=(FaultAt(Fault.TELEMETRY_STOP, 2.0, 2.0), FaultAt(Fault.HEARTBEAT_STOP, 6.0, inf)))
    bench.run(10.0)
    assert {row["msg"] for row in bench.rows if 2.0 < row["t"] < 4.0} == {"HEARTBEAT"}
    assert "HEARTBEAT" not in {row["msg"] for row in bench.rows if row["t"] > 6.0}


def test_reboot_is_silence_and_a_new_clock() -> None:
    bench = Bench(faults=(FaultAt(Fault.REBOOT, 5.0),))
    bench.command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, mavlink.MAVLINK_MSG_ID_CURRENT_MODE, 20_000)
    bench.run(10.0)
    assert not [row for row in bench.rows if 5.0 < row["t"] < 6.9]
    attitudes = [row for row in received(bench.rows, "ATTITUDE") if row["t"] > 7.0]
    assert attitudes[0]["time_boot_ms"] < 2100
    modes = [row for row in received(bench.rows, "CURRENT_MODE") if row["t"] > 7.5]
    assert len(modes) < 6, "the requested rates are forgotten"
