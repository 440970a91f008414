"""What the pure core does with a flight: engagement, silence, pace; anything in any order."""

from __future__ import annotations

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion import pilot
from companion.settings import (
    Settings,
    StreamSettings,
    VehicleSettings,
)
from companion.types import (
    Attitude,
    BeaconTold,
    CompanionHeartbeat,
    Defect,
    Event,
    FlightMode,
    Landed,
    LandedReport,
    LineOfSight,
    LocalMotion,
    Malformed,
    ModeReport,
    Phase,
    RangeSample,
    RangeVerdict,
    Setpoint,
    Status,
    SystemStatus,
    Tick,
    VehicleHeartbeat,
    Verdict,
)
from tests.core.flights import LOITER, MS, OFFBOARD, Flown, Script, engaged, fly, last_status, setpoints


def test_it_says_what_it_waits_for_and_is_silent_until_it_has_it() -> None:
    script = Script()
    script.range_m = None
    flown = fly(script.run(3.0))
    assert flown.state.phase is Phase.AWAIT
    assert not setpoints(flown)
    (awaited,) = last_status(flown).awaited
    assert "ranges of beacon 'b1'" in awaited
    assert "lab" in awaited


def test_standstill_is_streamed_before_engagement_and_the_height_is_the_present_one() -> None:
    script = Script()
    flown = fly(script.run(3.0))
    assert flown.state.phase is Phase.STANDBY
    sent = setpoints(flown)
    assert len(sent) > 40
    assert all((s.speed_m_s, s.yaw_rate_rad_s, s.height_m) == (0.0, 0.0, 3.0) for s in sent)


def test_it_engages_when_a_person_selects_offboard_and_moves() -> None:
    flown = engaged(Script())
    assert flown.state.phase in (Phase.ACQUIRE, Phase.APPROACH)
    assert max(s.speed_m_s for s in setpoints(flown)) > 0.0


def test_it_does_not_engage_on_the_ground_or_disarmed() -> None:
    for landed, armed in ((Landed.ON_GROUND, True), (Landed.IN_AIR, False)):
        script = Script()
        script.landed, script.armed = landed, armed
        flown = engaged(script)
        assert flown.state.phase is Phase.STANDBY
        assert all(s.speed_m_s == 0.0 for s in setpoints(flown))


def test_a_takeover_silences_it_within_the_same_event() -> None:
    script = Script()
    before = engaged(script)
    taken = fly([ModeReport(script.t_ms * MS, FlightMode.POSCTL, OFFBOARD)], before=before)
    assert taken.state.phase is Phase.RELEASED
    script.actual, script.intended = FlightMode.POSCTL, OFFBOARD
    after = fly(script.run(5.0), before=taken)
    assert after.state.phase is Phase.RELEASED
    assert not setpoints(after)


def test_after_a_takeover_a_flick_of_the_switch_engages_anew() -> None:
    script = Script()
    before = engaged(script)
    script.actual = script.intended = FlightMode.POSCTL
    told = fly(script.run(0.1), before=before)
    ready = fly(script.run(2.0), before=told)
    assert ready.state.phase is Phase.STANDBY
    assert all(s.speed_m_s == 0.0 for s in setpoints(ready))
    script.actual = script.intended = OFFBOARD
    assert fly(script.run(0.5), before=ready).state.phase.is_engaged


def test_an_autopilot_that_does_not_tell_the_intended_mode_is_not_streamed_to_again() -> None:
    script = Script()
    script.tells_mode = script.armed = False
    ready = fly(script.run(2.0))
    script.armed, script.actual = True, OFFBOARD
    before = fly(script.run(1.0), before=ready)
    assert before.state.phase.is_engaged
    script.actual = LOITER
    after = fly(script.run(5.0), before=before)
    assert after.state.phase is Phase.RELEASED
    assert not setpoints(after)[-1:] or setpoints(after)[-1].t_ns < (script.t_ms - 3000) * MS


def test_started_in_mid_air_it_stays_silent_until_it_knows_that_offboard_is_not_meant() -> None:
    script = Script()
    script.tells_mode = False  # HEARTBEAT says Hold: the failsafe after a crash
    flown = fly(script.run(3.0))
    assert flown.state.phase is Phase.AWAIT
    assert not setpoints(flown)
    assert "CURRENT_MODE" in last_status(flown).awaited[0]
    script.tells_mode, script.intended = True, OFFBOARD
    told = fly(script.run(1.0), before=flown)
    assert told.state.phase is Phase.INHIBITED
    assert not setpoints(told)


