"""The loop of a real flight: who takes what when, and that nobody steers past a hung or ended main thread.

The main thread sleeps by script: what a test does while it sleeps, Zenoh's thread could do then.
"""

from __future__ import annotations

import select
import sys
import time
from collections.abc import Callable, Iterator
from typing import cast

import pytest

from companion import fly as flying
from companion import pilot
from companion.link.mavlink import VehicleLink
from companion.link.zenoh_ranges import RangeLink
from companion.live import Bell, Loop
from companion.record import start_now
from companion.recorder import Recorder
from companion.settings import LossSettings, Settings, StatusSettings, StreamSettings, VehicleSettings
from companion.types import (
    CompanionHeartbeat,
    Event,
    Output,
    Phase,
    PhaseChange,
    RangeSample,
    Setpoint,
    Status,
    StopRequest,
    Tick,
)
from companion.view import ViewKind, open_view
from tests.core.flights import MS, OFFBOARD, Script
from tests.safety.test_check import Wire


class Vehicle:
    """What it says next, and what it was told. Its end of the link is a bell that nobody rings."""

    def __init__(self) -> None:
        self.bell = Bell()
        self.said: list[Event] = []
        self.sent: list[Output] = []

    def fileno(self) -> int:
        return self.bell.fileno()

    def receive(self) -> Iterator[Event]:
        while self.said:
            yield self.said.pop(0)

    def send(self, output: Output) -> None:
        self.sent.append(output)


class Ranges:
    """Ranges that wait."""

    def __init__(self) -> None:
        self.came: list[Event] = []
        self.wake: Callable[[], None] = lambda: None

    def receive(self) -> Iterator[Event]:
        while self.came:
            yield self.came.pop(0)


class AwakeError(Exception):
    """The script of sleeps is over."""


class Scene:
    """A loop whose clock and sleeps are the test's."""

    def __init__(self, patch: pytest.MonkeyPatch, settings: Settings) -> None:
        self.t_ms = 0
        patch.setattr(time, "monotonic_ns", lambda: self.t_ms * MS)
        patch.setattr(select, "poll", lambda: self)
        self.bell, self.vehicle, self.ranges = Bell(), Vehicle(), Ranges()
        self.taken: list[Event] = []
        self.told: list[Output] = []
        self.longest_ms = 0
        self._seq = 0
        self.loop = Loop(
            settings,
            cast(VehicleLink, self.vehicle),
            cast(RangeLink, self.ranges),
            self.bell,
            self.told.append,
            self._record,
        )

    def _record(self, item: Event | Output) -> None:
        if isinstance(item, Event):
            self.taken.append(item)

    def register(self, descriptor: int, mask: int) -> None:
        """As a poll object."""

    def poll(self, wait_ms: int) -> list[tuple[int, int]]:
        self.longest_ms = max(self.longest_ms, wait_ms)
        try:
            ready = next(self._sleeps)
        except StopIteration:
            raise AwakeError from None
        return [(descriptor, select.POLLIN) for descriptor in ready]

    def fly(self, sleeps: Iterator[list[int]]) -> None:
        """Until the script is over: each of its parts up to a `yield` is done while the main thread sleeps,
        and yields what is ready when it wakes."""
        self._sleeps = sleeps
        with pytest.raises(AwakeError):
            self.loop.fly()

    def engaged(self) -> list[int]:
        """The vehicle tells of a flight up to OFFBOARD."""
        script = Script()
        self.vehicle.said += script.run(2.0)
        script.actual = script.intended = OFFBOARD
        self.vehicle.said += script.run(1.0)
        self.t_ms, self._seq = script.t_ms, script.seq
        return [self.vehicle.fileno()]

    def range(self, at_ms: int = 0) -> None:
        """A range comes (to the clock, or earlier), and Zenoh's thread with it."""
        self._seq += 1
        self.ranges.came.append(RangeSample((at_ms or self.t_ms) * MS, "b1", "s", self._seq, 10.0))
        self.ranges.wake()

    def setpoints(self) -> int:
        """How many have left since this was last asked."""
        count = sum(isinstance(output, Setpoint) for output in self.vehicle.sent)
        self.vehicle.sent.clear()
        return count

    def rung(self) -> list[int]:
        """The bell, where it was rung since this was last asked."""
        ready = select.select([self.bell], [], [], 0.0)[0]
        self.bell.silence()
        return [self.bell.fileno()] if ready else []


@pytest.fixture
def scene(monkeypatch: pytest.MonkeyPatch) -> Iterator[Scene]:
    made = Scene(monkeypatch, Settings())
    yield made
    made.bell.close()
    made.vehicle.bell.close()


