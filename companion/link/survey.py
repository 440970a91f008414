"""What a vehicle tells of itself when it is asked, and only asked: nothing sent here can move or change it.

What leaves: our HEARTBEAT, PARAM_REQUEST_READ, and the commands SET_MESSAGE_INTERVAL and REQUEST_MESSAGE.
"""

from __future__ import annotations

import math
import struct
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import zenoh
from pymavlink.dialects.v20 import development as mavlink

from companion.link import decode
from companion.link.modes import STEERING, ardupilot_mode, message_id, px4_mode, wanted_rates
from companion.link.signing import REFUSALS, SignedMavlink
from companion.link.transport import ECHOES, Transport, is_from_peer, open_transport, settle
from companion.link.zenoh_ranges import RangeLink
from companion.link.zenoh_session import words
from companion.network_settings import RangesSettings
from companion.settings import VehicleSettings
from companion.types import Charge, EstimatorReport, FlightMode, Landed, SystemStatus

PARAMETERS = ("COM_OF_LOSS_T", "COM_OBL_RC_ACT", "COM_RCL_EXCEPT", "COM_RC_OVERRIDE", "MIS_TAKEOFF_ALT")
"""What is judged of PX4's parameters."""
ARDUPILOT_PARAMETERS = ("FS_GCS_ENABLE", "SYSID_MYGCS", "GUID_TIMEOUT")
"""The same of ArduCopter's."""
OPTIONAL_PARAMETERS = ("MAV_SIGN_CFG",)
"""Asked for as well, but not waited for: some versions have it."""
SETTLE_S, WINDOW_S = 1.0, 2.0
"""Rates are what came in the last `WINDOW_S`, at least `SETTLE_S` after they were asked for."""
_ASK_AGAIN_NS = 500_000_000
_HEARTBEAT_NS = 1_000_000_000
_SIGNED_FLAG = 1

REQUESTED = ("AUTOPILOT_VERSION", "SYS_STATUS", "BATTERY_STATUS", "ESTIMATOR_STATUS")


class SysStatus(NamedTuple):
    """SYS_STATUS: would it arm, which sensors are not well, is there a radio control."""

    may_arm: bool
    unhealthy: tuple[str, ...]
    remote_control: bool


class Other(NamedTuple):
    """Somebody else on the link."""

    system: int
    component: int
    kind: str


@dataclass(slots=True)
class VehicleFindings:
    """All that came, the last of each kind; None: it never came."""

    bytes_received: int = 0
    not_mavlink: int = 0
    refused: dict[str, int] = field(default_factory=dict)
    """Signed links: reason (`signing.REFUSALS`) → messages."""
    verified: int = 0
    """Messages with a signature that was checked."""
    signs: bool = False
    """The autopilot's messages carry signatures."""
    packets: int = 0
    packets_lost: int = 0
    """The autopilot's, by the gaps of its sequence numbers."""
    t_found_ns: int | None = None
    system_id: int | None = None
    vendor: str = ""
    kind: str = ""
    others: set[Other] = field(default_factory=set)
    commanders: set[Other] = field(default_factory=set)
    """Who sends setpoints to our vehicle."""
    version: str | None = None
    armed: bool | None = None
    mode: FlightMode | None = None
    """By HEARTBEAT, the actual one."""
    intended: FlightMode | None = None
    landed: Landed | None = None
    height_m: float | None = None
    estimator: EstimatorReport | None = None
    health: SysStatus | None = None
    charge: Charge | None = None
    battery_share: float | None = None
    battery_v: float | None = None
    parameters: dict[str, float] = field(default_factory=dict)
    rates_hz: dict[str, float] = field(default_factory=dict)
    """Streamed messages, measured at the end."""

    @property
    def is_px4(self) -> bool:
        """The autopilot is a PX4."""
        return self.vendor == "PX4"


