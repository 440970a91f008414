"""The settings of a flight: typed, range-checked, frozen. Loading them from files is `config.py`.

Each class is one table of the TOML file; the descriptions go into the JSON Schema and into `config show`.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from companion.guidance.settings import GuidanceSettings
from companion.guidance.station_settings import StationSettings
from companion.network_settings import (
    BeaconSettings,
    Finite,
    Name,
    RangesSettings,
    Table,
)


class MissionSettings(Table, frozen=True):
    """`[mission]`: what the flight is for."""

    shadow: Annotated[
        bool,
        Meta(
            description=(
                "Compute, show and record everything as if OFFBOARD were selected whenever the vehicle is in "
                "the air, but send nothing but the HEARTBEAT (`companion fly --shadow`)."
            )
        ),
    ] = False
    kind: Annotated[
        Literal["capture", "station"],
        Meta(
            description=(
                "`capture`: fly to one beacon. `station`: fly to the place that lies at given distances from "
                "three or more beacons, and stay."
            )
        ),
    ] = "capture"
    target: Annotated[Name, Meta(description="`capture`: id of the beacon to fly to.")] = "b1"


class VehicleSettings(Table, frozen=True):
    """`[vehicle]`: the autopilot, its link and how it answers."""

    mavlink: Annotated[
        str,
        Meta(description="`udpin:HOST:PORT`, `udpout:HOST:PORT`, `tcp:HOST:PORT` or `serial:DEVICE:BAUD`."),
    ] = "udpin:0.0.0.0:14540"
    kind: Annotated[
        Literal["px4", "ardupilot"],
        Meta(
            description=(
                "Whose modes and rules: PX4 (OFFBOARD) or ArduCopter (GUIDED, not flown yet; it needs "
                '`setpoint_frame = "body_ned"`).'
            )
        ),
    ] = "px4"
    setpoint_frame: Annotated[
        Literal["local_ned", "body_ned"],
        Meta(
            description=(
                "`local_ned`: the autopilot holds the height. `body_ned`: for vehicles with a "
                "velocity but no position estimate; the height is then held by the app."
            )
        ),
    ] = "local_ned"
    target_system: Annotated[
        int, Meta(ge=0, le=255, description="MAVLink system id of the autopilot; 0: the first one heard.")
    ] = 0
    component_id: Annotated[
        int, Meta(ge=1, le=255, description="Our own component id (191: MAV_COMP_ID_ONBOARD_COMPUTER).")
    ] = 191
    signing_key_file: Annotated[
        str,
        Meta(
            description=(
                "Key of a signed link: a file of 32 bytes, raw or hexadecimal, that others cannot read. "
                "With it modes are believed from signed messages only. Empty: not signed."
            )
        ),
    ] = ""
    signing_state_file: Annotated[
        str, Meta(description="Where the timestamps of a signed link are kept; writable, one for each key.")
    ] = ""
    signing_link_id: Annotated[
        int, Meta(ge=0, le=255, description="Link id in our signatures; another one for each link.")
    ] = 0
    accept_unsigned: Annotated[
        bool,
        Meta(description="On a signed link: believe unsigned telemetry too (never a mode, nor a HEARTBEAT)."),
    ] = False
    telemetry_rate_hz: Annotated[
        float, Meta(ge=5.0, le=200.0, description="Rate asked for attitude, position and mode.")
    ] = 50.0
    yaw_rate_lag_s: Annotated[
        float,
        Meta(
            ge=0.0,
            le=5.0,
            description="Time in which the yaw rate reaches 63 % of a step; the app's model of it.",
        ),
    ] = 0.47
    velocity_lag_s: Annotated[
        float,
        Meta(
            ge=0.0,
            le=5.0,
            description="The same of the horizontal velocity; used where the autopilot reports no velocity.",
        ),
    ] = 0.72
    response_delay_s: Annotated[
        float,
        Meta(
            ge=0.0,
            le=2.0,
            description=(
                "Dead time before the vehicle answers; `companion design` holds it against the delay margin."
            ),
        ),
    ] = 0.15
    speed_max_m_s: Annotated[
        float,
        Meta(
            gt=0.0,
            le=100.0,
            description=(
                "Faster than this it never moves, whoever flies it: bounds how fast a distance can change "
                "where the autopilot reports no velocity."
            ),
        ),
    ] = 15.0
    height_m: Annotated[
        Finite,
        Meta(
            description=(
                "Flight height above the take-off point: the operator climbs to it, and the slant "
                "correction uses it where the autopilot reports no height."
            )
        ),
    ] = 3.0
    height_sigma_m: Annotated[
        float, Meta(ge=0.0, le=10.0, description="One-sigma error of the height above the beacon.")
    ] = 0.1
    height_gain_1_s: Annotated[
        float, Meta(gt=0.0, le=5.0, description="`body_ned` only: climb rate per metre of height error.")
    ] = 0.8


class StreamSettings(Table, frozen=True):
    """`[stream]`: the pace of setpoints and status."""

    min_rate_hz: Annotated[
        float,
        Meta(
            ge=5.0,
            le=100.0,
            description=(
                "A setpoint leaves at least this often while the app is streaming; each fresh "
                "range gives one at once."
            ),
        ),
    ] = 20.0
    max_rate_hz: Annotated[
        float,
        Meta(ge=5.0, le=200.0, description="And not more often than this, however many beacons there are."),
    ] = 50.0
    status_rate_hz: Annotated[
        float, Meta(ge=0.5, le=50.0, description="Snapshots for the live view and the picture.")
    ] = 10.0


class StatusSettings(Table, frozen=True):
    """`[status]`: what the vehicle publishes of itself on Zenoh."""

    uav: Annotated[Name, Meta(description="This vehicle's id in the key `uav/v1/{uav}/status`.")] = "uav1"
    rate_hz: Annotated[
        float,
        Meta(
            ge=0.0,
            le=50.0,
            description=(
                "Status messages a second at most (and no more than `stream.status_rate_hz`); a phase change "
                "is told at once. 0: nothing is published, not even that the vehicle is there."
            ),
        ),
    ] = 5.0


class GroundStationSettings(Table, frozen=True):
    """`[ground_station]`: what a ground station is told over MAVLink, through the autopilot."""

    texts: Annotated[
        bool, Meta(description="STATUSTEXT at every change of phase, and while something is awaited.")
    ] = True
    values_rate_hz: Annotated[
        float,
        Meta(
            ge=0.0,
            le=20.0,
            description=(
                "NAMED_VALUE_FLOAT of `range_m`, `bear_deg`, `sigma_deg` and `togo_m`, so many times a "
                "second at most (and no more than `stream.status_rate_hz`); 0: none."
            ),
        ),
    ] = 4.0


class LossSettings(Table, frozen=True):
    """`[loss]`: what happens when something stops coming. Times count from the last good input."""

    coast_after_s: Annotated[
        float, Meta(gt=0.0, le=10.0, description="No believed range for this long: fly on the prediction.")
    ] = 0.5
    stall_after_s: Annotated[
        float, Meta(gt=0.0, le=60.0, description="No believed range for this long: stand still.")
    ] = 4.0
    coast_bearing_sigma_rad: Annotated[
        float,
        Meta(
            gt=0.0, le=3.2, description="Coasting ends earlier where the bearing is less certain than this."
        ),
    ] = 0.5
    hand_over_after_s: Annotated[
        float,
        Meta(
            gt=0.0,
            le=600.0,
            description="No believed range, or stray ones only, for this long: hand over.",
        ),
    ] = 15.0
    hand_over_to: Annotated[
        Literal["land", "hold", "release"],
        Meta(
            description=(
                "Mode asked for at a hand-over (AUTO.LAND, AUTO.LOITER), or `release`: fall "
                "silent, so that the autopilot's own failsafe acts (COM_OBL_RC_ACT)."
            )
        ),
    ] = "hold"
    hand_over_patience_s: Annotated[
        float,
        Meta(gt=0.0, le=60.0, description="The hand-over mode not reached after this long: fall silent."),
    ] = 3.0
    battery_hand_over: Annotated[
        Literal["low", "critical", "never"],
        Meta(
            description=(
                "Hand over, and do not begin, once the autopilot calls its battery `low` or `critical`."
            )
        ),
    ] = "low"
    battery_share: Annotated[
        float,
        Meta(ge=0.0, le=1.0, description="A battery with less left than this share is low in any case."),
    ] = 0.15
    battery_to: Annotated[
        Literal["land", "hold", "release"],
        Meta(description="As `hand_over_to`, for a low battery."),
    ] = "land"
    telemetry_after_s: Annotated[
        float, Meta(gt=0.0, le=10.0, description="No heading for this long: stand still.")
    ] = 0.5
    vehicle_after_s: Annotated[
        float,
        Meta(
            gt=0.0,
            le=30.0,
            description="No heartbeat or mode for this long: the vehicle is gone, fall silent.",
        ),
    ] = 3.0
    held_up_after_s: Annotated[
        float,
        Meta(
            ge=0.3,
            le=10.0,
            description=(
                "This app itself did not run for so long: fall silent until a person acts. Keep it below "
                "COM_OF_LOSS_T: PX4 returns to OFFBOARD by itself when a stream resumes."
            ),
        ),
    ] = 0.8
    wait_s: Annotated[
        float,
        Meta(
            gt=0.0,
            le=86_400.0,
            description="Give up when vehicle or ranges have not shown up after this long on the ground.",
        ),
    ] = 120.0


class LimitSettings(Table, frozen=True):
    """`[limits]`: the last check before the wire. They hold even if every range lies."""

    speed_m_s: Annotated[float, Meta(gt=0.0, le=20.0, description="Forward speed at most.")] = 1.0
    yaw_rate_rad_s: Annotated[float, Meta(gt=0.0, le=6.3, description="Yaw rate at most.")] = 1.0
    climb_m_s: Annotated[float, Meta(gt=0.0, le=5.0, description="Climb and sink rate at most.")] = 0.5
    acceleration_m_s2: Annotated[
        float,
        Meta(
            gt=0.0, le=50.0, description="Slew of the commanded speed upwards; slowing down is never limited."
        ),
    ] = 5.0
    yaw_acceleration_rad_s2: Annotated[
        float, Meta(gt=0.0, le=200.0, description="Slew of the commanded yaw rate.")
    ] = 20.0
    flight_time_s: Annotated[
        float, Meta(gt=0.0, le=86_400.0, description="Engaged for longer than this: hand over.")
    ] = 300.0
    distance_m: Annotated[
        float,
        Meta(
            gt=0.0,
            le=100_000.0,
            description="Flown further than this by dead reckoning of the commands: hand over.",
        ),
    ] = 150.0
    from_start_m: Annotated[
        float,
        Meta(
            gt=0.0,
            le=100_000.0,
            description="Further than this from where it was engaged, by dead reckoning: hand over.",
        ),
    ] = 60.0
    height_min_m: Annotated[Finite, Meta(description="No height below this is asked for.")] = 0.5
    height_max_m: Annotated[Finite, Meta(description="The height that is asked for stays in this band.")] = (
        50.0
    )


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All that the pilot and its links need to know."""

    mission: MissionSettings = MissionSettings()
    beacons: dict[str, BeaconSettings] = msgspec.field(default_factory=lambda: {"b1": BeaconSettings()})
    ranges: RangesSettings = RangesSettings()
    vehicle: VehicleSettings = VehicleSettings()
    guidance: GuidanceSettings = GuidanceSettings()
    station: StationSettings = StationSettings()
    stream: StreamSettings = StreamSettings()
    status: StatusSettings = StatusSettings()
    ground_station: GroundStationSettings = GroundStationSettings()
    loss: LossSettings = LossSettings()
    limits: LimitSettings = LimitSettings()

    @property
    def aim(self) -> tuple[str, float]:
        """What is flown to (a beacon's id, or `station`), and within which distance it is reached."""
        if self.mission.kind == "station":
            return "station", self.station.radius_m
        return self.mission.target, self.guidance.capture_radius_m
