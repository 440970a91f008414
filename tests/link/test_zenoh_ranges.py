"""Ranges over real Zenoh on loopback: what arrives, what is refused, and what never harms."""

from __future__ import annotations

import itertools
import json
import math
import socket
import threading
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
import zenoh

from companion import wire_range
from companion.link.zenoh_ranges import RangeLink
from companion.network_settings import RangesSettings
from companion.range_message import RangeMessage
from companion.types import Defect, Event, LineOfSight, Malformed, RangeSample
from companion.wire_range import JSON, MSGPACK, range_key
from tests.uwb.network import router, until

KEY = range_key("lab", "b1", "tag")


class Beacon:
    """A publisher that listens on a free port."""

    def __init__(self) -> None:
        config = {
            "mode": "peer",
            "listen": {"endpoints": ["tcp/127.0.0.1:0"]},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "adminspace": {"enabled": True},
        }
        self.session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        (reply,) = [r.ok for r in self.session.get(f"@/{self.session.zid()}/peer") if r.ok]
        (self.endpoint,) = json.loads(reply.payload.to_string())["locators"]

    def put(self, payload: bytes, encoding: str = JSON, key: str = KEY) -> None:
        self.session.put(key, payload, encoding=encoding)


class Listener:
    """A range link, and the bell that it rings."""

    def __init__(self, endpoint: str) -> None:
        self.rung = threading.Event()
        self.link = RangeLink(RangesSettings(connect=(endpoint,), tag="tag"), self.rung.set)

    def hear(self, at_least: int = 1) -> list[Event]:
        events: list[Event] = []

        def enough() -> bool:
            events.extend(self.link.receive())
            return len(events) >= at_least

        until(enough, "what was put")
        assert self.rung.is_set()
        return events


@pytest.fixture
def pair() -> Iterator[tuple[Beacon, Listener]]:
    beacon = Beacon()
    listener = Listener(beacon.endpoint)
    publisher: Any = beacon.session.declare_publisher(KEY)
    until(lambda: publisher.matching_status.matching, "that the range link listens")
    yield beacon, listener
    listener.link.close()
    beacon.session.close()  # type: ignore[no-untyped-call]


@pytest.mark.parametrize("encoding", [JSON, MSGPACK])
def test_a_range_arrives_whole(pair: tuple[Beacon, Listener], encoding: str) -> None:
    beacon, listener = pair
    sent = RangeMessage("s", 3, 4.25, 0.07, LineOfSight.LOS, -80.5, 10**18, "ok")
    beacon.put(wire_range.encode(sent, encoding), encoding)
    (event,) = listener.hear()
    assert isinstance(event, RangeSample)
    assert msgspec.structs.replace(event, t_ns=0) == RangeSample(
        0, "b1", "s", 3, 4.25, 0.07, LineOfSight.LOS, -80.5, 10**18
    )
    assert listener.link.connected() == 1


def text(**fields: object) -> bytes:
    return json.dumps({"session": "s", "seq": 1, "range_m": 5.0} | fields).encode()


def packed(**fields: object) -> bytes:
    return msgspec.msgpack.encode({"session": "s", "seq": 1, "range_m": 5.0} | fields)


@pytest.mark.parametrize(
    ("payload", "encoding", "defect"),
    [
        (b"", JSON, Defect.RANGE_PAYLOAD),
        (b"\xff\xfe\x00", JSON, Defect.RANGE_PAYLOAD),
        (b"{\"session\": ", JSON, Defect.RANGE_PAYLOAD),
        (text(range_m=math.nan), JSON, Defect.RANGE_PAYLOAD),
        (text(range_m=-1.0), JSON, Defect.RANGE_FIELD),
        (text(range_m="5"), JSON, Defect.RANGE_FIELD),
        (text(range_m=1e99), JSON, Defect.RANGE_FIELD),
        (text(seq=-1), JSON, Defect.RANGE_FIELD),
        (text(seq=2**70), JSON, Defect.RANGE_FIELD),
        (text(session=""), JSON, Defect.RANGE_FIELD),
        (text(los="maybe"), JSON, Defect.RANGE_FIELD),
        (text(sigma_m=0), JSON, Defect.RANGE_FIELD),
        (b"{}", JSON, Defect.RANGE_FIELD),
        (b"3", JSON, Defect.RANGE_FIELD),
        (text(status="RX_TIMEOUT"), JSON, Defect.RANGE_STATUS),
        (text(), "text/plain", Defect.RANGE_ENCODING),
        (text(), "zenoh/bytes", Defect.RANGE_ENCODING),
        (b" " * 5000, JSON, Defect.RANGE_TOO_LONG),
        (text()[:-1] + b', "x": ' + b"[" * 3900 + b"}", JSON, Defect.RANGE_ENCODING),
        (b"\xc1", MSGPACK, Defect.RANGE_PAYLOAD),
        (packed(range_m=math.nan), MSGPACK, Defect.RANGE_FIELD),
        (packed(rssi_dbm=math.inf), MSGPACK, Defect.RANGE_FIELD),
    ],
)  # fmt: skip
def test_what_is_no_range_is_named_and_harms_nothing(
    pair: tuple[Beacon, Listener], payload: bytes, encoding: str, defect: Defect
) -> None:
    beacon, listener = pair
    beacon.put(payload, encoding)
    beacon.put(text(seq=2))
    bad, good = listener.hear(2)
    assert isinstance(bad, Malformed)
    assert bad.defect is defect
    assert isinstance(good, RangeSample)


