"""The vehicle, its autopilot's rules and its beacons as an event source on a virtual clock.

`run(world.events(), …, world.send, …)` flies the app's pure core against it, as fast as the machine goes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise
from math import cos, hypot, pi, sin
from random import Random

import msgspec

from companion.types import (
    Attitude,
    BatteryReport,
    EstimatorReport,
    Event,
    FlightMode,
    LandedReport,
    LineOfSight,
    LocalMotion,
    ModeReport,
    ModeRequest,
    Output,
    Party,
    PartyHeard,
    Phase,
    RangeSample,
    Setpoint,
    Status,
    Tick,
    VehicleHeartbeat,
)
from sitl_mock.ardupilot import ArduPilot
from sitl_mock.autopilot import Target
from sitl_mock.clock import Clock
from sitl_mock.faults import Fault, FaultAt, Faults
from sitl_mock.modes import BY_NAME, WIRE, Mode
from sitl_mock.params import Params
from sitl_mock.px4 import Px4
from sitl_mock.scenario import Scenario
from sitl_mock.uwb import Beacon
from sitl_mock.vehicle import STEP_S, Vehicle, wrap
from sitl_mock.visitors import OTHER_SYSTEM, Visitors

_STEP_NS = round(STEP_S * 1e9)
_START_NS = 1_000_000_000
"""The clock begins here: a time of zero is no time in some readers' eyes."""
_PERSON_WAITS_S = 0.5
_STREAM_GAP_S = 0.5
"""Setpoints this close to one another are a stream."""


class TruthSample(msgspec.Struct, frozen=True, gc=False):
    """Where the vehicle really is, 50 times a second."""

    t_s: float
    x_m: float
    y_m: float
    height_m: float
    heading_rad: float
    speed_m_s: float
    distance_m: float
    """Horizontal distance to the first beacon."""


def start_pose(scenario: Scenario, seed: int) -> tuple[float, float, float]:
    """Where a flight with this seed begins: x, y, heading."""
    if not scenario.random_start:
        return scenario.start_x_m, scenario.start_y_m, scenario.start_heading_rad
    random = Random(f"{seed}/start")
    beacon = scenario.beacons[0]
    distance = random.uniform(*scenario.start_distance_m)
    azimuth, heading = random.uniform(-pi, pi), random.uniform(-pi, pi)
    return beacon.x_m + distance * cos(azimuth), beacon.y_m + distance * sin(azimuth), heading


