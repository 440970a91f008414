"""The autopilot as the ground side sees it: MAVSDK 4 behind a few typed calls.

MAVSDK is imported when a link is opened, so that nothing else needs it installed.
"""

from __future__ import annotations

import json
import math
import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from companion.types import FlightMode

MOTION_MAX_AGE_S = 1.5
TELEMETRY_RATE_HZ = 10.0
MAV_CMD_DO_SET_MODE = 176
MAV_MODE_FLAG_CUSTOM_MODE_ENABLED = 1

_PX4_MODE = {FlightMode.OFFBOARD: (6, 0), FlightMode.AUTO_LOITER: (4, 3)}
"""PX4's main and sub mode, the second and third parameter of MAV_CMD_DO_SET_MODE."""

_MODE_OF = {
    "READY": FlightMode.AUTO_READY,
    "TAKEOFF": FlightMode.AUTO_TAKEOFF,
    "HOLD": FlightMode.AUTO_LOITER,
    "MISSION": FlightMode.AUTO_MISSION,
    "RETURN_TO_LAUNCH": FlightMode.AUTO_RTL,
    "LAND": FlightMode.AUTO_LAND,
    "OFFBOARD": FlightMode.OFFBOARD,
    "MANUAL": FlightMode.MANUAL,
    "ALTCTL": FlightMode.ALTCTL,
    "POSCTL": FlightMode.POSCTL,
    "ACRO": FlightMode.ACRO,
    "STABILIZED": FlightMode.STABILIZED,
}
"""MAVSDK's names of the modes."""


class GroundLinkError(Exception):
    """MAVSDK is not there, could not connect, or the autopilot refused or did not answer."""


class Motion(NamedTuple):
    """Where the vehicle is and how it moves, in the frame of `companion.types`; `speed_m_s` is horizontal."""

    x_m: float
    y_m: float
    height_m: float
    heading_rad: float
    speed_m_s: float
    climb_m_s: float


def ground_url(url: str) -> str:
    """The MAVSDK form of `udpin:HOST:PORT`, `udpout:HOST:PORT`, `tcp:HOST:PORT` or `serial:DEVICE:BAUD`.

    Raises `ValueError` where it is none of these.
    """
    scheme, _, rest = url.partition(":")
    address, _, number = rest.rpartition(":")
    schemes = {"udpin": "udpin", "udpout": "udpout", "tcp": "tcpout", "serial": "serial"}
    if scheme not in schemes or not address or not number.isdigit():
        raise ValueError(
            f"{url!r}: expected udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"
        )
    return f"{schemes[scheme]}://{address}:{number}"


