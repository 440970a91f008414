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
    start_height_m: Annotated[
        NonNegative,
        Meta(description="Height at which a simulated flight begins (the wire mock starts on the ground)."),
    ] = 3.0
    start_heading_rad: float = 1.5707963267948966
    random_start: Annotated[
        bool,
        Meta(
            description=(
                "Draw the heading, and the distance to the first beacon from `start_distance_m`, "
                "for every seed."
            )
        ),
    ] = False
    start_distance_m: tuple[Positive, Positive] = (3.0, 30.0)

    yaw_rate_lag_s: NonNegative = 0.306
    yaw_rate_delay_s: NonNegative = 0.08
    yaw_rate_gain: Positive = 0.985
    yaw_rate_creep: Fraction = 0.103
    yaw_rate_creep_s: Annotated[
        NonNegative,
        Meta(description="The share of a yaw rate that comes, and goes, slowly, and its time constant."),
    ] = 2.7
    velocity_lag_s: NonNegative = 0.575
    velocity_delay_s: NonNegative = 0.105
    vertical_lag_s: Annotated[
        NonNegative,
        Meta(
            description=(
                "Yaw rate, horizontal and vertical velocity: a dead time, then two equal lags "
                "whose sum is `*_lag_s`. An ideal plant has all lags and delays zero, "
                "`yaw_rate_creep = 0` and `yaw_rate_gain = 1`."
            )
        ),
    ] = 0.25
    drift_x_m_s: float = 0.0
    drift_y_m_s: Annotated[
        float,
        Meta(
            description=(
                "True motion that the autopilot does not know of (a constant bias of its velocity estimate)."
            )
        ),
    ] = 0.0
    telemetry: Annotated[
        TelemetryKind,
        Meta(
            description=(
                "Errors of the autopilot's estimate: none, as with quiet sensors, as with stock "
                "ones; or never told."
            )
        ),
    ] = "quiet"
    remote_control: Annotated[
        bool,
        Meta(
            description=(
                "A radio control is there: its modes can be entered, and are the fallback after a "
                "lost stream."
            )
        ),
    ] = False

    range_rate_hz: Positive = 20.0
    range_sigma_m: NonNegative = 0.07
    range_dropout: Fraction = 0.10
    range_outliers: Fraction = 0.05
    range_outlier_m: Annotated[
        tuple[Positive, Positive],
        Meta(description="Non-line-of-sight outliers add a uniform positive error between these two."),
    ] = (0.5, 3.0)
    range_outliers_told: Annotated[
        bool,
        Meta(
            description=(
                "The module tells the path of its signal: `nlos` with an outlier, `los` "
                "otherwise; else `unknown`."
            )
        ),
    ] = False
    limit_s: Annotated[Positive, Meta(description="A simulated flight ends here at the latest.")] = 300.0

    def __post_init__(self) -> None:
        """Raises ValueError where two beacons have one id."""
        if len({beacon.id for beacon in self.beacons}) < len(self.beacons):
            raise ValueError("two beacons have the same id; ids must differ")
