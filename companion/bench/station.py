"""Station keeping on the desk: who flies, over which layouts of beacons, and what came of it.

The station schemes keep beacons in tuples of a length that depends on their number: numba does not compile
them as they stand, so they fly as they are, on all cores. Nothing of a flight imports this.
"""

from __future__ import annotations

import math
import os
import random
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from functools import partial
from multiprocessing import get_context
from typing import Any, NamedTuple

from companion.bench.station_plant import Air, Field, bound_m, fly, random_field, untold
from companion.guidance import station, station_paper, station_steer
from companion.guidance.scheme import UNKNOWN_M, Command, Knowledge, Scheme
from companion.guidance.settings import GuidanceSettings
from companion.guidance.station_settings import StationSettings
from companion.guidance.station_steer import AWAY, Law, Situation, Stay

Progress = Callable[[str, int, int], None]
"""Told what is being done, how many flights of all are done, and how many there are."""

MOST_UNASKED = 40
"""Layouts of each case where no station case is asked for by name: a flight takes about half a second."""


# ------------------------------------------------------------------------------------------- contenders


class Knowing(NamedTuple):
    """State of the limit: what it was told last, and whether it is there."""

    accepted: float
    truth: Situation
    stay: Stay


def perfect(law: Law) -> Scheme:
    """The default's steering with the true state: what finding the station costs is what it does better."""

    def initial(p: Law) -> Knowing:
        return Knowing(1.0, Situation(*(0.0,) * 7), AWAY)

    def predict(p: Law, s: Knowing, *_: float) -> Knowing:
        return s

    def command(p: Law, s: Knowing, dt_s: float, yaw_rate_rad_s: float) -> tuple[Knowing, Command]:
        stay, wanted = station_steer.steer(p, s.truth, s.stay, dt_s, yaw_rate_rad_s)
        return s._replace(stay=stay), wanted

    def knowledge(p: Law, s: Knowing) -> Knowledge:
        return Knowledge(math.hypot(s.truth.ex, s.truth.ey), 0.0, UNKNOWN_M, math.pi)

    return Scheme(law, initial, predict, predict, command, knowledge)


def told(s: Knowing, truth: Situation) -> Knowing:
    """The limit is told the truth."""
    return s._replace(truth=truth)


STATION_SCHEMES = {
    "station": "the default: all beacons located, stop and creep back",
    "station-paper": "the paper's, told the beacons' true bearings at the start",
    "station-perfect": "limit: the default's steering with the true state",
}


def make(name: str, field: Field, air: Air, g: GuidanceSettings, k: StationSettings) -> Scheme:
    """The scheme of this name for a field; the lags it is told are the plant's."""
    if name == "station-paper":
        return station_paper.from_settings(g, k, field.distances_m, field.bearings_rad)
    default = station.station(g, k, field.distances_m, air.yaw_rate_lag_s, air.speed_lag_s)
    return perfect(default.p.law) if name == "station-perfect" else default


# ------------------------------------------------------------------------------------------------ table


STATION_CASES = {
    "station": ("3 beacons 3 to 10 m around a station 3 to 30 m away, no drift", Air()),
    "station-drift-0.2": ("the same in an unknown drift of 0.2 m/s", Air(drift_m_s=0.2)),
}


class Outcome(NamedTuple):
    """A flight of the benchmark: as in `Stayed`, and the bound."""

    time_s: float
    path_m: float
    bound_m: float
    rms_m: float
    worst_m: float
    entered: bool


@dataclass(frozen=True, slots=True)
class StationRow:
    """One scheme in one case.

    `entered` is the share of flights that were ever within the radius, `arrived` the share whose scheme said
    that it stays, `held` the share that was then within the radius for a minute. Of the arrivals, None
    without any: path until the station was entered last before ÷ bound, and the time of the arrival. Of the
    flights that held: rms and greatest of the distance in that minute.
    """

    case: str
    scheme: str
    flights: int
    entered: float
    arrived: float
    held: float
    ratio_median: float | None = None
    ratio_p95: float | None = None
    ratio_max: float | None = None
    time_median_s: float | None = None
    hold_rms_m: float | None = None
    hold_worst_m: float | None = None


@dataclass(frozen=True, slots=True)
class StationReport:
    """The rows, and behind each its flights."""

    seed: int
    flying_s: float
    guidance: GuidanceSettings
    keeping: StationSettings
    rows: tuple[StationRow, ...]
    outcomes: tuple[tuple[Outcome, ...], ...]


def bench_station(
    cases: Sequence[str],
    schemes: Sequence[str],
    runs: int,
    seed: int,
    progress: Progress,
    guidance: GuidanceSettings,
    keeping: StationSettings,
) -> StationReport:
    """Fly every scheme over the same layouts, noise and drift; results depend on the seed alone."""
    began = time.perf_counter()
    total = len(cases) * len(schemes) * runs
    rows: list[StationRow] = []
    outcomes: list[tuple[Outcome, ...]] = []
    with ProcessPoolExecutor(os.cpu_count(), get_context("forkserver")) as pool:
        for case in cases:
            air = STATION_CASES[case][1]._replace(radius_m=keeping.radius_m)
            for scheme in schemes:
                one = partial(_outcome, scheme, air, guidance, keeping, seed)
                flown = []
                for outcome in pool.map(one, range(runs), chunksize=2):
                    flown.append(outcome)
                    progress(f"{scheme}, {case}", len(outcomes) * runs + len(flown), total)
                outcomes.append(tuple(flown))
                rows.append(_row(case, scheme, flown, keeping.radius_m))
    return StationReport(seed, time.perf_counter() - began, guidance, keeping, tuple(rows), tuple(outcomes))


