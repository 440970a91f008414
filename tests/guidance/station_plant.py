"""A plant with several beacons, for schemes that keep a station: lags, drift, dropouts, reflections."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import NamedTuple

from companion.guidance.scheme import STAY, Scheme

PERIOD_S = 0.05
SUBSTEPS = 2

Point = tuple[float, float]


class Field(NamedTuple):
    """The station and the beacons; the vehicle starts at the origin with heading 0."""

    station: Point
    beacons: tuple[Point, ...]

    @property
    def distances_m(self) -> tuple[float, ...]:
        return tuple(math.dist(b, self.station) for b in self.beacons)


class Air(NamedTuple):
    """What the flight is like; the defaults are the nominal case."""

    radius_m: float = 0.3
    sigma_m: float = 0.07
    dropout: float = 0.1
    reflected: float = 0.05
    yaw_rate_lag_s: float = 0.2
    speed_lag_s: float = 0.3
    drift_m_s: float = 0.0
    drift_azimuth_rad: float = 0.0
    limit_s: float = 150.0
    hold_s: float = 30.0


class Stayed(NamedTuple):
    """When the scheme said first that it stays (infinite: never), the path flown through the air until the
    station was entered last before, rms and largest true distance from then on, and the last state."""

    time_s: float
    path_m: float
    rms_m: float
    worst_m: float
    state: object


def random_field(rng: random.Random, count: int = 3) -> Field:
    """Station 3 to 30 m away, beacons 3 to 10 m around it, drawn again where they lie almost in a line or are
    seen in almost one line from the station."""
    while True:
        d, a = rng.uniform(3.0, 30.0), rng.uniform(-math.pi, math.pi)
        station = (d * math.cos(a), d * math.sin(a))
        rays = [(rng.uniform(3.0, 10.0), rng.uniform(-math.pi, math.pi)) for _ in range(count)]
        beacons = tuple((station[0] + r * math.cos(b), station[1] + r * math.sin(b)) for r, b in rays)
        if (
            _spread(beacons) > 0.1
            and _spread([(math.cos(b), math.sin(b)) for _, b in rays], (0.0, 0.0)) > 0.35
        ):
            return Field(station, beacons)


def _spread(points: list[Point] | tuple[Point, ...], middle: Point | None = None) -> float:
    """Ratio of the smaller to the larger principal axis."""
    n = len(points)
    mx, my = middle or (sum(p[0] for p in points) / n, sum(p[1] for p in points) / n)
    xx = sum((p[0] - mx) ** 2 for p in points)
    yy = sum((p[1] - my) ** 2 for p in points)
    xy = sum((p[0] - mx) * (p[1] - my) for p in points)
    half = math.hypot(0.5 * (xx - yy), xy)
    return math.sqrt(max(0.5 * (xx + yy) - half, 0.0) / (0.5 * (xx + yy) + half))


def fly(
    scheme: Scheme,
    field: Field,
    seed: int,
    air: Air,
    heard: Callable[[int, float], bool] = lambda beacon, t_s: True,
    watch: Callable[[float, float, float, float], None] = lambda t_s, d_m, v, omega: None,
) -> Stayed:
    """Fly once; `heard` tells whether a beacon works at a time, `watch` sees every command."""
    rng = random.Random(seed)
    p = scheme.p
    s = scheme.initial(p)
    x = y = heading = v = omega = t = path = path_in = 0.0
    wx = air.drift_m_s * math.cos(air.drift_azimuth_rad)
    wy = air.drift_m_s * math.sin(air.drift_azimuth_rad)
    h = PERIOD_S / SUBSTEPS
    keep_omega, keep_v = math.exp(-h / air.yaw_rate_lag_s), math.exp(-h / air.speed_lag_s)
    rested_s = math.inf
    inside = False
    worst = 0.0
    squares = []
    while t < air.limit_s and t < rested_s + air.hold_s:
        for i, (bx, by) in enumerate(field.beacons):
            if rng.random() >= air.dropout and heard(i, t):
                r = math.hypot(bx - x, by - y) + rng.gauss(0.0, air.sigma_m)
                if rng.random() < air.reflected:
                    r += rng.uniform(0.5, 3.0)
                s = scheme.update(p, s, i, max(r, 0.01), air.sigma_m, 0.0, 0.0)
        s, wanted = scheme.command(p, s, PERIOD_S, omega)
        d = math.dist(field.station, (x, y))
        watch(t, d, wanted.v_m_s, wanted.omega_rad_s)
        if rested_s < math.inf:
            worst = max(worst, d)
            squares.append(d * d)
        elif wanted.purpose == STAY:
            rested_s = t
        if d <= air.radius_m and not inside:
            path_in = path
        inside = d <= air.radius_m
        for _ in range(SUBSTEPS):
            omega = wanted.omega_rad_s + (omega - wanted.omega_rad_s) * keep_omega
            v = wanted.v_m_s + (v - wanted.v_m_s) * keep_v
            s = scheme.predict(p, s, h, v, 0.0, omega)
            x += (v * math.cos(heading + 0.5 * omega * h) + wx) * h
            y += (v * math.sin(heading + 0.5 * omega * h) + wy) * h
            heading += omega * h
            path += v * h
            t += h
    rms = math.sqrt(sum(squares) / len(squares)) if squares else math.inf
    return Stayed(rested_s, path_in if rested_s < math.inf else math.inf, rms, worst, s)
