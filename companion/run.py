"""The loop that one reads first. Live flight, simulation and replay differ only in what they pass in."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from companion import pilot
from companion.compiled import native, twin
from companion.settings import Settings
from companion.state import State
from companion.types import Event, Output


def run(
    events: Iterable[Event],
    settings: Settings,
    send: Callable[[Output], None],
    record: Callable[[Event | Output], None],
) -> State:
    """Fly: feed each event to the pilot and send what it decides, until the flight is over."""
    return Flying(settings, send, record).run(events)


class Flying:
    """A flight under way: the one place where events go in and outputs leave. For one thread at a time."""

    def __init__(
        self,
        settings: Settings,
        send: Callable[[Output], None],
        record: Callable[[Event | Output], None],
    ) -> None:
        self._step = twin(pilot.step)
        self._plan = twin(pilot.plan)(native(settings))
        self._state = twin(pilot.initial)(self._plan)
        self._send, self._record = send, record
        self._is_over = False

    def run(self, events: Iterable[Event]) -> State:
        """Take event after event, until the flight is over."""
        for event in events:
            self.take(event)
            if self._is_over:
                break
        return self._state

    def take(self, event: Event) -> None:
        """Feed one event to the pilot and send what it decides; once the flight is over, nothing any more."""
        if self._is_over:
            return
        self._record(event)  # critical: before it is used, so that the record holds the exact inputs
        self._state, outputs = self._step(self._plan, self._state, event)
        for output in outputs:
            self._record(output)
            self._send(output)  # critical: nothing else ever sends; when nothing is taken, there is silence
        self._is_over = self._state.phase.is_final