class GroundLink:
    """A ground station's link to the first autopilot heard on it. Use it as a context manager.

    Raises `GroundLinkError` where MAVSDK is not installed or the connection cannot be opened.
    """

    def __init__(self, mavsdk_url: str, tell: Callable[[str], None]) -> None:
        try:
            import mavsdk
            from mavsdk.plugins import action, mavlink_direct, telemetry
        except ImportError as error:
            raise GroundLinkError(
                f"MAVSDK is missing ({error}): pip install 'companion[operator]'"
            ) from error
        self._tell = tell
        self._action_plugin, self._direct_plugin, self._telemetry_plugin = action, mavlink_direct, telemetry
        self._system: Any = None
        self._motion: tuple[float, Any] | None = None
        self._texts: deque[str] = deque(maxlen=100)
        mavsdk.log_subscribe(lambda level, message, file, line: True)  # its own chatter on stdout
        ground_station = mavsdk.Configuration.create_with_component_type(mavsdk.ComponentType.GROUND_STATION)
        self._mavsdk = mavsdk.Mavsdk(ground_station)
        result = self._mavsdk.add_any_connection(mavsdk_url)
        if result != mavsdk.ConnectionResult.SUCCESS:
            self._mavsdk.destroy()
            raise GroundLinkError(f"cannot open {mavsdk_url}: {result.name}")

    def __enter__(self) -> GroundLink:
        return self

    def __exit__(self, *_: object) -> None:
        self._mavsdk.destroy()

    # ------------------------------------------------------------------------------------------ what is

    def find(self, timeout_s: float) -> bool:
        """Wait for an autopilot; True when one is there and its telemetry is asked for."""
        self._system = self._mavsdk.first_autopilot(timeout_s)
        if self._system is None:
            return False
        self._action = self._action_plugin.Action(self._system)
        self._direct = self._direct_plugin.MavlinkDirect(self._system)
        self._telemetry = self._telemetry_plugin.Telemetry(self._system)
        self._telemetry.subscribe_position_velocity_ned(self._on_motion)
        self._telemetry.subscribe_status_text(self._on_status_text)
        try:
            self._telemetry.set_rate_position_velocity_ned(TELEMETRY_RATE_HZ)
            self._telemetry.set_rate_attitude_euler(TELEMETRY_RATE_HZ)
        except self._telemetry_plugin.TelemetryError as error:
            self._tell(f"telemetry at {TELEMETRY_RATE_HZ:.0f} Hz was refused: {error.result.name}")
        return True

    @property
    def is_found(self) -> bool:
        """True once an autopilot was heard."""
        return self._system is not None

    @property
    def is_connected(self) -> bool:
        """False while no heartbeat comes (for 3 s)."""
        return bool(self._system.is_connected())

    @property
    def system_id(self) -> int:
        """Its MAVLink system id."""
        return int(self._system.get_system_id())

    @property
    def is_armed(self) -> bool:
        """From its HEARTBEAT."""
        return bool(self._telemetry.armed())

    @property
    def is_on_ground(self) -> bool:
        """From EXTENDED_SYS_STATE."""
        return bool(self._telemetry.landed_state() == self._telemetry_plugin.LandedState.ON_GROUND)

    @property
    def mode(self) -> FlightMode:
        """From its HEARTBEAT, so up to a second late."""
        return _MODE_OF.get(self._telemetry.flight_mode().name, FlightMode.OTHER)

    def motion(self) -> Motion | None:
        """The newest motion, None where it is older than `MOTION_MAX_AGE_S`: a frozen picture is no rest."""
        if self._motion is None or time.monotonic() - self._motion[0] > MOTION_MAX_AGE_S:
            return None
        position, velocity = self._motion[1].position, self._motion[1].velocity
        yaw_rad = math.radians(self._telemetry.attitude_euler().yaw_deg)
        return Motion(
            x_m=position.east_m,
            y_m=position.north_m,
            height_m=-position.down_m,
            heading_rad=math.remainder(0.5 * math.pi - yaw_rad, math.tau),
            speed_m_s=math.hypot(velocity.north_m_s, velocity.east_m_s),
            climb_m_s=-velocity.down_m_s,
        )

    def take_texts(self) -> list[str]:
        """What the vehicle has said to people (STATUSTEXT) since the last call."""
        return [self._texts.popleft() for _ in range(len(self._texts))]

    def not_ready(self) -> tuple[str, ...]:
        """What is missing before it can be armed and take off; empty when nothing is."""
        health = self._telemetry.health()
        wanted = (
            ("local position", health.is_local_position_ok),
            ("home position", health.is_home_position_ok),
            ("pre-arm checks", health.is_armable),
        )
        return tuple(name for name, ok in wanted if not ok)

    # ------------------------------------------------------------------------------------- what is asked

    def arm(self) -> None:
        """MAV_CMD_COMPONENT_ARM_DISARM, never forced. Raises `GroundLinkError` if refused."""
        self._ask("arming", self._action.arm)

    def take_off(self, height_m: float) -> None:
        """MIS_TAKEOFF_ALT, then MAV_CMD_NAV_TAKEOFF. Raises `GroundLinkError` if refused."""
        self._ask("the take-off height", lambda: self._action.set_takeoff_altitude(height_m))
        self._ask("take-off", self._action.takeoff)

    def land(self) -> None:
        """MAV_CMD_NAV_LAND. Raises `GroundLinkError` if refused."""
        self._ask("landing", self._action.land)

    def set_mode(self, mode: FlightMode) -> None:
        """MAV_CMD_DO_SET_MODE for OFFBOARD or AUTO_LOITER. Whether it became so, `mode` tells, not the ack.

        Raises `GroundLinkError` where no ack came at all.
        """
        main, sub = _PX4_MODE[mode]
        command = self._direct_plugin.MavlinkMessage(
            message_name="COMMAND_LONG",
            target_system_id=self.system_id,
            target_component_id=1,
            fields_json=json.dumps(
                {
                    "target_system": self.system_id,
                    "target_component": 1,
                    "command": MAV_CMD_DO_SET_MODE,
                    "confirmation": 0,
                    "param1": MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
                    "param2": main,
                    "param3": sub,
                    **{f"param{i}": 0 for i in range(4, 8)},
                }
            ),
        )
        try:
            self._direct.send_command(command)
        except self._direct_plugin.MavlinkDirectError as error:
            raise GroundLinkError(f"{mode.value}: {error.result.name}") from error

    def _ask(self, what: str, call: Callable[[], object]) -> None:
        try:
            call()
        except self._action_plugin.ActionError as error:
            raise GroundLinkError(f"{what}: {error.result.name}") from error

    # ------------------------------------------------------------------------ called by MAVSDK's threads

    def _on_motion(self, position_velocity: Any, _: Any) -> None:
        self._motion = (time.monotonic(), position_velocity)

    def _on_status_text(self, status_text: Any, _: Any) -> None:
        self._texts.append(status_text.text.strip())
