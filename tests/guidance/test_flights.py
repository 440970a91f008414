"""Flights on the compiled plant: the paper's example, and the default from anywhere."""

from __future__ import annotations

import math

import numpy as np

from companion.bench.batch import Floats, Flyer, fly_many, random_starts
from companion.bench.plant import Flight, Plant, Start
from companion.guidance.schemes import capture
from companion.guidance.settings import GuidanceSettings

NOMINAL = Plant()
IDEAL = Plant(dropout=0.0, reflected=0.0, yaw_rate_lag_s=0.0, velocity_lag_s=0.0)
PX4_LIKE = Plant(yaw_rate_lag_s=0.47, velocity_lag_s=0.72)

SECTION_VII = Start(math.hypot(5.5, 4.5), math.pi / 2.0 - math.atan2(4.5, 5.5), 0)
"""From (−2, 0.5) heading north to (3.5, 5): θ_T(0) = 0.885."""


def _flights(settings: GuidanceSettings, plant: Plant, starts: list[Start]) -> Flight:
    """A column of many flights in each field."""
    return Flight(*fly_many(Flyer(capture(settings, plant.yaw_rate_lag_s)), plant, starts).T)


def _section_vii_times(settings: GuidanceSettings) -> Floats:
    plant = IDEAL._replace(limit_s=60.0)
    return np.array(_flights(settings, plant, [SECTION_VII._replace(seed=n) for n in range(200)]).time_s)


def _ratios(settings: GuidanceSettings, plant: Plant, starts: list[Start]) -> Floats:
    flights = _flights(settings, plant, starts)
    ratios: Floats = np.array(flights.path_m) / np.array(flights.bound_m)
    return ratios


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


def test_the_default_captures_from_anywhere() -> None:
    flights = _flights(GuidanceSettings(), NOMINAL, random_starts(600, seed=1))
    ratios = np.array(flights.path_m) / np.array(flights.bound_m)
    assert np.isfinite(ratios).all()
    assert np.median(ratios) <= 1.035
    assert np.percentile(ratios, 95) <= 1.25
    assert np.mean(np.array(flights.rest_m) <= NOMINAL.radius_m) >= 0.995


def test_the_default_bears_many_reflections_and_dropouts() -> None:
    plant = NOMINAL._replace(reflected=0.2, dropout=0.4)
    ratios = _ratios(GuidanceSettings(), plant, random_starts(300, seed=2))
    assert np.isfinite(ratios).all()
    assert np.median(ratios) <= 1.05
    assert np.percentile(ratios, 95) <= 1.35


def test_the_default_on_a_vehicle_as_slow_as_px4s() -> None:
    ratios = _ratios(GuidanceSettings(), PX4_LIKE, random_starts(300, seed=3))
    assert np.isfinite(ratios).all()
    assert np.median(ratios) <= 1.045
    assert np.percentile(ratios, 95) <= 1.30


def test_the_papers_law_flies_on_the_kalman_filter() -> None:
    ratios = _ratios(GuidanceSettings(controller="lq-paper"), NOMINAL, random_starts(300, seed=4))
    assert np.isfinite(ratios).all()
    assert np.median(ratios) <= 1.06


def test_the_default_captures_in_a_drift_that_nobody_tells_it_of() -> None:
    ratios = _ratios(GuidanceSettings(), NOMINAL._replace(drift_m_s=0.1), random_starts(200, seed=5))
    assert np.isfinite(ratios).all()
    assert np.median(ratios) <= 1.15


def test_the_default_comes_to_rest_inside_the_radius_high_above_the_beacon() -> None:
    """Where the distance drowns in the height, the place must come from how the range changes on the way."""
    flights = _flights(GuidanceSettings(), NOMINAL._replace(height_m=5.0), random_starts(200, seed=6))
    assert np.mean(np.array(flights.rest_m) <= NOMINAL.radius_m) >= 0.97
