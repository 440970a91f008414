"""The table of phases, pair by pair, and what holds when: small enough to be run against every mutant."""

from __future__ import annotations

from pathlib import Path

import pytest
from msgspec.structs import replace

from companion import phase
from companion.guidance.scheme import PROBE, REFUSE, REST, STAY, TRACK
from companion.phase import Company, Condition, Facts, Ranges
from companion.types import FlightMode, Phase, Severity

OFFBOARD, LOITER = FlightMode.OFFBOARD, FlightMode.AUTO_LOITER
FLIES = Facts(
    actual=OFFBOARD,
    intended=OFFBOARD,
    armed=True,
    was_engaged=True,
    telemetry_late=False,
    ranges=Ranges.FRESH,
    purpose=TRACK,
)
HOVERS = Facts(actual=LOITER, intended=LOITER, armed=True, telemetry_late=False, ranges=Ranges.FRESH)
"""Before the engagement, in another mode."""


def names(facts: Facts) -> str:
    return " ".join(condition.name for condition in phase.conditions(facts))


@pytest.mark.parametrize(
    ("facts", "expected"),
    [
        (Facts(), "LEFT_OFFBOARD INPUTS_MISSING RANGES_LOST TELEMETRY_LATE RANGES_STALE"),
        (HOVERS, "LEFT_OFFBOARD OTHER_MODE READY PROBING"),
        (replace(HOVERS, actual=None), "LEFT_OFFBOARD OTHER_MODE INPUTS_MISSING PROBING"),
        (replace(HOVERS, intended=OFFBOARD), "LEFT_OFFBOARD OFFBOARD_ALREADY READY PROBING"),
        # In the air it is not known whether OFFBOARD is meant: not ready. On the ground it does not matter.
        (replace(HOVERS, intended=None), "LEFT_OFFBOARD PROBING"),
        (replace(HOVERS, intended=None, armed=None), "LEFT_OFFBOARD PROBING"),
        (replace(HOVERS, intended=None, armed=False), "LEFT_OFFBOARD READY PROBING"),
        (replace(HOVERS, intended=None, grounded=True), "LEFT_OFFBOARD LANDED READY PROBING"),
        (
            replace(HOVERS, telemetry_late=True),
            "LEFT_OFFBOARD OTHER_MODE INPUTS_MISSING TELEMETRY_LATE PROBING",
        ),
        (replace(HOVERS, vehicle_gone=True), "VEHICLE_GONE LEFT_OFFBOARD INPUTS_MISSING PROBING"),
        (replace(HOVERS, ranges=Ranges.LATE), "LEFT_OFFBOARD OTHER_MODE RANGES_LATE"),
        (replace(HOVERS, ranges=Ranges.STALE), "LEFT_OFFBOARD OTHER_MODE INPUTS_MISSING RANGES_STALE"),
        (
            replace(HOVERS, ranges=Ranges.LOST),
            "LEFT_OFFBOARD OTHER_MODE INPUTS_MISSING RANGES_LOST RANGES_STALE",
        ),
        (replace(HOVERS, battery_low=True), "LEFT_OFFBOARD OTHER_MODE BATTERY_LOW PROBING"),
        (replace(HOVERS, estimate_invalid=True), "LEFT_OFFBOARD OTHER_MODE ESTIMATE_INVALID PROBING"),
        (
            replace(HOVERS, company=Company.COMMANDER),
            "LEFT_OFFBOARD OTHER_MODE SECOND_COMMANDER PROBING",
        ),
        (
            replace(HOVERS, company=Company.OTHER_VEHICLE),
            "LEFT_OFFBOARD OTHER_MODE OTHER_VEHICLE PROBING",
        ),
        (
            replace(HOVERS, company=Company.OTHER_VEHICLE, vehicle_gone=True),
            "VEHICLE_CHANGED VEHICLE_GONE LEFT_OFFBOARD OTHER_VEHICLE INPUTS_MISSING PROBING",
        ),
        (
            replace(FLIES, company=Company.COMMANDER, vehicle_gone=True),
            "VEHICLE_GONE SECOND_COMMANDER INPUTS_MISSING TRACKING",
        ),
        (FLIES, "OFFBOARD_ALREADY READY ENGAGED TRACKING"),
        (replace(FLIES, intended=None), "OFFBOARD_ALREADY ENGAGED TRACKING"),
        (replace(FLIES, intended=LOITER), "OFFBOARD_ALREADY READY ENGAGED TRACKING"),
        (replace(FLIES, actual=LOITER), "LEFT_OFFBOARD OFFBOARD_ALREADY READY TRACKING"),
        (replace(FLIES, actual=LOITER, intended=LOITER), "LEFT_OFFBOARD OTHER_MODE READY TRACKING"),
        (replace(FLIES, rebooted=True), "REBOOTED OFFBOARD_ALREADY READY ENGAGED TRACKING"),
        (replace(FLIES, armed=False), "FLIGHT_OVER OFFBOARD_ALREADY READY TRACKING"),
        (replace(FLIES, armed=None), "FLIGHT_OVER OFFBOARD_ALREADY READY TRACKING"),
        (replace(FLIES, armed=False, was_engaged=False), "OFFBOARD_ALREADY READY TRACKING"),
        (replace(FLIES, held_up=True), "HELD_UP OFFBOARD_ALREADY READY ENGAGED TRACKING"),
        (replace(FLIES, stop_asked=True), "STOP_ASKED OFFBOARD_ALREADY READY ENGAGED TRACKING"),
        (replace(FLIES, waited_out=True), "WAITED_OUT OFFBOARD_ALREADY READY ENGAGED TRACKING"),
        (replace(FLIES, grounded=True), "OFFBOARD_ALREADY LANDED READY TRACKING"),
        (replace(FLIES, battery_low=True), "OFFBOARD_ALREADY BATTERY_LOW TRACKING"),
        (replace(FLIES, estimate_invalid=True), "OFFBOARD_ALREADY ESTIMATE_INVALID TRACKING"),
        (
            replace(FLIES, hand_over_overdue=True),
            "OFFBOARD_ALREADY READY ENGAGED HAND_OVER_OVERDUE TRACKING",
        ),
        (replace(FLIES, budget_spent=True), "OFFBOARD_ALREADY READY ENGAGED BUDGET_SPENT TRACKING"),
        (replace(FLIES, telemetry_late=True), "OFFBOARD_ALREADY INPUTS_MISSING TELEMETRY_LATE TRACKING"),
        (replace(FLIES, ranges=Ranges.LATE), "OFFBOARD_ALREADY RANGES_LATE"),
        (replace(FLIES, ranges=Ranges.LATE, bearing_lost=True), "OFFBOARD_ALREADY BEARING_LOST RANGES_LATE"),
        (
            replace(FLIES, ranges=Ranges.STALE, bearing_lost=True),
            "OFFBOARD_ALREADY INPUTS_MISSING RANGES_STALE",
        ),
        (replace(FLIES, ranges=Ranges.LOST), "OFFBOARD_ALREADY INPUTS_MISSING RANGES_LOST RANGES_STALE"),
        (replace(FLIES, purpose=PROBE), "OFFBOARD_ALREADY READY ENGAGED PROBING"),
        (replace(FLIES, purpose=REST), "OFFBOARD_ALREADY READY ENGAGED RESTING"),
        (replace(FLIES, purpose=STAY), "OFFBOARD_ALREADY READY ENGAGED STAYING"),
        (replace(FLIES, purpose=REFUSE), "OFFBOARD_ALREADY READY ENGAGED REFUSING"),
    ],
)  # fmt: skip
def test_what_holds_and_what_comes_first(facts: Facts, expected: str) -> None:
    assert names(facts) == expected


