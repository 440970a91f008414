"""Station keeping through the pilot: what is a loss with several beacons, and what people are told."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import msgspec
import pytest

from companion import pilot
from companion.config import Config, load
from companion.run import run
from companion.types import Event, Output, Phase, PhaseChange, RangeSample, Status
from sitl_mock.world import TruthSample, World

STATION = (8.0, 6.0)
NEAR = ("sim.random_start=false", "sim.start_x_m=6", "sim.start_y_m=4.5")
AT = "{{id='b{}',x_m={},y_m={},height_m=1.5}}"
THREE = f"sim.beacons=[{AT.format(1, 12, 9)},{AT.format(2, 5.5, 12)},{AT.format(3, 4, 3)}]"


def config(*overrides: str) -> Config:
    return load(Path("config/station.toml"), {}, (*NEAR, *overrides)).config


class Flown(NamedTuple):
    phase: Phase
    changes: list[PhaseChange]
    statuses: list[Status]
    truth: list[TruthSample]

    @property
    def phases(self) -> list[Phase]:
        """From the engagement on."""
        return list(itertools.dropwhile(lambda p: not p.is_engaged, (c.after for c in self.changes)))

    def away_m(self, since_s: float) -> list[float]:
        """True distances from the station."""
        return [math.dist((s.x_m, s.y_m), STATION) for s in self.truth if s.t_s >= since_s]


def always(beacon: str, t_s: float) -> bool:
    return True


def fly(config: Config, until_s: float, heard: Callable[[str, float], bool] = always) -> Flown:
    world = World(config.sim, 1)
    changes: list[PhaseChange] = []
    statuses: list[Status] = []

    def send(output: Output) -> None:
        if isinstance(output, PhaseChange):
            changes.append(output)
        elif isinstance(output, Status):
            statuses.append(output)
        world.send(output)

    def events() -> Iterator[Event]:
        for event in world.events():
            if world.t_s > until_s:
                return
            if not isinstance(event, RangeSample) or heard(event.beacon, world.t_s):
                yield event

    final = run(events(), config, send, lambda _: None)
    return Flown(final.phase, changes, statuses, world.truth)


@cache
def kept() -> Flown:
    """In a drift, one beacon of four silent from the fifth second on, another one once it is there."""
    ends_s = {"b1": 5.0, "b2": 25.0}
    return fly(config("sim.drift_x_m_s=0.2"), 40.0, lambda beacon, t_s: t_s < ends_s.get(beacon, 99.0))


def test_it_arrives_and_stays_in_one_phase_while_it_creeps_back_and_two_beacons_are_enough() -> None:
    flown = kept()
    assert flown.phases == [Phase.ACQUIRE, Phase.APPROACH, Phase.KEEP]
    arrived_s = (flown.changes[-1].t_ns - 1_000_000_000) * 1e-9
    assert max(flown.away_m(arrived_s)) <= 0.3
    speeds = {s.speed_m_s for s in flown.statuses if s.phase is Phase.KEEP}
    assert {0.0, 0.5} <= speeds


def test_people_see_where_the_station_is_and_which_beacons_are_heard() -> None:
    last = kept().statuses[-1]
    assert last.captured
    assert last.estimate is not None
    assert abs(last.estimate.distance_m - kept().away_m(0.0)[-1]) < 0.1
    assert last.estimate.distance_sigma_m < 0.1
    ages = last.beacons
    assert ages.keys() == {"b1", "b2", "b3", "b4"}
    assert ages["b1"] is not None and ages["b1"] > 30.0
    assert all(age is not None and age < 0.5 for name, age in ages.items() if name in ("b3", "b4"))


def test_a_change_of_phase_tells_how_well_the_bearing_is_known() -> None:
    found = next(c for c in kept().changes if c.after is Phase.APPROACH)
    status = next(s for s in kept().statuses if s.phase is Phase.APPROACH)
    assert status.estimate is not None
    told = float(found.reason.removeprefix("bearing known (± ").removesuffix("°)"))
    assert told == pytest.approx(math.degrees(status.estimate.bearing_sigma_rad), abs=3.0)


def test_too_few_beacons_are_named_it_stands_and_finds_the_station_anew() -> None:
    flown = fly(config(), 30.0, lambda beacon, t_s: beacon == "b4" or not 6.0 < t_s < 12.0)
    assert Phase.STALL in flown.phases
    stall = next(c for c in flown.changes if c.after is Phase.STALL)
    assert stall.reason == "too few beacons (b1, b2, b3 silent): standing still"
    standing = [s for s in flown.statuses if s.phase is Phase.STALL]
    assert {s.speed_m_s for s in standing} == {0.0}
    assert flown.phases[flown.phases.index(Phase.STALL) + 1] is Phase.ACQUIRE
    assert flown.phase in (Phase.APPROACH, Phase.KEEP)


def test_it_is_not_ready_before_three_beacons_are_heard() -> None:
    flown = fly(config(THREE, "beacons.b4.height_m=1.5"), 2.0, lambda beacon, t_s: beacon != "b2")
    assert flown.phase is Phase.AWAIT
    (_, awaited) = flown.statuses[-1].awaited
    assert "beacon 'b4'" in awaited
    assert all("'b1'" not in text for text in flown.statuses[-1].awaited)


def test_beacons_in_a_line_are_named_and_the_vehicle_is_handed_over() -> None:
    xs = (12.0, 8.0, 4.0, 10.0)
    beacons = ",".join(AT.format(i, x, 2) for i, x in enumerate(xs, 1))
    distances = [
        f"beacons.b{i}.station_distance_m={math.dist((x, 2.0), STATION)}" for i, x in enumerate(xs, 1)
    ]
    flown = fly(config(f"sim.beacons=[{beacons}]", *distances), 45.0)
    handed = next(c for c in flown.changes if c.after is Phase.HAND_OVER)
    assert "in one line" in handed.reason
    assert not flown.statuses[-1].captured


def test_a_vehicle_that_cannot_stop_keeps_the_station_on_a_small_circle() -> None:
    flown = fly(config("station.can_stop=false"), 45.0)
    assert flown.phases == [Phase.ACQUIRE, Phase.APPROACH, Phase.KEEP]
    assert max(flown.away_m(40.0)) < 1.2
    assert all(s.speed_m_s for s in flown.statuses if s.phase is Phase.KEEP)


def test_the_papers_scheme_flies_and_is_not_told_anew_with_every_range() -> None:
    flown = fly(config("station.scheme='station-paper'"), 20.0)
    assert flown.phases[:2] == [Phase.ACQUIRE, Phase.APPROACH]
    assert len(flown.phases) < 10


@pytest.mark.parametrize("scheme", ["station", "station-paper"])
def test_the_beacons_are_numbered_alike_whatever_their_order_in_the_file(scheme: str) -> None:
    c = config(f"station.scheme='{scheme}'")
    turned = load(None, {}, recorded=_turned(c)).config
    assert list(turned.beacons) == ["b4", "b3", "b2", "b1"]
    one, other = pilot.plan(c), pilot.plan(turned)
    assert one.scheme.p == other.scheme.p
    assert one.beacons == other.beacons


def _turned(c: Config) -> dict[str, object]:
    raw: dict[str, object] = msgspec.to_builtins(c)
    beacons = raw["beacons"]
    assert isinstance(beacons, dict)
    return raw | {"beacons": dict(reversed(beacons.items()))}
