"""What `companion check` makes of what it found: every rule, without a vehicle."""

from __future__ import annotations

import json
from typing import Any

import pytest
from msgspec.structs import replace

from companion.check import vehicle as vehicles
from companion.check.ranges import RangeFindings
from companion.check.ranges import judge as judge_ranges
from companion.check.report import CheckReport, Part, Row, State, text
from companion.link.signing import NOT_SIGNED, WRONG_SIGNATURE
from companion.link.survey import Other, SysStatus, VehicleFindings
from companion.network_settings import BeaconSettings, RangesSettings, Ros2Settings
from companion.settings import MissionSettings, Settings, VehicleSettings
from companion.types import (
    BeaconTold,
    Charge,
    Defect,
    EstimatorReport,
    Event,
    FlightMode,
    Landed,
    LineOfSight,
    Malformed,
    RangeSample,
)

SETTINGS = Settings()
GPS = EstimatorReport(0, velocity=True, position=True, height=True, global_position=True)
NO_GPS = replace(GPS, global_position=False)
WELL = SysStatus(may_arm=True, unhealthy=(), remote_control=True)
NO_RC = WELL._replace(remote_control=False)


def healthy(**changes: Any) -> VehicleFindings:
    """A PX4 on the ground with radio control and everything in order, with some changes."""
    fields: dict[str, Any] = {
        "bytes_received": 10_000,
        "packets": 500,
        "t_found_ns": 1,
        "system_id": 1,
        "vendor": "PX4",
        "kind": "quadrotor",
        "version": "1.17.0",
        "armed": False,
        "mode": FlightMode.AUTO_LOITER,
        "intended": FlightMode.AUTO_LOITER,
        "landed": Landed.ON_GROUND,
        "height_m": 0.0,
        "estimator": GPS,
        "health": WELL,
        "charge": Charge.OK,
        "battery_share": 0.95,
        "battery_v": 16.2,
        "parameters": {
            "COM_OF_LOSS_T": 1.0,
            "COM_OBL_RC_ACT": 5,
            "COM_RCL_EXCEPT": 4,
            "COM_RC_OVERRIDE": 3,
            "MIS_TAKEOFF_ALT": 2.5,
        },
        "rates_hz": {
            "ATTITUDE": 50.0,
            "LOCAL_POSITION_NED": 50.0,
            "CURRENT_MODE": 20.0,
            "EXTENDED_SYS_STATE": 5.0,
        },
    }
    return VehicleFindings(**(fields | changes))


def with_parameter(name: str, value: float | None, **changes: Any) -> VehicleFindings:
    found = healthy(**changes)
    del found.parameters[name]
    if value is not None:
        found.parameters[name] = value
    return found


def judged(found: VehicleFindings, settings: Settings = SETTINGS, is_signing: bool = False) -> list[Row]:
    return list(vehicles.judge(settings, found, is_signing, 5.0))


def row(rows: list[Row], subject: str) -> Row:
    (found,) = [r for r in rows if r.subject == subject]
    return found


def test_a_vehicle_in_order_has_nothing_to_look_at() -> None:
    rows = judged(healthy())
    assert {r.state for r in rows} == {State.OK}
    assert not any(r.why or r.do for r in rows)


OFFBOARD = FlightMode.OFFBOARD
BODY = Settings(vehicle=VehicleSettings(setpoint_frame="body_ned"))


