"""The autopilot's rules, sans I/O: modes, arming, take-off, landing, OFFBOARD and its failsafes.

This is the one place where they live: `world.py` flies it on a virtual clock, `protocol.py` puts it on
MAVLink. Time is a count of fixed steps. "Recorded" means: from a PX4 1.17 alpha in its own SIH simulation.
Frames as everywhere: x East, y North, height up, heading counter-clockwise from East.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, NamedTuple

from companion.types import Charge, Landed
from sitl_mock import px4_events as told
from sitl_mock.autopilot import Autopilot, Target
from sitl_mock.estimate import EstimateErrors
from sitl_mock.faults import Fault, Faults
from sitl_mock.modes import Mode, Result
from sitl_mock.params import Params
from sitl_mock.scenario import Scenario
from sitl_mock.vehicle import STEP_S, Vehicle

SPOOL_UP_S = 1.85
"""From arming to lift-off, recorded."""
LAND_DETECTION_S = 3.25
"""From touch-down to "landed", recorded."""
NOTICE_S = 0.05
"""How long the commander takes to see that a stream has stopped, recorded."""
REBOOT_S = 2.0
CRITICAL, INFO = 2, 6
"""MAV_SEVERITY."""
_CHARGE_SHARE = {Charge.OK: 1.0, Charge.LOW: 0.14, Charge.CRITICAL: 0.05}
_OTHER_SYSTEM = 42
_HIDDEN_TARGET = Target(vx_m_s=-0.4, vy_m_s=0.0, climb_m_s=0.0, yaw_rate_rad_s=-0.5)
_HIDDEN_STEPS = round(0.07 / STEP_S)
_DRAIN_1_S = 0.0164
"""Recorded: SIH drains its battery so fast in flight."""

_STREAM_LOST: dict[int, tuple[Mode, ...]] = {
    0: (Mode.POSCTL, Mode.ALTCTL),
    1: (Mode.ALTCTL,),
    2: (Mode.MANUAL,),
    3: (Mode.RTL, Mode.LAND),
    4: (Mode.LAND,),
    5: (Mode.LOITER, Mode.RTL, Mode.LAND),
}
"""What COM_OBL_RC_ACT wishes for, best first; what can run of it is flown, or else the blind descent."""


class Notice(NamedTuple):
    """A STATUSTEXT: MAV_SEVERITY and words."""

    severity: int
    text: str


class Px4:
    """The commander. Commands come in by methods, time by `step`; whoever owns it reads its state.

    `notices` collects what it says to people, `events` the same for a companion; `on_reboot` is called when
    it restarts.
    """

    is_ardupilot: ClassVar = False
    after_take_off: ClassVar = Mode.LOITER

    def __init__(
        self, scenario: Scenario, seed: int, vehicle: Vehicle, params: Params, faults: Faults
    ) -> None:
        self.vehicle = vehicle
        self.params = params
        self.faults = faults
        self.errors = EstimateErrors(scenario.telemetry, seed, scenario.drift_x_m_s, scenario.drift_y_m_s)
        self.autopilot = Autopilot(vehicle, self.errors, params)
        self.notices: list[Notice] = []
        self.events: list[told.Event] = []
        self.on_reboot: Callable[[], None] = lambda: None
        self.scenario = scenario
        self._steps = 0
        self._boot_step = 0
        self._seen_faults: set[Fault] = set()
        self._fault_changes = 0
        self._start()

    def _start(self) -> None:
        self.mode = Mode.LOITER
        self.intended = Mode.LOITER
        self.armed = False
        self.landed = True
        """The land detector's answer; `landed_state` is what EXTENDED_SYS_STATE says."""
        self.failsafe = False
        self.ever_streamed = False
        self._after_disarm = Mode.LOITER
        self._forced: Mode | None = None
        self._stream_step: int | None = None
        self._armed_step = 0
        self._contact_step: int | None = None
        self._landed_step = 0
        self._flown = False

    def start_in_air(self) -> None:
        """Begin armed and hovering in AUTO.LOITER where the vehicle is."""
        self.armed = self.vehicle.motors_on = self._flown = True
        self.landed = False
        self.autopilot.set_home()
        self.autopilot.home_height_m -= self.vehicle.height_m  # it took off from the ground below
        self.autopilot.enter(Mode.LOITER)

    # ------------------------------------------------------------------------------------------- state

    @property
    def t_s(self) -> float:
        """Seconds since the mock was started."""
        return self._steps * STEP_S

    @property
    def boot_s(self) -> float:
        """Seconds since the autopilot was started: its own clock."""
        return (self._steps - self._boot_step) * STEP_S

    @property
    def booting(self) -> bool:
        """True during a restart: it neither sends nor listens."""
        return self._boot_step > 0 and self.boot_s < REBOOT_S

    @property
    def landed_state(self) -> Landed:
        """EXTENDED_SYS_STATE.landed_state."""
        if self.landed:
            return Landed.ON_GROUND
        if self.mode is Mode.TAKEOFF:
            return Landed.TAKING_OFF
        return Landed.LANDING if self.mode is Mode.LAND else Landed.IN_AIR

    @property
    def velocity_valid(self) -> bool:
        """The estimator has a velocity and a local position."""
        return not self.faults.active(Fault.VELOCITY_INVALID)

    @property
    def global_position_valid(self) -> bool:
        """The estimator has a global position."""
        return self.velocity_valid and not self.faults.active(Fault.GPS_LOST)

    @property
    def battery(self) -> float:
        """The share of the battery that is left: SIH's never falls below a half."""
        used = _DRAIN_1_S * (self._steps - self._armed_step) * STEP_S if self.armed else 0.0
        return max(1.0 - used, 0.5)

    @property
    def battery_low(self) -> bool:
        """The battery is at its critical level."""
        return self.faults.active(Fault.BATTERY_LOW)

    @property
    def charge(self) -> Charge:
        """BATTERY_STATUS.charge_state."""
        if self.battery_low:
            return Charge.CRITICAL
        return Charge.LOW if self.faults.active(Fault.BATTERY_WARNING) else Charge.OK

    @property
    def battery_told(self) -> float:
        """The share of the battery that is told to be left."""
        return min(self.battery, _CHARGE_SHARE[self.charge])

    @property
    def remote_control(self) -> bool:
        """A radio control is there."""
        return (
            self.scenario.remote_control
            or self.faults.active(Fault.RC_SWITCH)
            or self.faults.active(Fault.RC_STICKS)
        )

    @property
    def streaming(self) -> bool:
        """A setpoint no older than COM_OF_LOSS_T is there."""
        since = self._stream_step
        return since is not None and (self._steps - since) * STEP_S <= self.params["COM_OF_LOSS_T"] + NOTICE_S

    @property
    def armable(self) -> bool:
        """The PREARM_CHECK bit of SYS_STATUS: recorded, it follows the mode in effect."""
        return self.can_run(self.mode) and not self.battery_low

    def can_run(self, mode: Mode) -> bool:
        """True where this mode has what it needs."""
        if mode is Mode.OFFBOARD:
            return self.streaming and self.velocity_valid
        if mode in (Mode.LOITER, Mode.TAKEOFF, Mode.RTL):
            return self.global_position_valid
        if mode is Mode.LAND:
            return self.velocity_valid
        if mode is Mode.POSCTL:
            return self.remote_control and self.velocity_valid
        # There is never a mission, and READY is no mode to fly in.
        return mode.is_manual and self.remote_control

    # ---------------------------------------------------------------------------------------- commands

    def set_mode(self, mode: Mode) -> Result:
        """DO_SET_MODE: refused in flight where the mode lacks what it needs; while disarmed anything goes."""
        if self.armed and not self.can_run(mode):
            if mode is Mode.OFFBOARD:
                self._say(CRITICAL, "Switching to Offboard is currently not available: no offboard signal")
            else:
                self._say(CRITICAL, f"Switching to {mode.value} is currently not available")
            return Result.TEMPORARILY_REJECTED
        self.intended = mode
        self._forced = None
        if mode not in (Mode.TAKEOFF, Mode.LAND, Mode.RTL):
            self._after_disarm = mode
        self._choose_mode()
        return Result.ACCEPTED

    def arm(self) -> Result:
        """COMPONENT_ARM_DISARM 1."""
        if self.armed:
            return Result.ACCEPTED
        if not self.armable or self.mode in (Mode.LAND, Mode.RTL):
            self._say(CRITICAL, "Arming denied: resolve system health failures first")
            self.events.append(told.ARM_DENIED)
            return Result.TEMPORARILY_REJECTED
        self.armed = self.vehicle.motors_on = True
        self._armed_step = self._steps
        self._flown = False
        self.autopilot.set_home()
        self.autopilot.enter(self.mode)
        self._say(INFO, "Armed by external command")
        self.events.append(told.ARMED)
        return Result.ACCEPTED

    def disarm(self, force: bool = False) -> Result:
        """COMPONENT_ARM_DISARM 0: refused in the air unless forced."""
        if self.armed and not self.landed and not force:
            self._say(CRITICAL, "Disarming denied: not landed")
            return Result.TEMPORARILY_REJECTED
        if self.armed:
            self._disarm("Disarmed by external command")
        return Result.ACCEPTED

    def take_off(self, height_m: float | None) -> Result:
        """NAV_TAKEOFF to this local height, or by MIS_TAKEOFF_ALT. It does not arm."""
        result = self.set_mode(Mode.TAKEOFF)
        if result is Result.ACCEPTED:
            self.autopilot.set_take_off(height_m)
        return result

    def setpoint(self, target: Target) -> None:
        """An accepted SET_POSITION_TARGET_LOCAL_NED: proof of life, and in OFFBOARD what is flown."""
        if self.faults.active(Fault.SETPOINTS_REFUSED):
            return
        self._stream_step = self._steps
        self.ever_streamed = True
        if self.mode is Mode.OFFBOARD:
            self.autopilot.offboard = target

    def reboot(self) -> None:
        """Start anew: the motors stop, wherever the vehicle is."""
        self.vehicle.motors_on = False
        self._boot_step = self._steps
        self._start()
        self.landed = self.vehicle.on_ground
        self.on_reboot()

    # -------------------------------------------------------------------------------------------- time

    def step(self) -> None:
        """Advance by STEP_S: faults, failsafes, flight, land detector."""
        self._steps += 1
        self.faults.advance(self.t_s)
        if self.faults.changes != self._fault_changes:
            self._fault_changes = self.faults.changes
            self._take_single_faults()
        if (
            self.faults.any
            and self.faults.active(Fault.HIDDEN_COMMANDER)
            and self._steps % _HIDDEN_STEPS == 0
        ):
            self.setpoint(_HIDDEN_TARGET)
        self.errors.step()
        self._choose_mode()
        if self.armed:
            spooled = (self._steps - self._armed_step) * STEP_S >= SPOOL_UP_S or self._flown
            taking_off = self.autopilot.fly(self.mode, self.landed, spooled)
            if taking_off and self.landed:
                self.landed = False
                self._flown = True
                self._say(INFO, "Takeoff detected")
                self.events.append(told.TAKE_OFF)
        self.vehicle.step()
        if self.mode is Mode.TAKEOFF and self.armed and self.autopilot.take_off_done:
            self.intended = self.after_take_off
            self._after_disarm = Mode.LOITER
            self._choose_mode()
        self._detect_landing()

    def _take_single_faults(self) -> None:
        for fault, act in (
            (Fault.RC_SWITCH, lambda: self.set_mode(Mode.POSCTL)),
            (Fault.RC_STICKS, self._sticks_moved),
            (Fault.REBOOT, self.reboot),
            (Fault.DISARM, lambda: self.disarm(force=True)),
            (Fault.BATTERY_LOW, self._battery_critical),
            (Fault.ID_CHANGE, lambda: self.params.set("MAV_SYS_ID", _OTHER_SYSTEM)),
        ):
            if not self.faults.active(fault):
                self._seen_faults.discard(fault)
            elif fault not in self._seen_faults:
                self._seen_faults.add(fault)
                act()

    def _sticks_moved(self) -> None:
        override = int(self.params["COM_RC_OVERRIDE"])
        if (self.mode.is_auto and override & 1) or (self.mode is Mode.OFFBOARD and override & 2):
            self._say(INFO, "Pilot took over using sticks")
            self.set_mode(Mode.POSCTL)

    def _battery_critical(self) -> None:
        self._say(CRITICAL, "Critical battery level, land now")
        action = {2: Mode.LAND, 3: Mode.RTL}.get(int(self.params["COM_LOW_BAT_ACT"]))
        if self.armed and action is not None:
            self._forced = action

    def _choose_mode(self) -> None:
        """The mode in effect: the intended one, or what a failsafe makes of it while that cannot run."""
        if not self.armed:
            mode, failsafe = self.intended, False
        elif self._forced is not None:
            mode, failsafe = self._forced if self.can_run(self._forced) else Mode.DESCEND, True
        elif self.can_run(self.intended):
            mode, failsafe = self.intended, False
        elif self.intended is Mode.OFFBOARD and self.params["COM_OBL_RC_ACT"] in (6, 7):
            self._disarm("Disarmed by failsafe")
            return
        else:
            mode, failsafe = self._fallback(), True
        if failsafe and not self.failsafe:
            self._say(
                CRITICAL,
                f"Failsafe activated: {'no offboard signal, ' if not self.streaming else ''}{mode.value}",
            )
            if self.intended is Mode.OFFBOARD and not self.can_run(Mode.OFFBOARD):
                self.events.append(told.NO_OFFBOARD)
            self.events.append(told.failsafe(self.intended, int(self.params["COM_OBL_RC_ACT"])))
        self.failsafe = failsafe
        if mode is not self.mode:
            self.mode = mode
            self.autopilot.enter(mode)

    def _fallback(self) -> Mode:
        """What is flown instead of the intended mode: COM_OBL_RC_ACT for OFFBOARD, then the next best."""
        wish: tuple[Mode, ...] = (Mode.POSCTL, Mode.LAND)
        if self.intended is Mode.OFFBOARD:
            wish = _STREAM_LOST.get(int(self.params["COM_OBL_RC_ACT"]), ())
        return next((mode for mode in wish if self.can_run(mode)), Mode.DESCEND)

    def _detect_landing(self) -> None:
        if not self.armed:
            self.landed = self.vehicle.on_ground
            return
        if self.landed:
            wait_s = self.params["COM_DISARM_LAND"] if self._flown else self.params["COM_DISARM_PRFLT"]
            since = self._landed_step if self._flown else self._armed_step
            # Before the first lift-off only a hover-less wait counts: a take-off is on its way.
            waiting = self._flown or self.mode is not Mode.TAKEOFF
            if waiting and wait_s > 0.0 and (self._steps - since) * STEP_S >= wait_s:
                self._disarm("Disarmed by landing" if self._flown else "Disarmed by auto preflight disarming")
            return
        if not self.vehicle.on_ground or self.autopilot.climbing:
            self._contact_step = None
            return
        if self._contact_step is None:
            self._contact_step = self._steps
        if (self._steps - self._contact_step) * STEP_S >= LAND_DETECTION_S:
            self.landed = True
            self._landed_step = self._steps
            self._contact_step = None
            self._say(INFO, "Landing detected")
            self.events.append(told.LANDED)

    def _disarm(self, words: str) -> None:
        self.armed = self.vehicle.motors_on = False
        self.intended = self.mode = self._after_disarm
        self.failsafe = False
        self._forced = None
        self._contact_step = None
        self.autopilot.enter(self.mode)
        self._say(INFO, words)
        if words == "Disarmed by landing":
            self.events.append(told.DISARMED_BY_LANDING)

    def say_critical(self, text: str) -> None:
        """Say this to people."""
        self._say(CRITICAL, text)

    def _say(self, severity: int, text: str) -> None:
        self.notices.append(Notice(severity, text))
