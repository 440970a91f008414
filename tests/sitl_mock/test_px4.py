"""The autopilot's rules, where the recordings do not show them: fallbacks, faults, arming, rates."""

from __future__ import annotations

from math import hypot

import pytest

from companion.types import Landed
from sitl_mock.autopilot import Target
from sitl_mock.faults import Fault, Faults
from sitl_mock.modes import Mode, Result
from sitl_mock.params import Params
from sitl_mock.px4 import Px4
from sitl_mock.scenario import Scenario
from sitl_mock.vehicle import Vehicle

FORWARD = Target(height_m=3.0, vx_m_s=0.5, vy_m_s=0.0, yaw_rate_rad_s=0.0)
QUIET = Scenario(telemetry="perfect")


def on_ground(scenario: Scenario = QUIET, **params: float) -> Px4:
    """A vehicle on the ground, disarmed."""
    vehicle = Vehicle(scenario, 0.0, 0.0, 0.0, 0.0)
    return Px4(scenario, 1, vehicle, Params(params), Faults())


def hovering(scenario: Scenario = QUIET, **params: float) -> Px4:
    """A vehicle that hovers at 3 m in AUTO.LOITER."""
    px4 = Px4(scenario, 1, Vehicle(scenario, 0.0, 0.0, 3.0, 0.0), Params(params), Faults())
    px4.start_in_air()
    return px4


def run(px4: Px4, duration_s: float, target: Target | None = None, rate_hz: float = 20.0) -> list[Mode]:
    """Let time pass, with or without a stream of setpoints; the modes that were in effect, in order."""
    end = px4.t_s + duration_s
    due = px4.t_s
    modes = [px4.mode]
    while px4.t_s < end - 1e-9:
        if target is not None and px4.t_s >= due - 1e-9:
            px4.setpoint(target)
            due += 1.0 / rate_hz
        px4.step()
        if px4.mode is not modes[-1]:
            modes.append(px4.mode)
    return modes


def in_offboard(scenario: Scenario = QUIET, **params: float) -> Px4:
    """A vehicle that flies forward in OFFBOARD."""
    px4 = hovering(scenario, **params)
    run(px4, 0.5, FORWARD)
    assert px4.set_mode(Mode.OFFBOARD) is Result.ACCEPTED
    run(px4, 3.0, FORWARD)
    assert px4.mode is Mode.OFFBOARD
    return px4


# ------------------------------------------------------------------------------------ the stream is lost


@pytest.mark.parametrize(
    ("action", "radio", "mode"),
    [
        (0, False, Mode.DESCEND), (0, True, Mode.POSCTL), (1, False, Mode.DESCEND), (1, True, Mode.ALTCTL),
        (2, True, Mode.MANUAL), (3, False, Mode.RTL), (4, False, Mode.LAND), (5, False, Mode.LOITER),
    ],
)  # fmt: skip
def test_lost_stream_is_answered_by_com_obl_rc_act(action: int, radio: bool, mode: Mode) -> None:
    px4 = in_offboard(Scenario(telemetry="perfect", remote_control=radio), COM_OBL_RC_ACT=action)
    assert run(px4, 1.5) == [Mode.OFFBOARD, mode]
    assert px4.intended is Mode.OFFBOARD
    assert px4.failsafe


@pytest.mark.parametrize(("action", "mode"), [(3, Mode.LAND), (5, Mode.LAND)])
def test_hold_and_return_need_a_global_position(action: int, mode: Mode) -> None:
    px4 = in_offboard(COM_OBL_RC_ACT=action)
    px4.faults.switch(Fault.GPS_LOST, True)
    assert run(px4, 1.0, FORWARD) == [Mode.OFFBOARD]
    assert run(px4, 1.5) == [Mode.OFFBOARD, mode]


@pytest.mark.parametrize("action", [6, 7])
def test_terminate_and_disarm_stop_the_motors(action: int) -> None:
    px4 = in_offboard(COM_OBL_RC_ACT=action)
    run(px4, 3.0)
    assert not px4.armed
    assert px4.vehicle.on_ground


@pytest.mark.parametrize(("rate_hz", "kept"), [(1.1, True), (2.0, True), (0.9, False)])
def test_slowest_stream_that_keeps_the_mode(rate_hz: float, kept: bool) -> None:
    px4 = in_offboard(COM_OBL_RC_ACT=5)
    assert (run(px4, 10.0, FORWARD, rate_hz) == [Mode.OFFBOARD]) is kept


def test_time_limit_is_a_parameter() -> None:
    px4 = in_offboard(COM_OF_LOSS_T=0.3, COM_OBL_RC_ACT=5)
    assert run(px4, 0.25) == [Mode.OFFBOARD]
    assert run(px4, 0.25) == [Mode.OFFBOARD, Mode.LOITER]


