"""What crosses the boundaries of the pure core: events in, outputs out.

Frames and signs, once for the whole project (the paper's, not the autopilot's):

- horizontal position and velocity: local frame, x East, y North, metres;
- height: metres, up positive, zero at the autopilot's local origin (the take-off point);
- heading: radians, counter-clockwise positive from East (so heading = π/2 − NED yaw), in (−π, π];
- yaw rate: rad/s, counter-clockwise positive seen from above (the negative of NED's);
- body velocity: forward and left, m/s;
- bearing θ = heading − azimuth of the line of sight, in (−π, π]; θ > 0: the target is on the right
  (paper, Fig. 1 and Eq. (4)).

The autopilot's NED signs exist in `link/mavlink.py` (out), `link/decode.py` (in) and in `sitl_mock` alone.

Time is integer nanoseconds of the local monotonic clock (`t_ns`), the time of reception; durations are
float seconds. `None` means "not told"; no field is ever NaN or infinite unless a docstring says so.
"""

from __future__ import annotations

from enum import Enum, IntEnum
from typing import Annotated

import msgspec
from msgspec import Meta


class LineOfSight(Enum):
    """What a UWB module says of the path of its signal."""

    LOS = "los"
    NLOS = "nlos"
    UNKNOWN = "unknown"


class FlightMode(Enum):
    """Flight modes, named as PX4 names them; ArduPilot's GUIDED is told as `OFFBOARD`."""

    __hash__ = object.__hash__  # looked up on every event; Enum's own hashes the name

    OFFBOARD = "OFFBOARD"
    MANUAL = "MANUAL"
    STABILIZED = "STABILIZED"
    ACRO = "ACRO"
    ALTCTL = "ALTCTL"
    POSCTL = "POSCTL"
    AUTO_READY = "AUTO.READY"
    AUTO_TAKEOFF = "AUTO.TAKEOFF"
    AUTO_LOITER = "AUTO.LOITER"
    AUTO_MISSION = "AUTO.MISSION"
    AUTO_RTL = "AUTO.RTL"
    AUTO_LAND = "AUTO.LAND"
    OTHER = "OTHER"


class Landed(Enum):
    """EXTENDED_SYS_STATE.landed_state."""

    __hash__ = object.__hash__  # as above

    UNKNOWN = "unknown"
    ON_GROUND = "on ground"
    IN_AIR = "in air"
    TAKING_OFF = "taking off"
    LANDING = "landing"


class Charge(Enum):
    """What an autopilot thinks of its battery."""

    UNKNOWN = "unknown"
    OK = "ok"
    LOW = "low"
    CRITICAL = "critical"


class Party(Enum):
    """Somebody else on the vehicle's link."""

    AUTOPILOT = "another autopilot"
    TWIN = "another companion with our own ids"
    COMMANDER = "somebody else's setpoints"


class Verdict(Enum):
    """What became of a range."""

    __hash__ = object.__hash__  # as above

    ACCEPTED = "accepted"
    UNKNOWN_BEACON = "unknown beacon"
    ABSURD = "absurd"
    REPEATED = "repeated"
    OUT_OF_ORDER = "out of order"
    STALE = "stale"
    SECOND_PUBLISHER = "second publisher"
    NLOS = "no line of sight"
    JUMP = "jump"
    OUTLIER = "outlier"


class Defect(Enum):
    """Why wire data could not become an event. A closed list, so that counting it takes bounded memory."""

    RANGE_PAYLOAD = "unreadable range"
    RANGE_FIELD = "range field missing or out of range"
    RANGE_TOO_LONG = "range payload too long"
    RANGE_ENCODING = "range encoding not JSON or MessagePack"
    RANGE_STATUS = "not a measurement"
    RANGE_ROS2 = "not a sensor_msgs/Range"
    RANGE_FLOOD = "more ranges than are read"
    BEACON_INFO = "unreadable info of a beacon"
    MAVLINK_BYTES = "not MAVLink"
    MAVLINK_FIELD = "MAVLink field not finite"
    MAVLINK_VENDOR = "HEARTBEAT of another kind of autopilot than vehicle.kind"
    MAVLINK_SIGNATURE = "MAVLink signature missing or wrong"


