"""What PX4 tells a companion in EVENT messages, and who else is on the link: from bytes to events."""

from __future__ import annotations

import struct
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as mavlink

from companion.link.mavlink import VehicleLink
from companion.link.px4_events import event_words
from companion.settings import VehicleSettings
from companion.types import (
    AutopilotWords,
    BatteryReport,
    Charge,
    EstimatorReport,
    Event,
    Party,
    PartyHeard,
)
from sitl_mock import px4_events as mock
from sitl_mock.modes import Mode
from tests.safety.test_check import Wire
from tests.sitl_mock.recordings import recording

OURS, OTHER = 7, 42


def heartbeat(autopilot: bool) -> Any:
    kind = mavlink.MAV_AUTOPILOT_PX4 if autopilot else mavlink.MAV_AUTOPILOT_INVALID
    return mavlink.MAVLink_heartbeat_message(2 if autopilot else 18, kind, 1, 4 << 16 | 3 << 24, 3, 3)


def setpoint(target: int) -> Any:
    return mavlink.MAVLink_set_position_target_local_ned_message(0, target, 1, 8, 1479, *([0.0] * 11))


class Line:
    """A link in memory, after the first heartbeat of our autopilot."""

    def __init__(self, **settings: Any) -> None:
        self.wire = Wire()
        self.link = VehicleLink(VehicleSettings(**settings), self.wire)
        self.hear(OURS, 1, heartbeat(autopilot=True))

    def hear(self, system: int, component: int, message: Any) -> list[Event]:
        self.wire.incoming.append(bytes(message.pack(mavlink.MAVLink(None, system, component))))
        return list(self.link.receive(lambda: 1))


def test_a_recorded_failsafe_is_told_in_words() -> None:
    words = {}
    for name in ("loss_hold_then_resume", "loss_land", "loss_default_no_rc"):
        rows = [row for row in recording(name) if row["msg"] == "EVENT"]
        texts = (event_words(row["id"], bytes(row["arguments"])) for row in rows)
        words[name] = [text for text in texts if text]
    no_signal = "OFFBOARD cannot run: no offboard signal"
    assert words["loss_hold_then_resume"][:2] == [no_signal, "failsafe in OFFBOARD: Hold"]
    assert words["loss_land"] == [no_signal, "failsafe in OFFBOARD: Land"]
    assert words["loss_default_no_rc"] == [no_signal, "failsafe in OFFBOARD: Position"]


def test_an_event_crosses_the_wire_into_words() -> None:
    line = Line()
    (event,) = line.hear(OURS, 1, mock.failsafe(Mode.OFFBOARD, 5).message(1000, 3))
    assert event == AutopilotWords(1, "failsafe in OFFBOARD: Hold")
    assert not line.hear(OURS, 1, mock.TAKE_OFF.message(1000, 4))
    assert not line.hear(OTHER, 1, mock.failsafe(Mode.OFFBOARD, 5).message(1000, 3))


def test_what_the_autopilot_says_to_people_is_kept_printable() -> None:
    (event,) = Line().hear(OURS, 1, mavlink.MAVLink_statustext_message(2, b"Critical\x1b battery"))
    assert event == AutopilotWords(1, "Critical  battery")


def test_battery_and_estimate_become_events() -> None:
    line = Line()
    cells = [65535] * 10
    for state, charge in ((0, Charge.UNKNOWN), (1, Charge.OK), (2, Charge.LOW), (3, Charge.CRITICAL)):
        told = mavlink.MAVLink_battery_status_message(
            0, 1, 1, 0, cells, -1, -1, -1, 12, 0, state, [0] * 4, 0, 0
        )
        assert line.hear(OURS, 1, told) == [BatteryReport(1, charge, 0.12)]
    told = mavlink.MAVLink_sys_status_message(0, 0, 0, 0, 0, -1, -1, *([0] * 6))
    assert line.hear(OURS, 1, told) == [BatteryReport(1)]
    flags = mavlink.ESTIMATOR_VELOCITY_HORIZ | mavlink.ESTIMATOR_POS_HORIZ_REL
    told = mavlink.MAVLink_estimator_status_message(0, flags, *([0.0] * 8))
    assert line.hear(OURS, 1, told) == [EstimatorReport(1, True, True, False, False)]


@pytest.mark.parametrize(
    ("system", "component", "message", "party"),
    [
        (OURS, 191, heartbeat(autopilot=False), Party.TWIN),
        (OURS, 195, setpoint(OURS), Party.COMMANDER),
        (255, 190, setpoint(0), Party.COMMANDER),
        (OTHER, 1, heartbeat(autopilot=True), Party.AUTOPILOT),
        (OTHER, 191, setpoint(OTHER), None),
        (255, 190, heartbeat(autopilot=False), None),
        (OURS, 195, heartbeat(autopilot=False), None),
    ],
)
def test_others_on_the_link_are_told_where_they_matter(
    system: int, component: int, message: Any, party: Party | None
) -> None:
    told = Line().hear(system, component, message)
    expected = [] if party is None else [PartyHeard(1, party, system, component, message.get_type())]
    assert told == expected


def test_with_its_id_configured_other_vehicles_are_none_of_our_business() -> None:
    assert not Line(target_system=OURS).hear(OTHER, 1, heartbeat(autopilot=True))


def test_the_mocks_events_are_the_recorded_ones() -> None:
    rows = {row["id"]: row for row in recording("loss_land") if row["msg"] == "EVENT"}
    for event in (
        mock.ARMED, mock.TAKE_OFF, mock.NO_OFFBOARD, mock.failsafe(Mode.OFFBOARD, 4), mock.LANDED,
        mock.DISARMED_BY_LANDING,
    ):  # fmt: skip
        row = rows[event.number]
        assert bytes(row["arguments"]).rstrip(b"\0") == event.arguments.rstrip(b"\0")
        assert row["log_levels"] == event.levels
    assert struct.calcsize("<IIHBBB40B") == 53
