"""Live events: the ranges, the vehicle and the clock, in the order in which they come, on one thread."""

from __future__ import annotations

import math
import os
import select
import time
from collections.abc import Iterator

from companion.link.mavlink import VehicleLink
from companion.link.zenoh_ranges import RangeLink
from companion.types import Event, StopRequest, Tick

TICK_NS = 25_000_000
"""The longest time without a tick: resolution of timeouts and of the stream's minimum rate."""
_TICK_EARLY_NS = 10_000_000
"""When the loop is awake anyway, it ticks after this: to be woken for a tick costs more than the tick."""
_PAUSE_NS = 250_000_000
"""A loop that stood still for longer is told so first; less than any `loss.held_up_after_s`."""


class Bell:
    """Wakes the loop from another thread or a signal handler."""

    def __init__(self) -> None:
        self._reader, self._writer = os.pipe()
        os.set_blocking(self._reader, False)
        os.set_blocking(self._writer, False)
        self.stop_asked = False

    def ring(self) -> None:
        """Wake the loop; a full pipe means that it is awake already."""
        try:  # not `suppress`: this is on the way of every range
            os.write(self._writer, b"\0")
        except BlockingIOError:
            return

    def ask_stop(self) -> None:
        """Wake the loop and end the flight in an orderly way."""
        self.stop_asked = True
        self.ring()

    def fileno(self) -> int:
        """The descriptor to wait on."""
        return self._reader

    def silence(self) -> None:
        """Take back the rings so far. Of more than fit in one go the rest wakes once more."""
        try:
            os.read(self._reader, 4096)
        except BlockingIOError:
            return

    def close(self) -> None:
        """Give both ends back."""
        os.close(self._reader)
        os.close(self._writer)
        self._reader = self._writer = -1  # a late ring fails, instead of going to who has the number next


def live(vehicle: VehicleLink, ranges: RangeLink, bell: Bell) -> Iterator[Event]:
    """Every event of a real flight, for as long as it is asked for.

    A range or a telemetry message is yielded as soon as it arrives; a tick at least every `TICK_NS`. Whoever
    iterates more slowly gets fewer ticks, never a backlog of them. After a pause the tick comes first: ranges
    that waited bear the times at which they came, as if there had been none.
    """
    waiting = select.poll()  # not `selectors`: its wrapping costs more than the system call
    telemetry, rung = vehicle.fileno(), bell.fileno()
    waiting.register(telemetry, select.POLLIN)
    waiting.register(rung, select.POLLIN)
    next_tick_ns, last_turn_ns = 0, time.monotonic_ns()
    stopped = False
    while True:
        wait_ms = math.ceil((next_tick_ns - time.monotonic_ns()) * 1e-6)
        ready = [descriptor for descriptor, _ in waiting.poll(max(0, wait_ms))]
        now_ns = time.monotonic_ns()
        if now_ns - last_turn_ns > _PAUSE_NS:
            yield Tick(t_ns=now_ns)  # critical: the pilot must see that it was held up before it steers again
        last_turn_ns = now_ns
        if rung in ready:
            bell.silence()
            yield from ranges.receive()
        if telemetry in ready:
            yield from vehicle.receive()
        now_ns = time.monotonic_ns()
        if bell.stop_asked and not stopped:
            stopped = True
            yield StopRequest(t_ns=now_ns)
        if now_ns >= next_tick_ns - (TICK_NS - _TICK_EARLY_NS):
            next_tick_ns = now_ns + TICK_NS
            yield Tick(t_ns=now_ns)
