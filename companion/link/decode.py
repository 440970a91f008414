"""MAVLink telemetry → events, one function a message. The NED signs of what comes in live here.

MAVLink's local frame is x North, y East, z down, yaw clockwise from North; ours is x East, y North, height
up, heading counter-clockwise from East (see `companion.types`). A decoder takes a message's fields by their
names, and returns None where their numbers cannot be used.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any

from pymavlink.dialects.v20 import development as mavlink

from companion.link.ekf_status import EkfStatusMessage
from companion.link.modes import Dialect
from companion.link.px4_events import event_words
from companion.types import (
    Attitude,
    AutopilotWords,
    BatteryReport,
    Charge,
    Defect,
    EstimatorReport,
    Event,
    Landed,
    LandedReport,
    LocalMotion,
    Malformed,
    ModeReport,
    TargetEcho,
    VehicleHeartbeat,
)

Decoder = Callable[[Any, int], Event | None]

LANDED = {
    mavlink.MAV_LANDED_STATE_ON_GROUND: Landed.ON_GROUND,
    mavlink.MAV_LANDED_STATE_IN_AIR: Landed.IN_AIR,
    mavlink.MAV_LANDED_STATE_TAKEOFF: Landed.TAKING_OFF,
    mavlink.MAV_LANDED_STATE_LANDING: Landed.LANDING,
}
_LONGEST_WORDS = 120


def heading_from_yaw(yaw_ned_rad: float) -> float:
    """NED yaw (clockwise from North) → heading (counter-clockwise from East), in (−π, π]. Its own inverse."""
    heading = math.pi / 2.0 - yaw_ned_rad
    wrapped = math.remainder(heading, 2.0 * math.pi)
    return math.pi if wrapped == -math.pi else wrapped


def heartbeat(dialect: Dialect, system_id: int, m: Any, t_ns: int) -> Event:
    """HEARTBEAT; of an autopilot of another kind its modes would be misread, so that one is not believed."""
    if m.autopilot != dialect.vendor:
        return Malformed(t_ns=t_ns, defect=Defect.MAVLINK_VENDOR, detail=f"autopilot {m.autopilot}")
    armed = bool(m.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    mode = dialect.mode(m.custom_mode)
    return VehicleHeartbeat(t_ns=t_ns, system_id=system_id, mode=mode, armed=armed)


def current_mode(dialect: Dialect, m: Any, t_ns: int) -> Event:
    """CURRENT_MODE; an intended mode of 0 is not told."""
    intended = dialect.mode(m.intended_custom_mode) if m.intended_custom_mode else None
    return ModeReport(t_ns=t_ns, actual=dialect.mode(m.custom_mode), intended=intended)


def extended_sys_state(m: Any, t_ns: int) -> Event | None:
    """EXTENDED_SYS_STATE."""
    return LandedReport(t_ns=t_ns, landed=LANDED.get(m.landed_state, Landed.UNKNOWN))


def attitude(m: Any, t_ns: int) -> Event | None:
    """ATTITUDE."""
    yaw: float = m.yaw
    yaw_rate: float = m.yawspeed
    if not (math.isfinite(yaw) and math.isfinite(yaw_rate)):
        return None
    return Attitude(
        t_ns=t_ns,
        heading_rad=heading_from_yaw(yaw),
        yaw_rate_rad_s=-yaw_rate,
        boot_ms=m.time_boot_ms,
    )


def local_position(m: Any, t_ns: int) -> Event | None:
    """LOCAL_POSITION_NED."""
    vx: float = m.vx
    vy: float = m.vy
    if not (math.isfinite(vx) and math.isfinite(vy)):
        return None
    x: float = m.x
    y: float = m.y
    z: float = m.z
    vz: float = m.vz
    return LocalMotion(
        t_ns=t_ns,
        x_m=y if math.isfinite(y) else None,
        y_m=x if math.isfinite(x) else None,
        height_m=-z if math.isfinite(z) else None,
        vx_m_s=vy,
        vy_m_s=vx,
        climb_m_s=-vz if math.isfinite(vz) else 0.0,
        boot_ms=m.time_boot_ms,
    )


def sys_status(m: Any, t_ns: int) -> Event | None:
    """SYS_STATUS: the share of the battery that is left, where it is known."""
    share = m.battery_remaining / 100.0 if m.battery_remaining >= 0 else None
    return BatteryReport(t_ns=t_ns, share=share)


_CHARGE = {
    mavlink.MAV_BATTERY_CHARGE_STATE_UNDEFINED: Charge.UNKNOWN,
    mavlink.MAV_BATTERY_CHARGE_STATE_OK: Charge.OK,
    mavlink.MAV_BATTERY_CHARGE_STATE_CHARGING: Charge.OK,
    mavlink.MAV_BATTERY_CHARGE_STATE_LOW: Charge.LOW,
}


def battery_status(m: Any, t_ns: int) -> BatteryReport:
    """BATTERY_STATUS: the autopilot's own judgement; what is worse than low is critical."""
    share = m.battery_remaining / 100.0 if m.battery_remaining >= 0 else None
    return BatteryReport(t_ns=t_ns, charge=_CHARGE.get(m.charge_state, Charge.CRITICAL), share=share)


