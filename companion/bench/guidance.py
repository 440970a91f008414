"""`companion bench guidance`: every scheme from the same starts, in the same noise, on the same plants.

One table. What it counts is in `Row`; what the plants are is in `cases.py` and `plant.py`; who the peers are
is in `peers.py`. Nothing of a flight imports this.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import msgspec
import numpy as np

from companion.bench import batch, peers
from companion.bench.batch import Floats, Flyer
from companion.bench.cases import CASES, SECTION_VII
from companion.bench.plant import Flight, Plant
from companion.guidance.schemes import capture
from companion.guidance.settings import GuidanceSettings

Progress = Callable[[str, int, int], None]
"""Told what is being done, how many flights of all are done, and how many there are."""

SHORTEST = "shortest-path"
UNAVAILABLE = (
    "The law of the paper's reference [10] (Güler and Fidan, European Journal of Control, 2018) is not in "
    "the table: its exact form was not available."
)
PAPER_POLE_RAD_S = 0.5
"""The λ with which the paper's observer gets along best from any start with ranges that reflect."""


def told_lag_s(plant: Plant) -> float:
    """The lag that a person would measure and configure: the time to 63 % of a step, dead time included."""
    return plant.yaw_rate_lag_s + plant.yaw_rate_dead_s


class Contender(NamedTuple):
    """A scheme under a name; `make` puts it together for the vehicle of a plant."""

    name: str
    text: str
    make: Callable[[GuidanceSettings, Plant], Flyer]


def _paper(settings: GuidanceSettings, plant: Plant) -> Flyer:
    paper = msgspec.structs.replace(
        settings,
        observer="luenberger",
        controller="lq-paper",
        luenberger_pole_rad_s=PAPER_POLE_RAD_S,
        initial_bearing_rad=None,
    )
    return Flyer(capture(paper, told_lag_s(plant)))


def paper_with_bearing(settings: GuidanceSettings, plant: Plant) -> Flyer:
    """The paper's scheme as in its Section VII: told the true initial bearing of that start, λ = 0.2."""
    paper = msgspec.structs.replace(
        settings,
        observer="luenberger",
        controller="lq-paper",
        luenberger_pole_rad_s=0.2,
        initial_bearing_rad=SECTION_VII[1],
    )
    return Flyer(capture(paper, told_lag_s(plant)))


def _kalman_lq_paper(settings: GuidanceSettings, plant: Plant) -> Flyer:
    mixed = msgspec.structs.replace(
        settings, observer="kalman", controller="lq-paper", initial_bearing_rad=None
    )
    return Flyer(capture(mixed, told_lag_s(plant)))


CONTENDERS: dict[str, Contender] = {
    contender.name: contender
    for contender in (
        Contender(
            "companion",
            "as configured; the default",
            lambda g, plant: Flyer(capture(g, told_lag_s(plant), plant.velocity_lag_s)),
        ),
        Contender("kalman-lq-paper", "Kalman filter on the lift, the paper's LQ law", _kalman_lq_paper),
        Contender("paper", f"Luenberger observer (λ = {PAPER_POLE_RAD_S}), the paper's LQ law", _paper),
        Contender("matveev", "sliding mode, Automatica 2011", lambda g, plant: Flyer(peers.matveev(g))),
        Contender("cao", "range-rate law, Automatica 2015", lambda g, plant: Flyer(peers.cao(g))),
        Contender(
            "cochran-krstic",
            "extremum seeking, IEEE TAC 2009",
            lambda g, plant: Flyer(peers.cochran_krstic(g)),
        ),
        Contender(
            "turn-on-increase",
            "π/2 when the range grows, Sensors 2025",
            lambda g, plant: Flyer(peers.turn_on_increase(g)),
        ),
        Contender(
            "lq-perfect",
            "limit: LQ with the true state",
            lambda g, plant: Flyer(peers.perfect(g, told_lag_s(plant)), peers.perfect_tell),
        ),
    )
}