def test_a_range_is_answered_while_the_main_thread_sleeps(scene: Scene) -> None:
    def sleeps() -> Iterator[list[int]]:
        yield scene.engaged()
        for _ in range(3):
            scene.setpoints()
            scene.t_ms += 30
            scene.range()
            assert scene.setpoints() == 1
            yield []

    scene.fly(sleeps())
    assert not scene.ranges.came
    scene.range()
    assert scene.ranges.came  # the loop was left, by an error in the midst of sleep


def test_while_the_main_thread_works_ranges_wait_for_it(scene: Scene) -> None:
    def busy(output: Output) -> None:
        if isinstance(output, Status):
            scene.setpoints()
            scene.range()
            assert scene.ranges.came
            assert not scene.setpoints()

    def sleeps() -> Iterator[list[int]]:
        yield scene.engaged()
        scene.loop._tell = busy
        scene.t_ms += 110
        yield []
        scene.loop._tell = scene.told.append
        yield scene.rung()
        assert not scene.ranges.came
        assert scene.setpoints() == 1

    scene.fly(sleeps())


def test_only_the_vehicle_hears_of_it_in_zenohs_thread_the_others_in_the_main_one(scene: Scene) -> None:
    """In order, and before what the main thread decides next."""

    def sleeps() -> Iterator[list[int]]:
        yield scene.engaged()
        scene.told.clear()
        scene.rung()
        scene.t_ms += 110  # a status is due
        scene.range()
        assert any(isinstance(output, Status) for output in scene.vehicle.sent)
        assert not scene.told
        taken = len(scene.taken)
        for number in range(110):  # and in a second a heartbeat
            scene.t_ms += 10
            if number % 10 == 0:
                yield []
        assert isinstance(scene.told[0], Status)
        assert scene.told[0].t_ns == scene.taken[taken - 1].t_ns
        assert any(isinstance(output, CompanionHeartbeat) for output in scene.told)

    scene.fly(sleeps())
    assert {type(output) for output in scene.told} <= {Status, PhaseChange, CompanionHeartbeat}
    assert [output.t_ns for output in scene.told] == sorted(output.t_ns for output in scene.told)


def test_what_zenohs_thread_has_to_tell_wakes_the_main_one(scene: Scene) -> None:
    def sleeps() -> Iterator[list[int]]:
        yield scene.engaged()
        scene.t_ms += 110
        scene.range()
        woken = scene.rung()
        assert woken
        yield woken
        scene.t_ms += 30
        scene.range()
        assert not scene.rung()  # a setpoint only

    scene.fly(sleeps())


def test_a_hung_main_thread_falls_silent_although_ranges_come(scene: Scene) -> None:
    """It alone hears the telemetry: that the pilot takes over, among the rest."""

    def sleeps() -> Iterator[list[int]]:
        yield scene.engaged()
        scene.setpoints()
        for _ in range(4):
            scene.t_ms += 30
            scene.range()
        assert scene.setpoints() == 4
        scene.rung()
        for _ in range(4):
            scene.t_ms += 30
            scene.range()
            assert scene.rung()
        assert len(scene.ranges.came) == 4
        assert not scene.setpoints()

    scene.fly(sleeps())


@pytest.mark.parametrize("zenoh_first", [True, False])
def test_ranges_that_waited_while_the_process_stood_still_do_not_hide_that(
    scene: Scene, zenoh_first: bool
) -> None:
    def sleeps() -> Iterator[list[int]]:
        yield scene.engaged()
        scene.setpoints()
        taken, began_ms = len(scene.taken), scene.t_ms
        scene.t_ms += 2000
        if not zenoh_first:
            yield []
        for n in range(1, 21):
            scene.range(began_ms + n * 100)
        yield scene.rung()
        assert isinstance(scene.taken[taken], Tick)
        assert sum(isinstance(event, RangeSample) for event in scene.taken[taken:]) == 20
        assert not scene.setpoints()

    scene.fly(sleeps())
    changes = [output for output in scene.told if isinstance(output, PhaseChange)]
    assert changes[-1].after is Phase.RELEASED