# ---------------------------------------------------------------------------------------------- events


class Event(msgspec.Struct, frozen=True, gc=False, tag_field="event"):
    """Something that happened, with the local monotonic time at which it reached us."""

    t_ns: int


class RangeSample(Event, frozen=True, gc=False, tag="range"):
    """One distance from one beacon, well-formed but not yet believed (`gate.py` decides that).

    `range_m` is the slant distance as measured, bias included. `sent_t_ns` is the publisher's Unix time: only
    its differences count.
    """

    beacon: str
    session: str
    seq: int
    range_m: float
    sigma_m: float | None = None
    los: LineOfSight = LineOfSight.UNKNOWN
    rssi_dbm: float | None = None
    sent_t_ns: int | None = None


class BeaconTold(Event, frozen=True, gc=False, tag="beacon_told"):
    """What a beacon tells of itself (`uwb/v1/{site}/{beacon}/info`): height of its antenna, bias, metres."""

    beacon: str
    height_m: float | None = None
    bias_m: float | None = None


class Malformed(Event, frozen=True, gc=False, tag="malformed"):
    """Wire data that could not be read, told so that it is counted and recorded."""

    defect: Defect
    detail: str = ""


class Attitude(Event, frozen=True, gc=False, tag="attitude"):
    """Measured heading and yaw rate (MAVLink ATTITUDE). `boot_ms`: the autopilot's own clock."""

    heading_rad: float
    yaw_rate_rad_s: float
    boot_ms: int = 0


class LocalMotion(Event, frozen=True, gc=False, tag="local_motion"):
    """Estimated position and velocity in the local frame (MAVLink LOCAL_POSITION_NED or ODOMETRY).

    Position fields are None where the autopilot has a velocity estimate only.
    """

    x_m: float | None
    y_m: float | None
    height_m: float | None
    vx_m_s: float
    vy_m_s: float
    climb_m_s: float
    boot_ms: int = 0


class VehicleHeartbeat(Event, frozen=True, gc=False, tag="heartbeat"):
    """The autopilot's HEARTBEAT: it is there, armed or not, and (up to a second late) in which mode."""

    system_id: int
    mode: FlightMode
    armed: bool


class ModeReport(Event, frozen=True, gc=False, tag="mode"):
    """CURRENT_MODE: the actual and the intended mode (None where the autopilot does not tell it)."""

    actual: FlightMode
    intended: FlightMode | None


class LandedReport(Event, frozen=True, gc=False, tag="landed"):
    """EXTENDED_SYS_STATE: on the ground or in the air."""

    landed: Landed


class BatteryReport(Event, frozen=True, gc=False, tag="battery"):
    """BATTERY_STATUS or SYS_STATUS: the autopilot's judgement, and the share that is left, 0 to 1."""

    charge: Charge = Charge.UNKNOWN
    share: float | None = None


class EstimatorReport(Event, frozen=True, gc=False, tag="estimator"):
    """ESTIMATOR_STATUS (ArduPilot: EKF_STATUS_REPORT): what of the autopilot's estimate is valid."""

    velocity: bool
    position: bool
    height: bool
    global_position: bool


class PartyHeard(Event, frozen=True, gc=False, tag="party"):
    """Somebody else spoke on the vehicle's link: who, with its ids, and what it said."""

    party: Party
    system_id: int
    component_id: int
    message: str


class TargetEcho(Event, frozen=True, gc=False, tag="target"):
    """POSITION_TARGET_LOCAL_NED: the horizontal speed and the yaw rate that the autopilot flies to."""

    speed_m_s: float
    yaw_rate_rad_s: float


