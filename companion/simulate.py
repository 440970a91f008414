"""Many simulated flights of the flying code: the same pilot on a virtual clock, against the mock's world."""

from __future__ import annotations

import math
import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

from companion.compiled import twin
from companion.config import Config
from companion.goal import true_goal
from companion.guidance.model import shortest_path_m, wrap
from companion.run import run
from companion.types import Event, Output, Phase, PhaseChange, StopRequest
from sitl_mock.world import TruthSample, World

_REST_S = 3.0
"""A flight is over when the app has held the target for this long."""
KEEP_S = 30.0
"""A station must be kept for this long after the arrival."""
_CHUNK = 2
"""Flights that a worker is given at a time: who stops it waits for those."""


class FlightResult(NamedTuple):
    """One flight, judged by the truth.

    `time_s` and `path_m` run from engagement to the first moment inside the capture radius; `shortest_m` is
    the shortest path to the disc with the turn bound from the pose at engagement; `rest_m` is the true
    distance at which the vehicle came to rest by the app's own decision.

    At a station: `time_s` and `path_m` run to the last entry into the radius before the app said that it
    stays; `rests_inside` says that the vehicle was within the radius from then on for `KEEP_S`, `hold_rms_m`
    and `hold_worst_m` are the true distances in that time (None: it never stayed).
    """

    seed: int
    captured: bool
    time_s: float
    path_m: float
    shortest_m: float
    rest_m: float
    rests_inside: bool
    ended: str
    hold_rms_m: float | None = None
    hold_worst_m: float | None = None

    @property
    def path_ratio(self) -> float:
        """Path length ÷ shortest path."""
        return self.path_m / self.shortest_m if self.shortest_m > 0.0 else 1.0

    @property
    def extra_path_m(self) -> float:
        """Path length − shortest path."""
        return self.path_m - self.shortest_m


class _Watch:
    """Notes when the app was engaged and when it came to hold, and ends the flight after that."""

    def __init__(self, world: World) -> None:
        self._world = world
        self.engaged_s: float | None = None
        self.hold_ns: int | None = None
        self._end_ns: float = math.inf

    def send(self, output: Output) -> None:
        if isinstance(output, PhaseChange):
            if self.engaged_s is None and output.after is Phase.ACQUIRE:
                self.engaged_s = self._world.t_s
            if output.after is Phase.KEEP and self.hold_ns is None:  # a station: what follows is judged
                self.hold_ns, self._end_ns = output.t_ns, output.t_ns + KEEP_S * 1e9
            elif output.after is Phase.HOLD:
                self.hold_ns, self._end_ns = output.t_ns, output.t_ns + _REST_S * 1e9
            elif output.before is Phase.HOLD and output.after is not Phase.HAND_OVER:
                self.hold_ns, self._end_ns = None, math.inf
        self._world.send(output)

    def events(self) -> Iterator[Event]:
        for event in self._world.events():
            yield event
            if event.t_ns > self._end_ns:
                yield StopRequest(t_ns=event.t_ns)
                return


def fly_one(config: Config, seed: int) -> FlightResult:
    """One simulated flight. Raises ConfigError where its goal is not in the simulated world."""
    goal = true_goal(config)
    world = twin(World)(config.sim, seed, autopilot=config.vehicle.kind)
    watch = _Watch(world)
    final = twin(run)(watch.events(), config, watch.send, _ignore)
    flown = [sample for sample in world.truth if sample.t_s >= (watch.engaged_s or 0.0)] or world.truth[-1:]
    return _judge(config, seed, goal, world, flown, watch, final.reason)


