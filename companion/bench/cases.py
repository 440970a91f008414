"""The cases of the benchmark, each a plant and where its flights begin.

The errors of telemetry are not recordings played back, but drawn from the processes that `sitl_mock.estimate`
fits to two recorded flights of a PX4 (quiet sensors, and stock noise, which is a poor GPS): two minutes of
recording would be the same two minutes for every flight.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from companion.bench.batch import random_starts
from companion.bench.plant import Plant, Start
from companion.guidance.settings import GuidanceSettings
from sitl_mock.estimate import QUALITY
from sitl_mock.scenario import TelemetryKind

SECTION_VII = (math.hypot(5.5, 4.5), math.pi / 2.0 - math.atan2(4.5, 5.5))
"""Distance and bearing from (−2, 0.5) heading north to (3.5, 5): θ_T(0) = 0.885, not the 0.68 of the
paper."""


class Case(NamedTuple):
    """A plant, and the distances and bearing (None: any) of its starts."""

    name: str
    text: str
    plant: Plant
    d_min_m: float = 3.0
    d_max_m: float = 30.0
    theta_rad: float | None = None

    def starts(self, runs: int, seed: int) -> list[Start]:
        """The starts of a benchmark. Those of one seed are the same for every scheme."""
        return random_starts(runs, seed, self.d_min_m, self.d_max_m, self.theta_rad)

    def for_settings(self, settings: GuidanceSettings) -> Plant:
        """The plant, with the capture radius, speed and yaw rate of the settings."""
        return self.plant._replace(
            radius_m=settings.capture_radius_m,
            speed_m_s=settings.speed_m_s,
            yaw_rate_max_rad_s=settings.yaw_rate_max_rad_s,
        )


NOMINAL = Plant()
PX4_LIKE = NOMINAL._replace(
    yaw_rate_lag_s=0.47, yaw_rate_dead_s=0.15, velocity_lag_s=0.7, slips=True, reports=True
)
SLANT = NOMINAL._replace(height_m=5.0)


def _as_recorded(kind: TelemetryKind) -> Plant:
    errors = QUALITY[kind]
    return PX4_LIKE._replace(
        height_m=5.0,
        position_error=errors.position,
        velocity_error=errors.velocity,
        heading_error=errors.heading,
        height_wander=errors.height,
        yaw_rate_noise_rad_s=errors.yaw_rate_noise_rad_s,
    )


CASES: dict[str, Case] = {
    case.name: case
    for case in (
        Case("nominal", "bearing unknown, 3 to 30 m", NOMINAL),
        Case("near", "the same from 3 to 8 m", NOMINAL, d_max_m=8.0),
        Case("px4", "yaw rate 0.47 s + 0.15 s dead, velocity 0.7 s with sideslip, telemetry 30 Hz", PX4_LIKE),
        Case("slant", "5 m above the beacon", SLANT),
        Case(
            "height-over",
            "slant, the vehicle 0.2 m lower than it believes, ranges 0.1 m too long",
            SLANT._replace(height_error_m=0.2, range_bias_m=0.1),
        ),
        Case(
            "height-under",
            "slant, the vehicle 0.2 m higher than it believes, ranges 0.1 m too long",
            SLANT._replace(height_error_m=-0.2, range_bias_m=0.1),
        ),
        Case(
            "quiet",
            "px4, 5 m above the beacon, telemetry errors as with quiet sensors",
            _as_recorded("quiet"),
        ),
        Case(
            "stock", "px4, 5 m above the beacon, telemetry errors as with stock noise", _as_recorded("stock")
        ),
        Case("drift-0.1", "unmodelled drift 0.1 m/s", NOMINAL._replace(drift_m_s=0.1)),
        Case("drift-0.2", "unmodelled drift 0.2 m/s", NOMINAL._replace(drift_m_s=0.2)),
        Case(
            "gyro",
            "turns 0.02 rad/s more (to either side) and flies 0.95 times as fast as modelled",
            NOMINAL._replace(gyro_bias_rad_s=0.02, speed_scale=0.95),
        ),
        Case("outliers", "20 % of the ranges reflected", NOMINAL._replace(reflected=0.2)),
        Case("dropout", "40 % of the ranges lost", NOMINAL._replace(dropout=0.4)),
        Case("outage", "no ranges for 3 s in every 20 s", NOMINAL._replace(outage_s=3.0)),
        Case(
            "section-vii",
            "the paper's start, bearing unknown",
            NOMINAL,
            d_min_m=SECTION_VII[0],
            d_max_m=SECTION_VII[0],
            theta_rad=SECTION_VII[1],
        ),
    )
}
