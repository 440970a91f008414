"""The `[guidance]` table of the configuration; the text under a key is its documentation."""

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

    observer: Literal["kalman", "luenberger"] = "kalman"
    """Who estimates the bearing: the Kalman filter, or the paper's observer Eq. (23)."""
    controller: Literal["lq", "lq-paper"] = "lq"
    """Who steers: LQ on the bearing error, or the paper's LQ law Eq. (12)."""
    speed_m_s: Annotated[float, Meta(gt=0.0, le=5.0)] = 0.5
    """Forward speed while moving, v̄ of the paper."""
    yaw_rate_max_rad_s: Annotated[float, Meta(gt=0.0, le=3.0)] = 1.0
    """Largest yaw rate, ω̄ of the paper."""
    capture_radius_m: Annotated[float, Meta(gt=0.0, le=50.0)] = 0.5
    """The target is captured within this horizontal distance, ε of the paper."""
    stop_margin_m: Annotated[float, Meta(ge=0.0, le=10.0)] = 0.05
    """Stop where the estimated distance is below the capture radius minus this; go on where it is above the
    radius."""
    first_turn: Literal["left", "right"] = "left"
    """Side of the probing turn while nothing is known of the bearing."""
    probe_turn_s: Annotated[float, Meta(ge=0.0, le=60.0)] = 0.5
    """Length of the first turn, at the largest yaw rate, before steering begins."""
    probe_sigma_rad: Annotated[float, Meta(gt=0.0, le=math.pi)] = 0.5
    """`kalman`: turn at the largest yaw rate while the bearing's sigma is above this."""
    turn_through_rad: Annotated[float, Meta(ge=0.0, le=1.5)] = 0.6
    """A turn under way is not reversed while the target is this near to straight astern."""
    lq_q: tuple[Weight, WeightOrNone] = (16.0, 1e-6)
    """`lq`: weights of the squared bearing and of the squared yaw rate."""
    lq_r: Weight = 1.0
    """`lq`: weight of the squared yaw-rate command."""
    kalman_position_noise: WeightOrNone = 1e-3
    """`kalman`: process noise on the target's position, m²/s."""
    kalman_turn_noise: WeightOrNone = 1e-3
    """`kalman`: process noise on the heading, rad²/s."""
    kalman_gate_sigma: Annotated[float, Meta(ge=1.0, le=100.0)] = 4.0
    """`kalman`: a range further than this many sigmas from the expected one is not believed."""
    lq_paper_q: tuple[Weight, WeightOrNone] = (0.5, 1.0)
    """`lq-paper`: diagonal of the weight Q_c in Eq. (8)."""
    lq_paper_r: Weight = 100.0
    """`lq-paper`: weight r_c in Eq. (8)."""
    luenberger_pole_rad_s: Annotated[float, Meta(gt=0.0, le=5.0)] = 0.2
    """`luenberger`: all three poles are at minus this, λ of Eq. (25)."""
    luenberger_yaw_rate_floor_rad_s: Annotated[float, Meta(gt=0.0, le=1.0)] = 0.02
    """`luenberger`: smallest yaw rate in the gain Eq. (25), which divides by it."""
    initial_bearing_rad: Annotated[float, Meta(ge=-math.pi, le=math.pi)] | None = None
    """`luenberger`: the target's bearing when guidance begins, which the paper takes as known."""

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
