"""The table of phases: every pair has one outcome, and no way leads to a speed that is not allowed."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import pytest
from msgspec.structs import replace

from companion import phase
from companion.guidance.scheme import PROBE, REFUSE, REST, STAY, TRACK
from companion.phase import MOVING, STREAMING, TABLE, Condition, Facts, Ranges
from companion.types import FlightMode, Phase

OFFBOARD, LOITER, LAND = FlightMode.OFFBOARD, FlightMode.AUTO_LOITER, FlightMode.AUTO_LAND
FLYING = Facts(
    actual=OFFBOARD,
    intended=OFFBOARD,
    armed=True,
    was_engaged=True,
    telemetry_late=False,
    ranges=Ranges.FRESH,
    purpose=TRACK,
)
ENGAGED = [p for p in Phase if p.is_engaged]


def all_facts() -> Iterator[Facts]:
    yes_no = (False, True)
    for values in itertools.product(
        yes_no,
        yes_no,
        (None, OFFBOARD, LOITER),
        (None, OFFBOARD, LOITER),
        (None, False, True),
        yes_no,
        yes_no,
        yes_no,
        Ranges,
        yes_no,
        yes_no,
        yes_no,
        (TRACK, REST, STAY, REFUSE),  # PROBE moves as TRACK does
    ):
        every: tuple[Any, ...] = (*values[:7], False, *values[7:])  # waiting matters on the ground alone
        yield Facts(*every)


def test_no_combination_of_facts_leads_to_a_speed_that_is_not_allowed() -> None:
    for facts in all_facts():
        for before in Phase:
            if before.is_engaged and not facts.was_engaged:
                continue  # the pilot sets it with the engagement
            after, why = phase.step(before, facts)
            assert (why is None) == (after is before)
            if after in MOVING:
                assert facts.actual is OFFBOARD
                assert facts.armed
                assert not (facts.vehicle_gone or facts.telemetry_late or facts.stop_asked)
                assert not facts.budget_spent or before is Phase.STANDBY
                assert facts.ranges is Ranges.FRESH or (
                    after is Phase.COAST and facts.ranges is Ranges.LATE and not facts.bearing_lost
                )
            if before is Phase.ENDED:
                assert after is Phase.ENDED


def test_engagement_takes_a_ready_app_that_watched_offboard_being_chosen() -> None:
    for facts in all_facts():
        for before in set(Phase) - set(ENGAGED) - {Phase.STANDBY}:
            assert not phase.step(before, facts)[0].is_engaged
        if phase.step(Phase.STANDBY, facts)[0].is_engaged:
            assert facts.actual is OFFBOARD
            assert facts.armed
            assert not facts.grounded
            assert facts.ranges is Ranges.FRESH


def test_standby_is_reached_only_while_another_mode_is_known_to_be_meant() -> None:
    for facts in all_facts():
        for before in set(Phase) - {Phase.STANDBY}:
            if phase.step(before, facts)[0] is Phase.STANDBY:
                assert facts.actual is not OFFBOARD
                assert facts.intended is not OFFBOARD


@pytest.mark.parametrize("before", ENGAGED)
def test_a_pilot_who_takes_over_silences_the_app_at_once(before: Phase) -> None:
    for intended in (LOITER, OFFBOARD, None):
        after, why = phase.step(before, replace(FLYING, actual=LOITER, intended=intended, stop_asked=True))
        assert (after, why) == (Phase.RELEASED, Condition.LEFT_OFFBOARD)
    assert Phase.RELEASED not in STREAMING


def test_released_is_left_only_when_another_mode_is_known_to_be_meant() -> None:
    released = replace(FLYING, actual=LOITER)
    assert phase.step(Phase.RELEASED, replace(released, intended=OFFBOARD))[0] is Phase.RELEASED
    assert phase.step(Phase.RELEASED, replace(released, intended=None))[0] is Phase.RELEASED
    assert phase.step(Phase.RELEASED, replace(released, intended=LOITER))[0] is Phase.AWAIT
    assert phase.step(Phase.RELEASED, FLYING)[0] is Phase.RELEASED


@pytest.mark.parametrize(("actual", "intended"), [(OFFBOARD, OFFBOARD), (LOITER, OFFBOARD), (OFFBOARD, None)])
def test_started_in_mid_air_with_offboard_meant_it_only_watches(
    actual: FlightMode, intended: FlightMode | None
) -> None:
    facts = replace(FLYING, actual=actual, intended=intended, was_engaged=False)
    assert phase.step(Phase.AWAIT, facts)[0] is Phase.INHIBITED
    assert phase.step(Phase.INHIBITED, facts)[0] is Phase.INHIBITED
    assert Phase.INHIBITED not in STREAMING
    assert phase.step(Phase.INHIBITED, replace(facts, actual=LOITER, intended=LOITER))[0] is Phase.AWAIT


@pytest.mark.parametrize(
    ("before", "facts", "after"),
    [
        (Phase.APPROACH, replace(FLYING, ranges=Ranges.LATE), Phase.COAST),
        (Phase.APPROACH, replace(FLYING, ranges=Ranges.LATE, bearing_lost=True), Phase.STALL),
        (Phase.COAST, replace(FLYING, ranges=Ranges.LATE), Phase.COAST),
        (Phase.COAST, replace(FLYING, ranges=Ranges.STALE), Phase.STALL),
        (Phase.STALL, replace(FLYING, ranges=Ranges.LOST), Phase.HAND_OVER),
        (Phase.STALL, FLYING, Phase.ACQUIRE),
        (Phase.HOLD, replace(FLYING, ranges=Ranges.LATE, purpose=REST), Phase.HOLD),
        (Phase.APPROACH, replace(FLYING, budget_spent=True), Phase.HAND_OVER),
        (Phase.APPROACH, replace(FLYING, stop_asked=True), Phase.HAND_OVER),
        (Phase.APPROACH, replace(FLYING, telemetry_late=True), Phase.STALL),
        (Phase.APPROACH, replace(FLYING, vehicle_gone=True), Phase.RELEASED),
        (Phase.HOLD, replace(FLYING, held_up=True, stop_asked=True), Phase.RELEASED),
        (Phase.HAND_OVER, replace(FLYING, held_up=True), Phase.RELEASED),
        (Phase.STANDBY, replace(FLYING, held_up=True), Phase.AWAIT),
        (Phase.HOLD, replace(FLYING, armed=False), Phase.ENDED),
        (Phase.HAND_OVER, replace(FLYING, hand_over_overdue=True), Phase.RELEASED),
        (Phase.HAND_OVER, replace(FLYING, actual=LAND), Phase.RELEASED),
        (Phase.ACQUIRE, FLYING, Phase.APPROACH),
        (Phase.APPROACH, replace(FLYING, purpose=PROBE), Phase.ACQUIRE),
        (Phase.APPROACH, replace(FLYING, purpose=REST), Phase.HOLD),
        (Phase.APPROACH, replace(FLYING, purpose=STAY), Phase.KEEP),
        (Phase.KEEP, replace(FLYING, purpose=STAY), Phase.KEEP),
        (Phase.KEEP, FLYING, Phase.APPROACH),
        (Phase.KEEP, replace(FLYING, ranges=Ranges.LATE, purpose=STAY), Phase.COAST),
        (Phase.KEEP, replace(FLYING, ranges=Ranges.LATE, bearing_lost=True), Phase.STALL),
        (Phase.COAST, replace(FLYING, purpose=STAY), Phase.KEEP),
        (Phase.STALL, replace(FLYING, purpose=STAY), Phase.ACQUIRE),
        (Phase.ACQUIRE, replace(FLYING, purpose=REFUSE), Phase.HAND_OVER),
        (Phase.APPROACH, replace(FLYING, purpose=REFUSE), Phase.HAND_OVER),
    ],
)
def test_the_transitions_of_a_flight(before: Phase, facts: Facts, after: Phase) -> None:
    assert phase.step(before, facts)[0] is after


@pytest.mark.parametrize("before", [p for p in Phase if p in STREAMING])
def test_held_up_it_does_not_steer_whatever_it_still_believes(before: Phase) -> None:
    yes_no = (False, True)
    for stop, spent, late, ranges in itertools.product(yes_no, yes_no, yes_no, Ranges):
        believed = replace(
            FLYING, held_up=True, stop_asked=stop, budget_spent=spent, telemetry_late=late, ranges=ranges
        )
        assert phase.step(before, believed)[0] not in STREAMING


def test_every_phase_has_a_row() -> None:
    assert set(TABLE) == set(Phase)
