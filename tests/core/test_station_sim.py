"""Simulated station keeping: where the station is in truth, and how flights are judged by it."""

from __future__ import annotations

from pathlib import Path

import pytest

from companion.cli import main
from companion.config import Config, ConfigError, load
from companion.exits import Exit
from companion.goal import true_goal
from companion.simulate import KEEP_S, fly_one, statistics

FILE = Path("config/station.toml")
LINE = "sim.beacons=[{id='b1',x_m=0,y_m=0},{id='b2',x_m=4,y_m=0},{id='b3',x_m=9,y_m=0},{id='b4',x_m=6,y_m=0}]"


def config(*overrides: str) -> Config:
    return load(FILE, {}, overrides).config


def test_the_goal_is_where_the_simulated_world_puts_it() -> None:
    assert true_goal(config()) == pytest.approx((8.0, 6.0), abs=0.01)
    assert true_goal(config("mission.kind='capture'", "mission.target='b3'")) == (4.0, 3.0)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("beacons.b1.station_distance_m=7", ["beacons.b1.station_distance_m = 7", "no place"]),
        ("beacons.b5.station_distance_m=7", ["sim.beacons: b5", "missing"]),
        (LINE, ["no place"]),
    ],
)
def test_a_station_that_the_simulated_world_does_not_have_is_named(
    override: str, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(ConfigError) as refused:
        true_goal(config(override))
    assert all(word in str(refused.value) for word in words), refused.value
    assert main(["sim", "--config", str(FILE), "--runs", "1", "--set", override]) == Exit.USAGE
    assert words[0] in capsys.readouterr().err


def test_a_flight_to_a_station_is_judged_by_the_truth() -> None:
    near = ("sim.random_start=false", "sim.start_x_m=6", "sim.start_y_m=4.5")
    kept, circled = fly_one(config(*near), 1), fly_one(config(*near, "station.can_stop=false"), 1)
    assert kept.captured and kept.rests_inside
    assert kept.hold_rms_m is not None and kept.hold_worst_m is not None
    assert kept.hold_rms_m <= kept.hold_worst_m <= 0.3
    assert circled.hold_rms_m is not None and circled.hold_rms_m > 0.3
    assert not circled.rests_inside
    figures = statistics([kept, circled])
    assert (figures["runs"], figures["captured"], figures["rests_inside"]) == (2, 2, 1)
    assert figures["hold_worst_m"]["max"] == circled.hold_worst_m
    assert KEEP_S == 30.0
