"""What a range on the wire says; `wire_range` tells how it is written."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from companion.types import LineOfSight


class RangeMessage(msgspec.Struct, frozen=True, gc=False, omit_defaults=True):
    """One measured distance between a beacon and a tag. Unknown fields are ignored, so that it can grow."""

    session: Annotated[
        str, Meta(min_length=1, max_length=64, description="random text, new at every start of the beacon")
    ]
    seq: Annotated[
        int, Meta(ge=0, lt=2**53, description="counts the ranges of this session, increasing by one")
    ]
    range_m: Annotated[
        float, Meta(gt=0.0, le=10_000.0, description="slant distance between the antennas, metres")
    ]
    sigma_m: (
        Annotated[float, Meta(gt=0.0, le=1_000.0, description="one standard deviation, metres")] | None
    ) = None
    los: Annotated[LineOfSight, Meta(description="line of sight as the module reports it")] = (
        LineOfSight.UNKNOWN
    )
    rssi_dbm: Annotated[float, Meta(ge=-300.0, le=100.0, description="received power, dBm")] | None = None
    t_ns: (
        Annotated[
            int,
            Meta(ge=0, lt=2**62, description="Unix time of the measurement, nanoseconds, if synchronised"),
        ]
        | None
    ) = None
    status: (
        Annotated[str, Meta(max_length=64, description="anything but 'ok' means: not a measurement")] | None
    ) = None