@pytest.mark.parametrize(
    ("changes", "subject", "state", "words"),
    [
        ({"vendor": "ArduPilot"}, "autopilot", State.FAIL, "never engage"),
        ({"version": None}, "AUTOPILOT_VERSION", State.WARN, "never came within 5.0 s"),
        ({"mode": OFFBOARD, "intended": OFFBOARD}, "mode", State.FAIL, "select another mode"),
        ({"intended": OFFBOARD}, "mode", State.FAIL, "inhibited"),
        ({"armed": True}, "armed", State.WARN, "before arming"),
        ({"health": None}, "SYS_STATUS", State.WARN, "never came within 5.0 s"),
        (
            {"health": SysStatus(False, ("gps", "3d mag"), True)},
            "arming checks",
            State.FAIL,
            "gps, 3d mag",
        ),
        (
            {"health": SysStatus(False, (), True), "estimator": NO_GPS},
            "arming checks",
            State.WARN,
            "in OFFBOARD only",
        ),
        ({"health": SysStatus(True, ("3d mag",), True)}, "arming checks", State.WARN, "3d mag"),
        ({"health": NO_RC}, "radio control", State.WARN, "Nobody can take over with a switch"),
        ({"charge": Charge.CRITICAL, "battery_share": 0.05}, "battery", State.FAIL, "5 %, 16.2 V, critical"),
        ({"charge": Charge.LOW}, "battery", State.FAIL, "COM_LOW_BAT_ACT"),
        ({"battery_share": 0.25}, "battery", State.WARN, "charge it"),
        ({"battery_share": 0.14}, "battery", State.FAIL, "loss.battery_share"),
        ({"charge": None, "battery_share": None, "battery_v": None}, "battery", State.WARN, "within 5.0 s"),
        ({"estimator": None}, "ESTIMATOR_STATUS", State.WARN, "never came within 5.0 s"),
        (
            {"estimator": replace(GPS, velocity=False)},
            "velocity",
            State.FAIL,
            "no offboard signal",
        ),
        ({"estimator": replace(GPS, height=False)}, "local position", State.FAIL, "body_ned"),
        ({"estimator": NO_GPS}, "global position", State.WARN, "COM_OBL_RC_ACT = 4 (Land)"),
        ({"estimator": NO_GPS}, "COM_OBL_RC_ACT", State.WARN, "lands instead"),
        ({"rates_hz": {}}, "ATTITUDE", State.FAIL, "never came"),
        ({"rates_hz": {}}, "LOCAL_POSITION_NED", State.FAIL, "never came"),
        ({"rates_hz": {}}, "CURRENT_MODE", State.WARN, "restart on the ground"),
        ({"rates_hz": {"ATTITUDE": 12.0}}, "ATTITUDE", State.WARN, "12 Hz of 50 Hz"),
        ({"packets": 70, "packets_lost": 30}, "packets lost", State.WARN, "30.0 %"),
        ({"others": {Other(1, 191, "onboard controller")}}, "second companion", State.FAIL, "stop the other"),
        (
            {"commanders": {Other(255, 190, "SET_ATTITUDE_TARGET")}},
            "second commander",
            State.FAIL,
            "stop the",
        ),
        ({"others": {Other(2, 1, "quadrotor")}}, "second vehicle", State.FAIL, "vehicle.target_system"),
        ({"signs": True}, "signing", State.FAIL, "no setpoint would be flown"),
    ],
)
def test_what_is_not_in_order_is_said_with_the_reason(
    changes: dict[str, Any], subject: str, state: State, words: str
) -> None:
    found = row(judged(healthy(**changes)), subject)
    assert found.state is state
    assert words in f"{found.found} {found.why} {found.do}"