def test_other_tags_and_sites_are_not_heard(pair: tuple[Beacon, Listener]) -> None:
    beacon, listener = pair
    beacon.put(text(), key=range_key("lab", "b1", "other"))
    beacon.put(text(), key=range_key("elsewhere", "b1", "tag"))
    beacon.put(text(seq=7))
    (event,) = listener.hear()
    assert isinstance(event, RangeSample)
    assert event.seq == 7


def test_after_a_flood_the_next_range_is_heard(pair: tuple[Beacon, Listener]) -> None:
    beacon, listener = pair
    for seq in range(10_000):
        beacon.put(text(seq=seq))
    later = iter(range(20_000, 30_000))

    def heard() -> bool:
        beacon.put(text(seq=next(later)))
        return any(isinstance(e, RangeSample) and e.seq >= 20_000 for e in listener.link.receive())

    until(heard, "a range after the flood")


def test_the_schema_is_the_definition() -> None:
    schema = wire_range.schema()["$defs"]["RangeMessage"]
    assert schema["required"] == ["session", "seq", "range_m"]
    assert set(schema["properties"]) == {
        "session", "seq", "range_m", "sigma_m", "los", "rssi_dbm", "t_ns", "status",
    }  # fmt: skip


@pytest.mark.parametrize("endpoint", ["tcp/203.0.113.1:7447", "foo/127.0.0.1:7447"])
def test_an_endpoint_that_cannot_be_listened_on_stops_the_start(endpoint: str) -> None:
    with pytest.raises(zenoh.ZError):
        RangeLink(RangesSettings(listen=(endpoint,)), lambda: None)


def test_a_bug_where_the_session_is_opened_does_not_go_unnoticed(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(self: RangeLink, session: zenoh.Session) -> None:
        raise TypeError("a bug")

    monkeypatch.setattr(RangeLink, "_listen", broken)
    with router() as network:
        link = RangeLink(RangesSettings(connect=(network.endpoint,)), lambda: None)

        def crashes() -> bool:
            try:
                link.connected()
            except TypeError:
                return True
            return False

        until(crashes, "the bug where the loop asks")
        link.close()


@pytest.mark.parametrize("vehicle_first", [True, False])
def test_a_router_hands_ranges_from_a_beacon_to_the_vehicle(vehicle_first: bool) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    quiet = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    router: Any = None
    listener = Listener(endpoint) if vehicle_first else None
    try:
        opened = {"mode": "router", "listen": {"endpoints": [endpoint]}, "scouting": quiet}
        router = zenoh.open(zenoh.Config.from_json5(json.dumps(opened)))
        listener = listener or Listener(endpoint)
        peer = {"mode": "peer", "connect": {"endpoints": [endpoint]}, "scouting": quiet}
        beacon: Any = zenoh.open(zenoh.Config.from_json5(json.dumps(peer)))
        seq = itertools.count()

        def heard() -> bool:
            beacon.put(KEY, text(seq=next(seq)), encoding=JSON)
            return any(isinstance(event, RangeSample) for event in listener.link.receive())

        until(heard, "a range through the router")
        beacon.close()
    finally:
        if listener is not None:
            listener.link.close()
        if router is not None:
            router.close()
