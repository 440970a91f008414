"""Publishers that lie, in simulated flights.

Beside the beacon they change nothing; in its place they move the vehicle no faster and no further than the
limits allow.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import pytest
from msgspec.structs import replace

from companion.config import Config, load
from companion.run import run
from companion.state import State
from companion.types import Event, Output, Phase, PhaseChange, RangeSample, Setpoint, StopRequest, Verdict
from sitl_mock.world import World

FROM_START_M = 8.0
CONFIG = load(
    None,
    {},
    [
        "sim.start_x_m=0.0",
        "sim.start_y_m=0.0",
        "sim.telemetry='perfect'",
        "sim.limit_s=40.0",
        f"limits.from_start_m={FROM_START_M}",
        "limits.flight_time_s=30.0",
    ],
).config
LIE_FROM_S = 5.0
"""The vehicle is on its way then."""


class Flight(NamedTuple):
    """What a flight came to."""

    state: State
    world: World
    setpoints: tuple[Setpoint, ...]
    heard: tuple[RangeSample, ...]

    @property
    def furthest_m(self) -> float:
        """From where it began."""
        begin = self.world.truth[0]
        return max(math.hypot(t.x_m - begin.x_m, t.y_m - begin.y_m) for t in self.world.truth)


Lie = Callable[[RangeSample, float], Iterable[RangeSample]]
"""A true range and the seconds since the lying began: what is heard instead."""


def fly(lie: Lie, config: Config = CONFIG, seed: int = 1) -> Flight:
    """A flight that ends at rest, handed over, or when its time is up."""
    world = World(config.sim, seed)
    setpoints: list[Setpoint] = []
    heard: list[RangeSample] = []
    ended: list[Phase] = []

    def send(output: Output) -> None:
        if isinstance(output, Setpoint):
            setpoints.append(output)
        elif isinstance(output, PhaseChange) and output.after in (Phase.HOLD, Phase.RELEASED):
            ended.append(output.after)
        world.send(output)

    def events() -> Iterator[Event]:
        for event in world.events():
            if isinstance(event, RangeSample):
                told = lie(event, world.t_s - LIE_FROM_S) if world.t_s >= LIE_FROM_S else (event,)
                for sample in told:
                    heard.append(sample)
                    yield sample
            else:
                yield event
            if ended:
                ended.clear()
                yield StopRequest(t_ns=event.t_ns)

    return Flight(run(events(), config, send, lambda _: None), world, tuple(setpoints), tuple(heard))


def truth(e: RangeSample, _: float) -> Iterable[RangeSample]:
    return (e,)


def offset(e: RangeSample, _: float) -> RangeSample:
    return replace(e, range_m=e.range_m + 3.0)


def shrinking(e: RangeSample, t_s: float) -> RangeSample:
    return replace(e, range_m=max(e.range_m - 2.0 * t_s, 0.3))


def growing(e: RangeSample, t_s: float) -> RangeSample:
    return replace(e, range_m=e.range_m + 2.0 * t_s)


def replayed(recording: tuple[RangeSample, ...]) -> Callable[[RangeSample, float], RangeSample]:
    """Another flight's ranges, one after the other, as they were: session, numbers, distances."""
    stream = iter(recording)

    def next_of_it(e: RangeSample, _: float) -> RangeSample:
        return replace(next(stream, recording[-1]), t_ns=e.t_ns)

    return next_of_it


@pytest.fixture(scope="module")
def honest() -> Flight:
    flight = fly(truth)
    assert flight.state.flight.captured
    return flight


LIES: dict[str, Callable[[Flight], Callable[[RangeSample, float], RangeSample]]] = {
    "offset": lambda _: offset,
    "shrinking": lambda _: shrinking,
    "growing": lambda _: growing,
    "replayed recording": lambda honest: replayed(tuple(replace(e, session="old") for e in honest.heard)),
}


@pytest.mark.parametrize("name", LIES)
def test_beside_the_beacon_a_liar_changes_nothing(name: str, honest: Flight) -> None:
    """Four lies for each true range, under another session: as if they were not there."""
    made = LIES[name](honest)
    number = [0]

    def lie(e: RangeSample, t_s: float) -> Iterable[RangeSample]:
        yield e
        for _ in range(4):
            number[0] += 1
            yield replace(made(e, t_s), session="mallory", seq=number[0])

    flight = fly(lie)
    assert flight.setpoints == honest.setpoints
    assert set(flight.state.ranging.rejected) - set(honest.state.ranging.rejected) == {
        Verdict.SECOND_PUBLISHER
    }


@pytest.mark.parametrize("name", LIES)
def test_in_the_beacons_place_a_liar_is_bound_by_the_limits(name: str, honest: Flight) -> None:
    made = LIES[name](honest)
    flight = fly(lambda e, t_s: (made(e, t_s),))
    limits = CONFIG.limits
    assert max(s.speed_m_s for s in flight.setpoints) <= limits.speed_m_s
    assert max(abs(s.yaw_rate_rad_s) for s in flight.setpoints) <= limits.yaw_rate_rad_s
    assert flight.furthest_m <= FROM_START_M + 0.8  # and what it takes to stop
    assert flight.world.t_s < 45.0
    assert flight.state.phase is Phase.ENDED or flight.world.t_s >= CONFIG.sim.limit_s - 1.0
