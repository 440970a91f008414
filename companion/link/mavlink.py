"""The vehicle over MAVLink 2: telemetry to events, outputs to messages.

The NED signs live here, for what goes out, and in `decode.py`, for what comes in. MAVLink's local frame is
x North, y East, z down, yaw clockwise from North; ours is x East, y North, height up, heading
counter-clockwise from East (see `companion.types`).
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from typing import Any, Final

import msgspec
from pymavlink.dialects.v20 import development as mavlink

from companion.link.decode import WORDS, decoders, heading_from_yaw
from companion.link.ground_station import GroundStation
from companion.link.modes import DIALECTS, STEERING, message_id, wanted_rates
from companion.link.packets import Packet, SetPositionTarget, packets
from companion.link.signing import REFUSALS, SignedMavlink
from companion.link.transport import ECHOES, Transport, has_more, is_from_peer, open_transport, settle
from companion.settings import VehicleSettings
from companion.types import (
    CompanionHeartbeat,
    Defect,
    Event,
    Malformed,
    ModeRequest,
    Output,
    Party,
    PartyHeard,
    Setpoint,
)

# POSITION_TARGET_TYPEMASK: a set bit means "ignore".
_IGNORE_XY, _IGNORE_Z = 1 | 2, 4
_IGNORE_VZ, _IGNORE_ACCELERATION, _IGNORE_YAW = 32, 64 | 128 | 256, 1024
_MASK_HEIGHT_HELD: Final = _IGNORE_XY | _IGNORE_VZ | _IGNORE_ACCELERATION | _IGNORE_YAW
_MASK_VELOCITY: Final = _IGNORE_XY | _IGNORE_Z | _IGNORE_ACCELERATION | _IGNORE_YAW
# MAV_FRAME.
_LOCAL_NED = 1
_BODY_NED = 8

_SIGNED_ONLY = frozenset({"HEARTBEAT", "CURRENT_MODE"})
"""On a signed link these are believed with a verified signature only, whatever else is."""

_TURN_NS = 20_000_000
"""So long is read at a time."""


class _Wanted(msgspec.Struct):
    """A message that is asked for: how often, and how often it came since that was looked at."""

    hz: float
    count: int = 0


class VehicleLink:
    """One autopilot behind one transport. Only who holds the loop's lock calls it."""

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
        self._component = settings.component_id
        self._seq = 0
        self._mav.robust_parsing = True
        self._target_system = settings.target_system
        self._dialect = DIALECTS[settings.kind]
        self._decoders = decoders(self._dialect, self._target_system)
        self._heard = frozenset({*self._decoders, *WORDS, *STEERING})
        self._wanted = {message_id(name): _Wanted(hz) for name, hz in wanted_rates(settings).items()}
        self._t_counted_ns = 0
        self._is_from_peer = False
        self._sent = [b""] * ECHOES
        """By sequence number: there are as many."""

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
        """What has come since, as events. Of a flood the rest waits: the loop has other things to do.

        Best called when the descriptor is ready.
        """
        began_ns = clock()
        while data := self._transport.receive():
            t_ns = clock()
            self._is_from_peer = is_from_peer(self._transport, t_ns)
            for packet in packets(self._mav, data, self._heard):
                event = self._event(packet, t_ns)
                if event is not None:
                    yield event
            if t_ns - began_ns >= _TURN_NS or not has_more(self._transport):
                return

    def _event(self, p: Packet, t_ns: int) -> Event | None:
        m = p.fields
        if p.name == "BAD_DATA":
            defect = Defect.MAVLINK_SIGNATURE if m.reason in REFUSALS else Defect.MAVLINK_BYTES
            return Malformed(t_ns=t_ns, defect=defect, detail=str(m.reason)[:80])
        if p.component != mavlink.MAV_COMP_ID_AUTOPILOT1 or self._target_system not in (0, p.system):
            return self._party(p, t_ns)
        if self._is_signing and p.name in _SIGNED_ONLY and not p.is_signed:
            return Malformed(t_ns=t_ns, defect=Defect.MAVLINK_SIGNATURE, detail=f"{p.name} not signed")
        is_heartbeat = p.name == "HEARTBEAT"
        is_vehicle = is_heartbeat and m.autopilot == self._dialect.vendor
        if is_vehicle:
            self._is_from_peer = settle(self._transport, t_ns)
        if not self._is_from_peer:  # critical: our id from another address is another vehicle, or a lie
            return self._party(p, t_ns)
        if is_vehicle and self._target_system == 0:
            self._adopt(p.system)
        decode = self._decoders.get(p.name)
        if decode is None:
            words = WORDS.get(p.name)
            return None if words is None or self._target_system == 0 else words(m, t_ns)
        if self._target_system == 0 and not is_heartbeat:
            return None
        wanted = self._wanted.get(p.number)
        if wanted is not None:
            wanted.count += 1
        if is_heartbeat and self._target_system:  # asked of system 0, everybody would answer
            self._ask_for_telemetry(t_ns)
        event = decode(m, t_ns)
        if event is None:
            return Malformed(t_ns=t_ns, defect=Defect.MAVLINK_FIELD, detail=p.name)
        return event

    def _party(self, p: Packet, t_ns: int) -> Event | None:
        """Somebody else, where it matters: another vehicle to mix up, or another one who steers ours.

        On a signed link nobody without the key steers. What cannot be seen: setpoints on other links of the
        autopilot, which it does not pass on to this one.
        """
        ours, configured, m = self._target_system, self._settings.target_system, p.fields
        party = None
        if (p.name != "HEARTBEAT" and p.name not in STEERING) or (self._is_signing and not p.is_signed):
            return None
        if p.component == self._settings.component_id and p.data in self._sent:
            return None  # a bridge sends back what this app has sent
        if p.name == "HEARTBEAT":
            if (p.system, p.component) == (ours, self._settings.component_id):
                party = Party.TWIN
            elif p.component == mavlink.MAV_COMP_ID_AUTOPILOT1 and configured in (0, p.system):
                party = Party.AUTOPILOT if m.autopilot != mavlink.MAV_AUTOPILOT_INVALID else None
        elif ours and m.target_system in (0, ours):
            party = Party.COMMANDER
        return None if party is None else PartyHeard(t_ns, party, p.system, p.component, p.name)

    def _adopt(self, system: int) -> None:
        """The first autopilot heard is ours; we are part of its system."""
        self._target_system = system
        self._decoders = decoders(self._dialect, system)
        self._mav.srcSystem = system

    def _ask_for_telemetry(self, t_ns: int) -> None:
        """Once a heartbeat: ask anew for each message that does not come at the rate wanted.

        No bookkeeping of acks: after a reboot, or on a link that lost the request, the rate is wrong and
        asked for again.
        """
        since_s = (t_ns - self._t_counted_ns) * 1e-9
        if since_s < 0.5:
            return
        for number, wanted in self._wanted.items():
            rate_hz = wanted.count / since_s
            if not 0.7 * wanted.hz <= rate_hz <= 1.5 * wanted.hz:
                self._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, number, 1e6 / wanted.hz)
            wanted.count = 0
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
            self._command(mavlink.MAV_CMD_DO_SET_MODE, *self._dialect.request(output.mode))
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
        seq = self._seq
        if isinstance(message, SetPositionTarget) and not self._is_signing:
            data = message.unsigned(seq, self._target_system or 1, self._component)
        else:
            self._mav.seq = seq
            data = bytes(message.pack(self._mav))
        self._seq = (seq + 1) % 256
        self._sent[seq] = data
        self._transport.send(data)


def setpoint_message(s: Setpoint, target_system: int) -> SetPositionTarget:
    """SET_POSITION_TARGET_LOCAL_NED for a setpoint.

    With a height: LOCAL_NED, v_x and v_y from the measured heading, z held. Without: BODY_NED with v_z.
    """
    t_boot_ms = (s.t_ns // 1_000_000) & 0xFFFFFFFF
    speed_m_s, height_m = s.speed_m_s, s.height_m
    if height_m is None:
        frame, mask = _BODY_NED, _MASK_VELOCITY
        vx, vy, vz, z = speed_m_s, 0.0, -s.climb_m_s, 0.0
    else:
        frame, mask = _LOCAL_NED, _MASK_HEIGHT_HELD
        yaw_ned = heading_from_yaw(s.heading_rad)
        vx, vy = speed_m_s * math.cos(yaw_ned), speed_m_s * math.sin(yaw_ned)
        vz, z = 0.0, -height_m
    return SetPositionTarget(t_boot_ms, z, vx, vy, vz, -s.yaw_rate_rad_s, mask, target_system, frame)
