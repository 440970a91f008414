"""The shape that every guidance scheme has, and the values that pass through it.

A scheme is five plain functions over Structs or NamedTuples of floats: no clock, no I/O, no arrays, so that
the flying process runs them as they stand and numba compiles them as they stand for batches. The paper's
frame holds everywhere (see `companion.types`): yaw rates counter-clockwise positive, θ > 0: the target is on
the right.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec

PROBE = 0
"""Turning to find out where the target is."""
TRACK = 1
"""Flying to it."""
REST = 2
"""Inside the capture radius, speed zero."""
STAY = 3
"""At the station: standing, creeping back where a drift carries it off, or on the circle around it."""
REFUSE = 4
"""The beacons do not tell where the station is (they lie in one line): it cannot be flown to."""
UNKNOWN_M = 1e6
"""`sigma_d_m` of a `Knowledge` before the first estimate: then its d_m and theta_rad mean nothing."""


class Knowledge(msgspec.Struct, frozen=True, gc=False):
    """What an observer knows: horizontal distance, bearing θ in (−π, π], one-sigma of each."""

    d_m: float
    theta_rad: float
    sigma_d_m: float
    sigma_theta_rad: float


class Command(msgspec.Struct, frozen=True, gc=False):
    """What is asked for: forward speed, yaw rate, and its purpose (PROBE, TRACK, REST, STAY, REFUSE)."""

    v_m_s: float
    omega_rad_s: float
    purpose: int


class Scheme(NamedTuple):
    """One guidance scheme. `p` is the record of its parameters, `s` that of its state.

    - `initial(p) -> s`
    - `predict(p, s, dt_s, forward_m_s, left_m_s, yaw_rate_rad_s) -> s`: the vehicle moved so for dt_s
      (body axes, measured where the autopilot tells it, else modelled);
    - `update(p, s, beacon, range_m, sigma_m, dh_m, sigma_dh_m) -> s`: one slant range from beacon number
      `beacon` (0 for target capture), dh_m = vehicle height − beacon height with its one-sigma;
      `s.accepted` is 1.0 if the innovation gate believed it, else 0.0;
    - `command(p, s, dt_s, yaw_rate_rad_s) -> (s, Command)`: the yaw rate measured now, dt_s since the last
      call;
    - `knowledge(p, s) -> Knowledge`.
    """

    p: Any
    initial: Callable[..., Any]
    predict: Callable[..., Any]
    update: Callable[..., Any]
    command: Callable[..., tuple[Any, Command]]
    knowledge: Callable[..., Knowledge]
