"""The vehicle over MAVLink 2: telemetry to events, outputs to messages. The NED signs live here alone.

MAVLink's local frame is x North, y East, z down, yaw clockwise from North; ours is x East, y North, height
up, heading counter-clockwise from East (see `companion.types`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any

from pymavlink.dialects.v20 import development as mavlink

from companion.link.ground_station import GroundStation
from companion.link.signing import REFUSALS, SignedMavlink, is_signed
from companion.link.transport import Transport, open_transport
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
    Output,
    Setpoint,
    VehicleHeartbeat,
)

_PX4_MODES = {
    (1, 0): FlightMode.MANUAL,
    (2, 0): FlightMode.ALTCTL,
    (3, 0): FlightMode.POSCTL,
    (4, 1): FlightMode.AUTO_READY,
    (4, 2): FlightMode.AUTO_TAKEOFF,
    (4, 3): FlightMode.AUTO_LOITER,
    (4, 4): FlightMode.AUTO_MISSION,
    (4, 5): FlightMode.AUTO_RTL,
    (4, 6): FlightMode.AUTO_LAND,
    (5, 0): FlightMode.ACRO,
    (6, 0): FlightMode.OFFBOARD,
    (7, 0): FlightMode.STABILIZED,
}
"""PX4 custom mode (main, sub) → mode."""
_PX4_CUSTOM = {mode: number for number, mode in _PX4_MODES.items()}

_LANDED = {
    mavlink.MAV_LANDED_STATE_ON_GROUND: Landed.ON_GROUND,
    mavlink.MAV_LANDED_STATE_IN_AIR: Landed.IN_AIR,
    mavlink.MAV_LANDED_STATE_TAKEOFF: Landed.TAKING_OFF,
    mavlink.MAV_LANDED_STATE_LANDING: Landed.LANDING,
}

# POSITION_TARGET_TYPEMASK: a set bit means "ignore".
_IGNORE_XY, _IGNORE_Z = 1 | 2, 4
_IGNORE_VZ, _IGNORE_ACCELERATION, _IGNORE_YAW = 32, 64 | 128 | 256, 1024
_MASK_HEIGHT_HELD = _IGNORE_XY | _IGNORE_VZ | _IGNORE_ACCELERATION | _IGNORE_YAW
_MASK_VELOCITY = _IGNORE_XY | _IGNORE_Z | _IGNORE_ACCELERATION | _IGNORE_YAW

_SIGNED_ONLY = frozenset({"HEARTBEAT", "CURRENT_MODE"})
"""On a signed link these are believed with a verified signature only, whatever else is."""

_MODE_RATE_HZ = 20.0
_LANDED_RATE_HZ = 5.0


def px4_mode(custom_mode: int) -> FlightMode:
    """PX4's custom_mode as a flight mode."""
    main, sub = (custom_mode >> 16) & 0xFF, (custom_mode >> 24) & 0xFF
    return _PX4_MODES.get((main, sub if main == 4 else 0), FlightMode.OTHER)


def heading_from_yaw(yaw_ned_rad: float) -> float:
    """NED yaw (clockwise from North) → heading (counter-clockwise from East), in (−π, π]. Its own inverse."""
    heading = math.pi / 2.0 - yaw_ned_rad
    wrapped = math.remainder(heading, 2.0 * math.pi)
    return math.pi if wrapped == -math.pi else wrapped


