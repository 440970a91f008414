"""What is lost, stands still or is spent in flight: coast, stand, hand over, fall silent, end."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from companion.settings import (
    LimitSettings,
    LossSettings,
    MissionSettings,
    Settings,
    VehicleSettings,
)
from companion.types import (
    Attitude,
    Event,
    FlightMode,
    LocalMotion,
    ModeReport,
    ModeRequest,
    Phase,
    PhaseChange,
    RangeSample,
    StopRequest,
    Tick,
)
from tests.core.flights import LOITER, MS, OFFBOARD, Script, engaged, fly, last_status, setpoints


def test_without_ranges_it_coasts_then_stands_then_hands_over() -> None:
    settings = Settings(
        loss=LossSettings(coast_after_s=0.5, stall_after_s=2.0, hand_over_after_s=5.0, hand_over_to="land")
    )
    script = Script()
    before = engaged(script, settings)
    script.range_m = None
    t_lost_ms = script.t_ms
    lost = fly(script.run(9.0), before=before)
    phases = [c.after for c in lost.outputs if isinstance(c, PhaseChange)]
    assert phases[-2:] == [Phase.HAND_OVER, Phase.RELEASED]
    assert Phase.STALL in phases
    gone_s = [((s.t_ns / MS - t_lost_ms) / 1000, s.speed_m_s) for s in setpoints(lost)]
    assert all(speed == 0.0 for t, speed in gone_s if t > 2.1)
    requests = lost.of(ModeRequest)
    assert requests
    assert all(isinstance(r, ModeRequest) and r.mode is FlightMode.AUTO_LAND for r in requests)
    assert not [t for t, _ in gone_s if t > 5.0 + settings.loss.hand_over_patience_s + 0.1]


def test_ranges_that_come_back_lead_through_acquisition() -> None:
    script = Script()
    before = engaged(script)
    script.range_m = None
    lost = fly(script.run(6.0), before=before)
    assert lost.state.phase is Phase.STALL
    script.range_m = 10.0
    back = fly(script.run(0.5), before=lost)
    changes = [c.after for c in back.outputs if isinstance(c, PhaseChange)]
    assert changes[0] is Phase.ACQUIRE


def test_stray_ranges_end_no_loss() -> None:
    """One now and one later, believed as they are, move nothing: a beacon that is back tells more."""
    script = Script()
    before = engaged(script, Settings(loss=LossSettings(hand_over_after_s=60.0)))
    script.range_m = None
    lost = fly(script.run(6.0), before=before)
    for _ in range(6):
        heard = lost.state.ranging.accepted
        script.range_m = 10.0
        while lost.state.ranging.accepted == heard:
            lost = fly(script.run(0.05), before=lost)
            assert lost.state.phase is Phase.STALL
        script.range_m = None
        lost = fly(script.run(5.0), before=lost)
        assert lost.state.phase is Phase.STALL
        assert {s.speed_m_s for s in setpoints(lost)} == {0.0}


def test_stray_ranges_put_off_no_hand_over() -> None:
    """They must not keep it standing in the air until the battery or the flight time ends."""
    script = Script()
    lost = engaged(script, Settings(loss=LossSettings(hand_over_after_s=10.0)))
    changes: list[PhaseChange] = []
    for _ in range(6):
        for range_m, seconds in ((None, 2.5), (10.0, 0.05)):
            script.range_m = range_m
            lost = fly(script.run(seconds), before=lost)
            changes += [c for c in lost.outputs if isinstance(c, PhaseChange)]
    handed = [c.reason for c in changes if c.after is Phase.HAND_OVER]
    assert handed == ["only stray ranges for too long"]


def test_an_old_loss_does_not_shorten_the_patience_with_the_next() -> None:
    script = Script()
    settings = Settings(loss=LossSettings(hand_over_after_s=10.0))
    script.range_m, before = None, engaged(script, settings)
    lost = fly(script.run(9.0), before=before)
    script.range_m = 10.0
    back = fly(script.run(2.0), before=lost)
    assert back.state.phase is not Phase.STALL
    script.range_m = None
    assert fly(script.run(8.0), before=back).state.phase is Phase.STALL


@pytest.mark.parametrize("began_with", ["ranges", "heading"])
def test_what_was_known_before_a_long_gap_does_not_steer_after_it(began_with: str) -> None:
    """Whatever the standstill began with: an uncertain bearing, or a heading that did not come."""
    script = Script()
    before = fly(script.run(1.0), before=engaged(script))
    script.tells_attitude = began_with == "ranges"
    script.range_m = None if began_with == "ranges" else 10.0
    standing = fly(script.run(1.0), before=before)
    assert standing.state.phase is Phase.STALL
    assert last_status(standing).estimate is not None  # a short gap is bridged by what is known
    script.tells_attitude, script.range_m = True, None
    assert last_status(fly(script.run(5.0), before=standing)).estimate is None


def test_without_a_heading_it_stands_still_and_without_a_vehicle_it_is_silent() -> None:
    script = Script()
    before = engaged(script)
    script.tells_attitude = False
    blind = fly(script.run(1.5), before=before)
    assert blind.state.phase is Phase.STALL
    assert setpoints(blind)[-1].speed_m_s == 0.0
    script.tells_mode = script.tells_heartbeat = False
    gone = fly(script.run(5.0), before=blind)
    assert gone.state.phase is Phase.RELEASED
    assert setpoints(gone)[-1].t_ns < (script.t_ms - 1500) * MS


def test_without_heartbeats_the_mode_proves_the_vehicle_for_a_while_only() -> None:
    """Whether it is armed is told by HEARTBEAT alone: an old word of that must not steer for ever."""
    script = Script()
    before = engaged(script)
    script.tells_heartbeat = False
    short = fly(script.run(8.0), before=before)
    assert short.state.phase.is_engaged
    assert fly(script.run(6.0), before=short).state.phase is Phase.RELEASED


def test_what_was_commanded_before_a_standstill_does_not_leave_after_it() -> None:
    script = Script()
    before = engaged(script)
    script.tells_attitude = False
    blind = fly(script.run(1.5), before=before)
    assert blind.state.phase is Phase.STALL
    t_ns = (script.t_ms + 100) * MS
    back = fly([Attitude(t_ns, 0.0, 0.0, script.t_ms + 100), Tick(t_ns)], before=blind)
    assert back.state.phase is Phase.ACQUIRE
    (first,) = setpoints(back)
    assert (first.speed_m_s, first.yaw_rate_rad_s) == (0.0, 0.0)


def without_motion(events: Iterator[Event]) -> Iterator[Event]:
    return (event for event in events if not isinstance(event, LocalMotion))


def test_by_a_height_that_is_not_told_any_more_it_does_not_climb() -> None:
    script = Script()
    before = engaged(script, Settings(vehicle=VehicleSettings(setpoint_frame="body_ned")))
    script.height_m = 2.5
    low = fly(script.run(0.5), before=before)
    assert setpoints(low)[-1].climb_m_s > 0.0
    blind = fly(without_motion(script.run(1.0)), before=low)
    assert setpoints(blind)[-1].climb_m_s == 0.0


@pytest.mark.parametrize("shadow", [False, True])
def test_a_shadow_does_not_take_its_own_commands_for_flown(shadow: bool) -> None:
    """Where no velocity comes the motion is modelled by what was sent, and a shadow sends nothing."""
    script = Script()
    before = engaged(script, Settings(mission=MissionSettings(shadow=shadow)))
    assert before.state.phase.is_engaged
    after = fly(without_motion(script.run(2.0)), before=before)
    assert (last_status(after).path_m > last_status(before).path_m + 0.05) is not shadow


def test_a_height_of_long_ago_is_not_the_one_to_hold() -> None:
    script = Script()
    ready = fly(script.run(2.0))
    assert ready.state.phase is Phase.STANDBY
    blind = fly(without_motion(script.run(1.0)), before=ready)
    assert blind.state.phase is Phase.AWAIT
    assert "LOCAL_POSITION_NED" in last_status(blind).awaited[0]
    script.actual = script.intended = OFFBOARD
    assert not setpoints(fly(without_motion(script.run(1.0)), before=blind))


@pytest.mark.parametrize("first", ["range", "mode", "tick"])
def test_held_up_in_flight_it_stays_silent_until_a_person_acts(first: str) -> None:
    script = Script()
    before = engaged(script)
    script.t_ms += 1000  # SIGSTOP: PX4 has gone to Hold, and a single setpoint would bring OFFBOARD back
    t_ns = script.t_ms * MS
    script.seq += 1
    woken = {
        "range": RangeSample(t_ns, "b1", "s", script.seq, 10.0),
        "mode": ModeReport(t_ns, OFFBOARD, OFFBOARD),  # told before the failsafe, read after it
        "tick": Tick(t_ns),
    }
    after = fly([woken[first], *script.run(2.0)], before=before)
    assert after.state.phase is Phase.RELEASED
    assert not setpoints(after)
    script.actual, script.intended = LOITER, OFFBOARD
    assert not setpoints(fly(script.run(2.0), before=after))


def test_a_short_pause_is_no_reason_to_let_go() -> None:
    script = Script()
    before = engaged(script)
    script.t_ms += 600
    assert fly(script.run(0.5), before=before).state.phase.is_engaged


def test_ctrl_c_in_flight_stands_still_asks_for_the_mode_and_ends() -> None:
    script = Script()
    before = engaged(script)
    asked = fly([StopRequest(script.t_ms * MS)], before=before)
    assert asked.state.phase is Phase.HAND_OVER
    handing = fly(script.run(0.5), before=asked)
    assert all(s.speed_m_s == 0.0 for s in setpoints(handing))
    (request,) = (*asked.of(ModeRequest), *handing.of(ModeRequest))
    assert isinstance(request, ModeRequest)
    assert request.mode is LOITER
    script.actual = script.intended = LOITER
    assert fly(script.run(0.2), before=handing).state.phase is Phase.ENDED


def test_ctrl_c_with_release_configured_falls_silent_and_ends() -> None:
    script = Script()
    before = engaged(script, Settings(loss=LossSettings(hand_over_to="release")))
    script.t_ms += 10
    ended = fly([StopRequest(script.t_ms * MS), *script.run(0.1)], before=before)
    assert ended.state.phase is Phase.ENDED
    assert not ended.of(ModeRequest)


def test_a_spent_budget_hands_over_and_says_which() -> None:
    script = Script()
    before = engaged(script, Settings(limits=LimitSettings(flight_time_s=3.0)))
    after = fly(script.run(4.0), before=before)
    change = next(c for c in after.outputs if isinstance(c, PhaseChange) and c.after is Phase.HAND_OVER)
    assert "flight time over 3 s" in change.reason


def test_waiting_for_nothing_ends() -> None:
    ticks = [Tick(k * 100 * MS) for k in range(1, 80)]
    flown = fly(ticks, Settings(loss=LossSettings(wait_s=5.0)))
    assert flown.state.phase is Phase.ENDED
    assert "HEARTBEAT" in last_status(flown).awaited[0]


def test_who_was_ready_once_is_waited_for_without_end() -> None:
    script = Script()
    ready = fly(script.run(2.0), Settings(loss=LossSettings(wait_s=3.0)))
    script.range_m = None
    assert fly(script.run(10.0), before=ready).state.phase is Phase.AWAIT


def test_ctrl_c_ends_it_also_while_nothing_is_there() -> None:
    assert fly([Tick(MS), StopRequest(2 * MS)]).state.phase is Phase.ENDED
