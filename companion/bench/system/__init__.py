"""The whole app measured beside the floor: the least that the same libraries can do.

Machines differ, and so do their neighbours: ours and the floor run in turn within minutes, and what counts
are ratios. Latencies are those of all turns together, as they are drawn; of CPU and start the quietest turn
counts, for either side. Both run with the precedence that
config/companion.service gives to a flight (SCHED_RR, priority 10), where that is allowed.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from typing import NamedTuple

from companion.bench.system import cost, wire
from companion.bench.system.figures import Figure, Machine, Report, here, quantile
from companion.bench.system.rig import Rig

Progress = Callable[[str, int, int], None]
"""What is being measured, how much is done, of how much."""


class Extent(NamedTuple):
    """How long everything takes. `tail`: the quantile that stands for it; a p99 wants a thousand samples."""

    rates_hz: tuple[float, ...]
    tail: float
    turns: int
    latency_s: float
    jitter_s: float
    cpu_s: float
    flight_min: float
    step_s: float
    step_repeats: int
    simulated_s: float
    batch: int
    starts: int


FULL = Extent((20.0, 50.0), 0.99, 6, 10.0, 300.0, 20.0, 30.0, 60.0, 12, 20.0, 2000, 7)
SHORT = Extent((50.0,), 0.9, 2, 3.5, 10.0, 6.0, 3.0, 10.0, 4, 2.0, 0, 3)

_POINTS = 200
_CPU_TURNS = 2


class Part(NamedTuple):
    """What a part of the benchmark came to."""

    figures: list[Figure]
    latencies_s: dict[str, tuple[float, ...]] = {}  # noqa: RUF012 - never changed
    sizes_mib: dict[str, float] = {}  # noqa: RUF012
    not_measured: tuple[str, ...] = ()


def bench_system(
    short: bool = False, only: Sequence[str] = (), progress: Progress = lambda what, done, total: None
) -> Report:
    """Measure everything, or these parts.

    Raises ValueError (there is no such part), RuntimeError or TimeoutError (something does not start).
    """
    for name in only:
        if name not in PARTS:
            raise ValueError(f"unknown part {name!r}; there are {', '.join(PARTS)}")
    extent, machine = SHORT if short else FULL, here(os.getloadavg()[0])
    parts: list[Part] = []
    chosen = [name for name in PARTS if not only or name in only]
    for done, name in enumerate(chosen):
        progress(name, done, len(chosen))
        parts.append(PARTS[name](extent))
    return _report(short, machine, parts)


def _report(short: bool, machine: Machine, parts: list[Part]) -> Report:
    return Report(
        short=short,
        machine=machine,
        figures=tuple(figure for part in parts for figure in part.figures),
        sizes_mib={name: mib for part in parts for name, mib in part.sizes_mib.items()},
        latencies_s={name: values for part in parts for name, values in part.latencies_s.items()},
        not_measured=tuple(words for part in parts for words in part.not_measured),
    )


# ------------------------------------------------------------------------------------------- the parts


def _latency(extent: Extent) -> Part:
    figures: list[Figure] = []
    curves: dict[str, tuple[float, ...]] = {}
    everything = (wire.FLOOR, wire.BARE, wire.WHOLE)
    with Rig(wire.ONE) as rig:
        for rate_hz in extent.rates_hz:
            turns: dict[str, list[list[float]]] = {c.name: [] for c in everything}
            for _ in range(extent.turns):
                for c in everything:
                    segment = wire.measure(rig, c, wire.ONE, rate_hz, extent.latency_s, 0.5)
                    turns[c.name].append(segment.latencies_s)
            pooled = {name: sorted(s for turn in parts for s in turn) for name, parts in turns.items()}
            for name, every in pooled.items():
                curves[f"{name}, {rate_hz:.0f} Hz"] = tuple(
                    quantile(every, i / _POINTS) for i in range(_POINTS + 1)
                )
            for c, share, goal in (
                (wire.BARE, 0.5, 1.3),
                (wire.BARE, extent.tail, 1.5),
                (wire.WHOLE, extent.tail, 2.0),
            ):
                ours, floor = ([quantile(turn, share) for turn in turns[x.name]] for x in (c, wire.FLOOR))
                name = "median" if share == 0.5 else f"p{100 * share:.0f}"
                more = "" if c is wire.BARE else ", all on"
                figures.append(
                    Figure(
                        key=f"latency_{'all_on_' if more else ''}{rate_hz:.0f}hz_{name}_us",
                        what=f"range put → setpoint received, {rate_hz:.0f} Hz{more}, {name}",
                        unit="µs",
                        value=quantile(pooled[c.name], share) * 1e6,
                        floor=quantile(pooled[wire.FLOOR.name], share) * 1e6,
                        goal=goal,
                        is_ratio=True,
                        least_ratio=min(a / b for a, b in zip(ours, floor, strict=True)),
                    )
                )
    return Part(figures, curves)


def _jitter(extent: Extent) -> Part:
    with Rig(wire.ONE) as rig, wire.loaded_cores():
        ours = wire.measure(rig, wire.WHOLE, wire.ONE, 50.0, extent.jitter_s, 0.5)
        floor = wire.measure(rig, wire.FLOOR, wire.ONE, 50.0, min(extent.jitter_s, 60.0), 0.5)
    off = [[abs(gap_s - 0.02) for gap_s in segment.gaps_s] for segment in (ours, floor)]
    loaded = "setpoints at 50 Hz, both cores loaded"
    return Part(
        [
            Figure(
                key="jitter_p999_ms",
                what=f"{loaded}: jitter, p99.9",
                unit="ms",
                value=quantile(off[0], 0.999) * 1e3,
                floor=quantile(off[1], 0.999) * 1e3,
                goal=10.0,
            ),
            Figure(
                key="longest_gap_ms",
                what=f"{loaded}: longest gap",
                unit="ms",
                value=max(ours.gaps_s) * 1e3,
                floor=max(floor.gaps_s) * 1e3,
                goal=100.0,
            ),
        ]
    )


def _cpu(extent: Extent) -> Part:
    with Rig(wire.THREE) as rig:
        ours, floor = (
            min(wire.measure(rig, c, wire.THREE, 20.0, extent.cpu_s, 2.0).cpu for _ in range(_CPU_TURNS))
            for c in (wire.UNSEEN, wire.FLOOR)
        )
    return Part(
        [
            Figure(
                key="cpu_percent",
                what="CPU in flight: 3 beacons × 20 Hz, 50 Hz telemetry, recording",
                unit="%",
                value=100.0 * ours,
                floor=100.0 * floor,
                goal=5.0,
            ),
        ]
    )


def _step(extent: Extent) -> Part:
    goals = {1: 25.0, 3: 60.0, 20: 400.0}
    figures: list[Figure] = []
    for beacons, goal in goals.items():
        c = cost.step_cost(beacons, extent.step_s, extent.step_repeats)
        what = f"pilot.step on a range, {beacons} beacon{'s' if beacons > 1 else ''}"
        figures += [
            Figure(f"step_{beacons}_us", f"{what}: median", "µs", c.median_s * 1e6, goal),
            Figure(f"step_{beacons}_p999_us", f"{what}: p99.9, CPU", "µs", c.p999_s * 1e6, 2000.0),
        ]
    return Part(figures)


def _memory(extent: Extent) -> Part:
    m = cost.memory(extent.flight_min)
    flight = f"accelerated flight of {m.flown_s / 60.0:.0f} min"
    figures = [Figure("memory_mib", f"resident memory after an {flight}", "MiB", m.rss_mib, 80.0)]
    if extent.flight_min >= 10.0:  # a start is no growth
        figures.append(
            Figure("growth_mib_per_h", "growth of it, second half", "MiB/h", m.growth_mib_per_h, 1.0)
        )
    return Part(figures)


def _start(extent: Extent) -> Part:
    with Rig(wire.ONE) as rig:
        turns = [[wire.start_s(rig, c) for c in (wire.WHOLE, wire.FLOOR)] for _ in range(extent.starts)]
    ours, floor = (min(turn[i] for turn in turns) for i in (0, 1))
    told = min(cost.start_help_s() for _ in range(extent.starts))
    return Part(
        [
            Figure("start_s", "command typed → first heartbeat on the wire", "s", ours, 0.6, floor),
            Figure("help_s", "companion --help", "s", told, 0.25),
        ]
    )


def _simulation(extent: Extent) -> Part:
    rate = cost.simulated_per_s(extent.simulated_s)
    figures = [
        Figure("simulated_per_s", "simulated flights of 30 s, a core", "1/s", rate, 20.0, at_least=True)
    ]
    batch = cost.batch_per_s(extent.batch) if extent.batch else None
    if batch is None:
        why = "the short form does not compile them" if not extent.batch else "pip install 'companion[bench]'"
        return Part(figures, not_measured=(f"flights of the batch path: {why}",))
    figures.append(
        Figure("batch_per_s", "flights of 30 s of the batch path, a core", "1/s", batch, 500.0, at_least=True)
    )
    return Part(figures)


def _size(_: Extent) -> Part:
    return Part([], sizes_mib=cost.install_size())


PARTS: dict[str, Callable[[Extent], Part]] = {
    "latency": _latency,
    "jitter": _jitter,
    "cpu": _cpu,
    "step": _step,
    "memory": _memory,
    "start": _start,
    "simulation": _simulation,
    "size": _size,
}
"""Every part by its name."""
