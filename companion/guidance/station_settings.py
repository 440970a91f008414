"""The `[station]` table of the configuration: used with `mission.kind = "station"`."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

BEACONS_NEEDED = 3
"""Fewer beacons do not determine a station."""


class StationSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """`[station]`: how a station given by its distances from beacons is found, reached and kept.

    Raises ValueError (as msgspec.ValidationError when decoded) where two values contradict each other.
    """

    scheme: Annotated[
        Literal["station", "station-paper"],
        Meta(
            description=(
                "`station`: all beacons are located and the vehicle stays; or the paper's, Eq. (37) to (48), "
                "which steers by the beacon whose distance is most wrong."
            )
        ),
    ] = "station"
    radius_m: Annotated[
        float,
        Meta(
            gt=0.0,
            le=50.0,
            description=(
                "The vehicle is at the station within this horizontal distance (`station-paper`: while no "
                "distance is more wrong than this), ε of the paper."
            ),
        ),
    ] = 0.3
    can_stop: Annotated[
        bool,
        Meta(
            description=(
                "false: the vehicle cannot stop and flies the smallest circle around the station; standstill "
                "is still commanded where ranges or telemetry are lost."
            )
        ),
    ] = True
    drift_sigma_m_s: Annotated[
        float,
        Meta(
            gt=0.0,
            le=2.0,
            description=(
                "`station`: one sigma, per axis, of the drift (wind, error of the velocity) before anything "
                "is known of it."
            ),
        ),
    ] = 0.15
    probe_turn_s: Annotated[
        float,
        Meta(
            ge=0.0,
            le=60.0,
            description="`station`: the vehicle turns at the largest yaw rate for at least this long first.",
        ),
    ] = 1.0
    probe_sigma_rad: Annotated[
        float,
        Meta(
            gt=0.0,
            le=math.pi,
            description="`station`: it turns on while the sigma of the station's bearing is above this.",
        ),
    ] = 0.3
    search_max_s: Annotated[
        float,
        Meta(
            gt=0.0,
            le=120.0,
            description="`station`: then it takes the most probable station, ambiguous or not.",
        ),
    ] = 12.0
    memory_s: Annotated[
        float,
        Meta(
            gt=0.0,
            le=3600.0,
            description=(
                "`station`: time constant with which old ranges are forgotten while the beacons are being "
                "located."
            ),
        ),
    ] = 30.0
    map_sigma_m: Annotated[
        float,
        Meta(
            gt=0.0,
            le=10.0,
            description=(
                "`station`: the beacons' places are kept once the sigma of the station's is below this."
            ),
        ),
    ] = 0.15
    refit_s: Annotated[
        float,
        Meta(
            gt=0.0,
            le=10.0,
            description=(
                "`station`: pause between two searches for a better fit during the flight to the station."
            ),
        ),
    ] = 0.5
    paper_q: Annotated[
        float,
        Meta(
            gt=0.0,
            le=1e6,
            description="`station-paper`: weight of the integral, the last of diag Q_cs in Eq. (45).",
        ),
    ] = 0.1
    paper_r: Annotated[
        float, Meta(gt=0.0, le=1e6, description="`station-paper`: weight r_cs of the yaw rate in Eq. (45).")
    ] = 100.0

    def __post_init__(self) -> None:
        """Hold what no single key can hold."""
        if self.scheme == "station-paper" and not self.can_stop:
            raise ValueError(
                "can_stop = False: only for scheme = 'station'; 'station-paper' stops at the station"
            )