@dataclass(frozen=True, slots=True)
class Row:
    """One scheme in one case.

    `captured` is the share of flights that came truly within the capture radius, `rests_inside` the share
    that the scheme's own stop left there. All else is of the captured flights, up to the capture, None
    without any: path ÷ shortest path (median, 95th percentile, greatest), path − shortest path, time, ∫|ω|
    dt and ∫ω² dt (means but for the ratio and the time).

    The shortest path is that of a vehicle at full speed from the first moment, with its turn bound and the
    drift known. A vehicle that turns while it gathers speed can be shorter by some centimetres. Where
    something carries the vehicle (drift, errors of its velocity estimate), it moves on while it rests.
    """

    case: str
    scheme: str
    flights: int
    captured: float
    ratio_median: float | None = None
    ratio_p95: float | None = None
    ratio_max: float | None = None
    extra_path_m: float | None = None
    time_median_s: float | None = None
    time_p95_s: float | None = None
    turned_rad: float | None = None
    smoothness: float | None = None
    rests_inside: float | None = None


@dataclass(frozen=True, slots=True)
class Result:
    """The flights behind a row: a `Start` and a `Flight` a line."""

    row: Row
    starts: Floats
    flights: Floats


@dataclass(frozen=True, slots=True)
class Report:
    """A benchmark: what it was, how long the compiler and the flights took, and its results."""

    runs: int
    seed: int
    compiling_s: float
    flying_s: float
    settings: GuidanceSettings
    results: tuple[Result, ...]

    @property
    def rows(self) -> tuple[Row, ...]:
        """The table."""
        return tuple(result.row for result in self.results)


def bench_guidance(
    cases: Sequence[str] = tuple(CASES),
    schemes: Sequence[str] = tuple(CONTENDERS),
    runs: int = 1000,
    seed: int = 1,
    progress: Progress = lambda what, done, total: None,
    settings: GuidanceSettings | None = None,
) -> Report:
    """Fly `runs` flights of each scheme in each case.

    Raises ValueError, with the names there are, where a case or scheme is unknown, and where `runs` < 1.
    """
    _check(cases, CASES, "case")
    _check(schemes, CONTENDERS, "scheme")
    if runs < 1:
        raise ValueError(f"runs = {runs}: must be at least 1")
    settings = settings or GuidanceSettings()
    total = len(cases) * len(schemes) * runs
    results: list[Result] = []
    compiling_s = flying_s = 0.0
    done = 0
    for scheme in schemes:
        for name in cases:
            case = CASES[name]
            plant, starts = case.for_settings(settings), case.starts(runs, seed)
            flyer = CONTENDERS[scheme].make(settings, plant)
            progress(f"compiling {scheme} (some seconds, once)", done, total)
            began = time.perf_counter()
            batch.prepare(flyer)
            compiled = time.perf_counter()
            tell = partial(_tell, progress, f"{scheme}, {name}", done, total)
            flights = batch.fly_many(flyer, plant, starts, tell)
            done += runs
            compiling_s += compiled - began
            flying_s += time.perf_counter() - compiled
            results.append(Result(_row(name, scheme, flights, plant.radius_m), np.array(starts), flights))
    bounds = [_shortest(r, settings.speed_m_s) for r in results if r.row.scheme == schemes[0]]
    order = {name: n for n, name in enumerate(cases)}
    ordered = sorted([*results, *bounds], key=lambda r: order[r.row.case])
    return Report(runs, seed, compiling_s, flying_s, settings, tuple(ordered))


def _tell(progress: Progress, what: str, before: int, total: int, done: int) -> None:
    progress(what, before + done, total)


def _check(names: Sequence[str], known: dict[str, Any], what: str) -> None:
    if not names:
        raise ValueError(f"no {what} at all")
    for name in names:
        if name not in known:
            raise ValueError(f"unknown {what} {name!r}; there are {', '.join(known)}")


