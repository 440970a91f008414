"""The table of phases: every pair has one outcome, and no way leads to a speed that is not allowed."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator
from typing import NamedTuple

import pytest
from msgspec.structs import replace

from companion import phase
from companion.guidance.scheme import PROBE, REFUSE, REST, STAY, TRACK
from companion.phase import MOVING, STREAMING, TABLE, Company, Condition, Facts, Ranges
from companion.types import FlightMode, Phase
from tests.core.test_phase_table import FLIES, LOITER, OFFBOARD

LAND = FlightMode.AUTO_LAND
ENGAGED = [p for p in Phase if p.is_engaged]


RANGING = (
    *((Ranges.FRESH, False, purpose) for purpose in (TRACK, REST, STAY, REFUSE)),  # PROBE moves as TRACK does
    (Ranges.LATE, False, TRACK),
    (Ranges.LATE, True, TRACK),
    (Ranges.STALE, False, TRACK),
    (Ranges.LOST, False, TRACK),
)
"""The bearing's certainty matters with late ranges alone, the purpose with fresh ones."""


BUDGETS = ((False, False), (True, False), (False, True))
"""The budget spent, the hand-over overdue."""


def all_facts() -> Iterator[Facts]:
    """All but a restart and a hold-up, each a condition on top; not told to be armed is as disarmed."""
    yes_no = (False, True)
    modes = (None, OFFBOARD, LOITER)
    for stop, gone, actual, intended, armed, grounded, was_engaged, late in itertools.product(
        yes_no, yes_no, modes, modes, yes_no, yes_no, yes_no, yes_no
    ):
        for (ranges, lost, purpose), (budget, overdue), company, battery, estimate in itertools.product(
            RANGING, BUDGETS, Company, yes_no, yes_no
        ):
            yield Facts(
                stop, gone, actual, intended, armed, grounded, was_engaged,
                False,  # waiting matters on the ground alone
                late, ranges, lost, budget, overdue, purpose, False, False, company, battery, estimate,
            )  # fmt: skip


class Outcome(NamedTuple):
    """Which phases lead where, under the same conditions."""

    to_moving: frozenset[Phase]
    to_engaged: frozenset[Phase]
    to_standby: frozenset[Phase]


@functools.cache
def outcome(holding: tuple[Condition, ...]) -> Outcome:
    after = {}
    for before in Phase:
        after[before], why = phase.decide(before, holding)
        assert (why is None) == (after[before] is before)
        for stop in (Condition.REBOOTED, Condition.HELD_UP):
            stopped = phase.decide(before, (stop, *holding))[0]
            assert stopped not in (STREAMING if before in STREAMING else MOVING)
    assert after[Phase.ENDED] is Phase.ENDED
    return Outcome(
        frozenset(p for p in Phase if after[p] in MOVING),
        frozenset(p for p in Phase if after[p].is_engaged),
        frozenset(p for p in Phase if after[p] is Phase.STANDBY and p is not Phase.STANDBY),
    )


def test_no_combination_of_facts_leads_to_a_speed_or_a_stream_that_is_not_allowed() -> None:
    """Every combination of facts, and every phase: engagement, speed and the way into standby."""
    for f in all_facts():
        to = outcome(tuple(phase.conditions(f)))
        moving = to.to_moving if f.was_engaged else to.to_moving - set(ENGAGED)  # set with the engagement
        if moving:
            assert f.actual is OFFBOARD
            assert f.armed
            assert not (f.vehicle_gone or f.telemetry_late or f.stop_asked)
            assert not (f.grounded or f.battery_low or f.estimate_invalid)
            assert f.company is not Company.COMMANDER
            assert f.ranges in (Ranges.FRESH, Ranges.LATE)
            assert not (f.ranges is Ranges.LATE and f.bearing_lost)
            assert not f.budget_spent or moving == {Phase.STANDBY}
        if to.to_engaged - set(ENGAGED):  # a ready app that watched OFFBOARD being chosen
            assert to.to_engaged - set(ENGAGED) == {Phase.STANDBY}
            assert f.actual is OFFBOARD
            assert f.armed
            assert not f.grounded
            assert f.ranges is Ranges.FRESH
            assert f.company is Company.NOBODY
        if to.to_standby:  # another mode is known to be meant, and nothing speaks against a flight
            assert f.actual is not OFFBOARD
            assert f.intended is not OFFBOARD
            assert f.intended is not None or not f.armed or f.grounded
            assert f.company is Company.NOBODY
            assert not (f.battery_low or f.estimate_invalid)