def test_resumed_stream_returns_unless_another_mode_was_commanded() -> None:
    px4 = in_offboard(COM_OBL_RC_ACT=5)
    run(px4, 2.0)
    assert run(px4, 1.0, FORWARD) == [Mode.LOITER, Mode.OFFBOARD]
    run(px4, 2.0)
    assert px4.set_mode(Mode.LOITER) is Result.ACCEPTED
    assert run(px4, 3.0, FORWARD) == [Mode.LOITER]
    assert px4.intended is Mode.LOITER


def test_setpoint_of_the_past_is_not_flown_on_after_the_return() -> None:
    """What counts is the first setpoint after the return, not what was flown before the loss."""
    px4 = in_offboard(COM_OBL_RC_ACT=5)
    run(px4, 4.0)
    run(px4, 1.0, Target(height_m=3.0, vx_m_s=0.0, vy_m_s=0.0))
    assert hypot(px4.vehicle.vx_m_s, px4.vehicle.vy_m_s) < 0.05


# ------------------------------------------------------------------------------------------ the pilot


def test_offboard_needs_a_fresh_setpoint() -> None:
    px4 = hovering()
    assert px4.set_mode(Mode.OFFBOARD) is Result.TEMPORARILY_REJECTED
    px4.setpoint(FORWARD)
    run(px4, 0.9)
    assert px4.set_mode(Mode.OFFBOARD) is Result.ACCEPTED
    px4 = hovering()
    px4.setpoint(FORWARD)
    run(px4, 1.2)
    assert px4.set_mode(Mode.OFFBOARD) is Result.TEMPORARILY_REJECTED


def test_switch_takes_over_and_the_stream_does_not_take_back() -> None:
    px4 = in_offboard()
    px4.faults.switch(Fault.RC_SWITCH, True)
    assert run(px4, 5.0, FORWARD) == [Mode.OFFBOARD, Mode.POSCTL]
    assert px4.intended is Mode.POSCTL
    assert hypot(px4.vehicle.vx_m_s, px4.vehicle.vy_m_s) < 0.05


@pytest.mark.parametrize(("override", "taken"), [(1, False), (2, True), (3, True)])
def test_sticks_take_over_from_offboard_by_com_rc_override(override: int, taken: bool) -> None:
    px4 = in_offboard(COM_RC_OVERRIDE=override)
    px4.faults.switch(Fault.RC_STICKS, True)
    assert (Mode.POSCTL in run(px4, 0.5, FORWARD)) is taken


def test_sticks_take_over_from_automatic_modes_by_default() -> None:
    px4 = hovering()
    px4.faults.switch(Fault.RC_STICKS, True)
    assert run(px4, 0.1) == [Mode.LOITER, Mode.POSCTL]


def test_manual_modes_need_a_radio_control() -> None:
    px4 = hovering()
    assert px4.set_mode(Mode.POSCTL) is Result.TEMPORARILY_REJECTED
    assert hovering(Scenario(remote_control=True)).set_mode(Mode.POSCTL) is Result.ACCEPTED


# ------------------------------------------------------------------------------------ estimator, battery


def test_invalid_velocity_reads_as_no_offboard_signal() -> None:
    px4 = in_offboard(COM_OBL_RC_ACT=5)
    px4.faults.switch(Fault.VELOCITY_INVALID, True)
    assert run(px4, 0.5, FORWARD) == [Mode.OFFBOARD, Mode.DESCEND]
    px4.faults.switch(Fault.VELOCITY_INVALID, False)
    assert run(px4, 0.5, FORWARD) == [Mode.DESCEND, Mode.OFFBOARD]


@pytest.mark.parametrize(("action", "mode"), [(0, Mode.OFFBOARD), (2, Mode.LAND), (3, Mode.RTL)])
def test_critical_battery(action: int, mode: Mode) -> None:
    px4 = in_offboard(COM_LOW_BAT_ACT=action)
    px4.faults.switch(Fault.BATTERY_LOW, True)
    run(px4, 1.0, FORWARD)
    assert px4.mode is mode
    if mode is not Mode.OFFBOARD:
        assert px4.set_mode(Mode.LOITER) is Result.ACCEPTED  # a person may overrule it
        assert run(px4, 0.5, FORWARD) == [Mode.LOITER]


def test_landing_forced_by_the_battery_goes_on_without_a_velocity() -> None:
    px4 = in_offboard(COM_LOW_BAT_ACT=2)
    px4.faults.switch(Fault.BATTERY_LOW, True)
    run(px4, 0.5, FORWARD)
    px4.faults.switch(Fault.VELOCITY_INVALID, True)
    assert run(px4, 0.5, FORWARD) == [Mode.LAND, Mode.DESCEND]


