"""How the autopilot flies its modes: from targets and its own estimate to what the vehicle is commanded.

The autopilot regulates its estimate, not the truth: the plant's input is the wanted velocity minus the
error of the estimated one, so a biased estimate moves the vehicle. That is why a height that is held in the
local frame keeps the estimate in place, and a bare zero climb rate drifts.
"""

from __future__ import annotations

from math import copysign, hypot, sqrt

import msgspec

from sitl_mock.estimate import EstimateErrors
from sitl_mock.modes import Mode
from sitl_mock.params import Params
from sitl_mock.vehicle import STEP_S, Vehicle, wrap

_YAW_P_1_S = 1.5
_YAW_RATE_MAX_RAD_S = 0.785
"""To a heading that is held."""
_YAW_RATE_LIMIT_RAD_S = 3.49
"""Of any yaw rate (MC_YAWRATE_MAX)."""
_STANDSTILL_M_S = 0.1
_CRAWL_HEIGHT_M = 0.68
"""Below this the landing crawls, recorded."""
_LANDING_RAMP_S = 0.5
"""A commanded landing gets to speed within this, recorded."""
_TAKE_OFF_ACCEPTANCE_M = 0.8
"""A take-off is over this close to its height (NAV_MC_ALT_RAD)."""
_TAKE_OFF_BRAKE_M_S2 = 0.41
_HOLD_HEIGHT_P_1_S = 0.7
"""How the height is approached by a take-off, and held by the automatic modes; recorded."""
_RETURN_REACHED_M = 0.5
# Shares of MPC_TKO_RAMP_T: after the first the vehicle rises, within the second it gets to speed; recorded.
_RAMP_START, _RAMP_RISE = 0.6, 0.75

_AFTER_TAKE_OFF = frozenset({Mode.LOITER, Mode.OFFBOARD})
"""PX4 and ArduCopter go on to the height of a take-off in these."""
_LIFTING = frozenset({Mode.TAKEOFF, Mode.OFFBOARD})
"""The modes that leave the ground."""
_LEVEL = frozenset({Mode.DESCEND, Mode.ALTCTL, Mode.MANUAL, Mode.STABILIZED, Mode.ACRO})
"""The modes that keep level and leave the horizontal velocity to the drag."""


class Target(msgspec.Struct, frozen=True, gc=False):
    """An OFFBOARD setpoint in the local frame; None: not controlled."""

    x_m: float | None = None
    y_m: float | None = None
    height_m: float | None = None
    vx_m_s: float | None = None
    vy_m_s: float | None = None
    climb_m_s: float | None = None
    heading_rad: float | None = None
    yaw_rate_rad_s: float | None = None


def _limit(value: float, low: float, high: float) -> float:
    return low if value < low else high if value > high else value