@pytest.mark.parametrize("before", ENGAGED)
def test_a_pilot_who_takes_over_silences_the_app_at_once(before: Phase) -> None:
    for intended in (LOITER, OFFBOARD, None):
        after, why = phase.step(before, replace(FLIES, actual=LOITER, intended=intended, stop_asked=True))
        assert (after, why) == (Phase.RELEASED, Condition.LEFT_OFFBOARD)
    assert Phase.RELEASED not in STREAMING


def test_released_is_left_only_when_another_mode_is_known_to_be_meant() -> None:
    released = replace(FLIES, actual=LOITER)
    assert phase.step(Phase.RELEASED, replace(released, intended=OFFBOARD))[0] is Phase.RELEASED
    assert phase.step(Phase.RELEASED, replace(released, intended=None))[0] is Phase.RELEASED
    assert phase.step(Phase.RELEASED, replace(released, intended=LOITER))[0] is Phase.AWAIT
    assert phase.step(Phase.RELEASED, FLIES)[0] is Phase.RELEASED


@pytest.mark.parametrize(("actual", "intended"), [(OFFBOARD, OFFBOARD), (LOITER, OFFBOARD), (OFFBOARD, None)])
def test_started_in_mid_air_with_offboard_meant_it_only_watches(
    actual: FlightMode, intended: FlightMode | None
) -> None:
    facts = replace(FLIES, actual=actual, intended=intended, was_engaged=False)
    assert phase.step(Phase.AWAIT, facts)[0] is Phase.INHIBITED
    assert phase.step(Phase.INHIBITED, facts)[0] is Phase.INHIBITED
    assert Phase.INHIBITED not in STREAMING
    assert phase.step(Phase.INHIBITED, replace(facts, actual=LOITER, intended=LOITER))[0] is Phase.AWAIT


