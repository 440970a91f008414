"""What the app costs on its own: a step, simulated flights, memory, the size of what is installed."""

from __future__ import annotations

import math
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib import import_module, metadata
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

import msgspec

from companion import pilot
from companion.bench.system.figures import quantile
from companion.compiled import PACKAGE, native, twin, why_not
from companion.config import Config
from companion.network_settings import BeaconSettings
from companion.run import run
from companion.settings import LimitSettings, MissionSettings
from companion.types import Event, RangeSample
from sitl_mock.scenario import BeaconAt, Scenario
from sitl_mock.world import World

_FLIGHT_S = 30.0
"""Simulated flights are counted in units of this length."""
_FLIGHTS = 8
"""So many different ones."""
_NAME_ENDS = re.compile(r"[\s\[<>=!~(]")
_LONG = LimitSettings(flight_time_s=36000.0, distance_m=100_000.0, from_start_m=100_000.0)


class StepCost(NamedTuple):
    """Seconds that a step takes on a range of which a setpoint leaves."""

    beacons: int
    median_s: float
    p999_s: float


def configuration(beacons: int, limit_s: float) -> Config:
    """A flight to one beacon, or to a station among several, on the mock's default vehicle."""
    if beacons == 1:
        return Config(sim=Scenario(limit_s=limit_s), limits=_LONG)
    names = [f"b{i:02d}" for i in range(beacons)]
    turns = [2.0 * math.pi * i / beacons for i in range(beacons)]
    at = [
        BeaconAt(name, 8.0 + 7.0 * math.cos(turn), 6.0 + 7.0 * math.sin(turn), 1.5)
        for name, turn in zip(names, turns, strict=True)
    ]
    known = BeaconSettings(height_m=1.5, station_distance_m=7.0)
    return Config(
        mission=MissionSettings(kind="station"),
        beacons=dict.fromkeys(names, known),
        sim=Scenario(beacons=tuple(at), limit_s=limit_s),
        limits=_LONG,
    )


def events(config: Config, seed: int = 1) -> list[Event]:
    """What the pilot gets to see in a simulated flight."""
    seen: list[Event] = []
    world = twin(World)(config.sim, seed)

    def noted() -> Iterator[Event]:
        for event in world.events():
            seen.append(event)
            yield event

    run(noted(), config, world.send, lambda _: None)
    return seen


def step_cost(beacons: int, seconds: float, repeats: int) -> StepCost:
    """Replay a flight with a watch on every step.

    Of a step's repeats the quickest counts for the median: what neighbours take away is not the step's. The
    tail is that of all repeats, in CPU time: pauses of our own (garbage collection) count there.
    """
    config = configuration(beacons, seconds)
    seen = events(config)
    step, plan = twin(pilot.step), twin(pilot.plan)(native(config))
    best: dict[int, int] = {}
    every: list[int] = []
    clock, cpu_clock = time.perf_counter_ns, time.thread_time_ns
    for _ in range(repeats):
        state = twin(pilot.initial)(plan)
        for number, event in enumerate(seen):
            cpu_began = cpu_clock()
            began = clock()
            state, outputs = step(plan, state, event)
            took = clock() - began
            cpu_took = cpu_clock() - cpu_began
            if type(event) is RangeSample and len(outputs) > 1:
                best[number] = min(took, best.get(number, took))
                every.append(cpu_took)
    return StepCost(beacons, quantile(best.values(), 0.5) * 1e-9, quantile(every, 0.999) * 1e-9)


def simulated_per_s(seconds: float) -> float:
    """Flights of 30 s of the flying code per second of one core's time; of a flight's repeats the quickest
    counts."""
    best = [math.inf] * _FLIGHTS
    used_s = 0.0
    config = Config(sim=Scenario(random_start=True, limit_s=_FLIGHT_S))
    while used_s < seconds or math.inf in best:
        for seed in range(_FLIGHTS):
            world = twin(World)(config.sim, seed)
            began = time.process_time()
            twin(run)(world.events(), config, world.send, lambda _: None)
            took_s = time.process_time() - began
            best[seed] = min(best[seed], took_s)
            used_s += took_s
    return _FLIGHTS / sum(best)


def batch_per_s(flights: int) -> float | None:
    """The same of the compiled guidance on the compiled plant, per core; None: numba is not installed."""
    if find_spec("numba") is None:
        return None
    from companion.bench.batch import Flyer, fly_many, prepare, random_starts
    from companion.bench.plant import Plant
    from companion.guidance.schemes import capture
    from companion.guidance.settings import GuidanceSettings

    plant = Plant()
    flyer = Flyer(capture(GuidanceSettings(), plant.yaw_rate_lag_s, plant.velocity_lag_s))
    prepare(flyer)
    began = time.process_time()
    flown = fly_many(flyer, plant, random_starts(flights, 1))
    used_s = time.process_time() - began
    return float(flown[:, 0][flown[:, 0] < 1e9].sum()) / _FLIGHT_S / used_s


class Memory(NamedTuple):
    """Resident memory after an accelerated flight, and its growth over the second half of it."""

    flown_s: float
    rss_mib: float
    growth_mib_per_h: float


def memory(minutes: float) -> Memory:
    """Fly in a process of its own, with record, view and everything that `companion fly` loads."""
    done = subprocess.run(
        [sys.executable, "-m", "companion.bench.system.memory", str(minutes)],
        capture_output=True,
        text=True,
        check=True,
    )
    return Memory(*msgspec.json.decode(done.stdout.splitlines()[-1], type=tuple[float, float, float]))


def start_help_s() -> float:
    """`companion --help`."""
    began = time.monotonic()
    subprocess.run([sys.executable, "-m", "companion", "--help"], capture_output=True, check=True)
    return time.monotonic() - began


def install_size() -> dict[str, float]:
    """What `pip install companion` brings, without extras: each distribution's size on this disk, MiB."""
    sizes: dict[str, float] = {}
    wanted = ["companion"]
    while wanted:
        name = wanted.pop().lower().replace("_", "-")
        if name in sizes:
            continue
        try:
            distribution = metadata.distribution(name)
        except metadata.PackageNotFoundError:
            continue  # for another platform or an older Python
        sizes[name] = sum(_bytes(Path(str(f.locate()))) for f in distribution.files or ()) / 2**20
        for requirement in distribution.requires or ():
            wanted_name, _, condition = requirement.partition(";")
            if "extra" not in condition:
                wanted.append(_NAME_ENDS.split(wanted_name.strip(), maxsplit=1)[0])
    sizes["companion"] = sum(_bytes(p) for p in Path(pilot.__file__).parent.rglob("*.py")) / 2**20
    if why_not() is None:
        for folder in import_module(PACKAGE).__path__:
            sizes["companion"] += sum(_bytes(p) for p in Path(folder).rglob("*.so")) / 2**20
    return dict(sorted(sizes.items(), key=lambda item: -item[1]))


def _bytes(path: Path) -> int:
    return path.stat().st_size if path.is_file() else 0
