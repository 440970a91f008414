"""The MAVLink messages that the autopilot streams: how each is made, and PX4's default rates.

Here the local frame (x East, y North, height up, heading counter-clockwise from East) becomes NED.
"""

from __future__ import annotations

from collections.abc import Callable
from math import cos, degrees, nan, pi, radians, sin
from typing import Any, NamedTuple, TypeAlias

from pymavlink.dialects.v20 import development as mavlink

from companion.types import Charge, Landed
from sitl_mock import ardupilot
from sitl_mock.faults import Fault
from sitl_mock.modes import WIRE
from sitl_mock.px4 import Px4
from sitl_mock.vehicle import wrap

ORIGIN_LATITUDE_DEG, ORIGIN_LONGITUDE_DEG, ORIGIN_ALTITUDE_M = 47.397742, 8.545594, 489.4
_EARTH_RADIUS_M = 6371000.0
_SENSORS_PRESENT, _SENSORS_ENABLED, _SENSORS_HEALTHY = 33570863, 33636399, 52480063
"""As recorded; PREARM_CHECK comes on top."""
_LANDED = {
    Landed.UNKNOWN: mavlink.MAV_LANDED_STATE_UNDEFINED,
    Landed.ON_GROUND: mavlink.MAV_LANDED_STATE_ON_GROUND,
    Landed.IN_AIR: mavlink.MAV_LANDED_STATE_IN_AIR,
    Landed.TAKING_OFF: mavlink.MAV_LANDED_STATE_TAKEOFF,
    Landed.LANDING: mavlink.MAV_LANDED_STATE_LANDING,
}
_BATTERY_FULL_V = 16.2
_CHARGE = {
    Charge.OK: mavlink.MAV_BATTERY_CHARGE_STATE_OK,
    Charge.LOW: mavlink.MAV_BATTERY_CHARGE_STATE_LOW,
    Charge.CRITICAL: mavlink.MAV_BATTERY_CHARGE_STATE_CRITICAL,
}
_UNKNOWN_COVARIANCE = [nan] * 21
_HARDWARE_UID = list(b"sitl-mock\0\0\0\0\0\0\0\0\0")

Message: TypeAlias = Any
"""A `mavlink.MAVLink_message`: pymavlink has no types."""


class View(NamedTuple):
    """The autopilot's estimate in NED at one moment, and its clock."""

    north: float
    east: float
    down: float
    v_north: float
    v_east: float
    v_down: float
    yaw: float
    yaw_rate: float
    boot_ms: int
    time_us: int


def view(px4: Px4) -> View:
    """Read the estimate, with the noise of one yaw-rate measurement."""
    v, e = px4.vehicle, px4.errors
    return View(
        v.y_m + e.y_m,
        v.x_m + e.x_m,
        -(v.height_m + e.height_m),
        v.vy_m_s + e.vy_m_s,
        v.vx_m_s + e.vx_m_s,
        -(v.climb_m_s + e.climb_m_s),
        wrap(pi / 2 - v.heading_rad - e.heading_rad),
        -(v.yaw_rate_rad_s + e.yaw_rate_noise()),
        round(px4.boot_s * 1e3),
        round(px4.boot_s * 1e6),
    )


def _degrees_e7(north: float, east: float) -> tuple[int, int]:
    latitude = ORIGIN_LATITUDE_DEG + degrees(north / _EARTH_RADIUS_M)
    scale = _EARTH_RADIUS_M * cos(radians(ORIGIN_LATITUDE_DEG))
    return round(latitude * 1e7), round((ORIGIN_LONGITUDE_DEG + degrees(east / scale)) * 1e7)


def _heartbeat(px4: Px4, _: View) -> Message:
    wire = WIRE[px4.mode]
    # Recorded: without a setpoint ever, disarmed OFFBOARD controls nothing and says so.
    base = wire.base if wire.main != 6 or px4.ever_streamed else mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
    if px4.armed:
        base |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
        status = mavlink.MAV_STATE_CRITICAL if px4.failsafe else mavlink.MAV_STATE_ACTIVE
    else:
        status = mavlink.MAV_STATE_STANDBY if px4.armable else mavlink.MAV_STATE_UNINIT
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_PX4, base, wire.custom, status, 3
    )


def _current_mode(px4: Px4, _: View) -> Message:
    wire = WIRE[px4.mode]
    return mavlink.MAVLink_current_mode_message(wire.standard, wire.custom, WIRE[px4.intended].custom)