class AutopilotWords(Event, frozen=True, gc=False, tag="words"):
    """What the autopilot says to people: STATUSTEXT, or an EVENT of PX4's that is known, in words."""

    text: str


class StopRequest(Event, frozen=True, gc=False, tag="stop"):
    """The person at the keyboard wants the flight to end (Ctrl-C, SIGTERM)."""


class Tick(Event, frozen=True, gc=False, tag="tick"):
    """Time passes: keeps staleness, timeouts and the minimum rate of the stream. Carries nothing."""


AnyEvent = (
    RangeSample
    | BeaconTold
    | Malformed
    | Attitude
    | LocalMotion
    | VehicleHeartbeat
    | ModeReport
    | LandedReport
    | BatteryReport
    | EstimatorReport
    | PartyHeard
    | TargetEcho
    | AutopilotWords
    | StopRequest
    | Tick
)
"""Every event there is: a tagged union, so that a record of them decodes to the same objects."""


# --------------------------------------------------------------------------------------------- outputs


class Output(msgspec.Struct, frozen=True, gc=False, tag_field="output"):
    """Something that a step decided, at the time of the event that caused it."""

    t_ns: int


class Setpoint(Output, frozen=True, gc=False, tag="setpoint"):
    """What the vehicle is to do now; valid for this moment only and never sent twice.

    `speed_m_s` is laid along `heading_rad`, the heading measured last. With `height_m` that height is held
    by the autopilot (LOCAL_NED); with None, `climb_m_s` comes from the app's own height loop (BODY_NED).
    """

    speed_m_s: float
    yaw_rate_rad_s: float
    heading_rad: float
    height_m: float | None
    climb_m_s: float


class ModeRequest(Output, frozen=True, gc=False, tag="mode_request"):
    """The hand-over after a loss: the only mode change that the flying process may ask for."""

    mode: FlightMode


class RangeVerdict(Output, frozen=True, gc=False, tag="range_verdict"):
    """What became of a range: for the record."""

    beacon: str
    seq: int
    verdict: Verdict


class Severity(IntEnum):
    """MAV_SEVERITY, as far as it is used."""

    CRITICAL = 2
    WARNING = 4
    NOTICE = 5
    INFO = 6


class SystemStatus(IntEnum):
    """MAV_STATE of our own HEARTBEAT."""

    BOOT = 1
    STANDBY = 3
    ACTIVE = 4
    CRITICAL = 5


class CompanionHeartbeat(Output, frozen=True, gc=False, tag="companion_heartbeat"):
    """Our own HEARTBEAT, sent by the loop so that it stops when the loop stops."""

    system_status: SystemStatus


class Phase(Enum):
    """Where the flight stands. The transitions are the table in `phase.py`."""

    __hash__ = object.__hash__  # looked up on every event; Enum's own hashes the name

    AWAIT = "await"
    """Vehicle telemetry or ranges are still missing. Silent."""
    STANDBY = "standby"
    """Everything is there: standstill is streamed, waiting for a fresh act that selects OFFBOARD."""
    INHIBITED = "inhibited"
    """Started, or back, with OFFBOARD already actual or intended: silent until a person acts."""
    ACQUIRE = "acquire"
    """Engaged; turning to find the bearing."""
    APPROACH = "approach"
    """Engaged; flying to the target."""
    HOLD = "hold"
    """Engaged; inside the capture radius at zero speed."""
    KEEP = "keep"
    """Engaged; at the station: standing, creeping back where a drift carries it off (or circling)."""
    COAST = "coast"
    """Engaged; no fresh range, flying on the prediction for a short while."""
    STALL = "stall"
    """Engaged; no range for too long: standing still, waiting for ranges."""
    HAND_OVER = "hand over"
    """Asking for the configured mode after a loss, a spent budget or Ctrl-C, still streaming standstill."""
    RELEASED = "released"
    """The vehicle left OFFBOARD: silent, until the intended mode is known to be another one."""
    ENDED = "ended"
    """The flight is over, or nothing came to begin it with. Final."""

    is_final: bool
    """The loop ends here."""
    is_engaged: bool
    """Setpoints steer the vehicle."""


