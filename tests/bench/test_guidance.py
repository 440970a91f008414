"""The guidance flown many times, compiled: it is the flying form, what it achieves, and what the report says.

All in one file, since every process compiles anew.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from companion.bench.batch import Floats, Flyer, fly_many, fly_plain, fly_traced, random_starts
from companion.bench.cases import CASES
from companion.bench.guidance import (
    CONTENDERS,
    SHORTEST,
    UNAVAILABLE,
    Report,
    as_json,
    bench_guidance,
    table,
)
from companion.bench.pictures import plots
from companion.bench.plant import Flight, Plant, Start
from companion.guidance.schemes import capture
from companion.guidance.settings import GuidanceSettings

pytestmark = pytest.mark.timeout(300)  # numba compiles every scheme


OTHERS: list[dict[str, Any]] = [  # what may be configured besides
    {"observer": "drift", "controller": "lq-paper"},
    {"observer": "kalman", "controller": "lq"},
    {"observer": "luenberger", "controller": "lq"},
]


@pytest.mark.parametrize(
    ("name", "keys"),
    [*((name, {}) for name in CONTENDERS), *(("companion", keys) for keys in OTHERS)],
    ids=[*CONTENDERS, *("-".join(keys.values()) for keys in OTHERS)],
)
@pytest.mark.parametrize("case", ["nominal", "stock"])
def test_the_compiled_form_is_held_to_the_flying_one_sample_by_sample(
    name: str, keys: dict[str, Any], case: str
) -> None:
    plant = CASES[case].plant._replace(limit_s=25.0)
    flyer = CONTENDERS[name].make(GuidanceSettings(**keys), plant)
    fast, trace = fly_traced(flyer, plant, Start(6.0, 2.0, 11))
    plain, trace_plain = fly_plain(flyer, plant, Start(6.0, 2.0, 11))
    assert len(trace) > 100
    # where one looked at the same numbers, so did the other: no rounding has grown
    np.testing.assert_allclose(trace, trace_plain, rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(np.array(fast), np.array(plain), rtol=1e-6, atol=1e-6)


def test_the_compiled_bound_is_the_same_in_a_wind() -> None:
    plant = CASES["drift-0.2"].plant._replace(limit_s=0.1)
    flyer = CONTENDERS["cao"].make(GuidanceSettings(), plant)
    starts = random_starts(50, 1)
    bounds_m = [fly_plain(flyer, plant, start)[0].bound_m for start in starts]
    np.testing.assert_allclose(Flight(*fly_many(flyer, plant, starts).T).bound_m, bounds_m, rtol=1e-9)


PEERS = {  # captured at least, median ratio within
    "matveev": (0.99, 1.05, 1.30),
    "cao": (0.97, 1.03, 1.25),
    "cochran-krstic": (0.95, 1.2, 1.6),
    "turn-on-increase": (0.95, 1.3, 1.8),
    "paper": (0.95, 1.5, 3.0),
    "kalman-lq-paper": (0.99, 1.0, 1.06),
    "lq-perfect": (1.0, 0.99, 1.005),
}


@pytest.fixture(scope="module")
def report() -> Report:
    return bench_guidance(cases=("nominal", "section-vii"), runs=200, seed=3)


@pytest.mark.parametrize("name", PEERS)
def test_the_peers_do_what_their_laws_can(report: Report, name: str) -> None:
    row = next(r for r in report.rows if (r.case, r.scheme) == ("nominal", name))
    captured, low, high = PEERS[name]
    assert row.captured >= captured
    assert row.ratio_median is not None
    assert low <= row.ratio_median <= high


def test_the_default_beats_every_peer(report: Report) -> None:
    for case in ("nominal", "section-vii"):
        extra = {r.scheme: r.extra_path_m for r in report.rows if r.case == case and r.captured == 1.0}
        ours = extra.pop("companion")
        assert ours is not None
        for scheme, theirs in extra.items():
            assert scheme in ("lq-perfect", SHORTEST) or (theirs is not None and ours < theirs)


def test_the_same_seed_gives_the_same_flights(report: Report) -> None:
    again = bench_guidance(cases=("nominal",), schemes=("companion",), runs=70, seed=3)
    first = next(r for r in report.results if (r.row.case, r.row.scheme) == ("nominal", "companion"))
    np.testing.assert_array_equal(again.results[0].flights, first.flights[:70])
    other = bench_guidance(cases=("nominal",), schemes=("companion",), runs=70, seed=4)
    assert (other.results[0].flights != first.flights[:70]).any()


def test_every_scheme_is_held_to_the_same_bound(report: Report) -> None:
    bounds = [
        Flight(*r.flights.T).bound_m
        for r in report.results
        if r.row.case == "nominal" and r.row.scheme != SHORTEST
    ]
    for bound in bounds:
        np.testing.assert_array_equal(bound, bounds[0])


def test_progress_counts_up() -> None:
    case = CASES["nominal"]
    done: list[int] = []
    flyer = CONTENDERS["companion"].make(GuidanceSettings(), case.plant)
    flights = fly_many(flyer, case.plant, case.starts(120, 1), done.append)
    assert np.isfinite(flights).all()
    assert done == sorted(done)
    assert done[-1] == 120


def test_a_report_is_json_without_infinities(report: Report) -> None:
    text = json.dumps(as_json(report), allow_nan=False)
    read = json.loads(text)
    assert len(read["rows"]) == 2 * (len(CONTENDERS) + 1)
    assert read["not_available"] == UNAVAILABLE
    assert {"captured", "ratio_median", "ratio_p95", "ratio_max", "extra_path_m", "smoothness"} <= set(
        read["rows"][0]
    )


def test_the_table_names_every_scheme_and_what_is_missing(report: Report) -> None:
    text = table(report)
    assert max(len(line) for line in text.splitlines()) <= 150
    for name in (*CONTENDERS, SHORTEST, "nominal: ", "section-vii: ", UNAVAILABLE):
        assert name in text


def test_a_scheme_that_never_captures_has_no_ratio() -> None:
    report = bench_guidance(cases=("height-over",), schemes=("companion", "matveev"), runs=3)
    assert "height-over" in table(report)
    json.dumps(as_json(report), allow_nan=False)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"cases": ("hurricane",)}, "unknown case 'hurricane'; there are nominal"),
        ({"schemes": ("guess",)}, "unknown scheme 'guess'; there are companion"),
        ({"runs": 0}, "at least 1"),
        ({"cases": ()}, "no case"),
    ],
)
def test_what_cannot_be_flown_is_refused_by_name(keys: dict[str, tuple[str, ...]], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        bench_guidance(**keys)  # type: ignore[arg-type]


def test_plots_are_written(report: Report, tmp_path: Path) -> None:
    written = plots(report, tmp_path / "new")
    assert {p.name for p in written} == {
        "path_ratio.png",
        "where.png",
        "figure3.png",
        "figure4.png",
        "figure5.png",
    }
    for path in written:
        assert path.read_bytes().startswith(b"\x89PNG")


# ------------------------------------------------------------------------------- what the default achieves

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


@pytest.mark.parametrize("d_m", [4.0, 25.0])
def test_a_target_behind_is_turned_to_on_the_spot_unless_the_vehicle_is_not_to_stop(d_m: float) -> None:
    """Turning on the spot is what beats the turn bound; where it is forbidden, no path is shorter than it."""
    starts = [Start(d_m, math.pi - 0.1, n) for n in range(40)]
    turning = _flights(GuidanceSettings(), NOMINAL, starts)
    assert np.median(np.divide(turning.path_m, turning.bound_m)) < 1.0
    settings = GuidanceSettings(turn_on_spot_rad=math.pi)
    going_on = _flights(settings, NOMINAL, starts)
    assert np.min(np.divide(going_on.path_m, going_on.bound_m)) > 0.97  # it gathers speed in the turn
    flight, trace = fly_plain(Flyer(capture(settings, 0.2)), NOMINAL, starts[0])
    far = trace[(trace[:, 4] > 2.0) & (trace[:, 0] < flight.time_s)]
    assert (far[:, 8] > 0.0).all()