def _attitude(_: Px4, s: View) -> Message:
    return mavlink.MAVLink_attitude_message(s.boot_ms, 0.0, 0.0, s.yaw, 0.0, 0.0, s.yaw_rate)


def _attitude_quaternion(_: Px4, s: View) -> Message:
    half = s.yaw / 2
    return mavlink.MAVLink_attitude_quaternion_message(
        s.boot_ms, cos(half), 0.0, 0.0, sin(half), 0.0, 0.0, s.yaw_rate
    )


def _attitude_target(_: Px4, s: View) -> Message:
    half = s.yaw / 2
    return mavlink.MAVLink_attitude_target_message(
        s.boot_ms, 0, [cos(half), 0.0, 0.0, sin(half)], 0.0, 0.0, s.yaw_rate, 0.5
    )


def _local_position(px4: Px4, s: View) -> Message | None:
    if not px4.velocity_valid:
        return None
    return mavlink.MAVLink_local_position_ned_message(
        s.boot_ms, s.north, s.east, s.down, s.v_north, s.v_east, s.v_down
    )


def _odometry(px4: Px4, s: View) -> Message:
    half = s.yaw / 2
    c, sn = cos(s.yaw), sin(s.yaw)
    valid = px4.velocity_valid
    return mavlink.MAVLink_odometry_message(
        s.time_us,
        mavlink.MAV_FRAME_LOCAL_NED,
        mavlink.MAV_FRAME_BODY_FRD,
        s.north if valid else nan,
        s.east if valid else nan,
        s.down,
        [cos(half), 0.0, 0.0, sin(half)],
        c * s.v_north + sn * s.v_east if valid else nan,
        c * s.v_east - sn * s.v_north if valid else nan,
        s.v_down,
        0.0,
        0.0,
        s.yaw_rate,
        _UNKNOWN_COVARIANCE,
        _UNKNOWN_COVARIANCE,
        0,
        mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT,
        100 if valid else 0,
    )


def _global_position(px4: Px4, s: View) -> Message | None:
    if not px4.global_position_valid:
        return None
    latitude, longitude = _degrees_e7(s.north, s.east)
    return mavlink.MAVLink_global_position_int_message(
        s.boot_ms,
        latitude,
        longitude,
        round((ORIGIN_ALTITUDE_M - s.down) * 1e3),
        round((-s.down - px4.autopilot.home_height_m) * 1e3),
        round(s.v_north * 1e2),
        round(s.v_east * 1e2),
        round(s.v_down * 1e2),
        round(degrees(s.yaw) % 360.0 * 1e2) % 36000,
    )


def _gps_raw(px4: Px4, s: View) -> Message:
    latitude, longitude = _degrees_e7(s.north, s.east)
    lost = px4.faults.active(Fault.GPS_LOST)
    return mavlink.MAVLink_gps_raw_int_message(
        s.time_us,
        mavlink.GPS_FIX_TYPE_NO_FIX if lost else mavlink.GPS_FIX_TYPE_3D_FIX,
        latitude,
        longitude,
        round((ORIGIN_ALTITUDE_M - s.down) * 1e3),
        65535 if lost else 70,
        65535 if lost else 110,
        round(((s.v_north**2 + s.v_east**2) ** 0.5) * 1e2),
        65535,
        0 if lost else 10,
    )


def _altitude(px4: Px4, s: View) -> Message:
    relative = -s.down - px4.autopilot.home_height_m
    return mavlink.MAVLink_altitude_message(
        s.time_us, ORIGIN_ALTITUDE_M - s.down, ORIGIN_ALTITUDE_M - s.down, -s.down, relative, nan, nan
    )


def _vfr_hud(_: Px4, s: View) -> Message:
    speed = (s.v_north**2 + s.v_east**2) ** 0.5
    heading = round(degrees(s.yaw) % 360.0) % 360
    return mavlink.MAVLink_vfr_hud_message(speed, speed, heading, 50, ORIGIN_ALTITUDE_M - s.down, -s.v_down)


