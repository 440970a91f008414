"""The reference flights: recorded once, replayed by the tests.

They are renewed on purpose only, by `python -m tests.record.accept`.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import msgspec

from companion.config import Config
from companion.settings import LossSettings
from sitl_mock.faults import Fault, FaultAt
from tests.record.flights import NEAR, Item, as_bytes, fly, start

DATA = Path(__file__).parent / "data"

SAME_BEHAVIOUR = 1e-9
"""Another machine's sine differs in the last bits; more than this is another behaviour."""


_SHORT = msgspec.structs.replace(NEAR, limit_s=11.0)


class Reference(NamedTuple):
    """A simulated flight."""

    config: Config
    faults: tuple[FaultAt, ...] = ()
    seed: int = 1


_QUICK = LossSettings(stall_after_s=2.0, hand_over_after_s=5.0)

FLIGHTS = {
    "capture": Reference(Config(sim=NEAR)),
    "ranges-lost-and-back": Reference(Config(sim=NEAR, loss=_QUICK), (FaultAt(Fault.RANGE_LOSS, 4.0, 4.0),)),
    "handed-over": Reference(Config(sim=_SHORT, loss=_QUICK), (FaultAt(Fault.RANGE_LOSS, 4.0),)),
}
"""Name → flight: to the target; with ranges lost until it stalls, and back; with ranges lost for good."""


def path_of(name: str) -> Path:
    return DATA / f"{name}.mcap"


def record(name: str) -> bytes:
    """Fly it with the code as it is."""
    flight = FLIGHTS[name]
    items: list[Item] = []
    fly(flight.config, flight.seed, items.append, flight.faults)
    return as_bytes(enumerate(items), start(flight.config))
