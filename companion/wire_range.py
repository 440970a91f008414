"""The range on the wire: one definition for publisher, subscriber and JSON Schema.

Key `uwb/v1/{site}/{beacon}/{tag}/range`; the payload is JSON (encoding `application/json`) or MessagePack
(`application/msgpack`), told by the encoding.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import Meta

from companion.types import LineOfSight

JSON = "application/json"
MSGPACK = "application/msgpack"
MAX_PAYLOAD_BYTES = 4096
"""A range needs about 150 bytes; more than this is refused unread."""

KEY_VERSION = "uwb/v1"


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


def range_key(site: str, beacon: str, tag: str) -> str:
    """The key that the ranges of one beacon to one tag are published on; `*` for any."""
    return f"{KEY_VERSION}/{site}/{beacon}/{tag}/range"


def info_key(site: str, beacon: str) -> str:
    """Where a beacon answers queries about itself; `*` for any."""
    return f"{KEY_VERSION}/{site}/{beacon}/info"


def alive_key(site: str, beacon: str) -> str:
    """The liveliness token that is there while the beacon's publisher is; `*` for any."""
    return f"{KEY_VERSION}/{site}/{beacon}/alive"


def beacon_of(key: str) -> str:
    """The beacon's id in a range key, or '' where the key is not one."""
    parts = key.split("/")
    return parts[3] if len(parts) == 6 and parts[5] == "range" else ""


def encode(message: RangeMessage, encoding: str = JSON) -> bytes:
    """The payload for an encoding (`JSON` or `MSGPACK`)."""
    return msgspec.json.encode(message) if encoding == JSON else msgspec.msgpack.encode(message)


_from_json = msgspec.json.Decoder(RangeMessage).decode
_from_msgpack = msgspec.msgpack.Decoder(RangeMessage).decode


def decode(payload: bytes, encoding: str) -> RangeMessage:
    """Read and validate a payload.

    Raises `msgspec.ValidationError` (a field is missing or out of range), `msgspec.DecodeError` (not JSON or
    MessagePack), `ValueError` (too long, too deep, or an encoding that is neither).
    """
    try:
        return _decode(payload, encoding)
    except RecursionError:  # nested a thousand deep in a field that nobody reads
        raise ValueError("nested too deeply") from None


def _decode(payload: bytes, encoding: str) -> RangeMessage:
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"payload of {len(payload)} bytes, at most {MAX_PAYLOAD_BYTES}")
    if encoding.startswith(JSON):
        return _from_json(payload)
    if encoding.startswith(MSGPACK):
        return _from_msgpack(payload)
    raise ValueError(f"encoding {encoding[:40]!r}, expected {JSON} or {MSGPACK}")


def schema() -> dict[str, Any]:
    """The JSON Schema of the payload."""
    return msgspec.json.schema(RangeMessage)
