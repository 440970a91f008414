"""What every UWB parser gives: measurements, and the reasons why bytes became none.

A parser is fed bytes as they come, in pieces of any size, and gives the measurements that they complete. It
never raises for what the bytes hold, finds its feet again after garbage, and keeps no more than its longest
message (`held_bytes`). The result does not depend on how the stream was cut.
"""

from __future__ import annotations

from collections import Counter
from enum import Enum
from typing import Annotated, Protocol

import msgspec
from msgspec import Meta

from companion.types import LineOfSight

OK = "ok"
"""The status of a measurement that is one."""
NOT_POSITIVE = "NOT_POSITIVE"
"""A distance of zero or less: antennas close together, and an antenna delay set too long."""
MAX_RANGE_M = 10_000.0
"""No UWB module measures further; a number above is a broken number."""


class Measured(
    msgspec.Struct,
    frozen=True,
    gc=False,
    omit_defaults=True,
    rename={"peer": "beacon", "sequence": "seq", "time_s": "t_s"},
):
    """One try of a module to measure a distance. Its JSON form is a line of a recording (`records.py`)."""

    peer: Annotated[
        str, Meta(min_length=1, max_length=64, description="the other end, as the module names it")
    ]
    range_m: (
        Annotated[
            float,
            Meta(
                gt=0.0, le=MAX_RANGE_M, description="slant distance in metres; absent where status is not ok"
            ),
        ]
        | None
    ) = None
    sigma_m: (
        Annotated[float, Meta(gt=0.0, le=1_000.0, description="one standard deviation, metres")] | None
    ) = None
    los: Annotated[LineOfSight, Meta(description="line of sight: los, nlos or unknown")] = LineOfSight.UNKNOWN
    rssi_dbm: Annotated[float, Meta(ge=-300.0, le=100.0, description="received power, dBm")] | None = None
    status: Annotated[
        str,
        Meta(min_length=1, max_length=64, description="ok, or the module's word for why there is no range"),
    ] = OK
    sequence: Annotated[int, Meta(ge=0, le=2**63 - 1, description="the module's own counter")] | None = None
    time_s: (
        Annotated[
            float,
            Meta(ge=0.0, le=1e11, description="seconds on the module's or recorder's clock, any origin"),
        ]
        | None
    ) = None


def distance(metres: float, status: str = OK) -> tuple[float | None, str]:
    """The distance and its status: only a good status and a positive distance make a range.

    Raises Unreadable where no module can have measured it.
    """
    if status != OK:
        return None, status
    if not metres <= MAX_RANGE_M:
        raise Unreadable(ParseDefect.FIELD)
    return (metres, OK) if metres > 0.0 else (None, NOT_POSITIVE)


class ParseDefect(Enum):
    """Why bytes that looked like a message are none. A closed list, so that counting takes bounded memory."""

    LENGTH = "length or number of measurements does not fit"
    CHECKSUM = "wrong checksum"
    FIELD = "a field missing, malformed or out of range"
    DUPLICATE = "the same peer twice in one message"
    TOO_LONG = "longer than any message"


class Unreadable(Exception):  # noqa: N818 - it says what the bytes are, nothing has gone wrong here
    """These bytes are no message after all. Raised and caught inside the parsers."""

    def __init__(self, defect: ParseDefect) -> None:
        super().__init__(defect.value)
        self.defect = defect


def distinct(measured: list[Measured]) -> list[Measured]:
    """The same list. Raises Unreadable where a peer is in it twice: a piece of the message was repeated."""
    if len({m.peer for m in measured}) != len(measured):
        raise Unreadable(ParseDefect.DUPLICATE)
    return measured


class LosRule(Enum):
    """How a module's hint of the signal's path is read. Sources contradict each other, hence no default."""

    UNKNOWN = "unknown"
    """Not read: every range says `unknown`."""
    ZERO_IS_LOS = "zero-is-los"
    """FiRa UCI, NLOS byte as Android reads it: 0 line of sight, 1 none."""
    ONE_IS_LOS = "one-is-los"
    """FiRa UCI, NLOS byte as a Qorvo stack enumerates it inside: 1 line of sight, 0 none."""
    POWER = "power"
    """LinkTrack: the received less the first-path power; below 6 dB line of sight, above 10 dB none."""


class Parser(Protocol):
    """Bytes in, measurements out."""

    defects: Counter[ParseDefect]
    """What looked like a message and was none, by reason."""
    skipped_bytes: int
    """Bytes that belong to no range message: prompts, other output, garbage, and rejected messages."""

    @property
    def held_bytes(self) -> int:
        """Bytes kept until the rest of their message comes; never more than `limit_bytes`."""

    @property
    def limit_bytes(self) -> int:
        """The longest message."""

    def feed(self, data: bytes) -> list[Measured]:
        """The measurements that these bytes complete, in order."""
