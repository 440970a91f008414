"""What a beacon tells of itself: the answer to a query for `uwb/v1/{site}/{beacon}/info`, as JSON."""

from __future__ import annotations

from typing import Annotated, Any

import msgspec
from msgspec import Meta


class BeaconInfo(msgspec.Struct, frozen=True, omit_defaults=True):
    """Facts that stay while a beacon stands where it is. All are optional; unknown fields are ignored.

    Ranges are published as the module measured them: `bias_m` is for the reader to subtract.
    """

    height_m: (
        Annotated[
            float, Meta(ge=-1e6, le=1e6, description="antenna above the vehicles' take-off point, metres")
        ]
        | None
    ) = None
    antenna_delay_ticks: (
        Annotated[
            int, Meta(ge=0, le=65_535, description="as set in the module; a tick is 15.65 ps or 4.69 mm")
        ]
        | None
    ) = None
    bias_m: (
        Annotated[float, Meta(ge=-100.0, le=100.0, description="mean of measured less true distance, metres")]
        | None
    ) = None
    sigma_m: (
        Annotated[
            float, Meta(gt=0.0, le=1_000.0, description="one standard deviation at a fixed place, metres")
        ]
        | None
    ) = None
    calibrated: Annotated[str, Meta(max_length=64, description="when and how, in words")] | None = None
    module: Annotated[str, Meta(max_length=64, description="hardware and firmware, in words")] | None = None


def encode(info: BeaconInfo) -> bytes:
    """As it is on the wire."""
    return msgspec.json.encode(info)


_decode = msgspec.json.Decoder(BeaconInfo).decode
_decode_many = msgspec.json.Decoder(dict[str, BeaconInfo]).decode


def decode(payload: bytes) -> BeaconInfo:
    """Read and validate. Raises ValueError: not JSON, or a field is out of range."""
    try:
        return _decode(payload)
    except RecursionError:
        raise ValueError("nested too deep") from None


def decode_many(text: bytes) -> dict[str, BeaconInfo]:
    """A file of several beacons: `{"b1": {"height_m": 1.2}, …}`. Raises ValueError."""
    try:
        return _decode_many(text)
    except RecursionError:
        raise ValueError("nested too deep") from None


def schema() -> dict[str, Any]:
    """The JSON Schema."""
    return msgspec.json.schema(BeaconInfo)
