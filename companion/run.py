"""The loop that one reads first. Live flight, simulation and replay differ only in what they pass in."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from companion import pilot
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
    plan = pilot.plan(settings)
    state = pilot.initial(plan)
    for event in events:
        record(event)  # critical: before it is used, so that the record holds the exact inputs
        state, outputs = pilot.step(plan, state, event)
        for output in outputs:
            record(output)
            send(output)  # critical: nothing else ever sends; when this loop stops, the vehicle hears silence
        if state.phase.is_final:
            break
    return state