class VehicleLink:
    """One autopilot behind one transport. Single-threaded: only the loop calls it."""

    def __init__(
        self,
        settings: VehicleSettings,
        transport: Transport,
        signed: SignedMavlink | None = None,
        heartbeat_only: bool = False,
        ground: GroundStation | None = None,
    ) -> None:
        """`signed`: for a signed link; the caller closes it. `heartbeat_only`: nothing else ever leaves.

        `ground`: what a ground station is told.
        """
        self._settings = settings
        self._transport = transport
        self._is_signing = signed is not None
        self._heartbeat_only = heartbeat_only
        self._ground = ground
        self._mav = signed or mavlink.MAVLink(None, srcComponent=settings.component_id)
        self._mav.srcSystem = settings.target_system or 1  # we are part of its system
        self._mav.robust_parsing = True
        self._target_system = settings.target_system
        self._wanted_hz = {
            mavlink.MAVLINK_MSG_ID_ATTITUDE: settings.telemetry_rate_hz,
            mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: settings.telemetry_rate_hz,
            mavlink.MAVLINK_MSG_ID_CURRENT_MODE: _MODE_RATE_HZ,
            mavlink.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: _LANDED_RATE_HZ,
        }
        self._counts = dict.fromkeys(self._wanted_hz, 0)
        self._t_counted_ns = 0

    @classmethod
    def open(
        cls,
        settings: VehicleSettings,
        signed: SignedMavlink | None = None,
        heartbeat_only: bool = False,
        ground: GroundStation | None = None,
    ) -> VehicleLink:
        """Open the configured link. Raises ValueError (not a URL) or OSError (cannot be opened)."""
        return cls(settings, open_transport(settings.mavlink), signed, heartbeat_only, ground)

    def fileno(self) -> int:
        """The descriptor to wait on."""
        return self._transport.fileno()

    def close(self) -> None:
        """Give the port back."""
        self._transport.close()

    # --------------------------------------------------------------------------------------- receiving

    def receive(self, clock: Callable[[], int] = time.monotonic_ns) -> Iterator[Event]:
        """Everything that has come since, as events."""
        while data := self._transport.receive():
            t_ns = clock()
            for message in self._mav.parse_buffer(data) or ():
                event = self._event(message, t_ns)
                if event is not None:
                    yield event

    def _event(self, m: Any, t_ns: int) -> Event | None:
        kind = m.get_type()
        if kind == "BAD_DATA":
            defect = Defect.MAVLINK_SIGNATURE if m.reason in REFUSALS else Defect.MAVLINK_BYTES
            return Malformed(t_ns=t_ns, defect=defect, detail=str(m.reason)[:80])
        system, component = m.get_srcSystem(), m.get_srcComponent()
        if component != mavlink.MAV_COMP_ID_AUTOPILOT1:
            return None
        if self._target_system not in (0, system):
            return None
        decode = _DECODERS.get(kind)
        if decode is None:
            return None
        if self._is_signing and kind in _SIGNED_ONLY and not is_signed(m):
            return Malformed(t_ns=t_ns, defect=Defect.MAVLINK_SIGNATURE, detail=f"{kind} not signed")
        if self._target_system == 0:
            if kind != "HEARTBEAT":
                return None
            self._adopt(system)
        if m.get_msgId() in self._counts:
            self._counts[m.get_msgId()] += 1
        if kind == "HEARTBEAT":
            self._ask_for_telemetry(t_ns)
        event = decode(m, t_ns)
        if event is None:
            return Malformed(t_ns=t_ns, defect=Defect.MAVLINK_FIELD, detail=kind)
        return event

    def _adopt(self, system: int) -> None:
        """The first autopilot heard is ours; we are part of its system."""
        self._target_system = system
        self._mav.srcSystem = system

    def _ask_for_telemetry(self, t_ns: int) -> None:
        """Once a heartbeat: ask anew for each message that does not come at the rate wanted.

        No bookkeeping of acks: after a reboot, or on a link that lost the request, the rate is wrong and
        asked for again.
        """
        since_s = (t_ns - self._t_counted_ns) * 1e-9
        if since_s < 0.5:
            return
        for message_id, wanted_hz in self._wanted_hz.items():
            rate_hz = self._counts[message_id] / since_s
            if not 0.7 * wanted_hz <= rate_hz <= 1.5 * wanted_hz:
                self._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id, 1e6 / wanted_hz)
            self._counts[message_id] = 0
        self._t_counted_ns = t_ns

    # ----------------------------------------------------------------------------------------- sending

    def send(self, output: Output) -> None:
        """Send what is meant for the vehicle; other outputs are none of its business."""
        if isinstance(output, Setpoint):
            self._send(setpoint_message(output, self._target_system))
        elif isinstance(output, CompanionHeartbeat):
            self._send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
                    mavlink.MAV_AUTOPILOT_INVALID,
                    0,
                    0,
                    int(output.system_status),
                    3,
                )
            )
        elif isinstance(output, ModeRequest):
            main, sub = _PX4_CUSTOM[output.mode]
            base = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            self._command(mavlink.MAV_CMD_DO_SET_MODE, base, main, sub)
        elif self._ground is not None and self._target_system:  # nobody would hear it before
            for message in self._ground.messages(output):
                self._send(message)

    def _command(self, command: int, *params: float) -> None:
        p = [float(value) for value in params] + [0.0] * (7 - len(params))
        self._send(
            mavlink.MAVLink_command_long_message(
                self._target_system, mavlink.MAV_COMP_ID_AUTOPILOT1, command, 0, *p
            )
        )

    def _send(self, message: Any) -> None:
        if self._heartbeat_only and message.get_msgId() != mavlink.MAVLINK_MSG_ID_HEARTBEAT:
            return  # critical: every message passes here
        data = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256  # pack() does not
        self._transport.send(bytes(data))


