"""The doors that samples come in by: what a flood leaves of itself, and of the others."""

from __future__ import annotations

from companion.link.range_events import RangeReader, Raw
from companion.link.zenoh_ranges import Door
from companion.types import Defect, Event, Malformed, RangeSample

S = 1_000_000_000
KEY = "uwb/v1/lab/b1/tag/range"


def raw(k: int, t_ns: int = 0) -> Raw:
    return Raw(t_ns, KEY, str(k).encode(), 1, "application/json")


def event(r: Raw) -> Event:
    return Malformed(r.t_ns, Defect.RANGE_PAYLOAD, r.payload.decode())


def numbers(door: Door, now_ns: int) -> list[int]:
    came: list[Event] = []
    door.receive(now_ns, came)
    return [int(e.detail) for e in came if isinstance(e, Malformed)]


def test_ranges_at_their_pace_pass() -> None:
    door = Door(KEY, 100.0, False, event)
    for k in range(1000):
        door.note(raw(k))
        assert numbers(door, k * S // 50) == [k]
    assert door.flood(100 * S) is None


def test_of_a_flood_no_more_passes_than_allowed_and_the_rest_is_counted() -> None:
    door = Door(KEY, 100.0, False, event)
    passed = told = 0
    for k in range(100_000):  # ten seconds of it, looked at after every fifth
        door.note(raw(k))
        if k % 5 == 0:
            passed += len(numbers(door, k * S // 10_000))
            if (flood := door.flood(k * S // 10_000)) is not None:
                assert flood.defect is Defect.RANGE_FLOOD
                told += 1
    assert 1000 <= passed <= 1064
    assert told <= 101


def test_of_a_burst_the_newest_are_kept() -> None:
    door = Door(KEY, 100.0, False, event)
    for k in range(10_000):
        door.note(raw(k))
    assert numbers(door, S) == list(range(9936, 10_000))
    lost = door.flood(S)
    assert isinstance(lost, Malformed)
    assert lost.detail == f"9936 of {KEY} dropped"


def test_a_door_for_many_beacons_lets_more_in() -> None:
    door = Door(KEY, 100.0, True, event)
    for k in range(1000):
        door.note(raw(k))
    assert numbers(door, S) == list(range(1000))


def test_each_range_is_its_own_beacons_whichever_came_before() -> None:
    read, came = RangeReader().event, []
    for k, beacon in enumerate(("b1", "b1", "b2", "b1", "*")):
        payload = b'{"session": "s", "seq": %d, "range_m": 3.5}' % k
        event = read(Raw(k, f"uwb/v1/lab/{beacon}/tag/range", payload, len(payload), "application/json"))
        assert isinstance(event, RangeSample)
        came.append(event.beacon)
    assert came == ["b1", "b1", "b2", "b1", "*"]
