"""The loop of a real flight: the ranges, the vehicle and the clock, in the order in which they come.

Whoever holds the loop's lock runs the turn. That is the main thread, but while it sleeps. A range that comes
then is taken in Zenoh's own thread, there and then: to wake the main thread for it took longer than the step
(0.2 ms, and 0.5 ms one time in ten, beside an interpreter that two threads want at once).
"""

from __future__ import annotations

import os
import select
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator

from companion.link.mavlink import VehicleLink
from companion.link.zenoh_ranges import RangeLink
from companion.run import Flying
from companion.settings import Settings
from companion.state import State
from companion.types import Event, ModeRequest, Output, RangeVerdict, Setpoint, StopRequest, Tick

_SLEEP_MS = 25
"""The longest sleep; half the stream's longest period where that is less. It is not cut short for the next
tick: ranges that are answered meanwhile put that off, and a third of all wakes would be for nothing.
Telemetry, at the rate asked for by default, comes sooner."""
_TICK_SHARE = 0.6
"""Whenever the loop is awake it ticks, if there was neither a tick nor a setpoint, a step as much as the
other, for this share of a sleep. What lies between two steps, the resolution of timeouts and of the stream's
minimum rate, is a sleep, and this on top where something woke the loop just before a tick was due: 40 ms at
most. No timeout's default is less than ten times that."""
_PAUSE_NS = 250_000_000
"""A loop that stood still for longer is told so first; less than any `loss.held_up_after_s`."""
_HUNG_NS = 125_000_000
"""A main thread whose last turn began longer ago (five sleeps) hangs or was held up: ranges are left to
it. It alone hears the telemetry, and with it the pilot who takes over. Less than `_PAUSE_NS`, so that after
a pause the tick comes first whichever thread runs first."""


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


class Loop:
    """A real flight, from its first event to its last.

    The main thread holds the lock but while it sleeps. So nobody else steers before its first turn, while it
    works or hangs, or once it has left the loop, in whatever way: it keeps the lock then.
    """

    def __init__(
        self,
        settings: Settings,
        vehicle: VehicleLink,
        ranges: RangeLink,
        bell: Bell,
        tell: Callable[[Output], None],
        record: Callable[[Event | Output], None],
    ) -> None:
        """`record` takes everything in either thread, one at a time, and must not wait. `tell` takes what is
        not for the vehicle and the record alone, after the vehicle, in the main thread."""
        self._vehicle, self._ranges, self._bell, self._tell = vehicle, ranges, bell, tell
        self._flying = Flying(settings, self._send, record)
        self._lock = threading.Lock()
        self._lock.acquire()
        self._is_asleep = False
        self._untold: deque[Output] = deque()
        self._bug: Exception | None = None
        self._t_turn_ns = 0
        self._sleep_ms = min(_SLEEP_MS, int(500.0 / settings.stream.min_rate_hz))
        self._tick_ns = int(_TICK_SHARE * 1e6 * self._sleep_ms)
        self._t_step_ns = -self._tick_ns
        """When a tick was given, or a setpoint left, last."""
        ranges.wake = self._wake

    def fly(self) -> State:
        """Fly until the flight is over. Raises what a step or a link raises, in whichever thread."""
        return self._flying.run(self._events())

    def _events(self) -> Iterator[Event]:
        """What the main thread takes.

        A range or a telemetry message is yielded as soon as it arrives; a tick where no setpoint has left for
        most of a sleep. Whoever iterates more slowly gets fewer ticks, never a backlog of them. After a pause
        the tick comes first: ranges that waited bear the times at which they came, as if there had been none.
        """
        waiting = select.poll()  # not `selectors`: its wrapping costs more than the system call
        telemetry, rung = self._vehicle.fileno(), self._bell.fileno()
        waiting.register(telemetry, select.POLLIN)
        waiting.register(rung, select.POLLIN)
        clock = time.monotonic_ns  # looked up once
        self._t_turn_ns = clock()
        stopped = False
        while True:
            ready = self._sleep(waiting)
            while self._untold:
                self._tell(self._untold.popleft())
            if self._bug is not None:
                raise self._bug
            now_ns = clock()
            if now_ns - self._t_turn_ns > _PAUSE_NS:
                yield Tick(t_ns=now_ns)  # critical: the pilot must see that it was held up before it steers
            self._t_turn_ns = now_ns
            if rung in ready:
                self._bell.silence()
                yield from self._ranges.receive()
            if telemetry in ready:
                yield from self._vehicle.receive()
            now_ns = clock()
            if self._bell.stop_asked and not stopped:
                stopped = True
                yield StopRequest(t_ns=now_ns)
            if now_ns >= self._t_step_ns + self._tick_ns:
                self._t_step_ns = now_ns
                yield Tick(t_ns=now_ns)

    def _sleep(self, waiting: select.poll) -> list[int]:
        """The descriptors that are ready. The only time in which another thread may have the lock."""
        self._is_asleep = True
        self._lock.release()
        try:
            return [descriptor for descriptor, _ in waiting.poll(self._sleep_ms)]
        finally:
            self._lock.acquire()
            self._is_asleep = False

    def _wake(self) -> None:
        """In Zenoh's thread, when something has come: take it now, or leave it to the main thread.

        Nothing is missed: whoever holds the lock may have looked for ranges already, but the bell rings on,
        and the main thread looks once more.
        """
        if not self._lock.acquire(False):  # at once or not at all
            self._bell.ring()
            return
        is_done = False
        try:
            is_done = self._take_ranges()
        except Exception as error:  # a bug must not die unnoticed in this thread: the main thread raises it
            self._bug = error
        finally:
            self._lock.release()
        if not is_done:
            self._bell.ring()

    def _take_ranges(self) -> bool:
        """In Zenoh's thread, with the lock; False: there is something for the main thread to do."""
        if self._bug is not None or time.monotonic_ns() - self._t_turn_ns > _HUNG_NS:
            return False  # critical: nobody steers past a bug, nor past telemetry that is not heard
        for event in self._ranges.receive():
            self._flying.take(event)
        return not self._untold

    def _send(self, output: Output) -> None:
        """To the vehicle at once, in either thread: no transport waits. To everybody else when awake."""
        kind = type(output)  # `isinstance` asks its metaclass: a thousand instructions to say no
        if kind is RangeVerdict:
            return  # for the record alone; asked first, as every range has one
        self._vehicle.send(output)
        if kind is Setpoint:
            self._t_step_ns = output.t_ns
        elif kind is ModeRequest:
            return  # for the vehicle and the record alone
        elif self._is_asleep:
            self._untold.append(output)
        else:
            self._tell(output)
