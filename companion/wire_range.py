"""The range on the wire: keys, encodings and JSON Schema, the same for publisher and subscriber.

Key `uwb/v1/{site}/{beacon}/{tag}/range`; the payload is JSON (encoding `application/json`) or MessagePack
(`application/msgpack`), told by the encoding.
"""

from __future__ import annotations

from typing import Any, Final

import msgspec

from companion.range_message import RangeMessage

JSON = "application/json"
MSGPACK = "application/msgpack"
MAX_PAYLOAD_BYTES = 4096
"""A range needs about 150 bytes; more than this is refused unread."""

KEY_VERSION = "uwb/v1"


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


_from_json: Final = msgspec.json.Decoder(RangeMessage).decode
_from_msgpack: Final = msgspec.msgpack.Decoder(RangeMessage).decode


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