def _outcome(scheme: str, air: Air, g: GuidanceSettings, k: StationSettings, seed: int, n: int) -> Outcome:
    rng = random.Random(f"{seed}/layout {n}")
    field = random_field(rng)
    air = air._replace(drift_azimuth_rad=rng.uniform(-math.pi, math.pi))
    tell = told if scheme == "station-perfect" else untold
    flight = fly(make(scheme, field, air, g, k), field, rng.getrandbits(32), air, tell=tell)
    return Outcome(
        flight.time_s,
        flight.path_m,
        bound_m(field, air, g.speed_m_s, g.yaw_rate_max_rad_s),
        flight.rms_m,
        flight.worst_m,
        flight.entered,
    )


def _row(case: str, scheme: str, flown: Sequence[Outcome], radius_m: float) -> StationRow:
    arrived = [o for o in flown if o.time_s < math.inf]
    held = [o for o in arrived if o.worst_m <= radius_m]
    ratios = sorted(o.path_m / max(o.bound_m, 1e-9) for o in arrived)
    inside = [ratio for ratio in ratios if ratio < math.inf]
    n = len(flown)
    return StationRow(
        case,
        scheme,
        n,
        sum(o.entered for o in flown) / n,
        len(arrived) / n,
        len(held) / n,
        _rank(inside, 0.5),
        _rank(inside, 0.95),
        _rank(inside, 1.0),
        _rank(sorted(o.time_s for o in arrived), 0.5),
        math.sqrt(sum(o.rms_m**2 for o in held) / len(held)) if held else None,
        max((o.worst_m for o in held), default=None),
    )


def _rank(ordered: Sequence[float], share: float) -> float | None:
    """Nearest rank."""
    return ordered[max(0, math.ceil(share * len(ordered)) - 1)] if ordered else None


def chosen(
    cases: Sequence[str], schemes: Sequence[str], known_cases: Sequence[str], known_schemes: Sequence[str]
) -> tuple[tuple[Sequence[str], Sequence[str]], tuple[Sequence[str], Sequence[str]]]:
    """What is asked for (nothing: everything), parted into (cases, schemes) of target capture, of stations.

    Either part is empty where the other alone is meant. Raises ValueError where a name is unknown, with those
    that there are, and where nothing is left to fly.
    """
    parts = []
    both = ((known_cases, known_schemes), (tuple(STATION_CASES), tuple(STATION_SCHEMES)))
    for what, names, n in (("case", cases, 0), ("scheme", schemes, 1)):
        for name in names:
            if name not in both[0][n] and name not in both[1][n]:
                raise ValueError(
                    f"unknown {what} {name!r}; there are {', '.join((*both[0][n], *both[1][n]))}"
                )
    for of_cases, of_schemes in both:
        c = [name for name in of_cases if name in cases or not cases]
        s = [name for name in of_schemes if name in schemes or not schemes]
        parts.append((c, s) if c and s else ((), ()))
    if not any(c for c, _ in parts):
        raise ValueError(f"none of the schemes {', '.join(schemes)} flies a case of {', '.join(cases)}")
    return parts[0], parts[1]


def as_json(report: StationReport) -> dict[str, Any]:
    """What `--json` prints of it."""
    return {
        "cases": {row.case: STATION_CASES[row.case][0] for row in report.rows},
        "flying_s": round(report.flying_s, 3),
        "rows": [asdict(row) for row in report.rows],
    }


def table(report: StationReport) -> str:
    """The report as text: a block for each case."""
    lines = []
    head = (
        f"{'':18}{'entered':>9}{'arrived':>9}{'held':>8}{'ratio':>8}{'p95':>8}{'max':>8}{'time':>8}"
        f"{'hold rms':>10}{'at most':>9}"
    )
    units = f"{'':18}{'%':>9}{'%':>9}{'%':>8}{'median':>8}{'':16}{'s':>8}{'m':>10}{'m':>9}"
    case = ""
    for row in report.rows:
        if row.case != case:
            case = row.case
            lines += ["", f"{case}: {STATION_CASES[case][0]}, {row.flights} layouts", head, units]
        lines.append(
            f"{row.scheme:18}{100.0 * row.entered:9.1f}{100.0 * row.arrived:9.1f}{100.0 * row.held:8.2f}"
            f"{_cell(row.ratio_median, 8, 3)}"
            f"{_cell(row.ratio_p95, 8, 3)}{_cell(row.ratio_max, 8, 2)}{_cell(row.time_median_s, 8, 1)}"
            f"{_cell(row.hold_rms_m, 10, 3)}{_cell(row.hold_worst_m, 9, 2)}"
        )
    flights = sum(row.flights for row in report.rows)
    return "\n".join(
        [
            f"station keeping, seed {report.seed}: held is within {report.keeping.radius_m:g} m for a minute "
            "from the arrival on",
            *lines,
            "",
            *(f"{name:18}{text}" for name, text in STATION_SCHEMES.items()),
            f"{flights} flights in {report.flying_s:.1f} s",
        ]
    )


def _cell(value: float | None, width: int, digits: int) -> str:
    return f"{'–':>{width}}" if value is None else f"{value:{width}.{digits}f}"
