"""The ground side as a script, in a person's place: arm, climb, hand over, watch, take over, land.

It runs in a process and on a link of its own, on MAVSDK, as a ground station does; it streams no setpoints
and never forces anything. Modes are set with MAV_CMD_DO_SET_MODE and believed from telemetry, never from an
ack: PX4 acknowledges OFFBOARD at once and may refuse it a moment later. For PX4; a pilot who takes the
sticks is left alone.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator
from enum import Enum
from typing import NamedTuple

from companion.ground import GroundLink, GroundLinkError, Motion, ground_url
from companion.types import FlightMode

STEP_S = 0.1
"""Pace at which telemetry is looked at."""
SAY_EVERY_S = 2.0
MODE_PATIENCE_S = 2.5
"""A mode or the armed state must show in telemetry within this: HEARTBEAT comes once a second."""
CLIMB_TOLERANCE_M = 0.5
STEADY_CLIMB_M_S = 0.2
STEADY_S = 1.0
REST_S = 2.5
REST_RADIUS_M = 0.25
"""At rest: for REST_S (or as long as told) no further than this from where it is now: 0.1 m/s, ..."""
REST_TURN_RAD = 0.2
"""... and turned by no more than this: turning on the spot to find the bearing is no rest."""
BEGUN_MOVE_M = 0.5
BEGUN_TURN_RAD = 1.0
"""Rest counts only once the vehicle has moved or turned so far: before that the flight has not begun."""
CLIMB_S = 30.0
LANDING_S = 30.0
SLOWEST_M_S = 0.3
"""Time allowed for climb and landing: CLIMB_S or LANDING_S, and the height at this speed."""

MANUAL_MODES = frozenset(
    {FlightMode.MANUAL, FlightMode.STABILIZED, FlightMode.ACRO, FlightMode.ALTCTL, FlightMode.POSCTL}
)


class OperatorResult(Enum):
    """How it ended. The exit statuses are stable."""

    FINISHED = "the vehicle came to rest, and was landed"
    TOOK_OVER = "took over when told, and landed"
    NO_VEHICLE = "no autopilot heard"
    NOT_READY = "the vehicle did not become ready to arm"
    REFUSED = "arming or take-off was refused"
    NO_COMPANION = "OFFBOARD was never accepted: no companion streams setpoints"
    LEFT_OFFBOARD = "the vehicle left OFFBOARD by itself"
    PILOT = "a pilot took over"
    TIMEOUT = "the flight did not end in time"
    LINK_LOST = "the link to the vehicle was lost"
    NOT_TAKEN_OVER = "the vehicle did not obey the take-over"
    NOT_LANDED = "the vehicle did not land and disarm in time"
    INTERRUPTED = "interrupted"

    @property
    def exit_status(self) -> int:
        """The process's exit status."""
        return _EXIT_STATUS[self]


_EXIT_STATUS = {
    OperatorResult.FINISHED: 0,
    OperatorResult.TOOK_OVER: 0,
    OperatorResult.NO_VEHICLE: 20,
    OperatorResult.NOT_READY: 21,
    OperatorResult.REFUSED: 22,
    OperatorResult.NO_COMPANION: 23,
    OperatorResult.LEFT_OFFBOARD: 24,
    OperatorResult.PILOT: 25,
    OperatorResult.TIMEOUT: 26,
    OperatorResult.LINK_LOST: 27,
    OperatorResult.NOT_TAKEN_OVER: 28,
    OperatorResult.NOT_LANDED: 29,
    OperatorResult.INTERRUPTED: 130,
}


def operate(
    url: str,
    *,
    height_m: float,
    take_over_after_s: float | None,
    timeout_s: float,
    say: Callable[[str], None],
    rest_s: float = REST_S,
) -> OperatorResult:
    """Fly one flight: wait for health, arm, climb to `height_m`, select OFFBOARD, watch, land.

    The flight is over when the vehicle has rested for `rest_s`, left OFFBOARD, `take_over_after_s` after
    OFFBOARD began (then AUTO.LOITER is selected first), or `timeout_s` after the start, whichever comes
    first. Each step is told through `say` in one line. Ctrl-C selects AUTO.LOITER and leaves the vehicle to
    the pilot.

    Raises `ValueError` for a URL that is none, `GroundLinkError` where MAVSDK is missing or cannot connect.
    """
    began = time.monotonic()

    def tell(text: str) -> None:
        say(f"{time.monotonic() - began:6.1f} s  {text}")

    with GroundLink(ground_url(url), tell) as vehicle:
        script = _Script(vehicle, height_m, take_over_after_s, began + timeout_s, tell, rest_s)
        try:
            return script.run(url)
        except KeyboardInterrupt:
            script.let_go()
            return OperatorResult.INTERRUPTED


