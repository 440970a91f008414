"""The settings of the sensor network, `[beacons.ID]` and `[ranges]`, and what all tables are built from."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Positive = Annotated[float, Meta(gt=0.0)]
NonNegative = Annotated[float, Meta(ge=0.0)]
Finite = Annotated[float, Meta(ge=-1e6, le=1e6)]
_WITH_PORT = r"(?:tcp|udp|tls|quic|ws)/"
_ENDPOINT = rf"^(?:{_WITH_PORT}[^/\s]+:[0-9]+([?#].*)?|(?!{_WITH_PORT})[a-z0-9\-]+/.+)$"
Endpoint = Annotated[str, Meta(pattern=_ENDPOINT)]
_NAME = r"^[A-Za-z0-9_.\-]+$(?!\n)"  # `$` alone would let a newline pass at the end
Name = Annotated[str, Meta(min_length=1, max_length=64, pattern=_NAME)]
NAME_RULE = "a name is letters, digits, `_`, `.`, `-`, at most 64 of them"
RULES = {
    _NAME: NAME_RULE,
    _ENDPOINT: "an endpoint is PROTOCOL/ADDRESS:PORT, such as tcp/192.168.1.10:7447",
}
"""What a pattern asks for, in words."""


def is_name(text: str) -> bool:
    """True where this can be a part of a Zenoh key."""
    try:
        msgspec.convert(text, Name)
    except msgspec.ValidationError:
        return False
    return True


class Table(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One table of the configuration: an unknown key in it is refused."""


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
