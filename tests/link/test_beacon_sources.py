"""Over real Zenoh: what beacons tell of themselves, and ranges that come from ROS 2."""

from __future__ import annotations

import itertools
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import zenoh

from companion.link import zenoh_ranges
from companion.link.range_events import Raw, info_event, ros2_event
from companion.link.zenoh_publish import PublishLink
from companion.link.zenoh_ranges import RangeLink
from companion.network_settings import RangesSettings, Ros2Settings
from companion.types import BeaconTold, Defect, Event, Malformed, RangeSample
from companion.uwb import ros2
from companion.uwb.info import BeaconInfo, encode
from companion.wire_range import info_key, range_key
from tests.uwb.network import router, until
from tests.uwb.samples import ATTACHMENT, JAZZY

HUMBLE = JAZZY[:40]
RMW_KEY = (
    f"7/uwb/a1/{ros2.RANGE_TYPE}/RIHS01_b42b62562e93cbfe9d42b82fe5994dfa3d63d7d5c90a317981703f7388adff3a"
)


class Ears:
    """A range link and everything that came by it."""

    def __init__(self, link: RangeLink, rung: threading.Event) -> None:
        self.link, self.rung = link, rung
        self.events: list[Event] = []

    def hear(self, enough: Callable[[list[Event]], bool], what: str) -> None:
        def look() -> bool:
            self.events += self.link.receive()
            return enough(self.events)

        until(look, what)


@contextmanager
def ears(settings: RangesSettings, beacons: tuple[str, ...] = ("*",)) -> Iterator[Ears]:
    rung = threading.Event()
    link = RangeLink(settings, rung.set, beacons)
    try:
        yield Ears(link, rung)
    finally:
        link.close()


@contextmanager
def beacon(endpoint: str, name: str, info: BeaconInfo) -> Iterator[PublishLink]:
    link = PublishLink(RangesSettings(connect=(endpoint,)))
    try:
        link.announce(name, encode(info))
        until(lambda: link.connected() > 0, "the beacon is connected")
        yield link
    finally:
        link.close()


def test_beacons_are_asked_at_the_start_and_when_they_appear() -> None:
    with (
        router() as network,
        beacon(network.endpoint, "b1", BeaconInfo(height_m=1.2, bias_m=0.3)),
        ears(RangesSettings(connect=(network.endpoint,)), ("b1", "b2")) as vehicle,
    ):
        early = BeaconTold(0, "b1", 1.2, 0.3)
        vehicle.hear(lambda events: told(events, early), "what b1 tells")
        with beacon(network.endpoint, "b2", BeaconInfo(height_m=0.4)):
            late = BeaconTold(0, "b2", 0.4, None)
            vehicle.hear(lambda events: told(events, late), "what b2 tells")


def test_a_beacon_that_has_not_answered_is_asked_again_while_its_ranges_come(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(zenoh_ranges, "_ASK_PACE_S", 0.1)
    with (
        router() as network,
        ears(RangesSettings(connect=(network.endpoint,)), ("b1", "b2")) as vehicle,
    ):
        until(lambda: vehicle.link.connected() > 0, "the vehicle is connected")
        asked: list[str] = []
        for name in ("b1", "b2"):
            key = info_key("lab", name)

            def answer(query: zenoh.Query, key: str = key) -> None:
                asked.append(key)
                if asked.count(key) > 3:  # so many are lost
                    query.reply(key, encode(BeaconInfo(height_m=1.2)))

            network.session.declare_queryable(key, answer)

        def put_until_told() -> bool:
            network.session.put(range_key("lab", "b1", "tag"), b"{}")
            vehicle.events += vehicle.link.receive()
            return told(vehicle.events, BeaconTold(0, "b1", 1.2, None))

        until(put_until_told, "what b1 tells")
        assert asked.count(info_key("lab", "b2")) <= 1  # no ranges, no questions


def told(events: list[Event], expected: BeaconTold) -> bool:
    return any(
        isinstance(e, BeaconTold)
        and (e.beacon, e.height_m, e.bias_m) == (expected.beacon, expected.height_m, expected.bias_m)
        for e in events
    )


@pytest.mark.parametrize("payload", [b"", b"{", b'{"height_m": "high"}', b'{"bias_m": 1e9}', b"[" * 4000])
def test_what_is_no_info_is_named(payload: bytes) -> None:
    event = info_event(Raw(0, "uwb/v1/lab/b1/info", payload, len(payload), ""))
    assert isinstance(event, Malformed)
    assert event.defect is Defect.BEACON_INFO


def test_ranges_of_both_bridges_arrive() -> None:
    topics = (
        Ros2Settings(topic="/uwb/a1", bridge="rmw_zenoh", domain=7),
        Ros2Settings(topic="/bot1/uwb/*/range"),
        Ros2Settings(topic="/front", beacon="b1"),
    )
    with router() as network, ears(RangesSettings(connect=(network.endpoint,), ros2=topics), ()) as vehicle:
        until(lambda: vehicle.link.connected() > 0, "the vehicle is connected")
        sent: list[tuple[str, bytes, bytes | None]] = [
            (RMW_KEY, JAZZY, ATTACHMENT),
            ("bot1/uwb/a2/range", HUMBLE, None),
            ("front", HUMBLE, None),
            ("front", b"\x00\x01\x00\x00nonsense", None),
        ]

        turn = itertools.cycle(sent)  # one at a time: of two at once on one key Zenoh's cap drops the second

        def put_until_heard() -> bool:
            key, payload, attachment = next(turn)
            network.session.put(key, payload, attachment=attachment)
            vehicle.events += vehicle.link.receive()
            return {kind(e) for e in vehicle.events} == {"a1", "a2", "b1", Defect.RANGE_ROS2}

        until(put_until_heard, "a range of each topic")
    ranges: dict[str, Any] = {e.beacon: e for e in vehicle.events if isinstance(e, RangeSample)}
    assert {e.range_m for e in ranges.values()} == {12.5}
    assert ranges["a1"].session == ATTACHMENT[17:].hex()
    assert ranges["a1"].sigma_m == pytest.approx(0.1)
    assert (ranges["a2"].session, ranges["a2"].sigma_m) == ("ros2", None)
    assert ranges["a2"].sent_t_ns == 1_700_000_000_250_000_000


def kind(event: Event) -> object:
    if isinstance(event, Malformed):
        return event.defect
    return event.beacon if isinstance(event, RangeSample) else None


@pytest.mark.parametrize(
    ("payload", "attachment", "defect"),
    [
        (JAZZY[:43], None, Defect.RANGE_ROS2),
        (JAZZY, b"", Defect.RANGE_ROS2),
        (JAZZY[:36] + b"\x00\x00\x80\x7f" + JAZZY[40:], None, Defect.RANGE_STATUS),
        (b"\x00" * 513, None, Defect.RANGE_TOO_LONG),
    ],
)
def test_what_is_no_ros2_range_is_named(payload: bytes, attachment: bytes | None, defect: Defect) -> None:
    event = ros2_event(Ros2Settings(topic="/uwb/a1"), Raw(0, "uwb/a1", payload, len(payload), "", attachment))
    assert isinstance(event, Malformed)
    assert event.defect is defect


def test_a_beacon_may_be_named_by_its_frame() -> None:
    topic = Ros2Settings(topic="/range", named_by="frame")
    event = ros2_event(topic, Raw(0, "range", JAZZY, len(JAZZY), ""))
    assert isinstance(event, RangeSample)
    assert event.beacon == "uwb_a1"
