"""The settings of a flight: typed, range-checked, frozen. Loading them from files is `config.py`.

Each class is one table of the TOML file; the descriptions go into the JSON Schema and into `config show`.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from companion.guidance.settings import GuidanceSettings
from companion.guidance.station_settings import StationSettings

Positive = Annotated[float, Meta(gt=0.0)]
NonNegative = Annotated[float, Meta(ge=0.0)]
Finite = Annotated[float, Meta(ge=-1e6, le=1e6)]
Endpoint = Annotated[str, Meta(pattern=r"^[a-z0-9\-]+/[^/].*$")]
Name = Annotated[str, Meta(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_.\-]+$")]
NAME_RULE = "a name is letters, digits, `_`, `.`, `-`, at most 64 of them"


def is_name(text: str) -> bool:
    """True where this can be a part of a Zenoh key."""
    try:
        msgspec.convert(text, Name)
    except msgspec.ValidationError:
        return False
    return True


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One table of the configuration: an unknown key in it is refused."""


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


class BeaconSettings(Table, frozen=True):
    """`[beacons.ID]`: what is known of a beacon. Its horizontal position is not among it."""

    height_m: Annotated[
        Finite | None,
        Meta(
            description=(
                "Height of its antenna above the take-off point. Not given: as the beacon tells, else 0."
            )
        ),
    ] = None
    sigma_m: Annotated[
        float,
        Meta(
            ge=0.005,
            le=5.0,
            description="Range noise, one standard deviation, where the range itself does not tell it.",
        ),
    ] = 0.07
    station_distance_m: Annotated[
        Annotated[float, Meta(gt=0.0, le=10_000.0)] | None,
        Meta(
            description=(
                "Mission `station`: horizontal distance of the station from this beacon, d* of the paper."
            )
        ),
    ] = None
    station_bearing_rad: Annotated[
        Annotated[float, Meta(ge=-math.pi, le=math.pi)] | None,
        Meta(
            description=(
                "`station-paper`: the beacon's bearing when guidance begins (right positive), which the "
                "paper takes as known; for all beacons or none."
            )
        ),
    ] = None
    bias_m: Annotated[
        Annotated[float, Meta(ge=-100.0, le=100.0)] | None,
        Meta(
            description=(
                "Measured less true distance, subtracted from every range; `companion calibrate` finds it. "
                "Not given: as the beacon tells, else 0."
            )
        ),
    ] = None
    bias_per_m: Annotated[
        float, Meta(ge=-0.2, le=0.2, description="And so much more for each metre of distance.")
    ] = 0.0
    bias_per_db: Annotated[
        float,
        Meta(
            ge=-0.1,
            le=0.1,
            description="And so many metres more for each dB of `rssi_dbm` above `power_dbm`.",
        ),
    ] = 0.0
    power_dbm: Annotated[
        float, Meta(ge=-300.0, le=100.0, description="Received power at which `bias_m` holds alone.")
    ] = -80.0


class Ros2Settings(Table, frozen=True):
    """`[[ranges.ros2]]`: a topic of sensor_msgs/msg/Range that reaches Zenoh from ROS 2."""

    topic: Annotated[
        str,
        Meta(
            min_length=1,
            max_length=255,
            pattern=r"^/?[A-Za-z0-9_*]+(/[A-Za-z0-9_*]+)*$",
            description="The topic, such as `/uwb/b1/range`; `*` stands for any one part.",
        ),
    ]
    bridge: Annotated[
        Literal["ros2dds", "rmw_zenoh"],
        Meta(description="How it reaches Zenoh: zenoh-plugin-ros2dds, or ROS 2 with rmw_zenoh."),
    ] = "ros2dds"
    domain: Annotated[int, Meta(ge=0, le=232, description="`rmw_zenoh`: ROS_DOMAIN_ID.")] = 0
    beacon: Annotated[Name | None, Meta(description="Whose ranges these are. Not given: `named_by`.")] = None
    named_by: Annotated[
        Literal["topic", "frame"],
        Meta(
            description=(
                "What names the beacon: the topic (its last part, or the one before a last part `range`), or "
                "the header's frame_id."
            )
        ),
    ] = "topic"


