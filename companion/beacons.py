"""What is known of each beacon, and what a measured range comes to with that."""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace

from companion.network_settings import BeaconSettings, RangesSettings
from companion.types import BeaconTold, LineOfSight, RangeSample


class Beacon(msgspec.Struct, frozen=True, gc=False):
    """What holds of a beacon: configuration, and where that is silent what the beacon tells of itself."""

    number: int
    """In the guidance scheme."""
    sigma_m: float
    height_m: float = 0.0
    bias_m: float = 0.0
    bias_per_m: float = 0.0
    bias_per_db: float = 0.0
    power_dbm: float = 0.0
    contradiction: str = ""
    """Where the beacon tells otherwise than the configuration, in words."""


def configured(number: int, b: BeaconSettings) -> Beacon:
    """What the configuration says of a beacon."""
    return Beacon(
        number,
        b.sigma_m,
        b.height_m or 0.0,
        b.bias_m or 0.0,
        b.bias_per_m,
        b.bias_per_db,
        b.power_dbm,
    )


def told(beacon: Beacon, b: BeaconSettings, e: BeaconTold) -> Beacon:
    """The same with what the beacon tells of itself: the configuration wins, a contradiction is named."""
    said = []
    for name, ours_m, theirs_m in (("height", b.height_m, e.height_m), ("bias", b.bias_m, e.bias_m)):
        if ours_m is not None and theirs_m is not None and abs(ours_m - theirs_m) > 0.01:
            said.append(f"{name} {theirs_m:g} m, the configuration {ours_m:g} m")
    return replace(
        beacon,
        height_m=_first(b.height_m, e.height_m),
        bias_m=_first(b.bias_m, e.bias_m),
        contradiction=f"{e.beacon} tells {' and '.join(said)}, which counts" if said else "",
    )


def _first(*values: float | None) -> float:
    return next((value for value in values if value is not None and math.isfinite(value)), 0.0)


def range_m(beacon: Beacon, sample: RangeSample) -> float:
    """The measured distance without its bias: subtracted here, and nowhere else."""
    measured_m = sample.range_m - beacon.bias_m
    if beacon.bias_per_db and sample.rssi_dbm is not None:
        measured_m -= beacon.bias_per_db * (sample.rssi_dbm - beacon.power_dbm)
    return measured_m / (1.0 + beacon.bias_per_m)


def sigma_m(cfg: RangesSettings, sample: RangeSample, default_m: float) -> float:
    """The range's one-sigma: its own or the beacon's, widened where the signal was not in line of sight."""
    sigma = default_m if sample.sigma_m is None else max(sample.sigma_m, 0.2 * default_m)
    return sigma * cfg.nlos_sigma_factor if sample.los is LineOfSight.NLOS else sigma
