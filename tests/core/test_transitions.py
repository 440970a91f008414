"""What may happen to a vehicle in flight: each is a transition with its own reason, none an accident."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from companion.guidance.settings import GuidanceSettings
from companion.settings import LossSettings, Settings, VehicleSettings
from companion.types import (
    Attitude,
    AutopilotWords,
    BatteryReport,
    Charge,
    Event,
    FlightMode,
    Landed,
    LandedReport,
    ModeReport,
    ModeRequest,
    Party,
    PartyHeard,
    Phase,
    PhaseChange,
    Setpoint,
    Status,
    VehicleHeartbeat,
)
from tests.core.flights import LOITER, MS, OFFBOARD, Flown, Script, engaged, fly


def change_to(flown: Flown, phase: Phase) -> PhaseChange:
    return next(c for c in flown.outputs if isinstance(c, PhaseChange) and c.after is phase)


def requested(flown: Flown) -> set[FlightMode]:
    return {o.mode for o in flown.outputs if isinstance(o, ModeRequest)}


def status(flown: Flown) -> Status:
    return next(o for o in reversed(flown.outputs) if isinstance(o, Status))


# --------------------------------------------------------------------------------------------- battery


@pytest.mark.parametrize(
    "told",
    [BatteryReport(0, Charge.LOW, 0.14), BatteryReport(0, Charge.CRITICAL), BatteryReport(0, share=0.1)],
)
def test_a_low_battery_in_flight_is_handed_over_to_a_landing(told: BatteryReport) -> None:
    script = Script()
    before = engaged(script)
    script.battery = told
    after = fly(script.run(1.0), before=before)
    assert change_to(after, Phase.HAND_OVER).reason.startswith("battery ")
    assert requested(after) == {FlightMode.AUTO_LAND}


def test_what_a_low_battery_does_is_configured() -> None:
    for loss, phase in (
        (LossSettings(battery_hand_over="never"), None),
        (LossSettings(battery_hand_over="critical"), None),
        (LossSettings(battery_to="hold"), Phase.HAND_OVER),
    ):
        script = Script()
        before = engaged(script, Settings(loss=loss))
        script.battery = BatteryReport(0, Charge.LOW, 0.05)
        after = fly(script.run(1.0), before=before)
        assert (after.state.phase is Phase.HAND_OVER) == (phase is Phase.HAND_OVER)
        assert requested(after) == ({LOITER} if phase else set())


def test_a_low_battery_does_not_begin_and_does_not_recover_by_resting() -> None:
    script = Script()
    script.battery = BatteryReport(0, Charge.LOW, 0.12)
    waiting = fly(script.run(2.0))
    assert waiting.state.phase is Phase.AWAIT
    assert "battery (low, 12 % left" in status(waiting).awaited[0]
    script.battery = BatteryReport(0, Charge.OK, 0.2)
    assert fly(script.run(1.0), before=waiting).state.phase is Phase.AWAIT


# ----------------------------------------------------------------------------------- landed and disarmed


def test_on_the_ground_it_stops_steering_and_hands_over() -> None:
    script = Script()
    before = engaged(script)
    script.landed = Landed.ON_GROUND
    after = fly(script.run(0.5), before=before)
    landed = change_to(after, Phase.HAND_OVER)
    assert "on the ground" in landed.reason
    sent = [s for s in after.outputs if isinstance(s, Setpoint) and s.t_ns > landed.t_ns]
    assert sent
    assert all(s.speed_m_s == s.yaw_rate_rad_s == 0.0 for s in sent)


def test_disarmed_in_the_air_is_told_apart_from_the_end_of_a_flight() -> None:
    for landed, words in ((Landed.IN_AIR, "in the air"), (Landed.ON_GROUND, "disarmed: the flight is over")):
        script = Script()
        before = engaged(script)
        t_ns = (script.t_ms + 1) * MS
        after = fly([LandedReport(t_ns, landed), VehicleHeartbeat(t_ns, 1, OFFBOARD, False)], before=before)
        assert words in (change_to(after, Phase.ENDED).reason)


# ----------------------------------------------------------------------------------------------- restart


def test_a_restart_in_flight_silences_it_and_nothing_known_before_counts() -> None:
    script = Script()
    before = engaged(script)
    script.boot_offset_ms = -script.t_ms
    script.tells_mode = script.tells_heartbeat = False
    after = fly(script.run(0.2), before=before)
    assert change_to(after, Phase.RELEASED).reason == "the autopilot restarted"
    assert after.state.vehicle.actual is None
    script.tells_mode = script.tells_heartbeat = True
    script.actual = script.intended = LOITER
    script.armed = False
    assert fly(script.run(1.0), before=after).state.phase is Phase.ENDED


def test_a_restart_before_the_flight_is_waited_for() -> None:
    script = Script()
    ready = fly(script.run(2.0))
    assert ready.state.phase is Phase.STANDBY
    script.boot_offset_ms = -script.t_ms
    back = fly(script.run(2.0), before=ready)
    assert change_to(back, Phase.AWAIT).reason == "the autopilot restarted"
    assert back.state.phase is Phase.STANDBY
    assert not fly(script.run(1.0), before=back).of(PhaseChange)  # it restarted once


def test_a_late_packet_is_no_restart_and_turns_nothing() -> None:
    script = Script()
    flown = engaged(script)
    heading = flown.state.vehicle.heading_rad
    for _ in range(5):
        late = Attitude((script.t_ms + 1) * MS, 2.0, 0.0, script.t_ms - 1500)
        flown = fly([late, late, *script.run(0.1)], before=flown)
    assert flown.state.phase.is_engaged
    assert flown.state.vehicle.heading_rad == heading


# -------------------------------------------------------------------------------------- others on the link


def heard(script: Script, party: Party, system: int = 1) -> Event:
    return PartyHeard((script.t_ms + 1) * MS, party, system, 191, "HEARTBEAT")


@pytest.mark.parametrize("party", [Party.TWIN, Party.COMMANDER])
def test_with_a_second_commander_it_hands_over(party: Party) -> None:
    script = Script()
    before = engaged(script)
    after = fly([heard(script, party), *script.run(0.5)], before=before)
    assert party.value in change_to(after, Phase.HAND_OVER).reason


def test_beside_a_second_commander_it_does_not_begin() -> None:
    script = Script()
    waiting = fly([heard(script, Party.TWIN), *script.run(1.0)])
    assert waiting.state.phase is Phase.AWAIT
    assert "stop the other one" in status(waiting).awaited[0]
    assert fly(script.run(4.0), before=waiting).state.phase is Phase.STANDBY


def test_with_two_autopilots_it_asks_which_but_a_flight_goes_on() -> None:
    script = Script()
    waiting = fly([heard(script, Party.AUTOPILOT, 42), *script.run(1.0)])
    assert waiting.state.phase is Phase.AWAIT
    assert "system 42" in status(waiting).awaited[0]
    script = Script()
    before = engaged(script)
    after = fly([heard(script, Party.AUTOPILOT, 42), *script.run(0.5)], before=before)
    assert after.state.phase.is_engaged


def test_a_vehicle_whose_id_changes_is_not_followed() -> None:
    script = Script()
    before = engaged(script)
    script.tells_mode = script.tells_heartbeat = script.tells_attitude = False
    events: list[Event] = []
    for _ in range(8):
        events += [heard(script, Party.AUTOPILOT, 42), *script.run(0.5)]
    after = fly(events, before=before)
    assert change_to(after, Phase.RELEASED).reason.endswith("another one is on its link: system 42")


# ------------------------------------------------------------------------------------------- the estimate


def test_without_a_valid_velocity_it_waits_and_names_the_parameters() -> None:
    script = Script()
    assert script.estimator is not None
    script.estimator = replace(script.estimator, velocity=False)
    waiting = fly(script.run(2.0))
    assert waiting.state.phase is Phase.AWAIT
    (awaited,) = status(waiting).awaited
    assert "a valid velocity estimate" in awaited
    assert "EKF2_EV_CTRL" in awaited
    assert "no offboard signal" in awaited


@pytest.mark.parametrize("height_m", [None, 3.0])
def test_local_ned_needs_a_position_and_body_ned_does_not(height_m: float | None) -> None:
    for frame, phase in (("local_ned", Phase.AWAIT), ("body_ned", Phase.STANDBY)):
        script = Script()
        assert script.estimator is not None
        script.estimator = replace(script.estimator, position=False, global_position=False)
        script.height_m = height_m
        settings = Settings(vehicle=VehicleSettings(setpoint_frame=frame))  # type: ignore[arg-type]
        assert fly(script.run(2.0), settings).state.phase is phase


def test_an_estimate_lost_in_flight_stops_it() -> None:
    script = Script()
    before = engaged(script)
    assert script.estimator is not None
    script.estimator = replace(script.estimator, velocity=False)
    after = fly(script.run(1.0), before=before)
    assert "velocity estimate" in change_to(after, Phase.STALL).reason
    assert after.state.phase is Phase.STALL


def test_offboard_left_by_a_failsafe_says_why() -> None:
    script = Script()
    before = engaged(script)
    t_ns = (script.t_ms + 1) * MS
    assert script.estimator is not None
    left = fly(
        [
            AutopilotWords(t_ns, "failsafe in OFFBOARD: Hold"),
            replace(script.estimator, t_ns=t_ns, velocity=False),
            ModeReport(t_ns, LOITER, OFFBOARD),
        ],
        before=before,
    )
    reason = change_to(left, Phase.RELEASED).reason
    assert "own failsafe" in reason
    assert "EKF2_OF_CTRL" in reason
    assert "failsafe in OFFBOARD: Hold" in reason
    taken = fly([ModeReport(t_ns, FlightMode.POSCTL, FlightMode.POSCTL)], before=before)
    assert change_to(taken, Phase.RELEASED).reason == "the vehicle left OFFBOARD for POSCTL"


def test_without_a_global_position_it_asks_for_land_where_hold_is_configured() -> None:
    script = Script()
    assert script.estimator is not None
    script.estimator = replace(script.estimator, global_position=False)
    before = engaged(script, Settings(loss=LossSettings(hand_over_to="hold", hand_over_after_s=4.5)))
    assert any("COM_OBL_RC_ACT = 4" in warning for warning in status(before).warnings)
    script.range_m = None
    after = fly(script.run(6.0), before=before)
    assert "Hold needs a global position" in change_to(after, Phase.HAND_OVER).reason
    assert requested(after) == {FlightMode.AUTO_LAND}


def test_what_never_comes_is_named_after_its_time() -> None:
    script = Script()
    script.battery = script.estimator = None
    script.tells_mode = False
    early = fly(script.run(3.0))
    assert not status(early).warnings
    late = fly(script.run(4.0), before=early)
    named = {warning.split()[0] for warning in status(late).warnings}
    assert {"BATTERY_STATUS", "ESTIMATOR_STATUS", "CURRENT_MODE"} <= named
    assert "never came within 5 s" in status(late).warnings[0]


# ------------------------------------------------------------------------------------------ standstill


def test_a_standstill_is_no_part_of_the_first_turn() -> None:
    script = Script()
    guidance = GuidanceSettings(observer="luenberger", probe_turn_s=4.0, first_turn="left")
    before = engaged(script, Settings(guidance=guidance))  # it turns for one second
    script.tells_attitude = False
    standing = fly(script.run(4.0), before=before)
    assert standing.state.phase is Phase.STALL
    script.tells_attitude = True
    turning = fly(script.run(2.0), before=standing)
    assert turning.state.phase is Phase.ACQUIRE
    last = turning.of(Setpoint)[-1]
    assert isinstance(last, Setpoint) and last.yaw_rate_rad_s == guidance.yaw_rate_max_rad_s
    assert fly(script.run(2.0), before=turning).state.phase is Phase.APPROACH
