"""A vehicle's status on the wire: one definition for publisher, watcher and JSON Schema.

Key `uav/v1/{uav}/status`, payload JSON (`application/json`). The liveliness token
`uav/v1/{uav}/alive` is there while the flying process is.
"""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import Meta

from companion.types import Status

JSON = "application/json"
MAX_PAYLOAD_BYTES = 16_384
"""A status needs about 900 bytes; more than this is refused unread."""

KEY_VERSION = "uav/v1"


class StatusMessage(msgspec.Struct, frozen=True):
    """The status of one vehicle at one moment. Unknown fields are ignored, so that it can grow."""

    session: Annotated[
        str, Meta(min_length=1, max_length=64, description="random text, new at every start of the app")
    ]
    seq: Annotated[int, Meta(ge=0, lt=2**53, description="counts the messages of this session")]
    sent_t_ns: Annotated[
        int, Meta(ge=0, lt=2**62, description="Unix time by the vehicle's own clock, nanoseconds")
    ]
    target: Annotated[str, Meta(max_length=64, description="id of the beacon that is flown to, or 'station'")]
    radius_m: Annotated[
        float, Meta(gt=0.0, description="it is reached within this horizontal distance, metres")
    ]
    status: Annotated[
        Status, Meta(description="the snapshot; its t_ns is of the vehicle's monotonic clock, nanoseconds")
    ]


def status_key(uav: str) -> str:
    """The key that a vehicle's status is published on; `*` for any."""
    return f"{KEY_VERSION}/{uav}/status"


def alive_key(uav: str) -> str:
    """The liveliness token that is there while the vehicle's app is; `*` for any."""
    return f"{KEY_VERSION}/{uav}/alive"


def uav_of(key: str) -> str:
    """The vehicle's id in a status or alive key, or '' where the key is neither."""
    parts = key.split("/")
    return parts[2] if len(parts) == 4 and parts[3] in ("status", "alive") else ""


def encode(message: StatusMessage) -> bytes:
    """The payload."""
    return msgspec.json.encode(message)


_decode = msgspec.json.Decoder(StatusMessage).decode


def decode(payload: bytes) -> StatusMessage:
    """Read and validate a payload. Raises ValueError (msgspec's errors are ValueErrors), with the reason.

    Texts in it can be printed as they are: they hold nothing that a terminal would obey.
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise ValueError(f"payload of {len(payload)} bytes, at most {MAX_PAYLOAD_BYTES}")
    try:
        message = _decode(payload)
    except RecursionError:  # nested a thousand deep in a field that nobody reads
        raise ValueError("nested too deeply") from None
    s = message.status
    for text in (message.target, s.reason, *s.awaited, *s.warnings, *s.rejected, *s.malformed, *s.beacons):
        if not text.isprintable():
            raise ValueError(f"a text holds control characters: {text[:40]!r}")
    return message


def schema() -> dict[str, Any]:
    """The JSON Schema of the payload."""
    return msgspec.json.schema(StatusMessage)
