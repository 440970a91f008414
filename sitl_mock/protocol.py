"""The autopilot on MAVLink 2, sans I/O: decoded messages in, messages to send out, for each of two links.

`receive` may be called at any time; everything that the commander decides happens in `step`, which is why its
answers come up to one step after the receiver's.
"""

from __future__ import annotations

import struct
from collections import deque
from enum import Enum
from math import cos, isfinite, pi, sin
from typing import NamedTuple

from pymavlink.dialects.v20 import development as mavlink

from sitl_mock import ardupilot
from sitl_mock.ardupilot import ArduPilot
from sitl_mock.autopilot import Target
from sitl_mock.faults import Fault
from sitl_mock.modes import BY_CUSTOM, Mode, Result
from sitl_mock.px4 import Px4
from sitl_mock.streams import (
    ARDUPILOT_BUILDERS,
    BUILDERS,
    GCS_HZ,
    MOTION,
    ONBOARD_HZ,
    ORIGIN_ALTITUDE_M,
    Message,
    view,
)
from sitl_mock.vehicle import STEP_S, wrap

_FORCE_DISARM = 21196.0
_PARAMS_PER_STEP = 5
# Type-mask bits of SET_POSITION_TARGET_LOCAL_NED.
_POSITION, _VELOCITY, _ACCELERATION, _FORCE, _YAW, _YAW_RATE = 0x007, 0x038, 0x1C0, 0x200, 0x400, 0x800


_PX4_FRAMES = (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_BODY_NED)


def _number(value: float) -> int:
    """A whole number in a float field; -1 for what is none."""
    return round(value) if isfinite(value) else -1


def _told(value: float, ignored: int) -> float | None:
    """A setpoint's field: None where the mask ignores it, or where it is not a number, as PX4 has it."""
    return None if ignored or not isfinite(value) else value


class Link(Enum):
    """The two MAVLink channels, each with one peer."""

    ONBOARD = "onboard"
    GCS = "ground station"


_RATES = {Link.ONBOARD: ONBOARD_HZ, Link.GCS: GCS_HZ}


class Outgoing(NamedTuple):
    """A message to send, and where."""

    link: Link
    message: Message


class _Stream:
    """One streamed message on one link."""

    __slots__ = ("interval", "next_step")

    def __init__(self, rate_hz: float, step: int) -> None:
        self.interval = 1.0 / (rate_hz * STEP_S)
        self.next_step: float = step + 1


