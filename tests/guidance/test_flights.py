"""Flights on the compiled plant: the paper's example, and the default from anywhere."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from companion.guidance.schemes import capture
from companion.guidance.settings import GuidanceSettings

from .plant import IDEAL, Flight, Plant, Start, flyer, path_ratios, random_starts

pytestmark = pytest.mark.xdist_group("numba")  # one worker compiles, not each
NOMINAL = Plant()
PX4_LIKE = Plant(yaw_rate_lag_s=0.47, speed_lag_s=0.72)

SECTION_VII = Start(math.hypot(5.5, 4.5), math.pi / 2.0 - math.atan2(4.5, 5.5), 0)
"""From (−2, 0.5) heading north to (3.5, 5): θ_T(0) = 0.885."""


def _section_vii_times(settings: GuidanceSettings) -> list[float]:
    fly = flyer(capture(settings, 0.0))
    plant = IDEAL._replace(limit_s=60.0)
    return [fly(plant, SECTION_VII._replace(seed=seed)).time_s for seed in range(200)]


def test_section_vii_is_reproduced_by_the_papers_scheme() -> None:
    times = _section_vii_times(
        GuidanceSettings(
            observer="luenberger",
            controller="lq-paper",
            initial_bearing_rad=SECTION_VII.theta_rad,
            luenberger_pole_rad_s=0.2,
            stop_margin_m=0.0,
        )
    )
    assert min(times) >= 13.33
    assert np.median(times) <= 13.6


def test_section_vii_without_a_known_bearing() -> None:
    times = _section_vii_times(GuidanceSettings())
    assert min(times) >= 13.33
    assert np.median(times) <= 15.0
    assert np.isfinite(times).all()


@pytest.fixture(scope="module")
def fly_default() -> Callable[[Plant, Start], Flight]:
    return flyer(capture(GuidanceSettings(), NOMINAL.yaw_rate_lag_s))


def test_the_default_captures_from_anywhere(fly_default: Callable[[Plant, Start], Flight]) -> None:
    ratios, rests = path_ratios(fly_default, NOMINAL, random_starts(600, seed=1), 0.5, 1.0)
    assert np.isfinite(ratios).all()
    assert np.median(ratios) <= 1.035
    assert np.percentile(ratios, 95) <= 1.25
    assert np.mean(rests <= NOMINAL.radius_m) >= 0.995


def test_the_default_bears_many_reflections_and_dropouts(
    fly_default: Callable[[Plant, Start], Flight],
) -> None:
    plant = NOMINAL._replace(reflected=0.2, dropout=0.4)
    ratios, _ = path_ratios(fly_default, plant, random_starts(300, seed=2), 0.5, 1.0)
    assert np.isfinite(ratios).all()
    assert np.median(ratios) <= 1.05
    assert np.percentile(ratios, 95) <= 1.35


def test_the_default_on_a_vehicle_as_slow_as_px4s() -> None:
    fly = flyer(capture(GuidanceSettings(), PX4_LIKE.yaw_rate_lag_s))
    ratios, _ = path_ratios(fly, PX4_LIKE, random_starts(300, seed=3), 0.5, 1.0)
    assert np.isfinite(ratios).all()
    assert np.median(ratios) <= 1.045
    assert np.percentile(ratios, 95) <= 1.30


def test_the_papers_law_flies_on_the_kalman_filter() -> None:
    fly = flyer(capture(GuidanceSettings(controller="lq-paper"), NOMINAL.yaw_rate_lag_s))
    ratios, _ = path_ratios(fly, NOMINAL, random_starts(300, seed=4), 0.5, 1.0)
    assert np.isfinite(ratios).all()
    assert np.median(ratios) <= 1.06