def test_what_was_meant_long_ago_does_not_count() -> None:
    """OFFBOARD may have been chosen unheard, and refused: a stream would bring it about."""
    script = Script()
    ready = fly(script.run(2.0))
    script.range_m = None
    waiting = fly(script.run(5.0), before=ready)
    assert waiting.state.phase is Phase.AWAIT
    script.tells_mode = False  # HEARTBEAT alone comes, and says Hold
    unheard = fly(script.run(2.0), before=waiting)
    script.range_m = 10.0
    back = fly(script.run(3.0), before=unheard)
    assert back.state.phase is Phase.AWAIT
    assert not setpoints(back)


def test_started_in_mid_air_in_offboard_it_stays_silent() -> None:
    script = Script()
    script.actual = script.intended = OFFBOARD
    flown = fly(script.run(5.0))
    assert flown.state.phase is Phase.INHIBITED
    assert not setpoints(flown)


def test_the_stream_keeps_between_its_rates() -> None:
    script = Script()
    settings = Settings(stream=StreamSettings(min_rate_hz=20.0, max_rate_hz=50.0))
    before = engaged(script, settings)

    def flood() -> list[Event]:
        events: list[Event] = []
        for event in script.run(4.0):
            events.append(event)
            if isinstance(event, Tick):
                script.seq += 1
                events.append(RangeSample(event.t_ns + 3 * MS, "b1", "s", script.seq, 10.0))
        return events

    flooded = fly(flood(), before=before)
    assert 190 <= len(setpoints(flooded)) <= 202
    script.range_m = None
    quiet = setpoints(fly(script.run(2.0), before=flooded))
    assert len(quiet) >= 38


def bearing(flown: Flown) -> float:
    known = flown.plan.scheme.knowledge(flown.plan.scheme.p, flown.state.observing.guidance)
    return float(known.theta_rad)


def test_a_reset_of_the_autopilots_heading_is_no_turn() -> None:
    script = Script()
    before = fly(script.run(1.0), before=engaged(script))
    t_ns = (script.t_ms + 10) * MS
    for heading_rad, turned_rad in ((0.1, 0.1), (1.1, 0.0)):
        after = fly([Attitude(t_ns, heading_rad, 0.0, script.t_ms)], before=before)
        assert bearing(after) - bearing(before) == pytest.approx(turned_rad, abs=0.02)


def test_a_reset_of_the_autopilots_position_is_no_move() -> None:
    script = Script()
    before = fly(script.run(1.0), before=engaged(script))
    assert last_status(before).estimate is not None
    moved = []
    for y_m in (0.0, 6.0):
        t_ns = (script.t_ms + 10) * MS
        told = [
            LocalMotion(t_ns, 0.0, y_m, 3.0, 0.0, 0.0, 0.0),
            Attitude(t_ns + 20 * MS, 0.0, 0.0, script.t_ms),
        ]
        moved.append(bearing(fly(told, before=before)))
    assert moved[0] == pytest.approx(moved[1], abs=1e-6)


def test_telemetry_makes_no_setpoint_and_nor_does_a_range_that_is_not_believed() -> None:
    script = Script()
    flown = engaged(script)
    script.t_ms += 60  # a setpoint is due
    t_ns = script.t_ms * MS
    told = [ModeReport(t_ns, OFFBOARD, OFFBOARD), RangeSample(t_ns, "b1", "s", script.seq, 10.0)]
    after = fly(told, before=flown)
    assert not after.of(Setpoint)
    assert after.of(RangeVerdict)
    assert fly([Tick(t_ns)], before=after).of(Setpoint)


def test_a_fresh_range_steers_at_once() -> None:
    script = Script()
    before = engaged(script)
    script.seq += 1
    t_ns = script.t_ms * MS + 7 * MS
    flown = fly([RangeSample(t_ns, "b1", "s", script.seq, 10.0)], before=before)
    (sent,) = setpoints(flown)
    assert sent.t_ns == t_ns
    again = RangeSample(t_ns + 25 * MS, "b1", "s", script.seq, 10.0)
    assert not setpoints(fly([again], before=flown))  # what is not believed does not steer