@pytest.mark.parametrize(
    ("before", "facts", "after"),
    [
        (Phase.APPROACH, replace(FLIES, ranges=Ranges.LATE), Phase.COAST),
        (Phase.APPROACH, replace(FLIES, ranges=Ranges.LATE, bearing_lost=True), Phase.STALL),
        (Phase.COAST, replace(FLIES, ranges=Ranges.LATE), Phase.COAST),
        (Phase.COAST, replace(FLIES, ranges=Ranges.STALE), Phase.STALL),
        (Phase.STALL, replace(FLIES, ranges=Ranges.LOST), Phase.HAND_OVER),
        (Phase.STALL, FLIES, Phase.ACQUIRE),
        (Phase.HOLD, replace(FLIES, ranges=Ranges.LATE, purpose=REST), Phase.HOLD),
        (Phase.APPROACH, replace(FLIES, budget_spent=True), Phase.HAND_OVER),
        (Phase.APPROACH, replace(FLIES, stop_asked=True), Phase.HAND_OVER),
        (Phase.APPROACH, replace(FLIES, telemetry_late=True), Phase.STALL),
        (Phase.APPROACH, replace(FLIES, vehicle_gone=True), Phase.RELEASED),
        (Phase.HOLD, replace(FLIES, held_up=True, stop_asked=True), Phase.RELEASED),
        (Phase.HAND_OVER, replace(FLIES, held_up=True), Phase.RELEASED),
        (Phase.STANDBY, replace(FLIES, held_up=True), Phase.AWAIT),
        (Phase.HOLD, replace(FLIES, armed=False), Phase.ENDED),
        (Phase.APPROACH, replace(FLIES, rebooted=True, armed=False), Phase.RELEASED),
        (Phase.HAND_OVER, replace(FLIES, rebooted=True), Phase.RELEASED),
        (Phase.STANDBY, replace(FLIES, rebooted=True, actual=None), Phase.AWAIT),
        (Phase.INHIBITED, replace(FLIES, rebooted=True, actual=None), Phase.AWAIT),
        (Phase.APPROACH, replace(FLIES, grounded=True), Phase.HAND_OVER),
        (Phase.STALL, replace(FLIES, battery_low=True), Phase.HAND_OVER),
        (Phase.STANDBY, replace(FLIES, battery_low=True, was_engaged=False), Phase.AWAIT),
        (Phase.APPROACH, replace(FLIES, company=Company.COMMANDER), Phase.HAND_OVER),
        (Phase.STANDBY, replace(FLIES, company=Company.COMMANDER, actual=LOITER), Phase.AWAIT),
        (Phase.APPROACH, replace(FLIES, company=Company.OTHER_VEHICLE), Phase.APPROACH),
        (Phase.STANDBY, replace(FLIES, company=Company.OTHER_VEHICLE, actual=LOITER), Phase.AWAIT),
        (Phase.APPROACH, replace(FLIES, estimate_invalid=True), Phase.STALL),
        (Phase.STALL, replace(FLIES, estimate_invalid=True), Phase.STALL),
        (Phase.STALL, replace(FLIES, estimate_invalid=True, ranges=Ranges.LOST), Phase.HAND_OVER),
        (Phase.STANDBY, replace(FLIES, estimate_invalid=True, actual=LOITER), Phase.AWAIT),
        (Phase.HAND_OVER, replace(FLIES, hand_over_overdue=True), Phase.RELEASED),
        (Phase.HAND_OVER, replace(FLIES, actual=LAND), Phase.RELEASED),
        (Phase.ACQUIRE, FLIES, Phase.APPROACH),
        (Phase.APPROACH, replace(FLIES, purpose=PROBE), Phase.ACQUIRE),
        (Phase.APPROACH, replace(FLIES, purpose=REST), Phase.HOLD),
        (Phase.APPROACH, replace(FLIES, purpose=STAY), Phase.KEEP),
        (Phase.KEEP, replace(FLIES, purpose=STAY), Phase.KEEP),
        (Phase.KEEP, FLIES, Phase.APPROACH),
        (Phase.KEEP, replace(FLIES, ranges=Ranges.LATE, purpose=STAY), Phase.COAST),
        (Phase.KEEP, replace(FLIES, ranges=Ranges.LATE, bearing_lost=True), Phase.STALL),
        (Phase.COAST, replace(FLIES, purpose=STAY), Phase.KEEP),
        (Phase.STALL, replace(FLIES, purpose=STAY), Phase.ACQUIRE),
        (Phase.ACQUIRE, replace(FLIES, purpose=REFUSE), Phase.HAND_OVER),
        (Phase.APPROACH, replace(FLIES, purpose=REFUSE), Phase.HAND_OVER),
    ],
)
def test_the_transitions_of_a_flight(before: Phase, facts: Facts, after: Phase) -> None:
    assert phase.step(before, facts)[0] is after


@pytest.mark.parametrize("before", [p for p in Phase if p in STREAMING])
def test_held_up_it_does_not_steer_whatever_it_still_believes(before: Phase) -> None:
    yes_no = (False, True)
    for stop, spent, late, ranges in itertools.product(yes_no, yes_no, yes_no, Ranges):
        believed = replace(
            FLIES, held_up=True, stop_asked=stop, budget_spent=spent, telemetry_late=late, ranges=ranges
        )
        assert phase.step(before, believed)[0] not in STREAMING


@pytest.mark.parametrize(
    ("facts", "condition"),
    [
        (replace(FLIES, rebooted=True, armed=False, actual=None), Condition.REBOOTED),
        (replace(FLIES, vehicle_gone=True, company=Company.OTHER_VEHICLE), Condition.VEHICLE_CHANGED),
        (replace(FLIES, vehicle_gone=True), Condition.VEHICLE_GONE),
        (replace(FLIES, company=Company.COMMANDER, budget_spent=True), Condition.SECOND_COMMANDER),
        (replace(FLIES, grounded=True, battery_low=True), Condition.LANDED),
        (replace(FLIES, battery_low=True, budget_spent=True), Condition.BATTERY_LOW),
        (replace(FLIES, estimate_invalid=True, telemetry_late=True), Condition.ESTIMATE_INVALID),
    ],
)
def test_what_happens_to_the_vehicle_has_its_own_name(facts: Facts, condition: Condition) -> None:
    assert phase.step(Phase.APPROACH, facts)[1] is condition


def test_every_phase_has_a_row() -> None:
    assert set(TABLE) == set(Phase)
