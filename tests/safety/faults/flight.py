"""One simulated flight with one fault: the pilot in the world of the mock, on a virtual clock.

The flight is led to a phase, the fault strikes there at a moment drawn by the seed, and what the app does is
held against the fault's rule and, whatever the fault, against the law of `Watch`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from math import inf
from random import Random
from typing import NamedTuple

from msgspec.structs import replace

from companion.network_settings import BeaconSettings
from companion.run import run
from companion.settings import LimitSettings, MissionSettings, Settings
from companion.types import (
    Event,
    ModeRequest,
    Output,
    Phase,
    PhaseChange,
    RangeSample,
    Setpoint,
    StopRequest,
    Tick,
)
from sitl_mock.faults import Fault as MockFault
from sitl_mock.modes import Mode
from sitl_mock.scenario import BeaconAt, Scenario
from sitl_mock.world import World
from tests.safety.faults.filters import RANGES, Filter, Uplink, lose
from tests.safety.faults.rules import Judgement, Rule, Sent, Step, judge
from tests.safety.faults.watch import Limits, Watch

Act = Callable[["Flight"], None]
_BEACON_HEIGHT_M = 1.5
UNIX_NS = 1_700_000_000_000_000_000
"""What the publisher's clock, which stamps the ranges, is ahead of the app's."""
_PREPARED_WITHIN_S = 60.0
HIDDEN_S = 1.5
"""So long after the strike are the ranges still hidden that were to be missed for COAST or STALL."""

SETTINGS = Settings(
    beacons={"b1": BeaconSettings(height_m=_BEACON_HEIGHT_M)},
    limits=LimitSettings(
        speed_m_s=0.6, from_start_m=20.0, distance_m=40.0, height_min_m=2.0, height_max_m=4.5
    ),
)
"""Of every flight: the defaults, with limits close to what is needed and budgets that lies can spend."""
ARDUPILOT = replace(SETTINGS, vehicle=replace(SETTINGS.vehicle, kind="ardupilot"))
"""The same with an ArduCopter, which tells no intended mode and stays in GUIDED when the setpoints end."""
PARAMS: dict[str, int | float] = {"COM_OBL_RC_ACT": 5, "COM_RC_OVERRIDE": 3, "COM_LOW_BAT_ACT": 2}


_STATION = (
    BeaconAt("b1", 12.0, 9.0),
    BeaconAt("b2", 5.5, 12.0),
    BeaconAt("b3", 4.0, 3.0),
    BeaconAt("b4", 11.0, 2.0),
)
_STATION_DISTANCES_M = (5.0, 6.5, 5.0, 5.0)
"""A station at (8, 6), and four beacons around it."""


def settings_of(fault: Fault, struck_in: Phase) -> Settings:
    """The fault's settings; a station is kept on a mission of its own."""
    if struck_in is not Phase.KEEP:
        return fault.settings
    beacons = {
        at.id: BeaconSettings(height_m=_BEACON_HEIGHT_M, station_distance_m=distance_m)
        for at, distance_m in zip(_STATION, _STATION_DISTANCES_M, strict=True)
    }
    return replace(fault.settings, mission=MissionSettings(kind="station"), beacons=beacons)


def scenario_of(struck_in: Phase) -> Scenario:
    """Near the target for what happens there, else far from it."""
    if struck_in is Phase.KEEP:
        beacons = tuple(replace(at, height_m=_BEACON_HEIGHT_M) for at in _STATION)
        return Scenario(beacons=beacons, start_x_m=6.0, start_y_m=4.5, limit_s=inf)
    return Scenario(
        beacons=(BeaconAt(height_m=_BEACON_HEIGHT_M),),
        random_start=True,
        start_distance_m=(2.5, 4.0) if struck_in is Phase.HOLD else (8.0, 14.0),
        limit_s=inf,
    )


class Fault(NamedTuple):
    """A fault: what happens, from the strike on, and what must come of it."""

    name: str
    family: str
    """range, link, vehicle, clock, process, load or person."""
    what: str
    acts: tuple[tuple[float, Act], ...]
    """Seconds after the strike, and what happens then."""
    rules: Mapping[Phase, Rule]
    """By the phase in which it strikes; only these are flown."""
    watch_s: float = 9.0
    settings: Settings = SETTINGS


class Outcome(NamedTuple):
    """What came of a flight."""

    fault: str
    struck_in: Phase
    seed: int
    steps: tuple[Step, ...]
    judgement: Judgement
    limits: Limits
    law_broken: tuple[str, ...]
    not_struck: str = ""
    """Why the fault could not strike: the phase was not reached."""

    dead: bool = False
    """The app does not run any more."""

    @property
    def held(self) -> bool:
        """The rule and the law."""
        return not (self.not_struck or self.judgement.broken or self.law_broken)


