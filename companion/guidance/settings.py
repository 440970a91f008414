"""The `[guidance]` table of the configuration."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Weight = Annotated[float, Meta(gt=0.0, le=1e6)]
WeightOrNone = Annotated[float, Meta(ge=0.0, le=1e6)]


class GuidanceSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`[guidance]`: how the target's bearing is found and how the vehicle is steered to it.

    Raises ValueError (as msgspec.ValidationError when decoded) where two values contradict each other.
    """

    observer: Annotated[
        Literal["drift", "kalman", "luenberger"],
        Meta(
            description=(
                "Who estimates the bearing: a Kalman filter that allows for drift and for constant errors "
                "of the ranges; one that does not; or the paper's observer Eq. (23)."
            )
        ),
    ] = "drift"
    controller: Annotated[
        Literal["lq", "lq-paper"],
        Meta(description="Who steers: LQ on the bearing error, or the paper's LQ law Eq. (12)."),
    ] = "lq"
    speed_m_s: Annotated[
        float, Meta(gt=0.0, le=5.0, description="Forward speed while moving, v̄ of the paper.")
    ] = 0.5
    yaw_rate_max_rad_s: Annotated[
        float, Meta(gt=0.0, le=3.0, description="Largest yaw rate, ω̄ of the paper.")
    ] = 1.0
    capture_radius_m: Annotated[
        float,
        Meta(
            gt=0.0,
            le=50.0,
            description="The target is captured within this horizontal distance, ε of the paper.",
        ),
    ] = 0.5
    stop_margin_m: Annotated[
        float,
        Meta(
            ge=0.0,
            le=10.0,
            description=(
                "`kalman`, `luenberger`: stop where the estimated distance is below the capture radius "
                "minus this; go on where it is above the radius."
            ),
        ),
    ] = 0.05
    first_turn: Annotated[
        Literal["left", "right"],
        Meta(description="Side of the probing turn while nothing is known of the bearing."),
    ] = "right"
    probe_turn_s: Annotated[
        float,
        Meta(
            ge=0.0,
            le=60.0,
            description=(
                "`kalman`, `luenberger`: length of the first turn, at the largest yaw rate, before "
                "steering begins."
            ),
        ),
    ] = 0.5
    probe_sigma_rad: Annotated[
        float,
        Meta(
            gt=0.0,
            le=math.pi,
            description="`kalman`: turn at the largest yaw rate while the bearing's sigma is above this.",
        ),
    ] = 0.5
    turn_through_rad: Annotated[
        float,
        Meta(
            ge=0.0,
            le=1.5,
            description="A turn under way is not reversed while the target is this near to straight astern.",
        ),
    ] = 0.6
    turn_on_spot_rad: Annotated[
        float,
        Meta(
            gt=0.0,
            le=math.pi,
            description=(
                "`drift`: a target further off the nose than this is turned to at speed 0, which saves the "
                "arc; with 3.14159 only one inside the turning circle, which flying on does not reach."
            ),
        ),
    ] = 2.0
    lq_q: Annotated[
        tuple[Weight, WeightOrNone],
        Meta(description="`lq`: weights of the squared bearing and of the squared yaw rate."),
    ] = (16.0, 1e-6)
    lq_r: Annotated[Weight, Meta(description="`lq`: weight of the squared yaw-rate command.")] = 1.0
    kalman_position_noise: Annotated[
        WeightOrNone, Meta(description="`drift`, `kalman`: process noise on the target's position, m²/s.")
    ] = 3e-4
    kalman_turn_noise: Annotated[
        WeightOrNone, Meta(description="`drift`, `kalman`: process noise on the heading, rad²/s.")
    ] = 3e-4
    kalman_drift_noise: Annotated[
        WeightOrNone, Meta(description="`drift`: process noise on the drift, (m/s)²/s.")
    ] = 2e-5
    kalman_gate_sigma: Annotated[
        float,
        Meta(
            ge=1.0,
            le=100.0,
            description=(
                "`drift`, `kalman`: a range further than this many sigmas from the expected one is not "
                "believed."
            ),
        ),
    ] = 4.0
    search_turn_s: Annotated[
        float,
        Meta(
            ge=0.0,
            le=60.0,
            description=(
                "`drift`: length of the first turn, at the largest yaw rate, before steering begins; the "
                "lag of the yaw rate comes on top."
            ),
        ),
    ] = 0.75
    drift_m_s: Annotated[
        float,
        Meta(
            gt=0.0,
            le=5.0,
            description=(
                "`drift`: expected motion, one-sigma of each component, that velocity or position do not "
                "tell: wind, or their error."
            ),
        ),
    ] = 0.1
    trust: Annotated[
        float,
        Meta(
            gt=0.0,
            le=1.0,
            description=(
                "`drift`: share of the expected errors of the dead reckoning (drift, process noise) that is "
                "reckoned with until the ranges contradict it."
            ),
        ),
    ] = 0.05
    range_offset_m: Annotated[
        float,
        Meta(ge=0.0, le=5.0, description="`drift`: one-sigma of a constant error of the ranges."),
    ] = 0.05
    stop_sigma: Annotated[
        float,
        Meta(
            ge=0.0,
            le=10.0,
            description=(
                "`drift`: the vehicle stops where it comes to rest inside the capture radius with this "
                "many sigmas to spare."
            ),
        ),
    ] = 2.5
    lq_paper_q: Annotated[
        tuple[Weight, WeightOrNone], Meta(description="`lq-paper`: diagonal of the weight Q_c in Eq. (8).")
    ] = (0.5, 1.0)
    lq_paper_r: Annotated[Weight, Meta(description="`lq-paper`: weight r_c in Eq. (8).")] = 100.0
    luenberger_pole_rad_s: Annotated[
        float,
        Meta(gt=0.0, le=5.0, description="`luenberger`: all three poles are at minus this, λ of Eq. (25)."),
    ] = 0.2
    luenberger_yaw_rate_floor_rad_s: Annotated[
        float,
        Meta(
            gt=0.0,
            le=1.0,
            description="`luenberger`: smallest yaw rate in the gain Eq. (25), which divides by it.",
        ),
    ] = 0.02
    initial_bearing_rad: Annotated[
        Annotated[float, Meta(ge=-math.pi, le=math.pi)] | None,
        Meta(
            description=(
                "`luenberger`: the target's bearing when guidance begins, which the paper takes as known."
            )
        ),
    ] = None

    def __post_init__(self) -> None:
        """Hold what no single key can hold."""
        if self.stop_margin_m >= self.capture_radius_m:
            raise ValueError(
                f"stop_margin_m = {self.stop_margin_m}: must be smaller than "
                f"capture_radius_m = {self.capture_radius_m}"
            )
        if self.initial_bearing_rad is not None and self.observer != "luenberger":
            raise ValueError(
                f"initial_bearing_rad = {self.initial_bearing_rad}: only for observer = 'luenberger'; "
                f"'{self.observer}' assumes no bearing"
            )
