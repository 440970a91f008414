"""Calibration: what ranges were made with is found again, from every kind of file; errors in words."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from random import Random

import msgspec
import pytest

from companion import beacons
from companion.calibrate import CalibrationError, Fit, Group, Point, calibrate, group, text
from companion.cli import main
from companion.exits import Exit
from companion.network_settings import BeaconSettings
from companion.record import start_now
from companion.recorder import Recorder
from companion.settings import Settings
from companion.types import LineOfSight, RangeSample


def ranges(
    distance_m: float,
    bias_m: float,
    power_dbm: float | None = None,
    count: int = 400,
    outliers: float = 0.05,
    seed: int = 1,
) -> list[Point]:
    chance = Random(f"{seed}/{distance_m}")
    points = []
    for k in range(count):
        noise = chance.gauss(0.0, 0.06) + (chance.uniform(0.5, 4.0) if chance.random() < outliers else 0.0)
        points.append(Point(0.05 * k, distance_m + bias_m + noise, power_dbm))
    return points


def groups(*made: tuple[float, float, float | None]) -> list[Group]:
    return [group(d, ranges(d, bias, power), "made") for d, bias, power in made]


def test_a_constant_is_found_whatever_the_outliers() -> None:
    found = calibrate("b1", groups((7.0, 0.31, None)))
    assert found.fit is Fit.CONSTANT
    assert found.bias_m == pytest.approx(0.31, abs=0.01)
    assert found.sigma_m == pytest.approx(0.06, abs=0.01)
    assert 5 <= len(found.groups[0].left_out) <= 40


def test_means_that_agree_are_one_constant() -> None:
    found = calibrate("b1", groups((3.0, 0.2, -70.0), (10.0, 0.205, -80.0), (30.0, 0.195, -90.0)))
    assert (found.fit, found.bias_per_m, found.bias_per_db) == (Fit.CONSTANT, 0.0, 0.0)


def test_a_line_over_distance_is_found() -> None:
    found = calibrate("b1", groups(*((d, 0.2 + 0.01 * d, None) for d in (2.0, 8.0, 15.0, 25.0))))
    assert found.fit is Fit.DISTANCE
    assert found.bias_m == pytest.approx(0.2, abs=0.02)
    assert found.bias_per_m == pytest.approx(0.01, abs=0.001)
    assert found.residual_m < 0.02


def test_a_line_over_power_is_found() -> None:
    """As in APS011: the weaker the signal the longer the range, whatever the distance."""
    made = [
        (d, 0.3 - 0.006 * (p + 77.0), p)
        for d, p in ((2.0, -65.0), (4.0, -83.0), (12.0, -72.0), (30.0, -88.0))
    ]
    found = calibrate("b1", groups(*made))
    assert found.fit is Fit.POWER
    assert found.bias_per_db == pytest.approx(-0.006, abs=0.001)
    assert found.bias_at_m(9.0, -77.0) == pytest.approx(0.3, abs=0.02)


@pytest.mark.parametrize(
    ("made", "fit"),
    [
        ([(5.0, 0.3, None), (20.0, 0.4, None)], Fit.DISTANCE),
        ([(5.0, 0.3, -70.0), (20.0, 0.4, -85.0)], Fit.POWER),
    ],
)
def test_what_is_written_is_what_a_flight_subtracts(
    made: list[tuple[float, float, float | None]], fit: Fit
) -> None:
    found = calibrate("b1", groups(*made), fit)
    table = tomllib.loads(text(found, "made"))["beacons"]["b1"]
    known = beacons.configured(0, msgspec.convert(table, BeaconSettings))
    for distance_m, bias_m, power_dbm in made:
        sample = RangeSample(0, "b1", "s", 0, distance_m + bias_m, rssi_dbm=power_dbm)
        assert beacons.range_m(known, sample) == pytest.approx(distance_m, abs=0.02)


def test_a_beacon_that_warms_up_is_told() -> None:
    cold = [p._replace(range_m=p.range_m + 0.1) for p in ranges(5.0, 0.3)[:200]]
    said = text(calibrate("b1", [group(5.0, cold + ranges(5.0, 0.3)[200:], "made")]), "made")
    assert "the second half reads -0.1" in said


# ------------------------------------------------------------------------------------------------ files


def as_json(points: list[Point]) -> str:
    return "".join(json.dumps({"beacon": "b1", "range_m": p.range_m, "t_s": p.t_s}) + "\n" for p in points)


def as_csv(points: list[Point]) -> str:
    return "t_s,beacon,range_m\n" + "".join(f"{p.t_s},b1,{p.range_m}\n" for p in points)


@pytest.mark.parametrize(("write", "draws"), [(as_json, True), (as_csv, False)])
def test_from_files_of_ranges_to_a_file_of_configuration(
    write: Callable[[list[Point]], str], draws: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    near, far, out, png = (tmp_path / name for name in ("near", "far", "b7.toml", "b7.png"))
    near.write_text(write(ranges(5.0, 0.3)))
    far.write_text(write(ranges(20.0, 0.45)))
    asked = f"calibrate {near} {far} --beacon b1 --as b7 --distance 5 --distance 20 -o {out}"
    assert main(asked.split() + (["--png", str(png)] if draws else [])) == Exit.OK
    told = capsys.readouterr().out
    assert told == out.read_text()
    assert tomllib.loads(told)["beacons"]["b7"]["bias_per_m"] == pytest.approx(0.01, abs=0.001)
    assert not draws or png.read_bytes().startswith(b"\x89PNG")
    assert main(asked.split()) == Exit.USAGE
    assert "b7.toml is there already" in capsys.readouterr().err


def test_from_a_recorded_flight_with_spans(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "flight.mcap"
    moved = [p._replace(t_s=p.t_s + 30.0) for p in ranges(20.0, 0.3)]
    with Recorder.open(path, start_now(Settings(), "digest", {})) as recorder:
        for k, p in enumerate(ranges(5.0, 0.3) + moved):
            t_ns = 10**12 + round(p.t_s * 1e9)
            recorder.write(RangeSample(t_ns, "b1", "s", k, p.range_m))
            recorder.write(RangeSample(t_ns, "b2", "s", k, 1.0))
            recorder.write(RangeSample(t_ns, "b1", "s", k, 50.0, los=LineOfSight.NLOS))
    asked = f"calibrate {path} --beacon b1 --distance 5@0-20 --distance 20@30-50"
    assert main(asked.split()) == Exit.OK
    table = tomllib.loads(capsys.readouterr().out)["beacons"]["b1"]
    assert table["bias_m"] == pytest.approx(0.3, abs=0.01)


@pytest.mark.parametrize(
    ("content", "options", "words"),
    [
        (None, "--beacon b1 --distance 5", "No such file"),
        ("", "--beacon b1 --distance 5", "expected an MCAP flight"),
        ("hello\nworld\n", "--beacon b1 --distance 5", "expected an MCAP flight"),
        ("\x89MCAP0\r\n", "--beacon b1 --distance 5", "no flight can be read"),
        (as_json(ranges(5.0, 0.3)), "--beacon b2 --distance 5", "no range of beacon 'b2'"),
        (as_json(ranges(5.0, 0.3)[:10]), "--beacon b1 --distance 5", "at least 20 are needed"),
        (as_json(ranges(5.0, 0.3)), "--beacon b1 --distance 5@100-200", "no ranges in the seconds given"),
        (as_json(ranges(5.0, 0.3)), "--beacon b1 --distance 5 --distance 7", "need their seconds"),
        (as_json(ranges(5.0, 0.3)), "--beacon b1 --distance 5000", "are the distances right"),
        (as_json(ranges(5.0, 0.3)), "--beacon b1 --distance 5 --fit distance", "needs two distances"),
        (as_json(ranges(5.0, 0.3)), "--beacon b1 --distance 5 --fit power", "needs two distances"),
        (as_json(ranges(5.0, 0.3)), "--beacon b1 --distance 5 --as b/1", "no id for the configuration"),
        (as_json(ranges(5.0, 0.3)), "--beacon b1 --distance 5 --png /nowhere/x.png", "/nowhere/x.png"),
    ],
)  # fmt: skip
def test_bad_input_is_told_in_a_line(
    content: str | None, options: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "ranges"
    if content is not None:
        path.write_text(content, encoding="latin-1")
    assert main(["calibrate", str(path), *options.split()]) == Exit.USAGE
    told = capsys.readouterr().err
    assert words in told
    assert len(told.splitlines()) <= 1 + ("wrote" in told)


def test_files_and_distances_go_in_pairs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    asked = ["calibrate", str(tmp_path / "a"), str(tmp_path / "b"), "--beacon", "b1", "--distance", "5"]
    assert main(asked) == Exit.USAGE
    assert "2 files, 1 distances" in capsys.readouterr().err


def test_too_few_ranges_are_no_calibration() -> None:
    with pytest.raises(CalibrationError, match="19 ranges"):
        group(5.0, ranges(5.0, 0.3, count=19, outliers=0.0), "made")