@pytest.mark.parametrize(
    ("name", "value", "health", "state", "words"),
    [
        ("COM_OF_LOSS_T", 0.1, WELL, State.FAIL, "set COM_OF_LOSS_T to 1.0"),
        ("COM_OF_LOSS_T", 0.8, WELL, State.FAIL, "above loss.held_up_after_s (0.8 s)"),
        ("COM_OF_LOSS_T", 5.0, WELL, State.WARN, "2.5 m"),
        ("COM_OBL_RC_ACT", 0, WELL, State.OK, "the pilot flies"),
        ("COM_OBL_RC_ACT", 0, NO_RC, State.FAIL, "blind descent"),
        ("COM_OBL_RC_ACT", 2, NO_RC, State.FAIL, "5 (Hold) or 4 (Land)"),
        ("COM_OBL_RC_ACT", 4, NO_RC, State.OK, "Land"),
        ("COM_OBL_RC_ACT", 6, WELL, State.FAIL, "stop in the air"),
        ("COM_OBL_RC_ACT", 7, WELL, State.FAIL, "stop in the air"),
        ("COM_OBL_RC_ACT", 42, WELL, State.FAIL, "unknown"),
        ("COM_RCL_EXCEPT", 0, WELL, State.OK, "ends without radio control"),
        ("COM_RCL_EXCEPT", 3, NO_RC, State.FAIL, "add 4 to COM_RCL_EXCEPT"),
        ("COM_RC_OVERRIDE", 1, WELL, State.WARN, "add 2 to COM_RC_OVERRIDE"),
        ("COM_RC_OVERRIDE", 1, NO_RC, State.OK, "no radio control now"),
        ("MIS_TAKEOFF_ALT", 80.0, WELL, State.WARN, "height band of 0.5 to 50 m"),
        ("COM_OBL_RC_ACT", None, WELL, State.FAIL, "never came within 5.0 s"),
        ("COM_OF_LOSS_T", None, WELL, State.FAIL, "never came within 5.0 s"),
        ("COM_RCL_EXCEPT", None, WELL, State.WARN, "never came within 5.0 s"),
        ("COM_RC_OVERRIDE", None, WELL, State.WARN, "never came within 5.0 s"),
        ("MIS_TAKEOFF_ALT", None, WELL, State.WARN, "never came within 5.0 s"),
    ],
)
def test_parameters(name: str, value: float | None, health: SysStatus, state: State, words: str) -> None:
    found = row(judged(with_parameter(name, value, health=health)), name)
    assert found.state is state
    assert words in f"{found.found} {found.why} {found.do}"


def test_with_body_ned_no_position_is_needed() -> None:
    found = healthy(estimator=EstimatorReport(0, True, False, False, False), rates_hz={"ATTITUDE": 50.0})
    rows = judged(found, BODY)
    assert row(rows, "local position").state is State.OK
    assert row(rows, "LOCAL_POSITION_NED").state is State.WARN


@pytest.mark.parametrize(
    ("changes", "state", "words"),
    [
        ({"verified": 99}, State.OK, "99 messages verified"),
        ({"refused": {NOT_SIGNED: 9}}, State.FAIL, "does not sign"),
        ({"refused": {WRONG_SIGNATURE: 9}}, State.FAIL, "the same key"),
        ({"verified": 99, "refused": {WRONG_SIGNATURE: 9}}, State.WARN, "Somebody without the key"),
    ],
)
def test_a_signed_link(changes: dict[str, Any], state: State, words: str) -> None:
    found = row(judged(healthy(**changes), is_signing=True), "signing")
    assert found.state is state
    assert words in f"{found.found} {found.why} {found.do}"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "nothing came at all"),
        ({"bytes_received": 900}, "900 bytes came, no HEARTBEAT among them"),
        ({"bytes_received": 900, "others": {Other(7, 1, "quadrotor")}}, "system 7 component 1 (quadrotor)"),
        ({"bytes_received": 900, "refused": {NOT_SIGNED: 3}}, "refused: 3 not signed"),
    ],
)
def test_without_an_autopilot_it_says_what_came_instead(changes: dict[str, Any], words: str) -> None:
    (found,) = judged(VehicleFindings(**changes))
    assert found.state is State.FAIL
    assert "within 5.0 s" in found.found
    assert words in found.found
    assert found.do


# ---------------------------------------------------------------------------------------------- ranges

S = 1_000_000_000


def sample(i: int, beacon: str = "b1", **changes: Any) -> RangeSample:
    fields: dict[str, Any] = {
        "t_ns": i * S // 20,
        "beacon": beacon,
        "session": "s1",
        "seq": i,
        "range_m": 7.0,
        "sigma_m": 0.07,
        "los": LineOfSight.LOS,
    }
    return RangeSample(**(fields | changes))


