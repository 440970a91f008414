"""How wrong the autopilot's own estimate is: seeded, slowly varying errors, held against recorded flights.

Each error is a constant draw plus a second-order Gauss-Markov process (white noise through two equal lags),
whose correlation is (1 + t/τ) exp(−t/τ): recorded errors are that smooth. The autopilot regulates its
estimate, so the truth is what moves: `px4.py` subtracts these errors from what it commands.
"""

from __future__ import annotations

from math import exp, sqrt
from typing import NamedTuple

from sitl_mock.noise import Noise
from sitl_mock.scenario import TelemetryKind
from sitl_mock.vehicle import STEP_S

_STEPS = 5
"""The errors move every fifth step: they vary over seconds."""
_UPDATE_S = _STEPS * STEP_S


class Spread(NamedTuple):
    """One error: standard deviation of its constant part and of its varying part, and the latter's τ."""

    constant: float
    varying: float
    tau_s: float


class Quality(NamedTuple):
    """The errors of one kind of vehicle; SI units."""

    position: Spread
    height: Spread
    velocity: Spread
    climb: Spread
    heading: Spread
    yaw_rate_noise_rad_s: float


_NONE = Spread(0.0, 0.0, 1.0)
QUALITY: dict[TelemetryKind, Quality] = {
    "perfect": Quality(_NONE, _NONE, _NONE, _NONE, _NONE, 0.0),
    "none": Quality(_NONE, _NONE, _NONE, _NONE, _NONE, 0.0),
    # Recorded over 130 s of turning flight: sensor noise × 0.1.
    "quiet": Quality(
        position=Spread(0.013, 0.0165, 1.7),
        height=Spread(0.03, 0.045, 4.2),
        velocity=Spread(0.0, 0.024, 1.4),
        climb=Spread(0.0, 0.0164, 2.9),
        heading=Spread(0.002, 0.008, 5.0),
        yaw_rate_noise_rad_s=0.0032,
    ),
    # The same flight with stock noise, which is a poor GPS.
    "stock": Quality(
        position=Spread(0.14, 0.155, 1.7),
        height=Spread(0.33, 0.4, 4.2),
        velocity=Spread(0.02, 0.235, 1.3),
        climb=Spread(0.0, 0.168, 2.0),
        heading=Spread(0.077, 0.075, 8.0),
        yaw_rate_noise_rad_s=0.0142,
    ),
}


class _Error:
    """One error process, stationary from its first step."""

    __slots__ = ("_first", "_gain", "_noise", "_second", "constant", "value")

    def __init__(self, spread: Spread, noise: Noise) -> None:
        decay = exp(-_UPDATE_S / spread.tau_s)
        # A lag fed by a lag of equal τ has half its variance: the first one varies by √2 more.
        sigma = spread.varying * sqrt(2.0)
        self._gain = 1.0 - decay
        self._noise = sigma * sqrt(1.0 - decay * decay)
        self._first = noise.gauss(sigma)
        self._second = 0.5 * self._first + noise.gauss(0.5 * sigma)
        self.constant = noise.gauss(spread.constant)
        self.value = self.constant + self._second

    def step(self, gauss: float) -> None:
        self._second += self._gain * (self._first - self._second)
        self._first += self._noise * gauss - self._gain * self._first
        self.value = self.constant + self._second


class EstimateErrors:
    """Estimate minus truth at this moment, in the local frame. `step` advances by STEP_S."""

    __slots__ = (
        "_climb",
        "_drift_x",
        "_drift_y",
        "_errors",
        "_heading",
        "_height",
        "_noise",
        "_perfect",
        "_vx",
        "_vy",
        "_wait",
        "_x",
        "_y",
        "_yaw_noise",
        "climb_m_s",
        "heading_rad",
        "height_m",
        "vx_m_s",
        "vy_m_s",
        "x_m",
        "y_m",
    )

    def __init__(self, kind: TelemetryKind, seed: int, drift_x_m_s: float, drift_y_m_s: float) -> None:
        quality = QUALITY[kind]
        self._noise = Noise(f"{seed}/estimate")
        self._perfect = kind in ("perfect", "none")
        self._x, self._y = _Error(quality.position, self._noise), _Error(quality.position, self._noise)
        self._vx, self._vy = _Error(quality.velocity, self._noise), _Error(quality.velocity, self._noise)
        self._height = _Error(quality.height, self._noise)
        self._climb = _Error(quality.climb, self._noise)
        self._heading = _Error(quality.heading, self._noise)
        self._errors = (self._x, self._y, self._vx, self._vy, self._height, self._climb, self._heading)
        self._yaw_noise = quality.yaw_rate_noise_rad_s
        self._drift_x, self._drift_y = drift_x_m_s, drift_y_m_s
        self._wait = _STEPS
        # The autopilot does not see the drift: its position lags further and further behind the truth.
        self._take()

    def step(self) -> None:
        """Advance by STEP_S."""
        self._wait -= 1
        if self._wait:
            return
        self._wait = _STEPS
        self._x.constant -= self._drift_x * _UPDATE_S
        self._y.constant -= self._drift_y * _UPDATE_S
        if self._perfect:
            self._x.value, self._y.value = self._x.constant, self._y.constant
            self.x_m, self.y_m = self._x.value, self._y.value
            return
        for error in self._errors:
            error.step(self._noise.gauss(1.0))
        self._take()

    def yaw_rate_noise(self) -> float:
        """Draw the error of one yaw-rate measurement, rad/s."""
        return self._noise.gauss(self._yaw_noise) if self._yaw_noise else 0.0

    def _take(self) -> None:
        self.x_m, self.y_m = self._x.value, self._y.value
        self.vx_m_s = self._vx.value - self._drift_x
        self.vy_m_s = self._vy.value - self._drift_y
        self.height_m = self._height.value
        self.climb_m_s = self._climb.value
        self.heading_rad = self._heading.value