def estimator_status(m: Any, t_ns: int) -> EstimatorReport:
    """ESTIMATOR_STATUS, or ArduPilot's EKF_STATUS_REPORT: the flags that are read have the same bits."""
    return EstimatorReport(
        t_ns=t_ns,
        velocity=bool(m.flags & mavlink.ESTIMATOR_VELOCITY_HORIZ),
        position=bool(m.flags & (mavlink.ESTIMATOR_POS_HORIZ_REL | mavlink.ESTIMATOR_POS_HORIZ_ABS)),
        height=bool(m.flags & (mavlink.ESTIMATOR_POS_VERT_ABS | mavlink.ESTIMATOR_POS_VERT_AGL)),
        global_position=bool(m.flags & mavlink.ESTIMATOR_POS_HORIZ_ABS),
    )


def statustext(m: Any, t_ns: int) -> Event | None:
    """STATUSTEXT: what the autopilot says to people."""
    text = "".join(c if c.isprintable() else " " for c in str(m.text)).strip()
    return AutopilotWords(t_ns=t_ns, text=text[:_LONGEST_WORDS]) if text else None


def event(m: Any, t_ns: int) -> Event | None:
    """EVENT: PX4's words for a companion, where they are known."""
    text = event_words(m.id, bytes(m.arguments))
    return AutopilotWords(t_ns=t_ns, text=text) if text else None


_DECODERS: dict[str, Decoder] = {
    "EXTENDED_SYS_STATE": extended_sys_state,
    "ATTITUDE": attitude,
    "LOCAL_POSITION_NED": local_position,
    "SYS_STATUS": sys_status,
    "BATTERY_STATUS": battery_status,
    "ESTIMATOR_STATUS": estimator_status,
    EkfStatusMessage.msgname: estimator_status,
}


def decoders(dialect: Dialect, system_id: int) -> dict[str, Decoder]:
    """For one autopilot, what must have usable numbers: None from these is a malformed message."""
    return _DECODERS | {
        "HEARTBEAT": partial(heartbeat, dialect, system_id),
        "CURRENT_MODE": partial(current_mode, dialect),
    }


def target(m: Any, t_ns: int) -> Event | None:
    """POSITION_TARGET_LOCAL_NED; without a velocity there is nothing to tell."""
    if not (math.isfinite(m.vx) and math.isfinite(m.vy) and math.isfinite(m.yaw_rate)):
        return None
    return TargetEcho(t_ns=t_ns, speed_m_s=math.hypot(m.vx, m.vy), yaw_rate_rad_s=-m.yaw_rate)


WORDS: dict[str, Decoder] = {"STATUSTEXT": statustext, "EVENT": event, "POSITION_TARGET_LOCAL_NED": target}
"""What may have nothing to say."""
