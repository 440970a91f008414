"""Floods over real Zenoh, from a process of their own: the loop goes on, others are heard, memory stays."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import NamedTuple

import pytest
import zenoh

from companion.link.mavlink import VehicleLink
from companion.link.zenoh_ranges import RangeLink
from companion.live import Bell, Loop
from companion.network_settings import BeaconSettings, RangesSettings
from companion.settings import MissionSettings, Settings, VehicleSettings
from companion.state import State
from companion.types import Defect, Event, Malformed, Output, RangeSample, Tick, Verdict
from companion.wire_range import JSON, range_key
from tests.sitl_mock.process import free_udp_port
from tests.uwb.network import LIMIT_S, router

FLOOD = """
import sys, time, zenoh
endpoint, key, count, size, rate = *sys.argv[1:3], *map(int, sys.argv[3:])
config = '{mode: "client", connect: {endpoints: ["%s"]}, scouting: {multicast: {enabled: false}}}' % endpoint
session = zenoh.open(zenoh.Config.from_json5(config))
put = session.declare_publisher(key, encoding="application/json").put
began = time.monotonic()
for seq in range(count):
    if rate:
        time.sleep(max(0.0, began + seq / rate - time.monotonic()))
    text = '{"session": "mallory", "seq": %d, "range_m": 3.0}' % seq
    put(text.ljust(size))
session.close()
"""


class Heard(NamedTuple):
    """What came of a flood; `ticks` of the loop meanwhile."""

    events: list[Event]
    flooded_s: float
    ticks: int
    honest_sent: int
    state: State
    grown_mb: float

    def figures(self, count: int, read: int, honest: int) -> str:
        return (
            f"{count / self.flooded_s:.0f}/s for {self.flooded_s:.2f} s, {self.ticks} ticks of the loop, "
            f"{read} read, honest {honest} of {self.honest_sent}, memory {self.grown_mb:+.1f} MB"
        )


def resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * 4096 / 1e6


def under_flood(count: int, size: int, rate_hz: int) -> Heard:
    """The loop of a flight to b2 while somebody floods b1, and for a moment after."""
    settings = Settings(
        mission=MissionSettings(target="b2"), beacons={"b1": BeaconSettings(), "b2": BeaconSettings()}
    )
    events: list[Event] = []
    ticks: list[Event] = []
    final: list[State] = []
    seq = honest = 0

    def record(item: Event | Output) -> None:
        if isinstance(item, Event):
            (ticks if isinstance(item, Tick) else events).append(item)

    bell = Bell()
    vehicle = VehicleLink.open(VehicleSettings(mavlink=f"udpin:127.0.0.1:{free_udp_port()}"))
    with router() as network:
        link = RangeLink(RangesSettings(connect=(network.endpoint,)), bell.ring, ("b1", "b2"))
        loop = Loop(settings, vehicle, link, bell, lambda _: None, record)
        flying = threading.Thread(target=lambda: final.append(loop.fly()))
        flying.start()
        beacon = network.session.declare_publisher(  # as `companion publish` declares it
            range_key("lab", "b2", "tag"), encoding=JSON, priority=zenoh.Priority.REAL_TIME
        )
        arguments = [network.endpoint, range_key("lab", "b1", "tag"), *map(str, (count, size, rate_hz))]
        flood: subprocess.Popen[bytes] | None = None
        began = ended = 0.0
        before_mb = resident_mb()
        deadline = time.monotonic() + LIMIT_S
        try:
            while not ended or time.monotonic() < ended + 0.5:
                assert time.monotonic() < deadline, "the flood does not end"
                time.sleep(0.05)
                seq, honest = seq + 1, honest + 1
                beacon.put(json.dumps({"session": "honest", "seq": seq, "range_m": 10.0}))
                if flood is None and any(isinstance(e, RangeSample) for e in list(events)):
                    honest, began = 0, time.monotonic()  # the vehicle hears: now it begins
                    events.clear()
                    ticks.clear()
                    flood = subprocess.Popen([sys.executable, "-c", FLOOD, *arguments])
                if flood is not None and not ended and flood.poll() is not None:
                    ended = time.monotonic()
        finally:
            bell.ask_stop()
            flying.join(LIMIT_S)
            link.close()
            vehicle.close()
            bell.close()
            if flood is not None:
                flood.kill()
                flood.wait()
    return Heard(events, ended - began, len(ticks), honest, final[0], resident_mb() - before_mb)


def of_b1(heard: Heard) -> list[Event]:
    return [
        e
        for e in heard.events
        if (isinstance(e, RangeSample) and e.beacon == "b1")
        or (isinstance(e, Malformed) and "/b1/" in e.detail)
    ]


@pytest.mark.parametrize(
    ("count", "size", "rate_hz"),
    [(15_000, 60, 10_000), (15_000, 60, 0), (240, 1 << 20, 0)],
    ids=["10,000 a second", "as fast as it goes", "1 MiB each"],
)
def test_a_flood_neither_stalls_the_loop_nor_fills_the_memory(count: int, size: int, rate_hz: int) -> None:
    heard = under_flood(count, size, rate_hz)
    honest = [e for e in heard.events if isinstance(e, RangeSample) and e.beacon == "b2"]
    assert heard.ticks >= 5
    assert len(honest) >= 0.5 * heard.honest_sent
    most = 64 + RangesSettings().max_rate_hz * (heard.flooded_s + 1.0)
    ranges = [e for e in of_b1(heard) if not (isinstance(e, Malformed) and e.defect is Defect.RANGE_FLOOD)]
    assert ranges
    assert len(ranges) <= most
    assert heard.grown_mb < 160.0  # the router of the test is in it; the large ones come to 250 MB
    if size > 4096:
        assert {e.defect for e in ranges if isinstance(e, Malformed)} == {Defect.RANGE_TOO_LONG}
    elif rate_hz:
        told = [e for e in heard.events if isinstance(e, Malformed)]
        assert {e.defect for e in told} == {Defect.RANGE_FLOOD}
    assert heard.state.ranging.accepted > 0
    assert set(heard.state.ranging.rejected) <= {Verdict.UNKNOWN_BEACON, Verdict.STALE}
    print(heard.figures(count, len(ranges), len(honest)))