def test_a_bug_in_zenohs_thread_ends_the_flight_at_once(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    def bug(*_: object) -> None:
        raise ZeroDivisionError

    def sleeps() -> Iterator[list[int]]:
        yield scene.engaged()
        scene.setpoints()
        scene.rung()
        with monkeypatch.context() as patch:
            patch.setattr(scene.loop._flying, "_step", bug)
            scene.t_ms += 30
            scene.range()
        taken = len(scene.taken)
        scene.t_ms += 30
        scene.range()
        assert not scene.setpoints()
        assert len(scene.taken) == taken
        scene.vehicle.said.append(Tick(scene.t_ms * MS))
        yield [*scene.rung(), scene.vehicle.fileno()]

    scene._sleeps = sleeps()
    with pytest.raises(ZeroDivisionError):
        scene.loop.fly()
    assert not scene.vehicle.sent
    assert scene.vehicle.said


def test_before_the_first_turn_and_after_a_bug_in_the_last_one_nobody_steers(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    def bug(*_: object) -> None:
        raise ZeroDivisionError

    def sleeps() -> Iterator[list[int]]:
        assert scene.setpoints() == 0
        yield scene.engaged()
        scene.t_ms += 30
        patch.setattr(scene.loop._flying, "_step", bug)
        yield []

    scene.range()
    assert scene.ranges.came
    assert scene.rung()
    scene.ranges.came.clear()
    scene._sleeps = sleeps()
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        scene.loop.fly()
    scene.setpoints()
    scene.t_ms += 30
    scene.range()
    assert scene.ranges.came
    assert not scene.vehicle.sent


def test_once_the_flight_is_over_nothing_is_taken_in_either_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = Scene(monkeypatch, Settings(loss=LossSettings(wait_s=1.0)))

    def sleeps() -> Iterator[list[int]]:
        for _ in range(10):
            scene.t_ms += 100
            yield []
        scene.t_ms += 110
        scene.range()  # with it a second is over in which nobody came
        taken = len(scene.taken)
        scene.vehicle.sent.clear()
        scene.range()
        scene.vehicle.said.append(Tick(scene.t_ms * MS))
        assert len(scene.taken) == taken
        yield [*scene.rung(), scene.vehicle.fileno()]

    scene._sleeps = sleeps()
    final = scene.loop.fly()
    last = scene.taken[-1]
    assert final.phase is Phase.ENDED
    assert isinstance(last, RangeSample)
    changes = [output for output in scene.told if isinstance(output, PhaseChange)]
    assert (changes[-1].after, changes[-1].t_ns) == (Phase.ENDED, last.t_ns)
    scene.range()
    assert scene.taken[-1] is last
    assert not scene.vehicle.sent
    scene.bell.close()
    scene.vehicle.bell.close()


def test_a_stop_is_told_to_the_pilot_once(scene: Scene) -> None:
    def sleeps() -> Iterator[list[int]]:
        yield []
        scene.bell.ask_stop()
        scene.t_ms += 5
        yield scene.rung()
        scene.t_ms += 5
        yield []

    scene._sleeps = sleeps()
    scene.loop.fly()
    assert sum(isinstance(event, StopRequest) for event in scene.taken) == 1


def test_it_ticks_when_it_is_awake_anyway_and_otherwise_every_25_ms(scene: Scene) -> None:
    """Within 40 ms, where something has woken it just before a tick was due."""

    def sleeps() -> Iterator[list[int]]:
        yield []
        for t_ms in (4, 16):
            scene.t_ms = t_ms
            scene.ranges.came.append(RangeSample(t_ms * MS, "b1", "s", t_ms, 10.0))
            yield [scene.bell.fileno()]
        for t_ms in (41, 55, 80):
            scene.t_ms = t_ms
            yield []

    scene.fly(sleeps())
    assert scene.longest_ms == 25
    assert [event.t_ns // MS for event in scene.taken if isinstance(event, Tick)] == [0, 16, 41, 80]
    assert [event.t_ns // MS for event in scene.taken if isinstance(event, RangeSample)] == [4, 16]


def test_a_stream_of_100_hz_wakes_the_loop_often_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """Twice a period, though nothing comes but the clock."""
    scene = Scene(monkeypatch, Settings(stream=StreamSettings(min_rate_hz=100.0, max_rate_hz=100.0)))

    def sleeps() -> Iterator[list[int]]:
        yield scene.engaged()
        scene.setpoints()
        for _ in range(20):
            scene.t_ms += 5
            yield []

    scene.fly(sleeps())
    assert scene.longest_ms == 5
    assert scene.setpoints() == 10


def test_a_setpoint_takes_a_ticks_place(scene: Scene) -> None:
    def ticks() -> int:
        return sum(isinstance(event, Tick) for event in scene.taken)

    def sleeps() -> Iterator[list[int]]:
        yield scene.engaged()
        scene.t_ms += 30
        scene.setpoints()
        before = ticks()
        for _ in range(5):
            scene.range()
            assert scene.setpoints() == 1
            scene.t_ms += 10
            yield []
            scene.t_ms += 7
        assert ticks() == before
        scene.t_ms += 20  # without a range
        yield []
        assert ticks() == before + 1

    scene.fly(sleeps())


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

    monkeypatch.setattr(pilot, "step", bug)
    monkeypatch.setattr(flying, "twin", lambda thing: thing)  # the compiled loop takes no other links
    monkeypatch.setattr(flying, "_links", lambda *_: (Vehicle(), Ranges()))
    settings = Settings(status=StatusSettings(rate_hz=0.0))
    recorder = Recorder(None, start_now(settings, "", {}), "none", "a test")
    with pytest.raises(ValueError, match="math domain"):
        flying.fly(settings, open_view(sys.stdout, ViewKind.NONE), recorder, None, None)