# --------------------------------------------------------------------------------------- what can happen


def on(fault: MockFault) -> Act:
    """A fault of the mock is switched on."""
    return lambda flight: flight.world.faults.switch(fault, True)


def off(fault: MockFault) -> Act:
    """And off again."""
    return lambda flight: flight.world.faults.switch(fault, False)


def select(mode: Mode) -> Act:
    """A person selects a mode."""

    def act(flight: Flight) -> None:
        flight.world.px4.set_mode(mode)

    return act


def stop(flight: Flight) -> None:
    """The app is asked to end (SIGTERM)."""
    flight.stop_asked = True


def kill(flight: Flight) -> None:
    """The app dies."""
    flight.alive = False


def start(flight: Flight) -> None:
    """The app is started anew."""
    flight.alive = True


class _Link(NamedTuple):
    """Once the app has been in `phase` for a time between these two, `act` happens; then the next link."""

    phase: Phase
    dwell_s: tuple[float, float]
    act: Act


def _strike(flight: Flight) -> None:
    flight.strike()


def _kill_and_start(flight: Flight) -> None:
    flight.alive = False
    flight.later.append((flight.world.t_s + 0.3, start))


def _refuse_for_a_while(flight: Flight) -> None:
    flight.world.faults.switch(MockFault.SETPOINTS_REFUSED, True)
    flight.later.append((flight.world.t_s + 2.0, off(MockFault.SETPOINTS_REFUSED)))


def _lose_ranges(flight: Flight) -> None:
    flight.filters[_lose_ranges] = lose(RANGES, 1.0)(flight.random)
    flight.after_strike.append((HIDDEN_S, _find_ranges))


def _find_ranges(flight: Flight) -> None:
    del flight.filters[_lose_ranges]


def _stop_in_vain(flight: Flight) -> None:
    """The mode that the app then asks for never comes."""
    flight.stop_asked = True
    flight.uplinks[_stop_in_vain] = lambda output: () if isinstance(output, ModeRequest) else (output,)


_CHAINS: dict[Phase, tuple[_Link, ...]] = {
    Phase.AWAIT: (_Link(Phase.AWAIT, (0.0, 0.0), _strike),),
    Phase.STANDBY: (_Link(Phase.STANDBY, (0.5, 2.0), _strike),),
    Phase.ACQUIRE: (_Link(Phase.ACQUIRE, (0.1, 0.9), _strike),),  # the quickest takes 0.95 s
    Phase.APPROACH: (_Link(Phase.APPROACH, (0.5, 4.0), _strike),),
    Phase.HOLD: (_Link(Phase.HOLD, (0.1, 1.5), _strike),),
    Phase.KEEP: (_Link(Phase.KEEP, (0.1, 3.0), _strike),),
    Phase.COAST: (_Link(Phase.APPROACH, (2.0, 4.0), _lose_ranges), _Link(Phase.COAST, (0.0, 0.5), _strike)),
    Phase.STALL: (_Link(Phase.APPROACH, (1.0, 3.0), _lose_ranges), _Link(Phase.STALL, (0.1, 2.0), _strike)),
    Phase.HAND_OVER: (
        _Link(Phase.APPROACH, (0.5, 2.0), _stop_in_vain),
        _Link(Phase.HAND_OVER, (0.1, 1.0), _strike),
    ),
    Phase.RELEASED: (
        _Link(Phase.APPROACH, (0.5, 2.0), _refuse_for_a_while),
        _Link(Phase.RELEASED, (1.5, 3.0), _strike),
    ),
    Phase.INHIBITED: (
        _Link(Phase.APPROACH, (0.5, 2.0), _kill_and_start),
        _Link(Phase.INHIBITED, (0.1, 2.0), _strike),
    ),
}
"""How a flight is led to each phase."""

_NOBODY_ENGAGES = (Phase.AWAIT, Phase.STANDBY)


# --------------------------------------------------------------------------------------------- the flight


