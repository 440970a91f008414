"""The benchmark of station keeping: same layouts for all, judged by the truth, and said as it is."""

from __future__ import annotations

import json
import math
import random
from pathlib import Path

import pytest

from companion.bench.cases import CASES
from companion.bench.guidance import CONTENDERS
from companion.bench.station import (
    STATION_CASES,
    STATION_SCHEMES,
    StationReport,
    as_json,
    bench_station,
    chosen,
    table,
)
from companion.bench.station_pictures import PAPER_START, example_field, station_plots
from companion.bench.station_plant import Air, bound_m, fly, random_field
from companion.cli import main
from companion.exits import Exit
from companion.guidance.scheme import STAY, Command, Knowledge, Scheme
from companion.guidance.settings import GuidanceSettings
from companion.guidance.station_settings import StationSettings


@pytest.fixture(scope="module")
def report() -> StationReport:
    keeping = StationSettings()
    case = ("station-drift-0.2",)
    return bench_station(
        case, tuple(STATION_SCHEMES), 2, 5, lambda what, done, total: None, GuidanceSettings(), keeping
    )


def test_all_fly_the_same_layouts_and_the_limit_holds(report: StationReport) -> None:
    ours, _, limit = report.outcomes
    assert [o.bound_m for o in ours] == [o.bound_m for o in limit]
    assert len({o.bound_m for o in ours}) == 2
    assert report.rows[2].held == 1.0
    assert report.rows[2].ratio_median == pytest.approx(1.0, abs=0.03)
    assert report.rows[0].held == 1.0
    assert report.rows[1].held < 1.0


def test_a_report_is_json_without_infinities_and_a_table(report: StationReport) -> None:
    read = json.loads(json.dumps(as_json(report), allow_nan=False))
    assert [row["scheme"] for row in read["rows"]] == list(STATION_SCHEMES)
    text = table(report)
    assert max(len(line) for line in text.splitlines()) <= 110
    for name in (*STATION_SCHEMES, "station-drift-0.2: ", "2 layouts"):
        assert name in text


def test_plots_are_written(report: StationReport, tmp_path: Path) -> None:
    written = station_plots(report, tmp_path / "new")
    assert {p.name for p in written} == {"station.png", "figure6.png"}
    assert all(p.read_bytes().startswith(b"\x89PNG") for p in written)


def test_the_papers_example_is_where_the_paper_puts_it() -> None:
    field, place = example_field(1)
    assert place(*field.station) == pytest.approx((0.0, 0.0), abs=1e-12)
    assert place(0.0, 0.0) == PAPER_START[:2]
    x, y = place(1.0, 0.0)
    assert math.atan2(y + 1.0, x + 4.0) == pytest.approx(math.pi / 3.0)


def test_who_only_says_that_it_stays_has_not_held() -> None:
    """A scheme that stands still and says so at once arrives, and holds nothing."""
    standing = Scheme(
        None,
        lambda p: None,
        lambda p, s, *_: None,
        lambda p, s, *_: None,
        lambda p, s, *_: (None, Command(0.0, 0.0, STAY)),
        lambda p, s: Knowledge(0.0, 0.0, 0.0, 0.0),
    )
    field = random_field(random.Random(1))
    flight = fly(standing, field, 1, Air(hold_s=2.0))
    assert (flight.time_s, flight.path_m, flight.entered) == (0.0, math.inf, False)
    assert flight.worst_m == pytest.approx(math.hypot(*field.station))


def test_the_bound_knows_the_drift() -> None:
    field = random_field(random.Random(2))
    towards = math.atan2(field.station[1], field.station[0])
    still, with_it, against = (
        bound_m(field, Air(drift_m_s=w, drift_azimuth_rad=towards), 0.5, 1.0) for w in (0.0, 0.2, -0.2)
    )
    assert with_it < still < against


ALL, OURS = tuple(CASES), tuple(CONTENDERS)


def test_cases_and_schemes_are_parted() -> None:
    everything = chosen((), (), ALL, OURS)
    assert everything == ((list(ALL), list(OURS)), (list(STATION_CASES), list(STATION_SCHEMES)))
    assert chosen((), ("cao",), ALL, OURS) == ((list(ALL), ["cao"]), ((), ()))
    assert chosen(("station",), (), ALL, OURS) == (((), ()), (["station"], list(STATION_SCHEMES)))


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--case", "hurricane"), ["unknown case 'hurricane'", "nominal", "station-drift-0.2"]),
        (("--scheme", "guess"), ["unknown scheme 'guess'", "companion", "station-paper"]),
        (("--case", "station", "--scheme", "cao"), ["cao", "station"]),
    ],
)
def test_what_cannot_be_flown_is_refused_by_name(
    arguments: tuple[str, ...], words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["bench", "guidance", *arguments]) == Exit.USAGE
    said = capsys.readouterr().err
    assert all(word in said for word in words), said