class Autopilot:
    """Position, velocity and yaw control of every mode."""

    def __init__(self, vehicle: Vehicle, errors: EstimateErrors, params: Params) -> None:
        self._vehicle, self._errors, self._params = vehicle, errors, params.values
        self.offboard: Target | None = None
        """The setpoint that OFFBOARD flies; None until the first one after its entry."""
        self.climbing = False
        """True while the wanted vertical velocity is upward."""
        self.home_x_m, self.home_y_m, self.home_height_m = self._position()
        self._hold_x: float | None = None
        self._hold_y: float | None = None
        self._hold_height = 0.0
        self._hold_heading: float | None = None
        self._take_off_height: float | None = None
        self._ramp_s = 0.0
        self._landing_s = 0.0
        self._return_height: float | None = None
        self._returned = False

    # ---------------------------------------------------------------------------------------- estimate

    def _position(self) -> tuple[float, float, float]:
        v, e = self._vehicle, self._errors
        return v.x_m + e.x_m, v.y_m + e.y_m, v.height_m + e.height_m

    @property
    def height_m(self) -> float:
        """Estimated height."""
        return self._vehicle.height_m + self._errors.height_m

    @property
    def heading_rad(self) -> float:
        """Estimated heading."""
        return wrap(self._vehicle.heading_rad + self._errors.heading_rad)

    @property
    def take_off_done(self) -> bool:
        """True where a take-off is as good as at its height."""
        return self._take_off_height is not None and self._take_off_remaining_m < _TAKE_OFF_ACCEPTANCE_M

    @property
    def _take_off_remaining_m(self) -> float:
        return (self._take_off_height or 0.0) - self.height_m

    # ------------------------------------------------------------------------------------------- modes

    def set_home(self) -> None:
        """Home is here."""
        self.home_x_m, self.home_y_m, self.home_height_m = self._position()

    def set_take_off(self, height_m: float | None) -> None:
        """Take off to this local height; None: MIS_TAKEOFF_ALT above home. Never downwards."""
        if height_m is None:
            height_m = self.home_height_m + self._params["MIS_TAKEOFF_ALT"]
        self._take_off_height = max(height_m, self.height_m)

    def enter(self, mode: Mode) -> None:
        """Begin to fly this mode from here."""
        x, y, height = self._position()
        self.offboard = None
        self._hold_heading = None
        self._hold_x = self._hold_y = None
        self._ramp_s = self._landing_s = 0.0
        if mode is Mode.TAKEOFF:
            self._hold_x, self._hold_y = x, y
            if self._take_off_height is None:
                self.set_take_off(None)
        elif mode in _AFTER_TAKE_OFF and self._take_off_height is not None and self.take_off_done:
            self._hold_x, self._hold_y, self._hold_height = x, y, self._take_off_height
        else:
            self._hold_height = height
        if mode is not Mode.TAKEOFF:
            self._take_off_height = None
        if mode is Mode.RTL:
            away = hypot(x - self.home_x_m, y - self.home_y_m)
            # PX4's cone of 45 degrees: the closer to home, the lower the return.
            self._return_height = max(height, self.home_height_m + min(self._params["RTL_RETURN_ALT"], away))
            self._returned = False

    def fly(self, mode: Mode, landed: bool, spooled: bool) -> bool:
        """Command the vehicle for one step. True where it is off the ground, or leaves it, by its will."""
        vehicle, errors = self._vehicle, self._errors
        vx, vy, climb, yaw_rate = self._wanted(mode)
        self.climbing = climb > 0.05
        if landed and not (spooled and self.climbing and mode in _LIFTING):
            vehicle.command(0.0, 0.0, -1.0, 0.0)
            self._ramp_s = 0.0
            return False
        if vehicle.on_ground and not self.climbing:
            vehicle.command(0.0, 0.0, -1.0, 0.0)
            return False
        if self._ramp_s < 2.0 * self._params["MPC_TKO_RAMP_T"] and (
            landed or mode is Mode.TAKEOFF or self._ramp_s
        ):
            self._ramp_s += STEP_S
            climb = min(climb, self._ramp_limit())
        if mode in _LEVEL:
            vehicle.level(climb - errors.climb_m_s)
        else:
            vehicle.command(vx - errors.vx_m_s, vy - errors.vy_m_s, climb - errors.climb_m_s, yaw_rate)
        return self.climbing

    def _ramp_limit(self) -> float:
        params = self._params
        ramp = params["MPC_TKO_RAMP_T"]
        share = 1.0 if ramp <= 0.0 else _limit((self._ramp_s / ramp - _RAMP_START) / _RAMP_RISE, 0.0, 1.0)
        return share * params["MPC_TKO_SPEED"]

    def _wanted(self, mode: Mode) -> tuple[float, float, float, float]:
        """Estimated velocity and yaw rate that this mode wants now."""
        params = self._params
        if mode is Mode.OFFBOARD:
            return self._wanted_offboard()
        vx, vy = self._hold_position()
        if mode is Mode.TAKEOFF:
            remaining = self._take_off_remaining_m
            climb = copysign(sqrt(2.0 * _TAKE_OFF_BRAKE_M_S2 * abs(remaining)), remaining)
            climb = min(climb, params["MPC_TKO_SPEED"])
        elif mode is Mode.LAND:
            climb = self._landing_climb()
        elif mode is Mode.DESCEND:
            climb = -params["MPC_LAND_SPEED"]
        elif mode is Mode.RTL:
            vx, vy, climb = self._wanted_return(vx, vy)
        else:
            climb = self._height_climb(self._hold_height)
        return vx, vy, climb, self._hold_yaw()

    def _wanted_offboard(self) -> tuple[float, float, float, float]:
        target, params = self.offboard, self._params
        if target is None:
            return 0.0, 0.0, self._height_climb(self._hold_height), 0.0
        vx, vy = target.vx_m_s or 0.0, target.vy_m_s or 0.0
        if target.x_m is not None and target.y_m is not None:
            x, y, _ = self._position()
            gain = params["MPC_XY_P"]
            vx += gain * (target.x_m - x)
            vy += gain * (target.y_m - y)
        speed, most = hypot(vx, vy), params["MPC_XY_VEL_MAX"]
        if speed > most:
            vx, vy = vx * most / speed, vy * most / speed
        climb = target.climb_m_s or 0.0
        if target.height_m is not None:
            climb += params["MPC_Z_P"] * (target.height_m - self.height_m)
        climb = _limit(climb, -params["MPC_Z_VEL_MAX_DN"], params["MPC_Z_VEL_MAX_UP"])
        yaw_rate = target.yaw_rate_rad_s or 0.0
        if target.heading_rad is not None:
            yaw_rate += self._yaw_to(target.heading_rad)
        return vx, vy, climb, _limit(yaw_rate, -_YAW_RATE_LIMIT_RAD_S, _YAW_RATE_LIMIT_RAD_S)

    def _hold_position(self) -> tuple[float, float]:
        """Brake, then keep the place where the vehicle came to a stand."""
        v, e = self._vehicle, self._errors
        x, y, _ = self._position()
        if self._hold_x is None or self._hold_y is None:
            if hypot(v.vx_m_s + e.vx_m_s, v.vy_m_s + e.vy_m_s) > _STANDSTILL_M_S:
                return 0.0, 0.0
            self._hold_x, self._hold_y = x, y
        return self._towards(self._hold_x - x, self._hold_y - y)

    def _towards(self, dx: float, dy: float) -> tuple[float, float]:
        vx, vy = self._params["MPC_XY_P"] * dx, self._params["MPC_XY_P"] * dy
        speed, most = hypot(vx, vy), self._params["MPC_XY_CRUISE"]
        return (vx, vy) if speed <= most else (vx * most / speed, vy * most / speed)

    def _height_climb(self, height_m: float) -> float:
        params = self._params
        return _limit(
            _HOLD_HEIGHT_P_1_S * (height_m - self.height_m),
            -params["MPC_Z_VEL_MAX_DN"],
            params["MPC_Z_VEL_MAX_UP"],
        )

    def _landing_climb(self) -> float:
        if self.height_m - self.home_height_m < _CRAWL_HEIGHT_M:
            return -self._params["MPC_LAND_CRWL"]
        self._landing_s += STEP_S
        return -self._params["MPC_LAND_SPEED"] * min(self._landing_s / _LANDING_RAMP_S, 1.0)

    def _wanted_return(self, vx: float, vy: float) -> tuple[float, float, float]:
        """Climb, fly home, land there."""
        x, y, height = self._position()
        dx, dy = self.home_x_m - x, self.home_y_m - y
        if self._returned:
            vx, vy = self._towards(dx, dy)
            return vx, vy, self._landing_climb()
        wanted = self._return_height if self._return_height is not None else height
        if wanted - height > _RETURN_REACHED_M:
            return vx, vy, self._height_climb(wanted)
        self._returned = hypot(dx, dy) < _RETURN_REACHED_M
        vx, vy = self._towards(dx, dy)
        return vx, vy, self._height_climb(wanted)

    def _hold_yaw(self) -> float:
        if self._hold_heading is None:
            if abs(self._vehicle.yaw_rate_rad_s) > 0.05:
                return 0.0
            self._hold_heading = self.heading_rad
        return self._yaw_to(self._hold_heading)

    def _yaw_to(self, heading_rad: float) -> float:
        rate = _YAW_P_1_S * wrap(heading_rad - self.heading_rad)
        return _limit(rate, -_YAW_RATE_MAX_RAD_S, _YAW_RATE_MAX_RAD_S)
