"""How a quadrotor really moves: truth kinematics of its own, independent of any guidance model.

The autopilot's inner loops are told by what they achieve, as fitted to recorded flights of a PX4: a velocity
or a yaw rate that is commanded arrives after a dead time and two equal first-order lags in series. Horizontal
velocity answers in the earth's frame, not in the body's, so the ground velocity lags the nose in a turn.

Frames as everywhere: x East, y North, height up, heading counter-clockwise from East; SI units.
"""

from __future__ import annotations

from math import atan2, cos, exp, pi, sin, sqrt

from sitl_mock.scenario import Scenario

STEP_S = 0.01
"""The fixed step of the simulation."""

_DRAG_1_S = 0.25
"""Linear drag, 1/s: how a levelled vehicle loses speed."""
_GRAVITY_M_S2 = 9.81
_TERMINAL_M_S = 15.0


def wrap(angle_rad: float) -> float:
    """Bring an angle into (−π, π]."""
    if -pi < angle_rad <= pi:
        return angle_rad
    wrapped = atan2(sin(angle_rad), cos(angle_rad))
    return wrapped if wrapped > -pi else pi


class Lag:
    """A dead time and two equal first-order lags in series, in fixed steps; `lag_s` is the sum of the two."""

    __slots__ = ("_at", "_gain", "_queue", "first", "value")

    def __init__(self, lag_s: float, delay_s: float = 0.0) -> None:
        self._gain = 1.0 - exp(-STEP_S / (0.5 * lag_s)) if lag_s > 0.0 else 1.0
        self._queue = [0.0] * round(delay_s / STEP_S)
        self._at = 0
        """The oldest command in the queue, which runs in a circle."""
        self.first = 0.0
        self.value = 0.0

    def step(self, command: float) -> float:
        """Advance by STEP_S with this command; return the new value."""
        queue = self._queue
        if queue:
            at = self._at
            command, queue[at] = queue[at], command
            self._at = at + 1 if at + 1 < len(queue) else 0
        self.first += self._gain * (command - self.first)
        self.value += self._gain * (self.first - self.value)
        return self.value

    def settle(self, value: float) -> None:
        """Take `value` as the state, as if it had been commanded for ever."""
        self.first = self.value = value
        for i in range(len(self._queue)):
            self._queue[i] = value


class Vehicle:
    """The truth: where the vehicle is and how it moves. `step` advances it by STEP_S."""

    __slots__ = (
        "_climb",
        "_command",
        "_creep",
        "_creep_gain",
        "_creep_share",
        "_level",
        "_vx",
        "_vy",
        "_yaw",
        "_yaw_gain",
        "climb_m_s",
        "heading_rad",
        "height_m",
        "motors_on",
        "path_m",
        "vx_m_s",
        "vy_m_s",
        "x_m",
        "y_m",
        "yaw_rate_rad_s",
    )

    def __init__(self, s: Scenario, x_m: float, y_m: float, height_m: float, heading_rad: float) -> None:
        self.x_m, self.y_m, self.height_m = x_m, y_m, height_m
        self.heading_rad = wrap(heading_rad)
        self.vx_m_s = self.vy_m_s = self.climb_m_s = self.yaw_rate_rad_s = 0.0
        self.motors_on = False
        self.path_m = 0.0
        """Horizontal path flown so far."""
        self._vx = Lag(s.velocity_lag_s, s.velocity_delay_s)
        self._vy = Lag(s.velocity_lag_s, s.velocity_delay_s)
        self._climb = Lag(s.vertical_lag_s)
        self._yaw = Lag(s.yaw_rate_lag_s, s.yaw_rate_delay_s)
        self._yaw_gain = s.yaw_rate_gain
        self._creep = 0.0
        self._creep_share = s.yaw_rate_creep
        self._creep_gain = 1.0 - exp(-STEP_S / s.yaw_rate_creep_s) if s.yaw_rate_creep_s > 0.0 else 1.0
        self._level = False
        self._command = (0.0, 0.0, 0.0, 0.0)

    @property
    def on_ground(self) -> bool:
        """True where the vehicle stands on the ground."""
        return self.height_m <= 0.0

    def command(self, vx_m_s: float, vy_m_s: float, climb_m_s: float, yaw_rate_rad_s: float) -> None:
        """Fly this velocity and yaw rate from now on."""
        self._command = (vx_m_s, vy_m_s, climb_m_s, yaw_rate_rad_s)
        self._level = False

    def level(self, climb_m_s: float) -> None:
        """Keep level: the horizontal velocity is left to the drag. The yaw stands still."""
        self._command = (0.0, 0.0, climb_m_s, 0.0)
        self._level = True

    def step(self) -> None:
        """Advance by STEP_S."""
        if not self.motors_on:
            self._fall()
            return
        vx, vy, climb, yaw_rate = self._command
        if self._level:
            keep = 1.0 - _DRAG_1_S * STEP_S
            self._vx.settle(self._vx.value * keep)
            self._vy.settle(self._vy.value * keep)
            vx, vy = self._vx.value, self._vy.value
        else:
            vx, vy = self._vx.step(vx), self._vy.step(vy)
        climb = self._climb.step(climb)
        # Most of the yaw rate comes at once, the rest creeps in (and out) by the rate loop's integrator.
        fast = self._yaw.step(yaw_rate)
        self._creep += self._creep_gain * (fast - self._creep)
        yaw_rate = self._yaw_gain * (fast + self._creep_share * (self._creep - fast))

        if self.height_m <= 0.0 and climb <= 0.0:
            self._rest()
            return
        # The old and the new rate's mean over the step: exact for a constant command.
        twice_x, twice_y = self.vx_m_s + vx, self.vy_m_s + vy
        self.x_m += 0.5 * twice_x * STEP_S
        self.y_m += 0.5 * twice_y * STEP_S
        self.height_m += climb * STEP_S
        self.heading_rad = wrap(self.heading_rad + yaw_rate * STEP_S)
        self.path_m += 0.5 * sqrt(twice_x * twice_x + twice_y * twice_y) * STEP_S
        self.vx_m_s, self.vy_m_s, self.climb_m_s, self.yaw_rate_rad_s = vx, vy, climb, yaw_rate
        if self.height_m <= 0.0:
            self._rest()

    def _fall(self) -> None:
        if self.height_m <= 0.0:
            self._rest()
            return
        self.climb_m_s = max(self.climb_m_s - _GRAVITY_M_S2 * STEP_S, -_TERMINAL_M_S)
        self.height_m += self.climb_m_s * STEP_S
        self.x_m += self.vx_m_s * STEP_S
        self.y_m += self.vy_m_s * STEP_S
        if self.height_m <= 0.0:
            self._rest()

    def _rest(self) -> None:
        """Stand on the ground: friction takes every motion but the next lift-off."""
        self.height_m = 0.0
        self.vx_m_s = self.vy_m_s = self.climb_m_s = self.yaw_rate_rad_s = 0.0
        self._vx.settle(0.0)
        self._vy.settle(0.0)
        self._yaw.settle(0.0)
        self._creep = 0.0
        self._climb.settle(max(self._climb.value, 0.0))