def test_the_heartbeat_follows_the_phase() -> None:
    script = Script()
    waiting = fly([Tick(MS)])
    (first,) = waiting.of(CompanionHeartbeat)
    assert isinstance(first, CompanionHeartbeat)
    assert first.system_status is SystemStatus.BOOT
    before = engaged(script)
    active = fly(script.run(2.0), before=before).of(CompanionHeartbeat)
    assert len(active) == 2
    assert all(isinstance(h, CompanionHeartbeat) and h.system_status is SystemStatus.ACTIVE for h in active)


def test_without_a_position_estimate_the_app_holds_the_height_itself() -> None:
    script = Script()
    before = engaged(script, Settings(vehicle=VehicleSettings(setpoint_frame="body_ned")))
    script.height_m = 2.5
    sent = setpoints(fly(script.run(1.0), before=before))[-1]
    assert sent.height_m is None
    assert sent.climb_m_s == pytest.approx(0.8 * 0.5)


def test_bad_ranges_are_counted_by_reason() -> None:
    script = Script()
    before = fly(script.run(2.0))
    t_ns = script.t_ms * MS
    bad: list[Event] = [
        RangeSample(t_ns, "b1", "s", script.seq, 10.0),
        RangeSample(t_ns, "b1", "s", 0, 10.0),
        RangeSample(t_ns, "b1", "s", 10**6, math.nan),
        RangeSample(t_ns, "zz", "s", 10**6, 10.0),
        Malformed(t_ns, Defect.RANGE_PAYLOAD),
    ]
    state = fly(bad, before=before).state
    assert state.ranging.rejected == {
        Verdict.REPEATED: 1,
        Verdict.OUT_OF_ORDER: 1,
        Verdict.ABSURD: 1,
        Verdict.UNKNOWN_BEACON: 1,
    }
    assert state.ranging.malformed == {"unreadable range": 1}


def test_a_flight_ends_when_the_vehicle_disarms() -> None:
    script = Script()
    before = engaged(script)
    script.armed = False
    assert fly(script.run(1.5), before=before).state.phase is Phase.ENDED


times = st.integers(0, 40 * MS)
floats = st.floats(-1e6, 1e6) | st.sampled_from([0.0, 1.0, 10.0, -3.0, math.nan, math.inf])
modes = st.sampled_from([OFFBOARD, LOITER, FlightMode.AUTO_LAND])
any_event = st.one_of(
    st.builds(Tick, times),
    st.builds(Attitude, times, floats, floats),
    st.builds(LocalMotion, times, floats, floats, st.none() | floats, floats, floats, floats),
    st.builds(VehicleHeartbeat, times, st.just(1), modes, st.booleans()),
    st.builds(ModeReport, times, modes, st.none() | modes),
    st.builds(LandedReport, times, st.sampled_from(Landed)),
    st.builds(
        RangeSample,
        times,
        st.sampled_from(["b1", "b2"]),
        st.sampled_from(["s", "t"]),
        st.integers(0, 10**6),
        floats,
        st.none() | floats,
        st.sampled_from(LineOfSight),
        st.none(),
        st.none() | st.integers(0, 2**62),
    ),
    st.builds(Malformed, times, st.sampled_from(Defect)),
    st.builds(BeaconTold, times, st.sampled_from(["b1", "b2"]), st.none() | floats, st.none() | floats),
)


@given(st.lists(any_event, max_size=60), st.booleans())
def test_any_events_in_any_order_give_bounded_and_finite_output(events: list[Event], flying: bool) -> None:
    script = Script()
    before = engaged(script) if flying else fly([])
    t_ns = script.t_ms * MS
    shifted = []
    for event in events:
        t_ns += event.t_ns - 5 * MS  # time may also step back a little
        shifted.append(msgspec.structs.replace(event, t_ns=t_ns))
    flown = fly(shifted, before=before)
    limits = flown.plan.settings.limits
    for s in setpoints(flown):
        assert 0.0 <= s.speed_m_s <= limits.speed_m_s
        assert abs(s.yaw_rate_rad_s) <= limits.yaw_rate_rad_s
        assert abs(s.climb_m_s) <= limits.climb_m_s
        assert math.isfinite(s.heading_rad)
        assert s.height_m is None or math.isfinite(s.height_m)
    for status in flown.of(Status):
        msgspec.json.encode(status)


def test_the_same_events_give_the_same_outputs() -> None:
    first, second = (engaged(Script()) for _ in range(2))
    assert first.outputs == second.outputs
    assert pilot.initial(first.plan) == pilot.initial(second.plan)