def _position_target(px4: Px4, s: View) -> Message:
    target = px4.autopilot.offboard
    if target is None:
        ignore_all = 63 if px4.landed else 0
        fill = nan if px4.landed else 0.0
        return mavlink.MAVLink_position_target_local_ned_message(
            s.boot_ms, 1, ignore_all, *([fill] * 9), s.yaw, 0.0
        )
    position = (target.y_m, target.x_m, None if target.height_m is None else -target.height_m)
    climb = target.climb_m_s
    velocity = (target.vy_m_s, target.vx_m_s, None if climb is None else -climb)
    fields = [nan if value is None else value for value in position + velocity]
    mask = sum(1 << i for i, value in enumerate(position) if value is None)
    yaw = s.yaw if target.heading_rad is None else wrap(pi / 2 - target.heading_rad)
    return mavlink.MAVLink_position_target_local_ned_message(
        s.boot_ms, 1, mask, *fields, 0.0, 0.0, 0.0, yaw, -(target.yaw_rate_rad_s or 0.0)
    )


def _extended_sys_state(px4: Px4, _: View) -> Message:
    return mavlink.MAVLink_extended_sys_state_message(0, _LANDED[px4.landed_state])


def _sys_status(px4: Px4, _: View) -> Message:
    health = _SENSORS_HEALTHY | (mavlink.MAV_SYS_STATUS_PREARM_CHECK if px4.armable else 0)
    if px4.faults.active(Fault.GPS_LOST):
        health &= ~mavlink.MAV_SYS_STATUS_SENSOR_GPS
    left = px4.battery_told
    volts = _BATTERY_FULL_V - 2.4 * (1.0 - left)
    return mavlink.MAVLink_sys_status_message(
        _SENSORS_PRESENT,
        _SENSORS_ENABLED,
        health,
        58,
        round(volts * 1e3),
        -100,
        round(left * 100),
        *([0] * 6),
    )


def _battery_status(px4: Px4, _: View) -> Message:
    left = px4.battery_told
    cells = [round((_BATTERY_FULL_V - 2.4 * (1.0 - left)) * 1e3)] + [65535] * 9
    return mavlink.MAVLink_battery_status_message(
        0, 1, 1, 32767, cells, -100, -1, -1, round(left * 100), 0, _CHARGE[px4.charge], [0, 0, 0, 0], 0, 0
    )


def _estimator_status(px4: Px4, s: View) -> Message:
    flags = 1023 if px4.landed else 895  # recorded
    if not px4.velocity_valid:
        flags &= ~(
            mavlink.ESTIMATOR_VELOCITY_HORIZ
            | mavlink.ESTIMATOR_POS_HORIZ_REL
            | mavlink.ESTIMATOR_POS_HORIZ_ABS
        )
    if px4.faults.active(Fault.GPS_LOST):
        flags &= ~(mavlink.ESTIMATOR_POS_HORIZ_ABS | mavlink.ESTIMATOR_PRED_POS_HORIZ_ABS)
    return mavlink.MAVLink_estimator_status_message(
        s.time_us, flags, 0.004, 0.004, 0.002, 0.007, 0.002, nan, 0.263, 0.072
    )


def _home(px4: Px4, s: View) -> Message | None:
    if not px4.global_position_valid:
        return None
    a = px4.autopilot
    latitude, longitude = _degrees_e7(a.home_y_m, a.home_x_m)
    altitude = round((ORIGIN_ALTITUDE_M + a.home_height_m) * 1e3)
    return mavlink.MAVLink_home_position_message(
        latitude, longitude, altitude, a.home_y_m, a.home_x_m, -a.home_height_m, [1.0, 0.0, 0.0, 0.0],
        0.0, 0.0, 0.0, s.time_us,
    )  # fmt: skip


def _system_time(_: Px4, s: View) -> Message:
    return mavlink.MAVLink_system_time_message(0, s.boot_ms)


def _timesync(_: Px4, s: View) -> Message:
    return mavlink.MAVLink_timesync_message(0, s.time_us * 1000)