class VehicleSurvey:
    """Listens to one autopilot and asks it, until everything is there or the caller's patience ends."""

    def __init__(
        self, settings: VehicleSettings, transport: Transport, signed: SignedMavlink | None = None
    ) -> None:
        self._settings = settings
        self._transport = transport
        self._mav = signed or mavlink.MAVLink(None, srcSystem=1, srcComponent=settings.component_id)
        self._mav.robust_parsing = True
        self._wanted_hz = wanted_rates(settings)
        self._arrivals: dict[str, list[int]] = {name: [] for name in self._wanted_hz}
        self._seen: set[str] = set()
        self._sequence: int | None = None
        self._t_asked_ns = 0
        self._t_heartbeat_ns = 0
        self._is_from_peer = False
        self._sent: deque[bytes] = deque(maxlen=ECHOES)
        self.found = VehicleFindings()

    @classmethod
    def open(cls, settings: VehicleSettings, signed: SignedMavlink | None = None) -> VehicleSurvey:
        """Open the configured link. Raises OSError or ValueError where that is not possible."""
        return cls(settings, open_transport(settings.mavlink), signed)

    def fileno(self) -> int:
        """The descriptor to wait on."""
        return self._transport.fileno()

    def close(self) -> None:
        """Give the port back."""
        self._transport.close()

    def missing(self) -> list[str]:
        """Messages and parameters that have not come yet, by name."""
        if self.found.t_found_ns is None:
            return ["HEARTBEAT"]
        names = [name for name in (*self._wanted_hz, *self._requested()) if name not in self._seen]
        names += [name for name in self._parameters() if name not in self.found.parameters]
        return names

    def _parameters(self) -> tuple[str, ...]:
        """What is judged of this autopilot."""
        if self.found.vendor == "ArduPilot":
            return ARDUPILOT_PARAMETERS
        return PARAMETERS if self.found.is_px4 else ()

    def _requested(self) -> tuple[str, ...]:
        """ArduPilot tells of its estimate by itself, in a message of its own."""
        return REQUESTED if self._settings.kind == "px4" else REQUESTED[:-1]

    def is_complete(self, t_ns: int) -> bool:
        """Everything has come, and the rates have been watched for long enough."""
        found_ns = self.found.t_found_ns
        return (
            found_ns is not None
            and t_ns - found_ns >= round((SETTLE_S + WINDOW_S) * 1e9)
            and not self.missing()
        )

    # --------------------------------------------------------------------------------------- receiving

    def receive(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        """Take in everything that has come since."""
        while data := self._transport.receive():
            self.found.bytes_received += len(data)
            t_ns = clock()
            self._is_from_peer = is_from_peer(self._transport, t_ns)
            for message in self._mav.parse_buffer(data) or ():
                self._take_in(message, t_ns)

    def measure(self, t_ns: int) -> None:
        """Work out the rates of the last `WINDOW_S`."""
        since_ns = t_ns - round(WINDOW_S * 1e9)
        for name, arrivals in self._arrivals.items():
            self.found.rates_hz[name] = sum(t > since_ns for t in arrivals) / WINDOW_S

    def _take_in(self, m: Any, t_ns: int) -> None:
        f, name = self.found, m.get_type()
        if name == "BAD_DATA":
            if m.reason in REFUSALS:
                f.refused[m.reason] = f.refused.get(m.reason, 0) + 1
            else:
                f.not_mavlink += 1
            return
        if name.startswith("UNKNOWN"):
            return
        system, component = m.get_srcSystem(), m.get_srcComponent()
        if component == self._settings.component_id and bytes(m.get_msgbuf()) in self._sent:
            return  # a bridge sends back what was sent from here
        if name == "HEARTBEAT":
            if self._is_ours(m):
                self._is_from_peer = settle(self._transport, t_ns)
            if not (self._is_ours(m) and self._is_from_peer):
                kind = _word(mavlink.enums["MAV_TYPE"], m.type, "MAV_TYPE_")
                f.others.add(Other(system, component, kind))
                return
            if f.system_id is None:
                f.system_id = self._mav.srcSystem = system
                f.t_found_ns = t_ns
        elif name in STEERING and m.target_system in (0, f.system_id):
            f.commanders.add(Other(system, component, name))
            return
        elif (system, component) != (f.system_id, mavlink.MAV_COMP_ID_AUTOPILOT1) or not self._is_from_peer:
            return
        self._count(m.get_seq())
        f.signs = f.signs or bool(m.get_header().incompat_flags & _SIGNED_FLAG)
        f.verified += bool(m.get_signed())
        self._seen.add(name)
        if name in self._arrivals:
            self._arrivals[name].append(t_ns)
        reader = _READERS.get(name)
        if reader is not None:
            reader(f, m)

    def _count(self, sequence: int) -> None:
        gap = 0 if self._sequence is None else (sequence - self._sequence - 1) % 256
        self.found.packets += 1
        if gap < 128:  # else it is late or came twice
            self.found.packets_lost += gap
            self._sequence = sequence

    def _is_ours(self, m: Any) -> bool:
        """A HEARTBEAT of the autopilot that is looked for: the configured one, or the first one heard."""
        wanted = self._settings.target_system or self.found.system_id or m.get_srcSystem()
        is_autopilot = m.autopilot != mavlink.MAV_AUTOPILOT_INVALID
        source = (m.get_srcSystem(), m.get_srcComponent())
        return is_autopilot and source == (wanted, mavlink.MAV_COMP_ID_AUTOPILOT1)

    # ------------------------------------------------------------------------------------------ asking

    def ask(self, t_ns: int) -> None:
        """Send what is due: our HEARTBEAT once a second; twice a second a request for all that is missing."""
        if t_ns - self._t_heartbeat_ns >= _HEARTBEAT_NS:
            self._t_heartbeat_ns = t_ns
            self._send(
                mavlink.MAVLink_heartbeat_message(
                    mavlink.MAV_TYPE_ONBOARD_CONTROLLER,
                    mavlink.MAV_AUTOPILOT_INVALID,
                    0,
                    0,
                    int(SystemStatus.STANDBY),
                    3,
                )
            )
        if self.found.system_id is None or t_ns - self._t_asked_ns < _ASK_AGAIN_NS:
            return
        self._t_asked_ns = t_ns
        self.measure(t_ns)
        for name, wanted_hz in self._wanted_hz.items():
            if not 0.7 * wanted_hz <= self.found.rates_hz[name] <= 1.5 * wanted_hz:
                self._command(mavlink.MAV_CMD_SET_MESSAGE_INTERVAL, message_id(name), 1e6 / wanted_hz)
        for name in self._requested():
            if name not in self._seen:
                self._command(mavlink.MAV_CMD_REQUEST_MESSAGE, message_id(name))
        for name in (*self._parameters(), *(OPTIONAL_PARAMETERS if self.found.is_px4 else ())):
            if name not in self.found.parameters:
                self._send(
                    mavlink.MAVLink_param_request_read_message(
                        self.found.system_id, mavlink.MAV_COMP_ID_AUTOPILOT1, name.encode(), -1
                    )
                )

    def _command(self, command: int, *params: float) -> None:
        p = [float(value) for value in params] + [0.0] * (7 - len(params))
        self._send(
            mavlink.MAVLink_command_long_message(
                self.found.system_id, mavlink.MAV_COMP_ID_AUTOPILOT1, command, 0, *p
            )
        )

    def _send(self, message: Any) -> None:
        data = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256  # pack() does not
        self._sent.append(data)
        self._transport.send(data)


def open_ranges(settings: RangesSettings, wake: Callable[[], None]) -> RangeLink:
    """Subscribe to all ranges of the site.

    Raises OSError where an endpoint is malformed or cannot be listened on, and CredentialsError.
    """
    try:
        return RangeLink(settings, wake)
    except zenoh.ZError as error:
        raise OSError(words(error)) from None


# -------------------------------------------------------------------------------------------- readers


def _word(names: Any, value: int, prefix: str) -> str:
    """An enum's entry in plain words."""
    entry = names.get(value)
    return f"{value}" if entry is None else str(entry.name.removeprefix(prefix).lower().replace("_", " "))


_VENDORS = {mavlink.MAV_AUTOPILOT_PX4: "PX4", mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA: "ArduPilot"}


def _heartbeat(f: VehicleFindings, m: Any) -> None:
    f.vendor = _VENDORS.get(m.autopilot) or _word(
        mavlink.enums["MAV_AUTOPILOT"], m.autopilot, "MAV_AUTOPILOT_"
    )
    f.kind = _word(mavlink.enums["MAV_TYPE"], m.type, "MAV_TYPE_")
    f.armed = bool(m.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
    f.mode = FlightMode.OTHER
    if f.is_px4:
        f.mode = px4_mode(m.custom_mode)
    elif m.autopilot == mavlink.MAV_AUTOPILOT_ARDUPILOTMEGA:
        f.mode = ardupilot_mode(m.custom_mode)


def _current_mode(f: VehicleFindings, m: Any) -> None:
    if f.is_px4:
        f.mode = px4_mode(m.custom_mode)
        f.intended = px4_mode(m.intended_custom_mode) if m.intended_custom_mode else None


_RELEASE = {0: " dev", 64: " alpha", 128: " beta", 192: " rc", 255: ""}
"""FIRMWARE_VERSION_TYPE."""


def _version(f: VehicleFindings, m: Any) -> None:
    v = m.flight_sw_version
    f.version = f"{v >> 24 & 255}.{v >> 16 & 255}.{v >> 8 & 255}{_RELEASE.get(v & 255, '')}"


def _sys_status(f: VehicleFindings, m: Any) -> None:
    present, health = m.onboard_control_sensors_present, m.onboard_control_sensors_health
    ill = present & m.onboard_control_sensors_enabled & ~health
    names = mavlink.enums["MAV_SYS_STATUS_SENSOR"]
    f.health = SysStatus(
        may_arm=bool(health & mavlink.MAV_SYS_STATUS_PREARM_CHECK),
        unhealthy=tuple(
            _word(names, 1 << bit, "MAV_SYS_STATUS_").removeprefix("sensor ")
            for bit in range(31)
            if ill >> bit & 1 and 1 << bit != mavlink.MAV_SYS_STATUS_PREARM_CHECK
        ),
        remote_control=bool(present & health & mavlink.MAV_SYS_STATUS_SENSOR_RC_RECEIVER),
    )
    f.battery_share = m.battery_remaining / 100.0 if m.battery_remaining >= 0 else None
    f.battery_v = m.voltage_battery / 1000.0 if m.voltage_battery != 0xFFFF else None


def _battery(f: VehicleFindings, m: Any) -> None:
    f.charge = decode.battery_status(m, 0).charge


def _estimator(f: VehicleFindings, m: Any) -> None:
    f.estimator = decode.estimator_status(m, 0)


def _extended_sys_state(f: VehicleFindings, m: Any) -> None:
    f.landed = decode.LANDED.get(m.landed_state, Landed.UNKNOWN)


def _local_position(f: VehicleFindings, m: Any) -> None:
    f.height_m = -m.z if math.isfinite(m.z) else None


def _parameter(f: VehicleFindings, m: Any) -> None:
    """PX4 sends whole numbers bit for bit in the float field, ArduPilot as floats."""
    name: str = m.param_id
    if m.param_type == mavlink.MAV_PARAM_TYPE_REAL32 or not f.is_px4:
        if math.isfinite(m.param_value):
            f.parameters[name] = m.param_value
    else:
        f.parameters[name] = struct.unpack("<i", struct.pack("<f", m.param_value))[0]


_READERS: dict[str, Callable[[VehicleFindings, Any], None]] = {
    "HEARTBEAT": _heartbeat,
    "CURRENT_MODE": _current_mode,
    "AUTOPILOT_VERSION": _version,
    "SYS_STATUS": _sys_status,
    "BATTERY_STATUS": _battery,
    "ESTIMATOR_STATUS": _estimator,
    "EKF_STATUS_REPORT": _estimator,
    "EXTENDED_SYS_STATE": _extended_sys_state,
    "LOCAL_POSITION_NED": _local_position,
    "PARAM_VALUE": _parameter,
}