def heard(*events: Event, settings: Settings = SETTINGS, **more: Any) -> list[Row]:
    found = RangeFindings(settings)
    for event in events:
        found.take_in(event)
    arguments: dict[str, Any] = {"connected": 1, "t_ns": 5 * S, "watched_s": 5.0, "height_m": 0.0}
    return list(judge_ranges(settings, found, **(arguments | more)))


GOOD = [sample(i) for i in range(100)]


def test_good_ranges_have_nothing_to_look_at() -> None:
    rows = heard(*GOOD)
    assert {r.state for r in rows} == {State.OK}
    assert "7.00 m, told sigma 0.07 m, 20.0 Hz" in row(rows, "b1 (target)").found
    assert "about 7 m away, 14 s" in row(rows, "way to the target").found


def test_nobody_connected_and_no_target() -> None:
    rows = heard(connected=0)
    assert row(rows, "Zenoh").state is State.FAIL
    assert "no endpoint configured" in row(rows, "Zenoh").found
    assert row(rows, "b1 (target)").state is State.FAIL
    assert "uwb/v1/lab/b1/*/range within 5.0 s" in row(rows, "b1 (target)").found


def test_ros2_topics_are_named_where_nothing_comes() -> None:
    settings = Settings(ranges=RangesSettings(ros2=(Ros2Settings(topic="/uwb/b1"),)))
    assert (
        "range on uwb/v1/lab/b1/*/range, /uwb/b1 within" in row(heard(settings=settings), "b1 (target)").found
    )


def test_another_beacon_missing_is_no_hindrance() -> None:
    settings = Settings(beacons={"b1": BeaconSettings(), "b2": BeaconSettings()})
    assert row(heard(*GOOD, settings=settings), "b2").state is State.WARN