class Protocol:
    """The autopilot's end of both links."""

    def __init__(self, px4: Px4) -> None:
        self.px4 = px4
        motion = px4.scenario.telemetry != "none"
        builders = ARDUPILOT_BUILDERS if px4.is_ardupilot else BUILDERS
        self._builders = {i: b for i, b in builders.items() if motion or i not in MOTION}
        px4.on_reboot = self._reset
        self._out: list[Outgoing] = []
        self._steps = 0
        self._reset()

    def _reset(self) -> None:
        self._commands: deque[tuple[Link, Message]] = deque()
        self._params_due: deque[tuple[Link, str]] = deque()
        self._gcs_seen: set[Link] = set()
        self._event_sequence = 0
        self._streams: dict[Link, dict[int, _Stream]] = {
            link: {i: _Stream(hz, self._steps) for i, hz in rates.items() if i in self._builders}
            for link, rates in _RATES.items()
        }

    # --------------------------------------------------------------------------------------------- out

    def step(self) -> list[Outgoing]:
        """Advance the autopilot by STEP_S and return what it sends."""
        self._steps += 1
        while self._commands:
            self._command(*self._commands.popleft())
        self.px4.step()
        for notice in self.px4.notices:
            for link in Link if self.px4.is_ardupilot else self._gcs_seen:
                text = notice.text.encode()[:50]
                self._send(link, mavlink.MAVLink_statustext_message(notice.severity, text))
        self.px4.notices.clear()
        for event in () if self.px4.is_ardupilot else self.px4.events:
            self._event_sequence += 1
            for link in Link:
                self._send(link, event.message(round(self.px4.boot_s * 1e3), self._event_sequence))
        self.px4.events.clear()
        if not self.px4.booting:
            self._stream()
            for _ in range(min(len(self._params_due), _PARAMS_PER_STEP)):
                self._send_param(*self._params_due.popleft())
        out, self._out = self._out, []
        return out

    def _stream(self) -> None:
        faults = self.px4.faults
        quiet, mute = faults.active(Fault.TELEMETRY_STOP), faults.active(Fault.HEARTBEAT_STOP)
        now = None
        for link, streams in self._streams.items():
            for message_id, stream in streams.items():
                if self._steps < stream.next_step:
                    continue
                stream.next_step = max(stream.next_step + stream.interval, self._steps + 0.5)
                heartbeat = message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT
                if mute if heartbeat else quiet:
                    continue
                if now is None:
                    now = view(self.px4)
                message = self._builders[message_id](self.px4, now)
                if message is not None:
                    self._send(link, message)

    def _send(self, link: Link, message: Message) -> None:
        self._out.append(Outgoing(link, message))

    # ---------------------------------------------------------------------------------------------- in

    def receive(self, link: Link, message: Message) -> None:
        """Take one decoded message from a peer."""
        if self.px4.booting:
            return
        kind = message.get_type()
        if kind == "SET_POSITION_TARGET_LOCAL_NED":
            if self._is_for_me(message):
                self._setpoint(message)
        elif kind in ("COMMAND_LONG", "COMMAND_INT"):
            if self._is_for_me(message):
                if message.command == mavlink.MAV_CMD_DO_SET_MODE:
                    # Recorded: the receiver acknowledges first, the commander answers later.
                    self._ack(link, message, Result.ACCEPTED)
                self._commands.append((link, message))
        elif kind == "SET_MODE":
            custom = message.custom_mode
            mode = self._mode(custom >> 16 & 0xFF, custom >> 24 & 0xFF)
            if mode is not None:
                self.px4.set_mode(mode)
        elif kind == "HEARTBEAT":
            if isinstance(self.px4, ArduPilot):
                self.px4.hear(message.get_srcSystem())
            if message.type == mavlink.MAV_TYPE_GCS:
                self._gcs_seen.add(link)
        elif kind.startswith("PARAM_"):
            if self._is_for_me(message):
                self._param(link, kind, message)
        elif kind == "TIMESYNC":
            if message.tc1 == 0:
                now_ns = round(self.px4.boot_s * 1e9)
                self._send(link, mavlink.MAVLink_timesync_message(now_ns, message.ts1))
        elif kind == "PING":
            if message.target_system == 0:
                self._send(
                    link,
                    mavlink.MAVLink_ping_message(
                        message.time_usec, message.seq, message.get_srcSystem(), message.get_srcComponent()
                    ),
                )
        elif kind == "MISSION_REQUEST_LIST" and self._is_for_me(message):
            self._send(
                link,
                mavlink.MAVLink_mission_count_message(
                    message.get_srcSystem(), message.get_srcComponent(), 0, message.mission_type
                ),
            )

    @property
    def system_id(self) -> int:
        """MAV_SYS_ID."""
        return int(self.px4.params["MAV_SYS_ID"])

    def _is_for_me(self, message: Message) -> bool:
        return message.target_system in (0, self.system_id) and message.target_component in (
            0,
            mavlink.MAV_COMP_ID_AUTOPILOT1,
        )

    def _ack(self, link: Link, message: Message, result: Result) -> None:
        self._send(
            link,
            mavlink.MAVLink_command_ack_message(
                message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
            ),
        )

    # --------------------------------------------------------------------------------------- setpoints

    def _mode(self, main: int, sub: int) -> Mode | None:
        """The mode that a command asks for."""
        return ardupilot.BY_NUMBER.get(main) if self.px4.is_ardupilot else BY_CUSTOM.get((main, sub))

    def _setpoint(self, m: Message) -> None:
        if isinstance(self.px4, ArduPilot) and not ardupilot.usable(m):
            self.px4.stop()
            return
        frames = ardupilot.FRAMES if self.px4.is_ardupilot else _PX4_FRAMES
        if m.coordinate_frame not in frames:
            self._say(f"coordinate frame {m.coordinate_frame} unsupported")
            return
        mask = m.type_mask
        if mask & _FORCE and mask & _ACCELERATION != _ACCELERATION:
            self._say("force not supported")
            return
        body = m.coordinate_frame in (mavlink.MAV_FRAME_BODY_NED, mavlink.MAV_FRAME_BODY_OFFSET_NED)
        position = not body and mask & _POSITION != _POSITION
        velocity = mask & _VELOCITY != _VELOCITY
        if not (position or velocity or mask & _ACCELERATION != _ACCELERATION):
            self._say("invalid type mask")
            return
        self.px4.setpoint(self._body_target(m) if body else self._local_target(m))

    def _say(self, what: str) -> None:
        self.px4.say_critical(f"SET_POSITION_TARGET_LOCAL_NED: {what}")

    def _yaw(self, m: Message) -> tuple[float | None, float | None]:
        yaw, rate = _told(m.yaw, m.type_mask & _YAW), _told(-m.yaw_rate, m.type_mask & _YAW_RATE)
        return None if yaw is None else wrap(pi / 2 - yaw), rate

    def _local_target(self, m: Message) -> Target:
        mask = m.type_mask
        heading, yaw_rate = self._yaw(m)
        return Target(
            x_m=_told(m.y, mask & 2),
            y_m=_told(m.x, mask & 1),
            height_m=_told(-m.z, mask & 4),
            vx_m_s=_told(m.vy, mask & 16),
            vy_m_s=_told(m.vx, mask & 8),
            climb_m_s=_told(-m.vz, mask & 32),
            heading_rad=heading,
            yaw_rate_rad_s=yaw_rate,
        )

    def _body_target(self, m: Message) -> Target:
        """BODY_NED: turned by the estimated yaw now; all three velocities or none."""
        heading, yaw_rate = self._yaw(m)
        if m.type_mask & _VELOCITY or not isfinite(m.vx + m.vy + m.vz):
            return Target(heading_rad=heading, yaw_rate_rad_s=yaw_rate)
        now = self.px4.autopilot.heading_rad
        forward, left = m.vx, -m.vy
        return Target(
            vx_m_s=forward * cos(now) - left * sin(now),
            vy_m_s=forward * sin(now) + left * cos(now),
            climb_m_s=-m.vz,
            heading_rad=heading,
            yaw_rate_rad_s=yaw_rate,
        )

    # ---------------------------------------------------------------------------------------- commands

    def _command(self, link: Link, m: Message) -> None:
        result = self._execute(link, m)
        if result is not None:
            self._ack(link, m, result)

    def _execute(self, link: Link, m: Message) -> Result | None:
        """Obey a command. None: it is never answered."""
        px4, command = self.px4, m.command
        long = m.get_type() == "COMMAND_LONG"
        if command == mavlink.MAV_CMD_DO_SET_MODE:
            custom = _number(m.param1) & mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
            mode = self._mode(_number(m.param2), _number(m.param3)) if custom else None
            return Result.DENIED if mode is None else px4.set_mode(mode)
        if command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            if m.param1 >= 0.5:
                return px4.arm()
            return px4.disarm(force=m.param2 == _FORCE_DISARM)
        if command == mavlink.MAV_CMD_NAV_TAKEOFF:
            altitude = m.param7 if long else m.z
            origin_m = 0.0 if px4.is_ardupilot else ORIGIN_ALTITUDE_M  # ArduCopter: above home
            return px4.take_off(altitude - origin_m if isfinite(altitude) else None)
        if command == mavlink.MAV_CMD_NAV_LAND:
            return px4.set_mode(Mode.LAND)
        if command == mavlink.MAV_CMD_NAV_RETURN_TO_LAUNCH:
            return px4.set_mode(Mode.RTL)
        if command == mavlink.MAV_CMD_SET_MESSAGE_INTERVAL:
            return self._set_interval(link, _number(m.param1), m.param2)
        if command == mavlink.MAV_CMD_GET_MESSAGE_INTERVAL:
            stream = self._streams[link].get(_number(m.param1))
            interval = -1 if stream is None else round(stream.interval * STEP_S * 1e6)
            self._send(link, mavlink.MAVLink_message_interval_message(_number(m.param1), interval))
            return Result.ACCEPTED
        if command == mavlink.MAV_CMD_REQUEST_MESSAGE:
            return self._request(link, _number(m.param1))
        if command == mavlink.MAV_CMD_REQUEST_AUTOPILOT_CAPABILITIES:
            return self._request(link, mavlink.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
        if command == mavlink.MAV_CMD_PREFLIGHT_REBOOT_SHUTDOWN and m.param1 >= 0.5:
            if px4.armed:
                return Result.TEMPORARILY_REJECTED
            self._ack(link, m, Result.ACCEPTED)
            px4.reboot()
            return None
        return Result.UNSUPPORTED

    def _set_interval(self, link: Link, message_id: int, interval_us: float) -> Result:
        if message_id not in self._builders:
            return Result.FAILED
        if message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT and not self.px4.is_ardupilot:
            return Result.ACCEPTED  # recorded: its rate cannot be changed
        streams = self._streams[link]
        default = _RATES[link].get(message_id)
        rate = default if interval_us == 0 else 1e6 / interval_us if interval_us > 0 else None
        streams.pop(message_id, None)
        if rate is not None:
            streams[message_id] = _Stream(rate, self._steps)
        return Result.ACCEPTED

    def _request(self, link: Link, message_id: int) -> Result:
        builder = self._builders.get(message_id)
        message = builder(self.px4, view(self.px4)) if builder is not None else None
        if message is None:
            return Result.DENIED
        self._send(link, message)
        return Result.ACCEPTED

    # -------------------------------------------------------------------------------------- parameters

    def _param(self, link: Link, kind: str, m: Message) -> None:
        names = self.px4.params.names()
        if kind == "PARAM_REQUEST_LIST":
            self._params_due.extend((link, name) for name in names)
        elif kind == "PARAM_REQUEST_READ":
            name = names[m.param_index] if 0 <= m.param_index < len(names) else m.param_id
            self._send_param(link, name)
        elif kind == "PARAM_SET":
            self._set_param(m.param_id, m.param_type, m.param_value)
            self._send_param(link, m.param_id)

    def _set_param(self, name: str, kind: int, value: float) -> None:
        """Refused, as PX4 does, where the type is not the parameter's; integers travel bit for bit."""
        old = self.px4.params.get(name)
        if isinstance(old, int) and kind == mavlink.MAV_PARAM_TYPE_INT32:
            self.px4.params.set(name, struct.unpack("<i", struct.pack("<f", value))[0])
        elif isinstance(old, float) and kind == mavlink.MAV_PARAM_TYPE_REAL32 and isfinite(value):
            self.px4.params.set(name, value)

    def _send_param(self, link: Link, name: str) -> None:
        """PARAM_VALUE; silence for a name that is not there. PX4's integers travel bit for bit."""
        value = self.px4.params.get(name)
        if value is None:
            return
        kind = mavlink.MAV_PARAM_TYPE_REAL32
        if isinstance(value, int):
            kind = mavlink.MAV_PARAM_TYPE_INT32
            if not self.px4.is_ardupilot:
                value = struct.unpack("<f", struct.pack("<i", value))[0]
        names = self.px4.params.names()
        self._send(
            link,
            mavlink.MAVLink_param_value_message(name.encode(), value, kind, len(names), names.index(name)),
        )
