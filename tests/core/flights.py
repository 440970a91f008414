"""Events of a small scripted flight, for tests of the pilot."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import NamedTuple

from msgspec.structs import replace

from companion import pilot
from companion.settings import Settings
from companion.state import Plan, State
from companion.types import (
    Attitude,
    BatteryReport,
    Charge,
    EstimatorReport,
    Event,
    FlightMode,
    Landed,
    LandedReport,
    LocalMotion,
    ModeReport,
    Output,
    RangeSample,
    Setpoint,
    Status,
    Tick,
    VehicleHeartbeat,
)

MS = 1_000_000
OFFBOARD, LOITER = FlightMode.OFFBOARD, FlightMode.AUTO_LOITER


class Flown(NamedTuple):
    plan: Plan
    state: State
    outputs: tuple[Output, ...]

    def of(self, kind: type) -> list[Output]:
        return [output for output in self.outputs if type(output) is kind]


class Script:
    """Telemetry and ranges of a vehicle that hovers 10 m from the beacon, until told otherwise."""

    def __init__(self) -> None:
        self.t_ms = 1000
        self.actual: FlightMode = LOITER
        self.intended: FlightMode | None = LOITER
        self.armed = True
        self.landed = Landed.IN_AIR
        self.range_m: float | None = 10.0
        self.tells_attitude = True
        self.tells_mode = True
        self.tells_landed = True
        self.tells_heartbeat = True
        self.height_m: float | None = 3.0
        self.battery: BatteryReport | None = BatteryReport(0, Charge.OK, 0.9)
        self.estimator: EstimatorReport | None = EstimatorReport(0, True, True, True, True)
        self.boot_offset_ms = 0
        self.seq = 0

    def run(self, seconds: float) -> Iterator[Event]:
        """That much more of the flight."""
        for _ in range(round(seconds * 100)):
            self.t_ms += 10
            yield from self.moment()

    def moment(self) -> Iterator[Event]:
        t_ns, t_ms = self.t_ms * MS, self.t_ms
        if t_ms % 500 == 0 and self.tells_heartbeat:
            yield VehicleHeartbeat(t_ns, 1, self.actual, self.armed)
        if t_ms % 50 == 0 and self.tells_mode:
            yield ModeReport(t_ns, self.actual, self.intended)
        if t_ms % 50 == 0 and self.tells_landed:
            yield LandedReport(t_ns, self.landed)
        if t_ms % 500 == 0 and self.battery is not None:
            yield replace(self.battery, t_ns=t_ns)
        if t_ms % 500 == 0 and self.estimator is not None:
            yield replace(self.estimator, t_ns=t_ns)
        if t_ms % 20 == 0 and self.tells_attitude:
            yield Attitude(t_ns, 0.0, 0.0, t_ms + self.boot_offset_ms)
            yield LocalMotion(t_ns, 0.0, 0.0, self.height_m, 0.0, 0.0, 0.0)
        if t_ms % 50 == 10 and self.range_m is not None:
            self.seq += 1
            yield RangeSample(t_ns, "b1", "s", self.seq, self.range_m)
        yield Tick(t_ns)


def fly(events: Iterable[Event], settings: Settings | None = None, before: Flown | None = None) -> Flown:
    """Feed events to the pilot; go on from an earlier flight where there is one."""
    plan = pilot.plan(settings or Settings()) if before is None else before.plan
    state = pilot.initial(plan) if before is None else before.state
    sent: list[Output] = []
    for event in events:
        state, outputs = pilot.step(plan, state, event)
        sent.extend(outputs)
    return Flown(plan, state, tuple(sent))


def engaged(script: Script, settings: Settings | None = None) -> Flown:
    """A flight that has just been engaged."""
    ready = fly(script.run(2.0), settings)
    script.actual = script.intended = OFFBOARD
    return fly(script.run(1.0), before=ready)


def last_status(flown: Flown) -> Status:
    status = flown.of(Status)[-1]
    assert isinstance(status, Status)
    return status


def setpoints(flown: Flown) -> list[Setpoint]:
    return [s for s in flown.outputs if isinstance(s, Setpoint)]