def test_every_condition_is_in_the_table_and_can_hold() -> None:
    assert {condition for row in phase.TABLE.values() for condition in row} == set(Condition)


# ------------------------------------------------------------------------------------------- the page

PAGE = Path(__file__).with_name("phase_table.md")


def page() -> str:
    """Every pair of condition and phase, for people: where it leads, or `·`: stay, look at the next."""
    phases = list(Phase)
    lines = [
        "# Every phase and every condition",
        "",
        "Written by `python -m tests.core.test_phase_table`: a change of the table is a change of this page.",
        "Conditions stand in order of importance; the first that holds and has an entry decides.",
        "`·`: stay, and look at the next one.",
        "",
        "| | " + " | ".join(p.value for p in phases) + " |",
        "|---" * (len(phases) + 1) + "|",
    ]
    for condition in Condition:
        cells = [phase.TABLE[p].get(condition) for p in phases]
        told = " | ".join("·" if after is None else after.value for after in cells)
        lines.append(f"| {condition.name.lower().replace('_', ' ')} | {told} |")
    return "\n".join(lines) + "\n"


def test_every_pair_leads_where_the_page_says() -> None:
    assert page() == PAGE.read_text(encoding="utf-8"), "python -m tests.core.test_phase_table"
    for before in Phase:
        for condition in Condition:
            after, why = phase.decide(before, (condition,))
            expected = phase.TABLE[before].get(condition, before)
            assert after is expected
            assert why is (None if after is before else condition)


def test_an_entry_that_stays_hides_what_comes_after_it() -> None:
    holding = (Condition.TELEMETRY_LATE, Condition.TRACKING)
    assert phase.decide(Phase.STALL, holding) == (Phase.STALL, None)
    assert phase.decide(Phase.STALL, holding[1:]) == (Phase.ACQUIRE, Condition.TRACKING)


@pytest.mark.parametrize(
    ("after", "condition", "severity"),
    [
        (Phase.HAND_OVER, Condition.STOP_ASKED, Severity.CRITICAL),
        (Phase.RELEASED, Condition.VEHICLE_GONE, Severity.CRITICAL),
        (Phase.AWAIT, Condition.REBOOTED, Severity.CRITICAL),
        (Phase.RELEASED, Condition.LEFT_OFFBOARD, Severity.WARNING),
        (Phase.STALL, Condition.RANGES_STALE, Severity.WARNING),
        (Phase.COAST, Condition.RANGES_LATE, Severity.WARNING),
        (Phase.INHIBITED, Condition.OFFBOARD_ALREADY, Severity.WARNING),
        (Phase.ACQUIRE, Condition.ENGAGED, Severity.NOTICE),
        (Phase.HOLD, Condition.RESTING, Severity.NOTICE),
        (Phase.KEEP, Condition.STAYING, Severity.NOTICE),
        (Phase.ENDED, Condition.FLIGHT_OVER, Severity.NOTICE),
        (Phase.APPROACH, Condition.TRACKING, Severity.INFO),
        (Phase.STANDBY, Condition.READY, Severity.INFO),
    ],
)
def test_how_loudly_it_is_told(after: Phase, condition: Condition, severity: Severity) -> None:
    assert phase.severity(after, condition) is severity


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
