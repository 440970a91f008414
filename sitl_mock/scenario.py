"""What the mock plays: where things are, how the vehicle answers, how good its sensors and beacons are."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Positive = Annotated[float, Meta(gt=0.0)]
NonNegative = Annotated[float, Meta(ge=0.0)]
Fraction = Annotated[float, Meta(ge=0.0, le=1.0)]
KEY_PART = r"^[^/*$?#\s]+$"
"""What can be one part of a Zenoh key."""
TelemetryKind = Literal["perfect", "quiet", "stock", "none"]


class BeaconAt(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A beacon: its id and position, metres East, North, up of the local origin, and its constant bias."""

    id: Annotated[str, Meta(pattern=KEY_PART)] = "b1"
    x_m: float = 3.5
    y_m: float = 5.0
    height_m: float = 0.0
    bias_m: float = 0.0


class Scenario(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The `[sim]` table. Defaults: a quadrotor as recorded from a real PX4, one beacon, honest UWB.

    The local origin is the autopilot's: positions are metres East and North of it, heights are above ground.
    """

    beacons: Annotated[tuple[BeaconAt, ...], Meta(min_length=1)] = (BeaconAt(),)
    start_x_m: float = -2.0
    start_y_m: float = 0.5
    start_height_m: NonNegative = 3.0
    """Height at which a simulated flight begins (the wire mock starts on the ground)."""
    start_heading_rad: float = 1.5707963267948966
    random_start: bool = False
    """Draw the heading, and the distance to the first beacon from `start_distance_m`, for every seed."""
    start_distance_m: tuple[Positive, Positive] = (3.0, 30.0)

    yaw_rate_lag_s: NonNegative = 0.306
    yaw_rate_delay_s: NonNegative = 0.08
    yaw_rate_gain: Positive = 0.985
    yaw_rate_creep: Fraction = 0.103
    yaw_rate_creep_s: NonNegative = 2.7
    """The share of a yaw rate that comes, and goes, slowly, and its time constant."""
    velocity_lag_s: NonNegative = 0.575
    velocity_delay_s: NonNegative = 0.105
    vertical_lag_s: NonNegative = 0.25
    """Yaw rate, horizontal and vertical velocity: a dead time, then two equal lags whose sum is `*_lag_s`.

    An ideal plant has all lags and delays zero, `yaw_rate_creep = 0` and `yaw_rate_gain = 1`.
    """
    drift_x_m_s: float = 0.0
    drift_y_m_s: float = 0.0
    """True motion that the autopilot does not know of (a constant bias of its velocity estimate)."""
    telemetry: TelemetryKind = "quiet"
    """Errors of the autopilot's estimate: none, as with quiet sensors, as with stock ones; or never told."""
    remote_control: bool = False
    """A radio control is there: its modes can be entered, and are the fallback after a lost stream."""

    range_rate_hz: Positive = 20.0
    range_sigma_m: NonNegative = 0.07
    range_dropout: Fraction = 0.10
    range_outliers: Fraction = 0.05
    range_outlier_m: tuple[Positive, Positive] = (0.5, 3.0)
    """Non-line-of-sight outliers add a uniform positive error between these two."""
    range_outliers_told: bool = False
    """The module tells the path of its signal: `nlos` with an outlier, `los` otherwise; else `unknown`."""
    limit_s: Positive = 300.0
    """A simulated flight ends here at the latest."""

    def __post_init__(self) -> None:
        """Raises ValueError where two beacons have one id."""
        if len({beacon.id for beacon in self.beacons}) < len(self.beacons):
            raise ValueError("two beacons have the same id; ids must differ")
