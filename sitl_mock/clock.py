"""Steady rates on a grid of fixed steps."""

from __future__ import annotations

from sitl_mock.vehicle import STEP_S


class Clock:
    """Says when something at a steady rate is due on a grid of steps."""

    __slots__ = ("_interval", "_next")

    def __init__(self, rate_hz: float, phase: float = 0.0) -> None:
        self._interval = 1.0 / (rate_hz * STEP_S)
        self._next = 1.0 + phase * self._interval

    def due(self, step: int) -> int:
        """How often since the last call."""
        count = 0
        while self._next <= step:
            self._next += self._interval
            count += 1
        return count