def test_return_flies_home_and_lands_there() -> None:
    px4 = in_offboard(RTL_RETURN_ALT=5.0, MPC_LAND_SPEED=1.5)
    run(px4, 12.0, FORWARD)
    assert px4.vehicle.x_m > 6.0
    assert px4.set_mode(Mode.RTL) is Result.ACCEPTED
    run(px4, 60.0)
    assert not px4.armed
    assert px4.landed_state is Landed.ON_GROUND
    assert hypot(px4.vehicle.x_m, px4.vehicle.y_m) < 0.6
    assert px4.mode is Mode.OFFBOARD  # what was flown before the return


# ------------------------------------------------------------------------------ arming, take-off, landing


@pytest.mark.parametrize("fault", [Fault.GPS_LOST, Fault.VELOCITY_INVALID, Fault.BATTERY_LOW])
def test_arming_is_refused(fault: Fault) -> None:
    px4 = on_ground()
    px4.faults.switch(fault, True)
    run(px4, 0.1)
    assert not px4.armable
    assert px4.arm() is Result.TEMPORARILY_REJECTED
    px4.faults.switch(fault, False)
    run(px4, 0.1)
    assert px4.arm() is Result.ACCEPTED


def test_armed_without_a_take_off_disarms_by_itself() -> None:
    px4 = on_ground()
    px4.arm()
    run(px4, 9.5)
    assert px4.armed
    run(px4, 1.0)
    assert not px4.armed


def test_take_off_height_is_a_parameter_or_told() -> None:
    for height, expected in ((None, 4.0), (6.0, 6.0)):
        px4 = on_ground(MIS_TAKEOFF_ALT=4.0)
        px4.take_off(height)
        px4.arm()
        modes = run(px4, 20.0)
        assert modes == [Mode.TAKEOFF, Mode.LOITER]
        assert px4.vehicle.height_m == pytest.approx(expected, abs=0.05)
        assert px4.landed_state is Landed.IN_AIR


def test_hold_during_a_take_off_holds_there() -> None:
    px4 = on_ground(MIS_TAKEOFF_ALT=8.0)
    px4.take_off(None)
    px4.arm()
    while px4.vehicle.height_m < 3.0:
        px4.step()
    assert px4.set_mode(Mode.LOITER) is Result.ACCEPTED
    run(px4, 10.0)
    assert px4.vehicle.height_m < 4.0


def test_landing_disarms_and_the_next_flight_can_begin() -> None:
    px4 = hovering()
    px4.set_mode(Mode.LAND)
    run(px4, 15.0)
    assert (px4.armed, px4.landed_state, px4.mode) == (False, Landed.ON_GROUND, Mode.LOITER)
    assert px4.arm() is Result.ACCEPTED
    px4.take_off(None)
    run(px4, 15.0)
    assert px4.vehicle.height_m == pytest.approx(2.5, abs=0.1)


def test_after_a_landing_from_offboard_arming_needs_another_mode_or_a_stream() -> None:
    px4 = in_offboard(COM_OBL_RC_ACT=4)
    run(px4, 20.0)
    assert (px4.armed, px4.mode, px4.intended) == (False, Mode.OFFBOARD, Mode.OFFBOARD)
    assert px4.arm() is Result.TEMPORARILY_REJECTED
    px4.set_mode(Mode.LOITER)
    assert px4.arm() is Result.ACCEPTED


def test_disarming_in_the_air_is_refused_unless_forced() -> None:
    px4 = hovering()
    assert px4.disarm() is Result.TEMPORARILY_REJECTED
    assert px4.disarm(force=True) is Result.ACCEPTED
    run(px4, 2.0)
    assert px4.vehicle.on_ground


def test_stock_noise_does_not_lift_a_parked_vehicle() -> None:
    px4 = on_ground(Scenario(telemetry="stock"))
    px4.arm()
    run(px4, 9.0)
    assert px4.armed and px4.vehicle.height_m == 0.0 and px4.vehicle.path_m == 0.0


def test_reboot_begins_anew() -> None:
    px4 = in_offboard()
    px4.faults.switch(Fault.REBOOT, True)
    run(px4, 1.0, FORWARD)
    assert px4.booting
    assert not px4.armed
    run(px4, 1.5, FORWARD)
    assert not px4.booting
    assert px4.boot_s < 3.0 < px4.t_s
    assert (px4.mode, px4.landed) == (Mode.LOITER, True)


def test_refused_setpoints_end_the_flight() -> None:
    px4 = in_offboard(COM_OBL_RC_ACT=5)
    px4.faults.switch(Fault.SETPOINTS_REFUSED, True)
    assert run(px4, 1.5, FORWARD) == [Mode.OFFBOARD, Mode.LOITER]
