"""A compiled plant: a vehicle with first-order lags, a beacon, ranges with dropouts and reflections.

Independent of `companion.guidance.model`: it integrates the pose in small steps and never sees the lift.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import numba
import numpy as np

from companion.guidance.model import shortest_path_m
from companion.guidance.scheme import REST, Scheme

from .compiled import compiled_scheme

PERIOD_S = 0.05
SUBSTEPS = 5
REST_S = 3.0


class Plant(NamedTuple):
    """What the flight is like; the defaults are the nominal case."""

    radius_m: float = 0.5
    sigma_m: float = 0.07
    dropout: float = 0.1
    reflected: float = 0.05
    yaw_rate_lag_s: float = 0.2
    speed_lag_s: float = 0.3
    height_m: float = 0.0
    limit_s: float = 300.0


IDEAL = Plant(dropout=0.0, reflected=0.0, yaw_rate_lag_s=0.0, speed_lag_s=0.0)


class Start(NamedTuple):
    """Distance, bearing, and the seed of the noise."""

    d_m: float
    theta_rad: float
    seed: int


class Flight(NamedTuple):
    """Time and path until the vehicle was truly inside the radius (time infinite: never), and the true
    distance after the scheme had rested for 3 s (infinite: it never did)."""

    time_s: float
    path_m: float
    rest_m: float


def flyer(scheme: Scheme) -> Callable[[Plant, Start], Flight]:
    """A compiled function that flies the scheme once."""
    _, initial, predict, update, command, _ = compiled_scheme(scheme)
    p = scheme.p

    @numba.njit
    def fly(p: Any, plant: Plant, start: Start) -> Flight:
        np.random.seed(start.seed)
        x = y = heading = v = omega = 0.0
        tx = start.d_m * math.cos(start.theta_rad)
        ty = -start.d_m * math.sin(start.theta_rad)
        h = PERIOD_S / SUBSTEPS
        keep_omega = math.exp(-h / plant.yaw_rate_lag_s) if plant.yaw_rate_lag_s > 0.0 else 0.0
        keep_v = math.exp(-h / plant.speed_lag_s) if plant.speed_lag_s > 0.0 else 0.0
        s = initial(p)
        path = rested = 0.0
        time_s = path_m = math.inf
        for k in range(int(plant.limit_s / PERIOD_S)):
            d = math.hypot(tx - x, ty - y)
            if np.random.random() >= plant.dropout:
                r = math.hypot(d, plant.height_m) + np.random.normal(0.0, plant.sigma_m)
                if np.random.random() < plant.reflected:
                    r += np.random.uniform(0.5, 3.0)
                s = update(p, s, 0, max(r, 0.0), plant.sigma_m, plant.height_m, 0.0)
            s, c = command(p, s, PERIOD_S, omega)
            rested = rested + PERIOD_S if c.purpose == REST else 0.0
            if rested > REST_S and time_s < math.inf:
                return Flight(time_s, path_m, d)
            for i in range(SUBSTEPS):
                omega = c.omega_rad_s + (omega - c.omega_rad_s) * keep_omega
                v = c.v_m_s + (v - c.v_m_s) * keep_v
                s = predict(p, s, h, v, 0.0, omega)
                x += v * h * math.cos(heading + 0.5 * omega * h)
                y += v * h * math.sin(heading + 0.5 * omega * h)
                heading += omega * h
                path += v * h
                if time_s == math.inf and math.hypot(tx - x, ty - y) <= plant.radius_m:
                    time_s = k * PERIOD_S + (i + 1) * h
                    path_m = path
        return Flight(time_s, path_m, math.inf)

    return lambda plant, start: fly(p, plant, start)


def random_starts(count: int, seed: int, d_min_m: float = 3.0, d_max_m: float = 30.0) -> list[Start]:
    """Distances and bearings drawn evenly."""
    rng = np.random.default_rng(seed)
    return [
        Start(
            float(rng.uniform(d_min_m, d_max_m)), float(rng.uniform(-math.pi, math.pi)), seed * 1_000_003 + k
        )
        for k in range(count)
    ]


def path_ratios(
    fly: Callable[[Plant, Start], Flight],
    plant: Plant,
    starts: Iterable[Start],
    v_m_s: float,
    omega_rad_s: float,
) -> tuple[np.ndarray[Any, np.dtype[np.float64]], np.ndarray[Any, np.dtype[np.float64]]]:
    """Path over shortest path of every flight (infinite: not captured), and the distances at rest."""
    ratios, rests = [], []
    for start in starts:
        flight = fly(plant, start)
        ratios.append(
            flight.path_m / shortest_path_m(start.d_m, start.theta_rad, plant.radius_m, v_m_s, omega_rad_s)
        )
        rests.append(flight.rest_m)
    return np.array(ratios), np.array(rests)