def setpoint_message(s: Setpoint, target_system: int) -> Any:
    """SET_POSITION_TARGET_LOCAL_NED for a setpoint.

    With a height: LOCAL_NED, v_x and v_y from the measured heading, z held. Without: BODY_NED with v_z.
    """
    t_boot_ms = (s.t_ns // 1_000_000) & 0xFFFFFFFF
    yaw_ned = heading_from_yaw(s.heading_rad)
    if s.height_m is None:
        frame, mask = mavlink.MAV_FRAME_BODY_NED, _MASK_VELOCITY
        vx, vy, vz, z = s.speed_m_s, 0.0, -s.climb_m_s, 0.0
    else:
        frame, mask = mavlink.MAV_FRAME_LOCAL_NED, _MASK_HEIGHT_HELD
        vx, vy = s.speed_m_s * math.cos(yaw_ned), s.speed_m_s * math.sin(yaw_ned)
        vz, z = 0.0, -s.height_m
    return mavlink.MAVLink_set_position_target_local_ned_message(
        t_boot_ms,
        target_system,
        mavlink.MAV_COMP_ID_AUTOPILOT1,
        frame,
        mask,
        0.0,
        0.0,
        z,
        vx,
        vy,
        vz,
        0.0,
        0.0,
        0.0,
        0.0,
        -s.yaw_rate_rad_s,
    )


# ------------------------------------------------------------------------------------------- decoders


def _heartbeat(m: Any, t_ns: int) -> Event | None:
    mode = px4_mode(m.custom_mode) if m.autopilot == mavlink.MAV_AUTOPILOT_PX4 else FlightMode.OTHER
    armed = bool(m.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    return VehicleHeartbeat(t_ns=t_ns, system_id=m.get_srcSystem(), mode=mode, armed=armed)


def _current_mode(m: Any, t_ns: int) -> Event | None:
    intended = px4_mode(m.intended_custom_mode) if m.intended_custom_mode else None
    return ModeReport(t_ns=t_ns, actual=px4_mode(m.custom_mode), intended=intended)


def _extended_sys_state(m: Any, t_ns: int) -> Event | None:
    return LandedReport(t_ns=t_ns, landed=_LANDED.get(m.landed_state, Landed.UNKNOWN))


def _attitude(m: Any, t_ns: int) -> Event | None:
    if not (math.isfinite(m.yaw) and math.isfinite(m.yawspeed)):
        return None
    return Attitude(
        t_ns=t_ns,
        heading_rad=heading_from_yaw(m.yaw),
        yaw_rate_rad_s=-m.yawspeed,
        boot_ms=m.time_boot_ms,
    )


def _local_position(m: Any, t_ns: int) -> Event | None:
    if not (math.isfinite(m.vx) and math.isfinite(m.vy)):
        return None
    return LocalMotion(
        t_ns=t_ns,
        x_m=m.y if math.isfinite(m.y) else None,
        y_m=m.x if math.isfinite(m.x) else None,
        height_m=-m.z if math.isfinite(m.z) else None,
        vx_m_s=m.vy,
        vy_m_s=m.vx,
        climb_m_s=-m.vz if math.isfinite(m.vz) else 0.0,
        boot_ms=m.time_boot_ms,
    )


_DECODERS: dict[str, Callable[[Any, int], Event | None]] = {
    "HEARTBEAT": _heartbeat,
    "CURRENT_MODE": _current_mode,
    "EXTENDED_SYS_STATE": _extended_sys_state,
    "ATTITUDE": _attitude,
    "LOCAL_POSITION_NED": _local_position,
}
