"""Seeded noise: the numbers of Python's `random.Random`, in a form that can be compiled.

`Random.gauss` is Python itself, and was an eighth of a compiled simulated flight.
"""

from __future__ import annotations

from math import cos, log, pi, sin, sqrt
from random import Random


class Noise:
    """One stream. The same seed gives the same numbers as `Random` does, draw for draw."""

    __slots__ = ("_other", "_random")

    def __init__(self, seed: str) -> None:
        self._random = Random(seed)
        self._other: float | None = None

    def random(self) -> float:
        """Evenly from [0, 1)."""
        return self._random.random()

    def uniform(self, low: float, high: float) -> float:
        """Evenly from [low, high)."""
        return low + (high - low) * self._random.random()

    def gauss(self, sigma: float) -> float:
        """Normally about zero. Two numbers come at once (Box and Muller); the other waits."""
        normal, self._other = self._other, None
        if normal is None:
            angle = self._random.random() * 2.0 * pi
            length = sqrt(-2.0 * log(1.0 - self._random.random()))
            normal, self._other = cos(angle) * length, sin(angle) * length
        return normal * sigma
