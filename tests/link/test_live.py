"""The order of live events after a pause of the loop, and of a link that never falls silent."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from itertools import islice
from typing import cast

import pytest

from companion import fly as flying
from companion.link.mavlink import VehicleLink
from companion.link.zenoh_ranges import RangeLink
from companion.live import Bell, live
from companion.record import Recorder, start_now
from companion.settings import Settings, StatusSettings, VehicleSettings
from companion.types import Event, Phase, RangeSample, Setpoint, Tick
from companion.view import ViewKind, open_view
from tests.core.flights import MS, Script, engaged, fly
from tests.safety.test_check import Wire


class Still:
    """A vehicle that says nothing: the other end of a bell that nobody rings."""

    def __init__(self) -> None:
        self.bell = Bell()

    def fileno(self) -> int:
        return self.bell.fileno()


class Waiting:
    """Ranges that have waited."""

    def __init__(self) -> None:
        self.came: list[Event] = []

    def receive(self) -> Iterator[Event]:
        while self.came:
            yield self.came.pop(0)


def test_ranges_that_waited_while_the_loop_stood_still_do_not_hide_that(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    script = Script()
    before = engaged(script)
    now_ns = script.t_ms * MS
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns)
    bell, still, ranges = Bell(), Still(), Waiting()
    events = live(cast(VehicleLink, still), cast(RangeLink, ranges), bell)
    flown = fly([next(events)], before=before)
    for n in range(1, 21):
        ranges.came.append(RangeSample(now_ns + n * 100 * MS, "b1", "s", script.seq + n, 10.0))
    bell.ring()
    now_ns += 2000 * MS
    woken = list(islice(events, 21))
    assert isinstance(woken[0], Tick)
    after = fly(woken, before=flown)
    assert after.state.phase is Phase.RELEASED
    assert not after.of(Setpoint)
    bell.close()
    still.bell.close()


def test_it_ticks_when_it_is_awake_anyway_and_otherwise_every_25_ms(monkeypatch: pytest.MonkeyPatch) -> None:
    now_ns = 0
    monkeypatch.setattr(time, "monotonic_ns", lambda: now_ns)
    bell, still, ranges = Bell(), Still(), Waiting()
    events = live(cast(VehicleLink, still), cast(RangeLink, ranges), bell)
    seen = [next(events)]
    for t_ms in (4, 12):
        now_ns = t_ms * MS
        ranges.came.append(RangeSample(now_ns, "b1", "s", t_ms, 10.0))
        bell.ring()
        seen.append(next(events))
    seen.append(next(events))
    now_ns = 37 * MS
    seen.append(next(events))
    assert [e.t_ns // MS for e in seen if isinstance(e, Tick)] == [0, 12, 37]
    bell.close()
    still.bell.close()


def test_a_link_that_is_flooded_leaves_the_loop_its_turn() -> None:
    wire, now_ns = Wire(), 0

    def clock() -> int:
        nonlocal now_ns
        now_ns += 5 * MS
        return now_ns

    wire.incoming = [b"\0"] * 1000
    list(VehicleLink(VehicleSettings(), wire).receive(clock))
    assert len(wire.incoming) > 900


def test_a_bug_in_flight_is_not_told_as_a_matter_of_the_link(monkeypatch: pytest.MonkeyPatch) -> None:
    def bug(*_: object) -> None:
        raise ValueError("math domain error")

    monkeypatch.setattr(flying, "run", bug)
    monkeypatch.setattr(flying, "_links", lambda *_: (Still(), Waiting()))
    settings = Settings(status=StatusSettings(rate_hz=0.0))
    recorder = Recorder(None, start_now(settings, "", {}), "none", "a test")
    with pytest.raises(ValueError, match="math domain"):
        flying.fly(settings, open_view(sys.stdout, ViewKind.NONE), recorder, None, None)