class World:
    """A flight that begins armed and hovering at `start_height_m` in AUTO.LOITER.

    With an ArduPilot it begins on the ground, disarmed, as an app that starts in the air stays silent there:
    the person selects GUIDED, arms and takes off once the app stands by.

    Its person selects OFFBOARD once setpoints have streamed for half a second, and again whenever `engage` is
    called. The same scenario, seed, faults and outputs give the same events, bit for bit.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        faults: Iterable[FaultAt] = (),
        params: dict[str, int | float] | None = None,
        autopilot: str = "px4",
    ) -> None:
        x, y, heading = start_pose(scenario, seed)
        self.scenario = scenario
        self.faults = Faults(faults)
        self._is_ardupilot = autopilot == "ardupilot"
        height_m = 0.0 if self._is_ardupilot else scenario.start_height_m
        self.vehicle = Vehicle(scenario, x, y, height_m, heading)
        kind = ArduPilot if self._is_ardupilot else Px4
        self.px4 = kind(scenario, seed, self.vehicle, Params(params, self._is_ardupilot), self.faults)
        if not self._is_ardupilot:
            self.px4.start_in_air()
        self.beacons = [Beacon(at, scenario, seed, self.faults) for at in scenario.beacons]
        self.truth: list[TruthSample] = []
        """The truth so far, 50 Hz; grows as the events are drawn."""
        self.engaged_at_s: float | None = None
        """When OFFBOARD was selected first."""
        self._stream_since: int | None = None
        self._last_setpoint = 0
        self._stands_by = False
        self._step = 0
        self._sample()

    @property
    def t_s(self) -> float:
        """Seconds since the beginning."""
        return self._step * STEP_S

    @property
    def is_ours(self) -> bool:
        """The vehicle still has the system id under which the app knows it."""
        return self.px4.params["MAV_SYS_ID"] != OTHER_SYSTEM

    @property
    def t_ns(self) -> int:
        """The events' clock."""
        return _START_NS + self._step * _STEP_NS

    def time_ns(self, t_s: float) -> int:
        """The time of a truth sample on the events' clock."""
        return _START_NS + round(t_s * 1e9)

    # ---------------------------------------------------------------------------------------------- in

    def send(self, output: Output) -> None:
        """Take what the app sends: setpoints and mode requests; everything else is ignored."""
        if isinstance(output, Setpoint):
            if self._step - self._last_setpoint > _STREAM_GAP_S / STEP_S or self._stream_since is None:
                self._stream_since = self._step
            self._last_setpoint = self._step
            if self.px4.booting or self.faults.active(Fault.LINK_LOSS) or not self.is_ours:
                return
            # With a height the velocity is in the local frame; without, it is turned by the heading now.
            held = output.height_m is not None
            heading = output.heading_rad if held else self.px4.autopilot.heading_rad
            self.px4.setpoint(
                Target(
                    height_m=output.height_m,
                    vx_m_s=output.speed_m_s * cos(heading),
                    vy_m_s=output.speed_m_s * sin(heading),
                    climb_m_s=None if held else output.climb_m_s,
                    yaw_rate_rad_s=output.yaw_rate_rad_s,
                )
            )
        elif isinstance(output, Status):
            self._stands_by = output.phase is Phase.STANDBY
        elif isinstance(output, ModeRequest):
            mode = BY_NAME.get(output.mode)
            heard = not (self.px4.booting or self.faults.active(Fault.LINK_LOSS))
            if mode is not None and heard and self.is_ours:
                self.px4.set_mode(mode)

    def engage(self) -> None:
        """The person selects OFFBOARD now."""
        self.px4.set_mode(Mode.OFFBOARD)
        if self.engaged_at_s is None and self.px4.mode is Mode.OFFBOARD:
            self.engaged_at_s = self.t_s

    # --------------------------------------------------------------------------------------------- out

    def events(self) -> Iterator[Event]:
        """Everything that reaches the app, in the order of time, until `limit_s`."""
        s, px4 = self.scenario, self.px4
        told = s.telemetry != "none"
        heartbeat = Clock(5.0 if self._is_ardupilot else 1.0)
        mode, landed, tick = Clock(20.0), Clock(5.0), Clock(50.0)
        attitude, motion, truth = Clock(50.0), Clock(30.0), Clock(50.0)
        count = len(self.beacons)
        ranges = [(b, Clock(s.range_rate_hz, i / count)) for i, b in enumerate(self.beacons)]
        visitors = Visitors(self.faults)
        last_modes = (px4.mode, px4.intended)
        while self.t_s < s.limit_s:
            self._step += 1
            step, t_ns = self._step, self.t_ns
            px4.step()
            px4.notices.clear()
            px4.events.clear()
            self._person()
            if truth.at <= step and truth.due(step):
                self._sample()
            reachable = telling = not px4.booting
            if self.faults.any:
                linked = not self.faults.active(Fault.LINK_LOSS)
                reachable = reachable and linked and self.is_ours
                telling = reachable and not self.faults.active(Fault.TELEMETRY_STOP)
                if linked:
                    yield from visitors.heard(step, t_ns)

            beat = heartbeat.at <= step and heartbeat.due(step)
            if beat and reachable and not self.faults.active(Fault.HEARTBEAT_STOP):
                yield VehicleHeartbeat(t_ns, 1, self._told(px4.mode), px4.armed)
            elif beat and not self.is_ours:
                yield PartyHeard(t_ns, Party.AUTOPILOT, OTHER_SYSTEM, 1, "HEARTBEAT")
            if beat and telling:
                yield BatteryReport(t_ns, px4.charge, px4.battery_told)
                local, everywhere = px4.velocity_valid, px4.global_position_valid
                yield EstimatorReport(t_ns, local, local, height=True, global_position=everywhere)
            modes = (px4.mode, px4.intended)
            if self._is_ardupilot:
                pass  # it tells its mode by HEARTBEAT alone
            elif ((mode.at <= step and mode.due(step)) or modes != last_modes) and telling:
                last_modes = modes
                yield ModeReport(t_ns, WIRE[px4.mode].name, WIRE[px4.intended].name)
            if landed.at <= step and landed.due(step) and telling:
                yield LandedReport(t_ns, px4.landed_state)
            if attitude.at <= step and attitude.due(step) and telling and told:
                yield self._attitude(t_ns)
            if motion.at <= step and motion.due(step) and telling and told and px4.velocity_valid:
                yield self._motion(t_ns)
            for beacon, clock in ranges:
                if clock.at > step:
                    continue
                for _ in range(clock.due(step)):
                    v = self.vehicle
                    r = beacon.measure(v.x_m, v.y_m, v.height_m)
                    if r is not None:
                        los = LineOfSight(r.los)
                        yield RangeSample(t_ns, r.beacon, r.session, r.seq, r.range_m, r.sigma_m, los)
            if tick.at <= step and tick.due(step):
                yield Tick(t_ns)

    def path_length_m(self, until_s: float | None = None, since_s: float = 0.0) -> float:
        """Horizontal path flown between two times, by default from the beginning until now; the truth."""
        last = until_s if until_s is not None else self.t_s
        inside = [p for p in self.truth if since_s <= p.t_s <= last]
        return sum(hypot(b.x_m - a.x_m, b.y_m - a.y_m) for a, b in pairwise(inside))

    def _told(self, mode: Mode) -> FlightMode:
        """The mode as HEARTBEAT tells it: ArduCopter takes off in GUIDED."""
        return FlightMode.OFFBOARD if mode is Mode.TAKEOFF and self._is_ardupilot else WIRE[mode].name

    def _take_off(self) -> None:
        """The person of an ArduPilot: GUIDED, arm, take off, once; the app engages when it is up."""
        if not self.px4.armed and self.engaged_at_s is None:
            self.px4.set_mode(Mode.OFFBOARD)
            self.px4.arm()
            self.px4.take_off(self.scenario.start_height_m)
        elif self.px4.mode is Mode.OFFBOARD and self.engaged_at_s is None:
            self.engaged_at_s = self.t_s

    def _person(self) -> None:
        if self._is_ardupilot:
            if self._stands_by or self.px4.armed:
                self._take_off()
            return
        since = self._stream_since
        if self.engaged_at_s is None and since is not None:
            if (self._step - self._last_setpoint) * STEP_S > _STREAM_GAP_S:
                self._stream_since = None
            elif (self._step - since) * STEP_S >= _PERSON_WAITS_S:
                self.engage()

    def _attitude(self, t_ns: int) -> Attitude:
        v, e = self.vehicle, self.px4.errors
        heading = wrap(v.heading_rad + e.heading_rad)
        return Attitude(t_ns, heading, v.yaw_rate_rad_s + e.yaw_rate_noise(), round(self.px4.boot_s * 1e3))

    def _motion(self, t_ns: int) -> LocalMotion:
        v, e = self.vehicle, self.px4.errors
        return LocalMotion(
            t_ns,
            v.x_m + e.x_m,
            v.y_m + e.y_m,
            v.height_m + e.height_m,
            v.vx_m_s + e.vx_m_s,
            v.vy_m_s + e.vy_m_s,
            v.climb_m_s + e.climb_m_s,
            round(self.px4.boot_s * 1e3),
        )

    def _sample(self) -> None:
        v, b = self.vehicle, self.scenario.beacons[0]
        self.truth.append(
            TruthSample(
                self.t_s,
                v.x_m,
                v.y_m,
                v.height_m,
                v.heading_rad,
                hypot(v.vx_m_s, v.vy_m_s),
                hypot(v.x_m - b.x_m, v.y_m - b.y_m),
            )
        )