class _GiveUpError(Exception):
    """A step could not be done; what follows is landing, where there is something to land."""

    def __init__(self, result: OperatorResult, why: str) -> None:
        super().__init__(why)
        self.result = result


class _Script:
    """The steps, in their order."""

    def __init__(
        self,
        vehicle: GroundLink,
        height_m: float,
        take_over_after_s: float | None,
        deadline: float,
        tell: Callable[[str], None],
        rest_s: float,
    ) -> None:
        self._rest_s = rest_s
        self._vehicle = vehicle
        self._height_m = height_m
        self._take_over_after_s = take_over_after_s
        self._deadline = deadline
        self._tell = tell
        self._ground_m = 0.0  # the height that the autopilot shows where it stands before take-off

    def run(self, url: str) -> OperatorResult:
        """All of it. The result is the first thing that went wrong, else how the flight ended."""
        try:
            self._find(url)
            self._wait_ready()
            self._arm()
        except _GiveUpError as given_up:
            self._tell(str(given_up))
            return given_up.result
        try:
            self._climb()
            self._select_offboard()
            result = self._watch()
        except _GiveUpError as given_up:
            self._tell(str(given_up))
            result = given_up.result
        if result is OperatorResult.PILOT:
            return result
        return result if self._land() else OperatorResult.NOT_LANDED

    def let_go(self) -> None:
        """Ctrl-C: what flies is told to hold its place, and left to the pilot."""
        if not self._vehicle.is_found or not self._vehicle.is_armed or self._vehicle.is_on_ground:
            self._tell("interrupted: nothing is flying")
            return
        self._tell("interrupted: AUTO.LOITER, over to the pilot")
        if self._hold():
            self._tell("mode AUTO.LOITER: still in the air, over to the pilot")
        else:
            self._tell(f"AUTO.LOITER is NOT confirmed, mode {self._vehicle.mode.value}: take over by hand")

    # ----------------------------------------------------------------------------------------- the steps

    def _find(self, url: str) -> None:
        self._tell(f"waiting for an autopilot on {url}")
        while not self._vehicle.find(1.0):
            if time.monotonic() > self._deadline:
                raise _GiveUpError(OperatorResult.NO_VEHICLE, f"no autopilot heard on {url}")
        self._tell(f"autopilot heard: system {self._vehicle.system_id}")

    def _wait_ready(self) -> None:
        told: tuple[str, ...] | None = None
        for _ in self._until(self._deadline):
            if self._vehicle.is_armed:
                raise _GiveUpError(
                    OperatorResult.REFUSED, "the vehicle is armed already: left to whoever armed it"
                )
            missing = self._vehicle.not_ready()
            motion = self._vehicle.motion()
            if not missing and motion is not None:
                self._ground_m = motion.height_m
                break
            if missing != told:
                told = missing
                self._tell(f"not ready yet: {', '.join(missing) or 'no position heard'}")
        else:
            raise _GiveUpError(OperatorResult.NOT_READY, OperatorResult.NOT_READY.value)
        # After a landing in OFFBOARD, PX4 stays in it and then refuses to arm.
        if self._vehicle.mode is FlightMode.OFFBOARD and not self._hold():
            raise _GiveUpError(OperatorResult.NOT_READY, "the vehicle stays in OFFBOARD on the ground")
        self._tell("healthy and ready to arm")

    def _arm(self) -> None:
        try:
            self._vehicle.arm()
        except GroundLinkError as error:
            raise _GiveUpError(OperatorResult.REFUSED, str(error)) from error
        if not any(self._vehicle.is_armed for _ in self._until(time.monotonic() + MODE_PATIENCE_S)):
            raise _GiveUpError(
                OperatorResult.REFUSED, "arming was acknowledged, but the vehicle is not armed"
            )
        self._tell("armed")

    def _climb(self) -> None:
        try:
            self._vehicle.take_off(self._height_m)
        except GroundLinkError as error:
            raise _GiveUpError(OperatorResult.REFUSED, str(error)) from error
        self._tell(f"taking off to {self._height_m:.1f} m")
        steady_since: float | None = None
        climbs = False
        limit = time.monotonic() + CLIMB_S + self._height_m / SLOWEST_M_S
        for now in self._until(min(limit, self._deadline), aloud=True):
            if not self._vehicle.is_armed:
                raise _GiveUpError(OperatorResult.REFUSED, "the vehicle disarmed instead of climbing")
            mode = self._vehicle.mode
            if climbs and mode in MANUAL_MODES:
                raise _GiveUpError(
                    OperatorResult.PILOT, f"mode {mode.value}: a pilot took over, left to them"
                )
            climbs = climbs or mode is FlightMode.AUTO_TAKEOFF
            motion = self._vehicle.motion()
            if motion is None or not self._is_steady(motion):
                steady_since = None
            elif steady_since is None:
                steady_since = now
            elif now - steady_since >= STEADY_S:
                self._tell(f"steady at {self._height(motion):.2f} m, mode {self._vehicle.mode.value}")
                return
        raise _GiveUpError(OperatorResult.TIMEOUT, f"{self._height_m:.1f} m not reached in time")

    def _select_offboard(self) -> None:
        """Ask until telemetry shows OFFBOARD: without a companion's setpoint stream PX4 refuses it."""
        self._tell("selecting OFFBOARD")
        asked = 0
        while (left_s := self._deadline - time.monotonic()) > 0.0:
            mode = self._vehicle.mode
            if mode in MANUAL_MODES:
                raise _GiveUpError(
                    OperatorResult.PILOT, f"mode {mode.value}: a pilot took over, left to them"
                )
            if self._became(FlightMode.OFFBOARD):
                self._tell("mode OFFBOARD: the companion flies")
                return
            if asked % 4 == 0:
                self._tell(
                    f"OFFBOARD refused, mode {self._vehicle.mode.value}: no companion streams setpoints yet; "
                    f"asking on for {left_s:.0f} s"
                )
            asked += 1
        raise _GiveUpError(OperatorResult.NO_COMPANION, OperatorResult.NO_COMPANION.value)

    def _watch(self) -> OperatorResult:
        """Until the flight is over; see `operate`."""
        rest = RestWatch(self._rest_s)
        lost = False
        take_over_at = math.inf
        if self._take_over_after_s is not None:
            take_over_at = time.monotonic() + self._take_over_after_s
        for now in self._until(self._deadline, aloud=True):
            if now >= take_over_at:
                return self._take_over()
            if lost is self._vehicle.is_connected:
                lost = not lost
                self._tell("link lost: waiting for it" if lost else "link back")
            if lost:
                continue
            mode = self._vehicle.mode
            if mode in MANUAL_MODES:
                self._tell(f"mode {mode.value}: a pilot took over, or a failsafe; left to them")
                return OperatorResult.PILOT
            if not self._vehicle.is_armed:
                self._tell("the vehicle disarmed by itself")
                return OperatorResult.LEFT_OFFBOARD
            if mode is not FlightMode.OFFBOARD:
                self._tell(f"the vehicle left OFFBOARD by itself: mode {mode.value}")
                return OperatorResult.LEFT_OFFBOARD
            motion = self._vehicle.motion()
            if motion is not None and rest.add(now, motion):
                self._tell(f"at rest, {self._where(motion)}")
                return OperatorResult.FINISHED
        self._tell("the time is up")
        return OperatorResult.LINK_LOST if lost else OperatorResult.TIMEOUT

    def _take_over(self) -> OperatorResult:
        self._tell("taking over: AUTO.LOITER")
        if self._hold():
            self._tell("mode AUTO.LOITER: the companion is out")
            return OperatorResult.TOOK_OVER
        self._tell(f"AUTO.LOITER is not confirmed: mode {self._vehicle.mode.value}")
        return OperatorResult.NOT_TAKEN_OVER

    def _land(self) -> bool:
        """Land and wait until the vehicle has disarmed; True if it has."""
        motion = self._vehicle.motion()
        height_m = self._height_m if motion is None else max(self._height(motion), 0.0)
        limit = time.monotonic() + LANDING_S + height_m / SLOWEST_M_S
        asked_at = -math.inf
        for now in self._until(limit, aloud=True):
            if not self._vehicle.is_armed:
                self._tell("landed and disarmed" if self._vehicle.is_on_ground else "disarmed")
                return True
            comes_down = self._vehicle.mode in (FlightMode.AUTO_LAND, FlightMode.AUTO_RTL)
            if not comes_down and now - asked_at > MODE_PATIENCE_S:
                asked_at = now
                self._tell("landing")
                try:
                    self._vehicle.land()
                except GroundLinkError as error:
                    self._tell(str(error))
        self._tell("NOT landed in time")
        return False

    # --------------------------------------------------------------------------------------------- tools

    def _until(self, deadline: float, *, aloud: bool = False) -> Iterator[float]:
        """The time, every STEP_S until the deadline; aloud: with a line of telemetry every SAY_EVERY_S."""
        say_at = time.monotonic() + SAY_EVERY_S
        while (now := time.monotonic()) < deadline:
            yield now
            for text in self._vehicle.take_texts():
                self._tell(f"the vehicle says: {text}")
            if aloud and now >= say_at:
                say_at = now + SAY_EVERY_S
                motion = self._vehicle.motion()
                where = "no position heard" if motion is None else self._where(motion)
                self._tell(f"{self._vehicle.mode.value}, {where}")
            time.sleep(STEP_S)

    def _became(self, mode: FlightMode) -> bool:
        """Ask for a mode; True once telemetry shows it."""
        try:
            self._vehicle.set_mode(mode)
        except GroundLinkError as error:
            self._tell(str(error))
        return any(self._vehicle.mode is mode for _ in self._until(time.monotonic() + MODE_PATIENCE_S))

    def _hold(self) -> bool:
        """AUTO.LOITER, asked for up to three times; True once telemetry shows it."""
        return any(self._became(FlightMode.AUTO_LOITER) for _ in range(3))

    def _height(self, motion: Motion) -> float:
        return motion.height_m - self._ground_m

    def _is_steady(self, motion: Motion) -> bool:
        return (
            abs(self._height(motion) - self._height_m) <= CLIMB_TOLERANCE_M
            and abs(motion.climb_m_s) <= STEADY_CLIMB_M_S
            and self._vehicle.mode is not FlightMode.AUTO_TAKEOFF
        )

    def _where(self, motion: Motion) -> str:
        return (
            f"height {self._height(motion):.2f} m, East {motion.x_m:.2f} m, North {motion.y_m:.2f} m, "
            f"{motion.speed_m_s:.2f} m/s"
        )


