"""The `[guidance]` table of the configuration: every key with its unit, range and default."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

Positive = Annotated[float, Meta(gt=0.0, le=1e6)]
NotNegative = Annotated[float, Meta(ge=0.0, le=1e6)]


class GuidanceSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """How the target's bearing is found and how the vehicle is steered to it.

    Raises ValueError (msgspec.ValidationError when decoded) if two values contradict each other.
    """

    observer: Annotated[
        Literal["kalman", "luenberger"],
        Meta(description="Who estimates the bearing: the Kalman filter, or the paper's observer Eq. (23)"),
    ] = "kalman"
    controller: Annotated[
        Literal["lq", "lq-paper"],
        Meta(description="Who steers: LQ on the bearing error, or the paper's LQ law Eq. (12)"),
    ] = "lq"
    speed_m_s: Annotated[float, Meta(gt=0.0, le=5.0, description="Forward speed v̄ while moving")] = 0.5
    yaw_rate_max_rad_s: Annotated[float, Meta(gt=0.0, le=3.0, description="Largest yaw rate ω̄")] = 1.0
    capture_radius_m: Annotated[float, Meta(gt=0.0, le=50.0, description="Capture radius ε")] = 0.5
    stop_margin_m: Annotated[
        float, Meta(ge=0.0, le=10.0, description="Stop at ε minus this, go on beyond ε plus this")
    ] = 0.05
    yaw_rate_lag_s: Annotated[
        float, Meta(ge=0.0, le=5.0, description="First-order lag of the vehicle's yaw rate, for `lq`")
    ] = 0.2
    range_sigma_m: Annotated[
        float, Meta(gt=0.0, le=10.0, description="One sigma of a range that does not tell its own")
    ] = 0.07
    first_turn: Annotated[
        Literal["left", "right"], Meta(description="Side of the probing turn while nothing is known")
    ] = "left"
    probe_turn_s: Annotated[
        float, Meta(ge=0.0, le=60.0, description="Length of the first turn at ω̄, before steering")
    ] = 0.5
    probe_sigma_rad: Annotated[
        float, Meta(gt=0.0, le=math.pi, description="Turn at ω̄ while the bearing's sigma is above this")
    ] = 0.5
    turn_through_rad: Annotated[
        float,
        Meta(ge=0.0, le=1.5, description="A turn under way is finished if the target is this near to astern"),
    ] = 0.6
    lq_q: Annotated[
        tuple[Positive, NotNegative], Meta(description="`lq`: weights of bearing and yaw rate")
    ] = (16.0, 1e-6)
    lq_r: Annotated[Positive, Meta(description="`lq`: weight of the yaw-rate command")] = 1.0
    kalman_position_noise: Annotated[
        NotNegative, Meta(description="Process noise on the target's position, m²/s")
    ] = 1e-3
    kalman_turn_noise: Annotated[NotNegative, Meta(description="Process noise on the heading, rad²/s")] = 1e-3
    kalman_gate_sigma: Annotated[
        float, Meta(ge=1.0, le=100.0, description="A range further off than this many sigmas is not believed")
    ] = 4.0
    lq_paper_q: Annotated[
        tuple[Positive, NotNegative], Meta(description="`lq-paper`: Q_c = diag(…) of Eq. (8)")
    ] = (0.5, 1.0)
    lq_paper_r: Annotated[Positive, Meta(description="`lq-paper`: r_c of Eq. (8)")] = 100.0
    luenberger_pole_rad_s: Annotated[
        float, Meta(gt=0.0, le=5.0, description="`luenberger`: all three poles at minus this, λ of Eq. (25)")
    ] = 0.2
    luenberger_yaw_rate_floor_rad_s: Annotated[
        float, Meta(gt=0.0, le=1.0, description="`luenberger`: smallest yaw rate in the gain Eq. (25)")
    ] = 0.02
    initial_bearing_rad: Annotated[
        Annotated[float, Meta(ge=-math.pi, le=math.pi)] | None,
        Meta(description="`luenberger`: the target's bearing at the start, if known, as the paper assumes"),
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