class RangesSettings(Table, frozen=True):
    """`[ranges]`: where the ranges come from, and which are refused at the door."""

    site: Annotated[
        Name, Meta(description="Second part of the key `uwb/v1/{site}/{beacon}/{tag}/range`.")
    ] = "lab"
    tag: Annotated[
        str,
        Meta(
            min_length=1,
            max_length=64,
            pattern=r"^([A-Za-z0-9_.\-]+|\*)$",
            description="This vehicle's UWB tag; `*` takes the ranges of every tag of the site.",
        ),
    ] = "*"
    connect: Annotated[
        tuple[Endpoint, ...],
        Meta(
            description=(
                "Zenoh endpoints (a router or beacons) to connect to, such as `tcp/192.168.1.10:7447`."
            )
        ),
    ] = ()
    listen: Annotated[
        tuple[Endpoint, ...], Meta(description="Zenoh endpoints to listen on, such as `tcp/0.0.0.0:7447`.")
    ] = ()
    multicast_scouting: Annotated[
        bool, Meta(description="Find peers by multicast. Off: only the endpoints above are used.")
    ] = False
    ros2: Annotated[
        tuple[Ros2Settings, ...],
        Meta(
            description=(
                "Ranges from ROS 2 besides: tables with `topic`, `bridge` (`ros2dds` or `rmw_zenoh`), "
                "`domain`, and `beacon` or `named_by`."
            )
        ),
    ] = ()
    ask_beacons: Annotated[
        bool,
        Meta(description="Ask beacons for the height and bias that the configuration does not give."),
    ] = True
    max_rate_hz: Annotated[
        float,
        Meta(
            ge=5.0,
            le=1000.0,
            description="More ranges a second of one beacon are a flood: dropped unread, the newest kept.",
        ),
    ] = 100.0
    tls: Annotated[
        str,
        Meta(
            description=(
                "Directory of `companion keys` for this vehicle: endpoints are then `tls/…`, and both sides "
                "show certificates. Empty: in the clear."
            )
        ),
    ] = ""
    max_age_s: Annotated[
        float,
        Meta(
            ge=0.02,
            le=5.0,
            description=(
                "Older ranges are stale: dropped. Judged from the publisher's own stamps or numbers, so its "
                "clock need not be set."
            ),
        ),
    ] = 0.3
    max_range_m: Annotated[
        float, Meta(gt=0.0, le=10_000.0, description="Longer ranges are absurd: dropped.")
    ] = 200.0
    nlos: Annotated[
        Literal["distrust", "drop"],
        Meta(
            description=(
                'A range marked "nlos" (not in line of sight) counts with a larger sigma, or is dropped. '
                'One marked "unknown" counts as any other.'
            )
        ),
    ] = "distrust"
    nlos_sigma_factor: Annotated[
        float,
        Meta(ge=1.0, le=100.0, description='`distrust`: the sigma of a range marked "nlos", times this.'),
    ] = 5.0
    restart_after_s: Annotated[
        float,
        Meta(
            ge=0.1,
            le=60.0,
            description=(
                "Another session of a beacon is believed once the former one has been silent for so long; "
                "before, it is a second publisher: dropped and named."
            ),
        ),
    ] = 1.0
    own_motion_error_m_s: Annotated[
        float,
        Meta(
            ge=0.1,
            le=20.0,
            description=(
                "A distance changes no faster than the vehicle moves by its own account and this much more, "
                "climbing included; ranges that do are dropped as jumps."
            ),
        ),
    ] = 1.0


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
        float, Meta(gt=0.0, le=600.0, description="No believed range for this long: hand over.")
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