@pytest.mark.parametrize(
    ("events", "state", "words"),
    [
        ([sample(i, seq=1) for i in range(100)], State.FAIL, "99 repeated"),
        ([sample(i, range_m=500.0) for i in range(100)], State.FAIL, "100 absurd"),
        (GOOD[:50], State.FAIL, "fallen silent"),
        ([sample(i, seq=i // 2) for i in range(100)], State.WARN, "50 repeated"),
        (GOOD[:40] + GOOD[60:], State.WARN, "longest gap 1.05 s"),
    ],
)
def test_a_beacon_that_is_not_in_order(events: list[RangeSample], state: State, words: str) -> None:
    found = row(heard(*events), "b1 (target)")
    assert found.state is state
    assert words in f"{found.found} {found.why}"


def test_two_publishers_under_one_id_are_told_from_a_restart() -> None:
    mixed = [sample(i, session=f"s{i % 2}") for i in range(100)]
    assert row(heard(*mixed), "b1").state is State.FAIL
    restarted = [sample(i, session="s2" if i > 50 else "s1") for i in range(100)]
    assert not [r for r in heard(*restarted) if r.subject == "b1"]


def test_ranges_that_contradict_the_height_or_are_blocked() -> None:
    short = heard(*(sample(i, range_m=2.0) for i in range(100)), height_m=5.0)
    assert "check beacons.b1.height_m" in row(short, "b1").do
    blocked = heard(*(sample(i, los=LineOfSight.NLOS) for i in range(100)))
    assert "100 of 100" in row(blocked, "b1").found


def test_a_beacon_that_tells_otherwise_than_the_configuration() -> None:
    settings = Settings(beacons={"b1": BeaconSettings(height_m=1.5)})
    found = row(heard(BeaconTold(1, "b1", height_m=0.5), *GOOD, settings=settings), "b1")
    assert found.state is State.WARN
    assert "height 0.5 m, the configuration 1.5 m" in found.found
    told = heard(BeaconTold(1, "b1", height_m=0.5), *GOOD, height_m=9.0)
    assert "8.50 m above or below" in row(told, "b1").found


def test_a_target_out_of_reach() -> None:
    far = row(heard(*(sample(i, range_m=90.0) for i in range(100))), "way to the target")
    assert far.state is State.FAIL
    assert "limits.from_start_m = 60" in far.found


def test_strangers_and_what_cannot_be_read_are_named() -> None:
    bad = Malformed(t_ns=1, defect=Defect.RANGE_FIELD, detail="uwb/v1/lab/b1/t/range: no `seq`")
    rows = heard(*GOOD, sample(1, beacon="B1"), bad, bad)
    assert "B1" in row(rows, "other beacons").found
    assert row(rows, "unreadable").found == f"2: {Defect.RANGE_FIELD.value}: {bad.detail}"


def test_a_flood_of_ids_takes_bounded_memory() -> None:
    found = RangeFindings(SETTINGS)
    for i in range(5000):
        found.take_in(sample(i, beacon=f"x{i}", session=f"s{i}"))
        found.take_in(sample(i, session=f"s{i}"))
    assert len(found.beacons) <= 64
    assert all(len(h.sessions) <= 64 for h in found.beacons.values())
    rows = list(judge_ranges(SETTINGS, found, 1, 5 * S, 5.0, None))
    assert "and more" in row(rows, "other beacons").found


# ----------------------------------------------------------------------------------------------- table

ROWS = (
    Row(Part.LINK, "signing", State.OK, "off"),
    Row(
        Part.AUTOPILOT, "mode", State.FAIL, "OFFBOARD\x1b[2J", "Too early.", "select another " + "mode " * 40
    ),
    Row(Part.RANGES, "b1", State.WARN, "slow", "Late.", "hurry"),
)


def test_the_table_says_what_why_and_what_to_do_within_its_width() -> None:
    table = text(CheckReport(ROWS), width=80)
    assert all(len(line) <= 80 for line in table.splitlines())
    for words in (
        "ok",
        "FAIL",
        "warn",
        "Too early.",
        "→ select another",
        "NOT READY: 1 to mend, 1 to look at.",
    ):
        assert words in table
    assert "\x1b" not in table
    assert text(CheckReport(ROWS[:1])).endswith("READY to fly, nothing to look at.")
    assert "\x1b[1;31mFAIL\x1b[0m" in text(CheckReport(ROWS), colour=True)


def test_json_has_every_row_with_all_its_words() -> None:
    told = json.loads(CheckReport(ROWS).json())
    assert told["ready"] is False
    assert set(told) == {"ready", "rows"}
    assert told["rows"][2] == {
        "part": "ranges",
        "subject": "b1",
        "state": "warn",
        "found": "slow",
        "why": "Late.",
        "do": "hurry",
    }
    assert json.loads(CheckReport(ROWS[::2]).json())["ready"] is True


THREE = {name: BeaconSettings(station_distance_m=d) for name, d in (("b1", 5.0), ("b2", 6.5), ("b3", 5.0))}
STATION = Settings(mission=MissionSettings(kind="station"), beacons=THREE)


def around(*ranges_m: float) -> list[Row]:
    """What is said of beacons b1, b2, … heard at these ranges."""
    found = RangeFindings(STATION)
    for i in range(60):
        for n, range_m in enumerate(ranges_m, 1):
            found.take_in(RangeSample(i * 50_000_000, f"b{n}", "s", i, range_m))
    return list(judge_ranges(STATION, found, 1, 3_000_000_000, 3.0, 0.0))


def test_a_station_needs_three_beacons() -> None:
    assert row(around(10.0, 9.0, 8.0), "b3 (d* 5 m)").state is State.OK
    missing = row(around(10.0, 9.0), "b3 (d* 5 m)")
    assert missing.state is State.FAIL
    assert "fewer than 3 beacons" in missing.why


def test_the_way_to_a_station_follows_from_all_beacons() -> None:
    fine = row(around(10.0, 9.0, 8.0), "way to the station")
    assert (fine.state, fine.found) == (State.OK, "5 to 13 m away, 10 to 26 s")
    assert row(around(90.0, 90.0, 90.0), "way to the station").state is State.FAIL
    mixed_up = row(around(2.0, 30.0, 4.0), "way to the station")
    assert mixed_up.state is State.FAIL
    assert "No place" in mixed_up.why
