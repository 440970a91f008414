"""Simulated flights to record, and records made of them."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from companion.config import Config, Loaded
from companion.flight_writer import FlightWriter
from companion.record import Start, start_now, versions
from companion.run import run
from companion.state import State
from companion.types import Event, Output, Phase, PhaseChange, StopRequest
from sitl_mock.faults import FaultAt
from sitl_mock.scenario import Scenario
from sitl_mock.world import World

Item = Event | Output

NEAR = Scenario(start_x_m=1.0, start_y_m=3.0, limit_s=40.0)
"""Three metres from the beacon: over soon."""
EPOCH_NS = 1_750_000_000_000_000_000
"""A fixed date, so that the same flight gives the same file."""


def fly(
    config: Config,
    seed: int,
    record: Callable[[Item], None],
    faults: Iterable[FaultAt] = (),
    rest_s: float = 1.0,
) -> State:
    """A simulated flight; it is stopped when the app has held for `rest_s`."""
    world = World(config.sim, seed, faults)
    hold_ns: list[int] = []

    def send(output: Output) -> None:
        if isinstance(output, PhaseChange):
            hold_ns[:] = [output.t_ns] if output.after is Phase.HOLD else []
        world.send(output)

    def events() -> Iterator[Event]:
        for event in world.events():
            yield event
            if hold_ns and event.t_ns - hold_ns[0] > rest_s * 1e9:
                yield StopRequest(t_ns=event.t_ns)
                hold_ns.clear()

    return run(events(), config, send, record)


def flown(config: Config | None = None, seed: int = 1) -> list[Item]:
    """All events and outputs of a short flight, in order."""
    items: list[Item] = []
    fly(Config(sim=NEAR) if config is None else config, seed, items.append)
    return items


def start(config: Config | None = None) -> Start:
    """A start of the simulation's clock at `EPOCH_NS`."""
    loaded = Loaded(Config(sim=NEAR) if config is None else config, {"guidance.speed_m_s": "a test"})
    return Start(
        unix_ns=EPOCH_NS,
        monotonic_ns=0,
        config=start_now(loaded.config, "", {}).config,
        digest=loaded.digest,
        sources=loaded.sources,
        versions=versions(),
        kind="simulation",
    )


def as_bytes(items: Iterable[tuple[int, Item]], begin: Start, finish: bool = True) -> bytes:
    """A file of these numbered events and outputs."""
    stream = io.BytesIO()
    writer = FlightWriter(stream, begin)
    for number, item in items:
        writer.add(number, item)
    if finish:
        writer.finish()
    else:
        writer.flush()
    return stream.getvalue()


def in_file(path: Path, items: Iterable[Item], begin: Start | None = None) -> Path:
    """The file of a whole flight."""
    path.write_bytes(as_bytes(enumerate(items), start() if begin is None else begin))
    return path
