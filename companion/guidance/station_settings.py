"""The settings of station keeping; the text under a key is its documentation."""

from __future__ import annotations

import math
from typing import Annotated

import msgspec
from msgspec import Meta


class StationSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """How a station given by its distances from beacons is found, reached and kept."""

    radius_m: Annotated[float, Meta(gt=0.0, le=50.0)] = 0.3
    """The vehicle is at the station within this horizontal distance, ε of the paper."""
    can_stop: bool = True
    """false: the vehicle cannot stop; it flies the smallest circle around the station."""
    drift_sigma_m_s: Annotated[float, Meta(gt=0.0, le=2.0)] = 0.15
    """One sigma, per axis, of the drift (wind, error of the velocity) before anything is known of it."""
    probe_turn_s: Annotated[float, Meta(ge=0.0, le=60.0)] = 1.0
    """The vehicle turns at the largest yaw rate for at least this long before it steers."""
    probe_sigma_rad: Annotated[float, Meta(gt=0.0, le=math.pi)] = 0.3
    """It goes on turning while one sigma of the station's bearing is above this."""
    search_max_s: Annotated[float, Meta(gt=0.0, le=120.0)] = 12.0
    """After this long it takes the most probable station, ambiguous or not."""
    memory_s: Annotated[float, Meta(gt=0.0, le=3600.0)] = 30.0
    """Time constant with which old ranges are forgotten while the beacons are being located."""
    map_sigma_m: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.15
    """The beacons' places are kept once one sigma of the station's is below this."""
    refit_s: Annotated[float, Meta(gt=0.0, le=10.0)] = 0.5
    """Pause between two searches for a better fit during the flight to the station."""
