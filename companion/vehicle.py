"""What is known of the vehicle: the last of each telemetry message, and how it has moved since."""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace

from companion.types import Attitude, FlightMode, Landed, LocalMotion, ModeReport, VehicleHeartbeat

_MODE_REPORT_FRESH_NS = 1_500_000_000
"""While CURRENT_MODE comes, the mode in HEARTBEAT (up to a second late) is not looked at."""
_ARMED_KNOWN_NS = 10_000_000_000
"""HEARTBEAT alone tells whether the vehicle is armed. On a bad link many are lost, but not so many."""
_MOTION_FRESH_NS = 300_000_000
"""An older velocity is no longer taken for the present one."""


class Vehicle(msgspec.Struct, frozen=True, gc=False):
    """The last word of each kind. Times are None until something came."""

    t_link_ns: int | None = None
    """When it was there for certain: a HEARTBEAT, or a mode while those come."""
    t_beat_ns: int | None = None
    t_mode_ns: int | None = None
    actual: FlightMode | None = None
    intended: FlightMode | None = None
    armed: bool | None = None
    landed: Landed = Landed.UNKNOWN
    t_attitude_ns: int | None = None
    heading_rad: float = 0.0
    yaw_rate_rad_s: float = 0.0
    boot_ms: int = 0
    """The autopilot's own clock, of the last attitude."""
    t_motion_ns: int | None = None
    x_m: float | None = None
    y_m: float | None = None
    height_m: float | None = None
    forward_m_s: float = 0.0
    left_m_s: float = 0.0


class BodyMotion(msgspec.Struct, frozen=True, gc=False):
    """How the vehicle moves: body axes, paper frame."""

    forward_m_s: float = 0.0
    left_m_s: float = 0.0
    yaw_rate_rad_s: float = 0.0


def on_heartbeat(v: Vehicle, e: VehicleHeartbeat) -> Vehicle:
    """HEARTBEAT: armed or not; the mode only where CURRENT_MODE does not tell it better."""
    if v.t_mode_ns is not None and e.t_ns - v.t_mode_ns < _MODE_REPORT_FRESH_NS:
        return replace(v, t_link_ns=e.t_ns, t_beat_ns=e.t_ns, armed=e.armed)
    return replace(v, t_link_ns=e.t_ns, t_beat_ns=e.t_ns, armed=e.armed, actual=e.mode, intended=None)


def on_mode(v: Vehicle, e: ModeReport) -> Vehicle:
    """CURRENT_MODE: the one message that the mode is believed from."""
    is_beating = v.t_beat_ns is not None and e.t_ns - v.t_beat_ns < _ARMED_KNOWN_NS
    t_link_ns = e.t_ns if is_beating else v.t_link_ns
    return replace(v, t_link_ns=t_link_ns, t_mode_ns=e.t_ns, actual=e.actual, intended=e.intended)


def on_attitude(v: Vehicle, e: Attitude) -> Vehicle:
    """ATTITUDE."""
    heading_rad, yaw_rate_rad_s = e.heading_rad, e.yaw_rate_rad_s
    if not (math.isfinite(heading_rad) and math.isfinite(yaw_rate_rad_s)):
        return v
    return replace(
        v, t_attitude_ns=e.t_ns, heading_rad=heading_rad, yaw_rate_rad_s=yaw_rate_rad_s, boot_ms=e.boot_ms
    )


def on_motion(v: Vehicle, e: LocalMotion) -> Vehicle:
    """LOCAL_POSITION_NED or ODOMETRY. The velocity is kept in body axes: in a turn it changes least there."""
    t_ns, vx_m_s, vy_m_s = e.t_ns, e.vx_m_s, e.vy_m_s
    if not (math.isfinite(vx_m_s) and math.isfinite(vy_m_s)):
        return v
    since_s = 0.0 if v.t_attitude_ns is None else (t_ns - v.t_attitude_ns) * 1e-9
    heading = v.heading_rad + v.yaw_rate_rad_s * min(since_s, _MOTION_FRESH_NS * 1e-9)
    c, s = math.cos(heading), math.sin(heading)
    return replace(
        v,
        t_motion_ns=t_ns,
        x_m=e.x_m,
        y_m=e.y_m,
        height_m=e.height_m,
        forward_m_s=vx_m_s * c + vy_m_s * s,
        left_m_s=vy_m_s * c - vx_m_s * s,
    )


def speed_m_s(v: Vehicle, t_ns: int) -> float | None:
    """The horizontal speed that the autopilot tells; None where it tells none now."""
    if v.t_motion_ns is None or t_ns - v.t_motion_ns >= _MOTION_FRESH_NS:
        return None
    return math.hypot(v.forward_m_s, v.left_m_s)


def is_measured(v: Vehicle, t_ns: int) -> bool:
    """Whether telemetry tells both the velocity and the yaw rate of now."""
    return (
        v.t_attitude_ns is not None
        and t_ns - v.t_attitude_ns < _MOTION_FRESH_NS
        and v.t_motion_ns is not None
        and t_ns - v.t_motion_ns < _MOTION_FRESH_NS
    )


def body_motion(
    v: Vehicle,
    before: BodyMotion,
    commanded: BodyMotion,
    t_ns: int,
    dt_s: float,
    velocity_lag_s: float,
    yaw_rate_lag_s: float,
) -> BodyMotion:
    """The motion now: measured where telemetry is fresh, else the commanded one through a first-order lag."""
    if v.t_attitude_ns is not None and t_ns - v.t_attitude_ns < _MOTION_FRESH_NS:
        yaw_rate = v.yaw_rate_rad_s
    else:
        yaw_rate = _lag(before.yaw_rate_rad_s, commanded.yaw_rate_rad_s, dt_s, yaw_rate_lag_s)
    if v.t_motion_ns is not None and t_ns - v.t_motion_ns < _MOTION_FRESH_NS:
        return BodyMotion(v.forward_m_s, v.left_m_s, yaw_rate)
    return BodyMotion(
        _lag(before.forward_m_s, commanded.forward_m_s, dt_s, velocity_lag_s),
        _lag(before.left_m_s, 0.0, dt_s, velocity_lag_s),
        yaw_rate,
    )


def _lag(value: float, towards: float, dt_s: float, tau_s: float) -> float:
    return towards if tau_s <= 0.0 else towards + (value - towards) * math.exp(-dt_s / tau_s)
