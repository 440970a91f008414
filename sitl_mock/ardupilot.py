"""ArduCopter instead of PX4: modes, GUIDED, setpoints. From its source, not held against a flight.

The plant, the estimate and the simple modes are those of the PX4 mock. What differs: GUIDED needs no stream,
counts setpoints only while it is in effect, stops after three seconds without one and stays; nobody tells an
intended mode; a take-off is a part of GUIDED; EKF_STATUS_REPORT takes the place of ESTIMATOR_STATUS.
"""

from __future__ import annotations

import struct
from typing import Any, ClassVar

from pymavlink.dialects.v20 import development as mavlink

from sitl_mock.autopilot import Target
from sitl_mock.faults import Fault
from sitl_mock.modes import Mode, Result
from sitl_mock.px4 import CRITICAL, Px4
from sitl_mock.vehicle import STEP_S

FS_GCS_TIMEOUT_S = 5.0
FRAMES = frozenset({1, 7, 8, 9})
"""LOCAL_NED, LOCAL_OFFSET_NED, BODY_NED, BODY_OFFSET_NED: any other stops the vehicle."""
NUMBER = {
    Mode.STABILIZED: 0,
    Mode.MANUAL: 0,
    Mode.ACRO: 1,
    Mode.ALTCTL: 2,
    Mode.MISSION: 3,
    Mode.OFFBOARD: 4,
    Mode.TAKEOFF: 4,
    Mode.POSCTL: 5,
    Mode.RTL: 6,
    Mode.LAND: 9,
    Mode.DESCEND: 9,
    Mode.LOITER: 17,
    Mode.READY: 17,
}
"""HEARTBEAT.custom_mode; LOITER is BRAKE here, POSCTL is ArduCopter's LOITER."""
BY_NUMBER = {0: Mode.STABILIZED, 2: Mode.ALTCTL, 4: Mode.OFFBOARD, 5: Mode.POSCTL, 6: Mode.RTL, 9: Mode.LAND,
             17: Mode.LOITER}  # fmt: skip
_STANDSTILL = Target(vx_m_s=0.0, vy_m_s=0.0, climb_m_s=0.0, yaw_rate_rad_s=0.0)
_EKF_STATUS, _EKF_CRC_EXTRA = 193, 71
_EKF_FLAGS, _EKF_VELOCITY, _EKF_POSITION = 831, 2, 8 | 16


class ArduPilot(Px4):
    """The commander with ArduCopter's rules."""

    is_ardupilot = True
    _ground_step: int | None = None
    after_take_off = Mode.OFFBOARD

    @property
    def armable(self) -> bool:
        """Would it arm."""
        return self.global_position_valid and not self.battery_low

    def can_run(self, mode: Mode) -> bool:
        """GUIDED needs a position, not a stream."""
        if mode in (Mode.OFFBOARD, Mode.POSCTL):
            return self.velocity_valid
        return True if mode.is_manual else super().can_run(mode)

    def take_off(self, height_m: float | None) -> Result:
        """NAV_TAKEOFF: in GUIDED, once armed."""
        if self.mode is not Mode.OFFBOARD or not self.armed:
            return Result.FAILED
        return super().take_off(height_m)

    def setpoint(self, target: Target) -> None:
        """Outside of GUIDED it does not count."""
        if self.mode is Mode.OFFBOARD:
            super().setpoint(target)

    def stop(self) -> None:
        """What GUIDED makes of a setpoint that it cannot use: it stands."""
        if self.mode is Mode.OFFBOARD:
            self.autopilot.enter(Mode.OFFBOARD)

    def step(self) -> None:
        """GUID_TIMEOUT after the last setpoint the vehicle stops; the mode stays."""
        super().step()
        since = self._stream_step
        flying = self.mode is Mode.OFFBOARD and self.autopilot.offboard is not None
        if flying and since is not None and (self._steps - since) * STEP_S > self.params["GUID_TIMEOUT"]:
            self.autopilot.offboard = _STANDSTILL
        heard = self._ground_step
        lost = heard is not None and (self._steps - heard) * STEP_S > FS_GCS_TIMEOUT_S
        if lost and self.armed and self._forced is None and self.params["FS_GCS_ENABLE"] == 5:
            self._say(CRITICAL, "GCS Failsafe")
            self._forced = Mode.LAND

    def hear(self, system: int) -> None:
        """A HEARTBEAT of this system; only that of SYSID_MYGCS counts, from the first one on."""
        if system == self.params["SYSID_MYGCS"]:
            self._ground_step = self._steps

    def _fallback(self) -> Mode:
        """FS_EKF_ACTION = 1: land."""
        self._say(CRITICAL, "EKF Failsafe: changed to LAND Mode")
        return Mode.LAND if self.can_run(Mode.LAND) else Mode.DESCEND


def heartbeat(px4: Px4) -> Any:
    """HEARTBEAT of an ArduCopter."""
    base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED | mavlink.MAV_MODE_FLAG_STABILIZE_ENABLED
    if px4.armed:
        base |= mavlink.MAV_MODE_FLAG_SAFETY_ARMED
    status = mavlink.MAV_STATE_ACTIVE if px4.armed else mavlink.MAV_STATE_STANDBY
    return mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR, mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA, base, NUMBER[px4.mode], status, 3
    )


class EkfStatusMessage(mavlink.MAVLink_message):  # type: ignore[misc]
    """EKF_STATUS_REPORT on the wire: pymavlink's common dialects do not have it."""

    fieldnames: ClassVar = ["flags"]

    def __init__(self, flags: int) -> None:
        super().__init__(_EKF_STATUS, "EKF_STATUS_REPORT")
        self.flags = flags

    def pack(self, mav: Any) -> bytes:
        """The packet."""
        data: bytes = self._pack(mav, _EKF_CRC_EXTRA, struct.pack("<fffffH", *([0.05] * 5), self.flags))
        return data


def ekf_status(px4: Px4) -> EkfStatusMessage:
    """What of the estimate is valid."""
    flags = _EKF_FLAGS
    if not px4.velocity_valid:
        flags &= ~(_EKF_VELOCITY | _EKF_POSITION)
    elif px4.faults.active(Fault.GPS_LOST):
        flags &= ~(1 << 4)
    return EkfStatusMessage(flags)


def usable(m: Any) -> bool:
    """Can GUIDED fly this setpoint: a known frame, and all three velocities or all three positions."""
    if m.coordinate_frame not in FRAMES or (m.type_mask & 0x200 and m.type_mask & 0x1C0 != 0x1C0):
        return False
    return not m.type_mask & 0x38 or not m.type_mask & 0x7