def _ping(_: Px4, s: View) -> Message:
    return mavlink.MAVLink_ping_message(s.time_us, s.time_us // 1_000_000, 0, 0)


def _highres_imu(_: Px4, s: View) -> Message:
    return mavlink.MAVLink_highres_imu_message(
        s.time_us, 0.0, 0.0, -9.81, 0.0, 0.0, s.yaw_rate, 0.2, 0.0, 0.4, 955.0, 0.0,
        ORIGIN_ALTITUDE_M - s.down, 25.0, 0x1FFF,
    )  # fmt: skip


def _autopilot_version(_: Px4, __: View) -> Message:
    capabilities = (
        mavlink.MAV_PROTOCOL_CAPABILITY_MISSION_INT
        | mavlink.MAV_PROTOCOL_CAPABILITY_COMMAND_INT
        | mavlink.MAV_PROTOCOL_CAPABILITY_SET_POSITION_TARGET_LOCAL_NED
        | mavlink.MAV_PROTOCOL_CAPABILITY_MAVLINK2
        | mavlink.MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_BYTEWISE
    )
    version = 1 << 24 | 17 << 16 | 64  # 1.17.0 alpha, as recorded
    return mavlink.MAVLink_autopilot_version_message(
        capabilities, version, 0, 0, 1 << 24, [0] * 8, [0] * 8, [0] * 8, 0, 0, 0x51714D0C, _HARDWARE_UID
    )


BUILDERS: dict[int, Callable[[Px4, View], Message | None]] = {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: _heartbeat,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: _sys_status,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: _system_time,
    mavlink.MAVLINK_MSG_ID_PING: _ping,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: _gps_raw,
    mavlink.MAVLINK_MSG_ID_ATTITUDE: _attitude,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: _attitude_quaternion,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: _local_position,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: _global_position,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: _vfr_hud,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET: _attitude_target,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: _position_target,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: _highres_imu,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: _timesync,
    mavlink.MAVLINK_MSG_ID_ALTITUDE: _altitude,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: _battery_status,
    mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION: _autopilot_version,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: _estimator_status,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: _home,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: _extended_sys_state,
    mavlink.MAVLINK_MSG_ID_ODOMETRY: _odometry,
    mavlink.MAVLINK_MSG_ID_CURRENT_MODE: _current_mode,
}
"""How every message that can be streamed or requested is made; None: there is nothing to tell now."""

ARDUPILOT_BUILDERS: dict[int, Callable[[Px4, View], Message | None]] = {
    i: b
    for i, b in BUILDERS.items()
    if i not in (mavlink.MAVLINK_MSG_ID_CURRENT_MODE, mavlink.MAVLINK_MSG_ID_HOME_POSITION)
} | {
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: lambda px4, _: ardupilot.heartbeat(px4),
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: lambda px4, _: ardupilot.ekf_status(px4),
}
"""ArduCopter's: EKF_STATUS_REPORT comes in the place of ESTIMATOR_STATUS."""

MOTION = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_ATTITUDE,
        mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
        mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET,
        mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT,
        mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED,
        mavlink.MAVLINK_MSG_ID_ODOMETRY,
        mavlink.MAVLINK_MSG_ID_HIGHRES_IMU,
        mavlink.MAVLINK_MSG_ID_ALTITUDE,
        mavlink.MAVLINK_MSG_ID_VFR_HUD,
    }
)
"""What tells of position and motion: never sent where the scenario's telemetry is "none"."""

ONBOARD_HZ: dict[int, float] = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 100,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION: 50,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 50,
    mavlink.MAVLINK_MSG_ID_HIGHRES_IMU: 50,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 30,
    mavlink.MAVLINK_MSG_ID_ODOMETRY: 30,
    mavlink.MAVLINK_MSG_ID_ALTITUDE: 10,
    mavlink.MAVLINK_MSG_ID_ATTITUDE_TARGET: 10,
    mavlink.MAVLINK_MSG_ID_POSITION_TARGET_LOCAL_NED: 10,
    mavlink.MAVLINK_MSG_ID_TIMESYNC: 10,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: 10,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 8,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 5,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 5,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 1,
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1,
    mavlink.MAVLINK_MSG_ID_PING: 1,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: 0.5,
    mavlink.MAVLINK_MSG_ID_CURRENT_MODE: 0.5,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
}
"""PX4's defaults on the onboard link, as recorded."""

GCS_HZ: dict[int, float] = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 15,
    mavlink.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: 5,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 1,
    mavlink.MAVLINK_MSG_ID_ALTITUDE: 1,
    mavlink.MAVLINK_MSG_ID_VFR_HUD: 4,
    mavlink.MAVLINK_MSG_ID_GPS_RAW_INT: 1,
    mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: 1,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 1,
    mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS: 0.5,
    mavlink.MAVLINK_MSG_ID_HEARTBEAT: 1,
    mavlink.MAVLINK_MSG_ID_PING: 0.1,
    mavlink.MAVLINK_MSG_ID_SYSTEM_TIME: 1,
    mavlink.MAVLINK_MSG_ID_BATTERY_STATUS: 0.5,
    mavlink.MAVLINK_MSG_ID_CURRENT_MODE: 0.5,
    mavlink.MAVLINK_MSG_ID_HOME_POSITION: 0.5,
}
"""PX4's defaults on a ground station's link (source)."""
