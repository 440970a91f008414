"""Steady rates on a grid of fixed steps."""

from __future__ import annotations

from sitl_mock.vehicle import STEP_S


class Clock:
    """Says when something at a steady rate is due on a grid of steps."""

    __slots__ = ("_interval", "at")

    def __init__(self, rate_hz: float, phase: float = 0.0) -> None:
        self._interval = 1.0 / (rate_hz * STEP_S)
        self.at = 1.0 + phase * self._interval
        """It is due at the first whole step from here on: quicker to look at than `due` is to call."""

    def due(self, step: int) -> int:
        """How often since the last call."""
        count = 0
        while self.at <= step:
            self.at += self._interval
            count += 1
        return count