def _judge(
    config: Config,
    seed: int,
    goal: tuple[float, float],
    world: World,
    flown: list[TruthSample],
    watch: _Watch,
    reason: str,
) -> FlightResult:
    g, (_, radius_m) = config.guidance, config.aim
    away_m = [math.dist((sample.x_m, sample.y_m), goal) for sample in flown]
    start = flown[0]
    azimuth = math.atan2(goal[1] - start.y_m, goal[0] - start.x_m)
    shortest = shortest_path_m(
        away_m[0], wrap(start.heading_rad - azimuth), radius_m, g.speed_m_s, g.yaw_rate_max_rad_s
    )
    inside = next((i for i, d in enumerate(away_m) if d <= radius_m), None)
    held_m: list[float] = []
    if config.mission.kind == "station" and watch.hold_ns is not None:
        first = next(i for i, sample in enumerate(flown) if world.time_ns(sample.t_s) >= watch.hold_ns)
        held_m = away_m[first:]
        outside = next((i for i in range(first, -1, -1) if away_m[i] > radius_m), -1)
        inside = min(outside + 1, first)
    until = flown[-1 if inside is None else inside]
    engaged = watch.engaged_s is not None
    return FlightResult(
        seed=seed,
        captured=engaged and inside is not None,
        time_s=until.t_s - start.t_s,
        path_m=world.path_length_m(until.t_s, since_s=start.t_s),
        shortest_m=shortest,
        rest_m=away_m[-1],
        rests_inside=watch.hold_ns is not None and max(held_m or away_m[-1:]) <= radius_m,
        ended=reason if engaged else f"never engaged: {reason}",
        hold_rms_m=math.sqrt(sum(d * d for d in held_m) / len(held_m)) if held_m else None,
        hold_worst_m=max(held_m, default=None),
    )


def _ignore(_: object) -> None:
    """A simulated flight is not recorded."""


def fly_many(
    config: Config, runs: int, seed: int, progress: Callable[[int], None] = _ignore
) -> list[FlightResult]:
    """`runs` flights with the seeds seed, seed + 1, …, on all cores; how many does not change the results."""
    seeds = range(seed, seed + runs)
    if runs < 8:
        return list(_counted((fly_one(config, s) for s in seeds), progress))
    workers = os.cpu_count() or 1
    early: list[int] = []  # an interrupt while the workers are started would leave a pool that never ends
    before = signal.signal(signal.SIGTERM, lambda number, _: early.append(number))
    try:
        with ProcessPoolExecutor(workers, get_context("forkserver"), _Worker, (config,)) as pool:
            flights = pool.map(_fly_in_worker, seeds, chunksize=_CHUNK)
            try:
                signal.signal(signal.SIGTERM, signal.default_int_handler)  # its workers must not outlive it
                if early:
                    raise KeyboardInterrupt
                return list(_counted(flights, progress))
            except KeyboardInterrupt:
                pool.shutdown(cancel_futures=True)
                raise
    finally:
        signal.signal(signal.SIGTERM, before)


def _counted(results: Iterable[FlightResult], progress: Callable[[int], None]) -> Iterator[FlightResult]:
    for done, result in enumerate(results, start=1):
        progress(done)
        yield result


class _Worker:
    """Holds the configuration in a worker process."""

    config: Config

    def __init__(self, config: Config) -> None:
        type(self).config = config


def _fly_in_worker(seed: int) -> FlightResult:
    return fly_one(_Worker.config, seed)


def statistics(results: list[FlightResult]) -> dict[str, Any]:
    """What `--json` prints. Time, ratio and extra path are those of the captured flights."""
    captured = [r for r in results if r.captured]
    return {
        "runs": len(results),
        "captured": len(captured),
        "rests_inside": sum(r.rests_inside for r in results),
        "time_s": _spread([r.time_s for r in captured]),
        "path_ratio": _spread([r.path_ratio for r in captured]),
        "extra_path_m": _spread([r.extra_path_m for r in captured]),
        "rest_m": _spread([r.rest_m for r in captured]),
        "hold_rms_m": _spread([r.hold_rms_m for r in captured if r.hold_rms_m is not None]),
        "hold_worst_m": _spread([r.hold_worst_m for r in captured if r.hold_worst_m is not None]),
        "not_captured": [{"seed": r.seed, "ended": r.ended} for r in results if not r.captured],
    }


def _spread(values: list[float]) -> dict[str, float | None]:
    """Median, 95th percentile (nearest rank) and maximum."""
    if not values:
        return {"median": None, "p95": None, "max": None, "mean": None}
    ordered = sorted(values)
    n = len(ordered)
    middle = (ordered[(n - 1) // 2] + ordered[n // 2]) / 2.0
    return {
        "median": middle,
        "p95": ordered[max(0, math.ceil(0.95 * n) - 1)],
        "max": ordered[-1],
        "mean": sum(ordered) / n,
    }