class Flight:
    """The app, the world and what happens to both."""

    def __init__(self, fault: Fault, struck_in: Phase, seed: int) -> None:
        self.fault, self.struck_in, self.seed = fault, struck_in, seed
        self.random = Random(f"{fault.name}/{struck_in.value}/{seed}")
        self.settings = settings_of(fault, struck_in)
        self.world = World(scenario_of(struck_in), seed, params=PARAMS, autopilot=self.settings.vehicle.kind)
        if struck_in in _NOBODY_ENGAGES:
            self.world.engaged_at_s = 0.0
        self.alive = True
        self.stop_asked = False
        self.filters: dict[object, Filter] = {}
        """What events go through, by whoever put it there."""
        self.uplinks: dict[object, Uplink] = {}
        self.later: list[tuple[float, Act]] = []
        """What happens when, in the world's time."""
        self.after_strike: list[tuple[float, Act]] = list(fault.acts)
        self.wall_step_ns = 0
        """How far the publisher's clock has been set."""
        self._stamps: dict[tuple[str, str, int], int] = {}
        """Of every range by beacon, session and number."""
        self.watch = Watch(self.settings, self.world)
        self.phase = Phase.AWAIT
        self._phase_since_s = 0.0
        self._chain = list(_CHAINS[struck_in])
        self._dwell_s = self._draw()
        self._strike_s: float | None = None
        self._steps: list[Step] = []
        self._sent: list[Sent] = []
        self._stop_told = False

    def fly(self) -> Outcome:
        """The whole flight."""
        events = self.world.events()
        while not self._over:
            run(self._feed(events), self.settings, self._send, self.watch.record)
            if self.alive:
                self.alive = self.phase is not Phase.ENDED  # it has ended by itself: the world goes on
            for _ in events:
                self._happen()
                if self.alive or self._over:
                    break
            if self.alive and not self._over:
                self._enter(Phase.AWAIT, "started anew")
        return self._outcome()

    def strike(self) -> None:
        """The fault strikes now."""
        t_s = self._strike_s = self.world.t_s
        self.later += [(t_s + after_s, act) for after_s, act in self.after_strike]
        self.watch.begin()
        self._happen()

    @property
    def _over(self) -> bool:
        t_s = self.world.t_s
        if self._strike_s is None:
            return t_s > _PREPARED_WITHIN_S
        return t_s > self._strike_s + self.fault.watch_s

    def _feed(self, events: Iterator[Event]) -> Iterator[Event]:
        """What reaches the app, until it is killed or the watch is over."""
        self._lead()
        for event in events:
            if isinstance(event, Tick):
                self._lead()
                self._happen()
                self.watch.look()
            if not self.alive or self._over:
                return
            arriving: list[Event] = [self._stamped(event)]
            for each in self.filters.values():
                arriving = [out for one in arriving for out in each(one)]
            for one in arriving:
                self.watch.told(one)
                yield one
            if self.stop_asked and not self._stop_told:
                self._stop_told = True
                yield StopRequest(t_ns=event.t_ns)

    def _stamped(self, event: Event) -> Event:
        """A range carries the publisher's clock as it was measured, as over the wire; so do its repeats."""
        if not isinstance(event, RangeSample):
            return event
        now_ns = event.t_ns + UNIX_NS + self.wall_step_ns
        stamp_ns = self._stamps.setdefault((event.beacon, event.session, event.seq), now_ns)
        return replace(event, sent_t_ns=stamp_ns)

    def _send(self, output: Output) -> None:
        self.watch.sent(output, self.phase)
        if isinstance(output, PhaseChange):
            self._enter(output.after, output.reason)
        elif isinstance(output, Setpoint) and self._strike_s is not None:
            self._sent.append(Sent(self.world.t_s - self._strike_s, output.speed_m_s))
        arriving: list[Output] = [output]
        for each in self.uplinks.values():
            arriving = [out for one in arriving for out in each(one)]
        for one in arriving:
            self.world.send(one)

    def _enter(self, phase: Phase, reason: str) -> None:
        if phase is self.phase:
            return
        self.phase = phase
        self._phase_since_s = self.world.t_s
        if self._strike_s is not None:
            self._steps.append(Step(self.world.t_s - self._strike_s, phase, reason))

    def _lead(self) -> None:
        """Follow the chain that leads to the phase in which the fault is to strike."""
        if not self._chain or self.phase is not self._chain[0].phase:
            return
        if self.world.t_s - self._phase_since_s >= self._dwell_s:
            self._chain.pop(0).act(self)
            self._phase_since_s = self.world.t_s
            self._dwell_s = self._draw()

    def _draw(self) -> float:
        return self.random.uniform(*self._chain[0].dwell_s) if self._chain else inf

    def _happen(self) -> None:
        due = [entry for entry in self.later if entry[0] <= self.world.t_s]
        self.later = [entry for entry in self.later if entry[0] > self.world.t_s]
        for _, act in due:
            act(self)

    def _outcome(self) -> Outcome:
        steps = tuple(self._steps)
        if self._strike_s is None:
            why = f"never {self.struck_in.value}; at the end {self.phase.value}"
            nothing = Judgement((), None)
            return Outcome(
                self.fault.name, self.struck_in, self.seed, steps, nothing, self.watch.limits, (), why
            )
        judgement = judge(self.fault.rules[self.struck_in], self.struck_in, self._steps, self._sent)
        return Outcome(
            self.fault.name,
            self.struck_in,
            self.seed,
            steps,
            judgement,
            self.watch.limits,
            (*self.watch.broken, *self.watch.limits.exceeded(self.settings)),
            dead=not self.alive and self.phase is not Phase.ENDED,
        )