class _Seen(NamedTuple):
    t_s: float
    x_m: float
    y_m: float
    heading_rad: float


class RestWatch:
    """Tells rest from slowness: the vehicle has set out, and since `rest_s` neither moves nor turns.

    Speed alone would not do: a vehicle that turns on the spot to find the bearing has none, and a noisy
    velocity estimate always has some.
    """

    def __init__(self, rest_s: float = REST_S) -> None:
        self._rest_s = rest_s
        self._start: _Seen | None = None
        self._window: deque[_Seen] = deque()
        self._turned_rad = 0.0
        self._begun = False

    def add(self, t_s: float, motion: Motion) -> bool:
        """Take one more look; True if the vehicle has come to rest."""
        seen = _Seen(t_s, motion.x_m, motion.y_m, motion.heading_rad)
        if self._start is None:
            self._start = seen
        if self._window:
            last = self._window[-1]
            self._turned_rad += math.remainder(seen.heading_rad - last.heading_rad, math.tau)
            if t_s - last.t_s > REST_S / 2:
                self._window.clear()  # what happened in between is not known
        self._begun = (
            self._begun
            or math.hypot(seen.x_m - self._start.x_m, seen.y_m - self._start.y_m) > BEGUN_MOVE_M
            or abs(self._turned_rad) > BEGUN_TURN_RAD
        )
        self._window.append(seen)
        while len(self._window) > 2 and self._window[1].t_s <= t_s - self._rest_s:
            self._window.popleft()
        return (
            self._begun
            and t_s - self._window[0].t_s >= self._rest_s
            and all(math.hypot(s.x_m - seen.x_m, s.y_m - seen.y_m) <= REST_RADIUS_M for s in self._window)
            and all(
                abs(math.remainder(s.heading_rad - seen.heading_rad, math.tau)) <= REST_TURN_RAD
                for s in self._window
            )
        )
