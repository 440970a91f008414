"""A long flight on a virtual clock, in a process that carries what a flying one does; it tells its memory.

    python -m companion.bench.system.memory 30

prints seconds flown, resident MiB at the end, MiB per hour of flight over the second half, as JSON.
"""

from __future__ import annotations

import io
import os
import sys
import tempfile
from pathlib import Path

import msgspec

import companion.fly  # noqa: F401 - what a flight loads, the libraries of both links among it
from companion.bench.system.cost import configuration
from companion.bench.system.wire import rss_of
from companion.compiled import twin
from companion.flight_writer import FlightWriter
from companion.link.ground_station import GroundStation
from companion.link.mavlink import VehicleLink
from companion.link.zenoh_ranges import RangeLink
from companion.network_settings import RangesSettings
from companion.record import start_now
from companion.recorder import FLUSH_S
from companion.run import run
from companion.summary import FlightLog
from companion.types import Event, Output, PhaseChange, Status
from companion.view import ViewKind, open_view
from sitl_mock.world import World

_SAMPLE_S = 5.0


class _Nowhere:
    """A transport that leads nowhere."""

    def fileno(self) -> int:
        return -1

    def receive(self) -> bytes:
        return b""

    def send(self, data: bytes) -> None:
        pass

    def close(self) -> None:
        pass


def fly(minutes: float, file: io.FileIO) -> list[tuple[float, float]]:
    """Simulated seconds and resident MiB, every `_SAMPLE_S` of the flight."""
    config = configuration(1, minutes * 60.0)
    world = twin(World)(config.sim, 1)
    pending = io.BytesIO()
    writer = twin(FlightWriter)(pending, start_now(config, "", {}))
    link = twin(VehicleLink)(config.vehicle, _Nowhere(), ground=twin(GroundStation)(config))
    log = FlightLog()
    view = open_view(io.StringIO(), ViewKind.NONE)
    ranges = twin(RangeLink)(RangesSettings(listen=("tcp/127.0.0.1:0",)), lambda: None)
    samples: list[tuple[float, float]] = []
    number, flushed_s, sampled_s = 0, 0.0, 0.0

    def record(item: Event | Output) -> None:
        nonlocal number, flushed_s, sampled_s
        writer.add(number, item, item.t_ns)
        number += 1
        if world.t_s - flushed_s >= FLUSH_S:
            flushed_s = world.t_s
            writer.flush()
            file.write(pending.getvalue())
            pending.seek(0)
            pending.truncate()
            world.truth.clear()  # the simulator's, not the app's
        if world.t_s - sampled_s >= _SAMPLE_S:
            sampled_s = world.t_s
            samples.append((sampled_s, rss_of(os.getpid())))

    def send(output: Output) -> None:
        world.send(output)
        link.send(output)
        if isinstance(output, Status):
            view.show(output)
            log.add(output)
        elif isinstance(output, PhaseChange):
            view.note(output)
            log.add(output)

    run(world.events(), config, send, record)
    ranges.close()
    view.close()
    return samples


def growth_mib_per_h(samples: list[tuple[float, float]]) -> float:
    """Slope of the straight line through the second half."""
    half = samples[len(samples) // 2 :]
    t0 = sum(t for t, _ in half) / len(half)
    m0 = sum(m for _, m in half) / len(half)
    slope = sum((t - t0) * (m - m0) for t, m in half) / sum((t - t0) ** 2 for t, _ in half)
    return 3600.0 * slope


def main(minutes: float) -> None:
    """Fly, and print what it came to."""
    with tempfile.TemporaryDirectory() as scratch, (Path(scratch) / "flight.mcap").open("wb", 0) as file:
        samples = fly(minutes, file)
    last_s, last_mib = samples[-1]
    print(msgspec.json.encode((last_s, last_mib, growth_mib_per_h(samples))).decode())


if __name__ == "__main__":
    main(float(sys.argv[1]))
