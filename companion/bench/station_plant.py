"""A plant with several beacons, for schemes that keep a station: random layouts, lags, drift, reflections."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from typing import Any, NamedTuple

from companion.bench.plant import shortest_time_s
from companion.guidance import station_fit
from companion.guidance.model import wrap
from companion.guidance.scheme import STAY, Scheme
from companion.guidance.station_steer import Situation

Point = tuple[float, float]

PERIOD_S = 0.05
"""Between two commands, and between two ranges of a beacon."""
SUBSTEPS = 2
"""Steps of the plant in a period."""


class Field(NamedTuple):
    """The station and the beacons; the vehicle starts at the origin with heading 0."""

    station: Point
    beacons: tuple[Point, ...]

    @property
    def distances_m(self) -> tuple[float, ...]:
        """What is told of the station: d_i*."""
        return tuple(math.dist(b, self.station) for b in self.beacons)

    @property
    def bearings_rad(self) -> tuple[float, ...]:
        """θ of each beacon at the start, which the paper takes as known."""
        return tuple(wrap(-math.atan2(y, x)) for x, y in self.beacons)


class Air(NamedTuple):
    """What the flight is like; the defaults are the nominal case, as for target capture."""

    radius_m: float = 0.3
    sigma_m: float = 0.07
    dropout: float = 0.1
    reflected: float = 0.05
    yaw_rate_lag_s: float = 0.2
    speed_lag_s: float = 0.3
    drift_m_s: float = 0.0
    drift_azimuth_rad: float = 0.0
    limit_s: float = 300.0
    hold_s: float = 60.0


class Stayed(NamedTuple):
    """One flight, judged by the truth.

    When the scheme said first that it stays (infinite: never); the path flown through the air until the
    station was entered last before that (infinite: it was not inside then); rms and greatest true distance
    from then on; whether the vehicle was ever within the radius; the scheme's last state.
    """

    time_s: float
    path_m: float
    rms_m: float
    worst_m: float
    entered: bool
    state: Any


class Moment(NamedTuple):
    """What is so when a command is given: the true pose and distance from the station, and the command."""

    t_s: float
    x_m: float
    y_m: float
    heading_rad: float
    d_m: float
    v_m_s: float
    omega_rad_s: float


def random_field(rng: random.Random, count: int = 3) -> Field:
    """Station 3 to 30 m away, beacons 3 to 10 m around it, all evenly drawn; drawn again where the beacons
    lie almost in a line (a tenth as wide as long), or almost in one line seen from the station (GDOP > 3)."""
    while True:
        d, a = rng.uniform(3.0, 30.0), rng.uniform(-math.pi, math.pi)
        at = (d * math.cos(a), d * math.sin(a))
        beacons = _around(at, rng, count)
        if beacons:
            return Field(at, beacons)


def random_beacons(at: Point, seed: int) -> tuple[Point, ...]:
    """Three beacons around a given station, as in `random_field`."""
    rng = random.Random(f"{seed}/beacons")
    while not (beacons := _around(at, rng, 3)):
        pass
    return beacons


def _around(at: Point, rng: random.Random, count: int) -> tuple[Point, ...]:
    """Beacons around a station, none where they lie badly."""
    rays = [(rng.uniform(3.0, 10.0), rng.uniform(-math.pi, math.pi)) for _ in range(count)]
    beacons = tuple((at[0] + r * math.cos(b), at[1] + r * math.sin(b)) for r, b in rays)
    of = station_fit.shape(beacons)
    xx = sum(math.cos(b) ** 2 for _, b in rays)
    xy = sum(math.cos(b) * math.sin(b) for _, b in rays)
    lie_well = of.across_m > 0.1 * of.along_m and xx * (count - xx) - xy * xy > count / 9.0
    return beacons if lie_well else ()


def untold(s: Any, truth: Situation) -> Any:
    """Whoever flies is not told the truth."""
    return s


def fly(
    scheme: Scheme,
    field: Field,
    seed: int,
    air: Air,
    heard: Callable[[int, float], bool] = lambda beacon, t_s: True,
    watch: Callable[[Moment], None] = lambda moment: None,
    tell: Callable[[Any, Situation], Any] = untold,
) -> Stayed:
    """Fly once; `heard` tells whether a beacon works at a time, `watch` sees every command."""
    rng = random.Random(seed)
    p = scheme.p
    s = scheme.initial(p)
    sx, sy = field.station
    x = y = heading = v = omega = t = path = 0.0
    path_in = math.inf
    wx = air.drift_m_s * math.cos(air.drift_azimuth_rad)
    wy = air.drift_m_s * math.sin(air.drift_azimuth_rad)
    h = PERIOD_S / SUBSTEPS
    keep_omega, keep_v = math.exp(-h / air.yaw_rate_lag_s), math.exp(-h / air.speed_lag_s)
    stays_s = math.inf
    entered = False
    worst = 0.0
    squares = []
    while t < air.limit_s and t < stays_s + air.hold_s:
        for i, (bx, by) in enumerate(field.beacons):
            if rng.random() >= air.dropout and heard(i, t):
                r = math.hypot(bx - x, by - y) + rng.gauss(0.0, air.sigma_m)
                if rng.random() < air.reflected:
                    r += rng.uniform(0.5, 3.0)
                s = scheme.update(p, s, i, max(r, 0.01), air.sigma_m, 0.0, 0.0)
        truth = Situation(sx - x, sy - y, heading, v * math.cos(heading), v * math.sin(heading), wx, wy)
        s, wanted = scheme.command(p, tell(s, truth), PERIOD_S, omega)
        d = math.dist(field.station, (x, y))
        entered = entered or d <= air.radius_m
        watch(Moment(t, x, y, heading, d, wanted.v_m_s, wanted.omega_rad_s))
        if stays_s < math.inf:
            worst = max(worst, d)
            squares.append(d * d)
        else:
            if d > air.radius_m:
                path_in = math.inf
            elif path_in == math.inf:
                path_in = path
            if wanted.purpose == STAY:
                stays_s, worst = t, d
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
    return Stayed(stays_s, path_in, rms, worst if squares else math.inf, entered, s)


def bound_m(field: Field, air: Air, v_m_s: float, omega_rad_s: float) -> float:
    """The shortest path through the air to the disc around the station, with the turn bound, drift known."""
    sx, sy = field.station
    wx = air.drift_m_s * math.cos(air.drift_azimuth_rad)
    wy = air.drift_m_s * math.sin(air.drift_azimuth_rad)
    d, theta = math.hypot(sx, sy), -math.atan2(sy, sx)
    return v_m_s * shortest_time_s(d, theta, air.radius_m, v_m_s, omega_rad_s, wx, wy)