def _row(case: str, scheme: str, flights: Floats, radius_m: float) -> Row:
    f = Flight(*flights.T)
    ok = np.isfinite(f.time_s)
    inside = np.mean(f.rest_m <= radius_m)
    row = Row(case, scheme, len(flights), float(np.mean(ok)), rests_inside=float(inside))
    if not ok.any():
        return row
    f = Flight(*flights[ok].T)
    ratio = f.path_m / np.maximum(f.bound_m, 1e-9)
    return replace(
        row,
        ratio_median=float(np.median(ratio)),
        ratio_p95=float(np.percentile(ratio, 95)),
        ratio_max=float(np.max(ratio)),
        extra_path_m=float(np.mean(f.path_m - f.bound_m)),
        time_median_s=float(np.median(f.time_s)),
        time_p95_s=float(np.percentile(f.time_s, 95)),
        turned_rad=float(np.mean(f.turned_rad)),
        smoothness=float(np.mean(f.effort)),
    )


def _shortest(result: Result, speed_m_s: float) -> Result:
    """The other limit, which nobody flies: the bound itself."""
    bound_m = Flight(*result.flights.T).bound_m
    time_s = bound_m / speed_m_s
    row = replace(
        result.row,
        scheme=SHORTEST,
        captured=1.0,
        ratio_median=1.0,
        ratio_p95=1.0,
        ratio_max=1.0,
        extra_path_m=0.0,
        time_median_s=float(np.median(time_s)),
        time_p95_s=float(np.percentile(time_s, 95)),
        turned_rad=None,
        smoothness=None,
        rests_inside=None,
    )
    flights = np.full_like(result.flights, math.nan)
    return Result(row, result.starts, flights)


def as_json(report: Report) -> dict[str, Any]:
    """What `--json` prints."""
    return {
        "runs": report.runs,
        "seed": report.seed,
        "compiling_s": round(report.compiling_s, 3),
        "flying_s": round(report.flying_s, 3),
        "cases": {row.case: CASES[row.case].text for row in report.rows},
        "rows": [asdict(row) for row in report.rows],
        "not_available": UNAVAILABLE,
    }


def table(report: Report) -> str:
    """The report as text: a block for each case."""
    lines = []
    head = (
        f"{'':18}{'captured':>9}{'ratio':>7}{'p95':>7}{'max':>7}{'extra':>7}{'time':>7}{'p95':>7}"
        f"{'turned':>8}{'∫ω² dt':>8}{'rests in':>10}"
    )
    units = f"{'':18}{'%':>9}{'median':>7}{'':14}{'m':>7}{'s':>7}{'s':>7}{'rad':>8}{'rad²/s':>8}{'%':>10}"
    case = ""
    for row in report.rows:
        if row.case != case:
            case = row.case
            lines += ["", f"{case}: {CASES[case].text}", head, units]
        lines.append(
            f"{row.scheme:18}{_cell(100.0 * row.captured, 9, 2)}{_cell(row.ratio_median, 7, 3)}"
            f"{_cell(row.ratio_p95, 7, 3)}{_cell(row.ratio_max, 7, 2)}{_cell(row.extra_path_m, 7, 2)}"
            f"{_cell(row.time_median_s, 7, 2)}{_cell(row.time_p95_s, 7, 2)}{_cell(row.turned_rad, 8, 2)}"
            f"{_cell(row.smoothness, 8, 2)}"
            f"{_cell(None if row.rests_inside is None else 100.0 * row.rests_inside, 10, 1)}"
        )
    flights = sum(row.flights for row in report.rows if row.scheme != SHORTEST)
    return "\n".join(
        [
            f"{report.runs} flights a row, seed {report.seed}: path ÷ shortest path and what follows of "
            "the captured flights, up to the capture",
            *lines,
            "",
            *(f"{name:18}{contender.text}" for name, contender in CONTENDERS.items()),
            f"{SHORTEST:18}limit: full speed at once, the turn bound, everything known",
            UNAVAILABLE,
            f"{flights} flights in {report.flying_s:.1f} s, after {report.compiling_s:.1f} s of compiling",
        ]
    )


def _cell(value: float | None, width: int, digits: int) -> str:
    return f"{'–':>{width}}" if value is None else f"{value:{width}.{digits}f}"
