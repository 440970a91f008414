"""Many simulated flights of the flying code: the same pilot on a virtual clock, against the mock's world."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any, NamedTuple

from companion.config import Config
from companion.guidance.model import shortest_path_m, wrap
from companion.run import run
from companion.types import Event, Output, Phase, PhaseChange, StopRequest
from sitl_mock.world import TruthSample, World

_REST_S = 3.0
"""A flight is over when the app has held for this long."""


class FlightResult(NamedTuple):
    """One flight, judged by the truth.

    `time_s` and `path_m` run from engagement to the first moment inside the capture radius; `shortest_m` is
    the shortest path to the disc with the turn bound from the pose at engagement; `rest_m` is the true
    distance at which the vehicle came to rest by the app's own decision.
    """

    seed: int
    captured: bool
    time_s: float
    path_m: float
    shortest_m: float
    rest_m: float
    rests_inside: bool
    ended: str

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

    def send(self, output: Output) -> None:
        if isinstance(output, PhaseChange):
            if self.engaged_s is None and output.after is Phase.ACQUIRE:
                self.engaged_s = self._world.t_s
            if output.after is not Phase.HAND_OVER:
                self.hold_ns = output.t_ns if output.after is Phase.HOLD else None
        self._world.send(output)

    def events(self) -> Iterator[Event]:
        for event in self._world.events():
            yield event
            if self.hold_ns is not None and event.t_ns - self.hold_ns > _REST_S * 1e9:
                yield StopRequest(t_ns=event.t_ns)
                return


def fly_one(config: Config, seed: int) -> FlightResult:
    """One simulated flight."""
    world = World(config.sim, seed)
    watch = _Watch(world)
    final = run(watch.events(), config, watch.send, _ignore)
    flown = [sample for sample in world.truth if sample.t_s >= (watch.engaged_s or 0.0)] or world.truth[-1:]
    return _judge(config, seed, world, flown, watch, final.reason)


def _judge(
    config: Config, seed: int, world: World, flown: list[TruthSample], watch: _Watch, reason: str
) -> FlightResult:
    g = config.guidance
    beacon = config.sim.beacons[0]
    start, last = flown[0], flown[-1]
    azimuth = math.atan2(beacon.y_m - start.y_m, beacon.x_m - start.x_m)
    shortest = shortest_path_m(
        start.distance_m,
        wrap(start.heading_rad - azimuth),
        g.capture_radius_m,
        g.speed_m_s,
        g.yaw_rate_max_rad_s,
    )
    inside = next((sample for sample in flown if sample.distance_m <= g.capture_radius_m), None)
    until = last if inside is None else inside
    engaged = watch.engaged_s is not None
    return FlightResult(
        seed=seed,
        captured=engaged and inside is not None,
        time_s=until.t_s - start.t_s,
        path_m=world.path_length_m(until.t_s, since_s=start.t_s),
        shortest_m=shortest,
        rest_m=last.distance_m,
        rests_inside=watch.hold_ns is not None and last.distance_m <= g.capture_radius_m,
        ended=reason if engaged else f"never engaged: {reason}",
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
    with ProcessPoolExecutor(workers, get_context("forkserver"), _Worker, (config,)) as pool:
        chunk = max(1, min(16, runs // (4 * workers)))
        return list(_counted(pool.map(_fly_in_worker, seeds, chunksize=chunk), progress))


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