_ENGAGED = frozenset(
    {Phase.ACQUIRE, Phase.APPROACH, Phase.HOLD, Phase.KEEP, Phase.COAST, Phase.STALL, Phase.HAND_OVER}
)
for _phase in Phase:  # plain attributes, not properties: asked for several times on every event
    _phase.is_final = _phase is Phase.ENDED
    _phase.is_engaged = _phase in _ENGAGED


class PhaseChange(Output, frozen=True, gc=False, tag="phase_change"):
    """A transition, with its reason in words for a person."""

    before: Phase
    after: Phase
    reason: str
    severity: Severity


class Estimate(msgspec.Struct, frozen=True, gc=False):
    """What the observer knows of the target, or of the station. The sigmas are one standard deviation."""

    distance_m: Annotated[float, Meta(description="horizontal distance of the target, metres")]
    distance_sigma_m: Annotated[float, Meta(description="its standard deviation, metres")]
    bearing_rad: Annotated[
        float, Meta(description="θ = heading − line of sight, in (−π, π]; positive: on the right")
    ]
    bearing_sigma_rad: Annotated[float, Meta(description="its standard deviation, radians")]


class Status(Output, frozen=True, gc=False, tag="status"):
    """A snapshot for people, a few times a second: what the live views show."""

    phase: Annotated[Phase, Meta(description="where the flight stands")]
    reason: Annotated[str, Meta(description="why it stands there, in words")]
    awaited: Annotated[
        tuple[str, ...], Meta(description="what is missing before the flight can begin, and from where")
    ]
    mode: Annotated[FlightMode | None, Meta(description="the autopilot's flight mode")]
    armed: Annotated[bool | None, Meta(description="whether the vehicle is armed")]
    range_m: Annotated[float | None, Meta(description="range believed last, slant, without its bias, metres")]
    range_age_s: Annotated[float | None, Meta(description="time since then, seconds")]
    ranges_accepted: Annotated[int, Meta(description="ranges believed so far")]
    rejected: Annotated[dict[str, int], Meta(description="ranges not believed so far, by reason")]
    malformed: Annotated[dict[str, int], Meta(description="wire data that could not be read, by reason")]
    telemetry_age_s: Annotated[float | None, Meta(description="time since the last heading, seconds")]
    estimate: Annotated[Estimate | None, Meta(description="what the observer knows of the target")]
    speed_m_s: Annotated[float | None, Meta(description="commanded forward speed; null: nothing is sent")]
    yaw_rate_rad_s: Annotated[
        float | None,
        Meta(description="commanded yaw rate, counter-clockwise positive; null: nothing is sent"),
    ]
    x_m: Annotated[float | None, Meta(description="position East of the autopilot's origin, metres")]
    y_m: Annotated[float | None, Meta(description="position North of it, metres")]
    height_m: Annotated[float | None, Meta(description="height above it, metres")]
    heading_rad: Annotated[float | None, Meta(description="counter-clockwise from East, radians")]
    path_m: Annotated[float, Meta(description="flown since OFFBOARD was selected, metres")]
    engaged_s: Annotated[float, Meta(description="time since then, or that it lasted, seconds")]
    captured: Annotated[bool, Meta(description="whether target or station was reached since then")]
    beacons: Annotated[
        dict[str, float | None],
        Meta(description="station keeping: seconds since each beacon's last believed range; null: never"),
    ] = {}
    warnings: Annotated[
        tuple[str, ...],
        Meta(description="what a person should know: two publishers, a contradiction, what is not told"),
    ] = ()


AnyOutput = RangeVerdict | Setpoint | ModeRequest | CompanionHeartbeat | PhaseChange | Status
"""Every output there is."""
