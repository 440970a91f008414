"""The processes of the network's bench: a router, beacons, a vehicle, each started with `python -m`.

Each is told what it is by one JSON argument, says when it is ready, and then takes orders by lines on
standard input. The links are the app's own; only the loop around them is simpler.
"""

from __future__ import annotations

import os
import select
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import msgspec
import zenoh

from companion import gate
from companion.link.zenoh_publish import PublishLink
from companion.link.zenoh_ranges import RangeLink
from companion.live import Bell
from companion.network_settings import RangesSettings
from companion.range_message import RangeMessage
from companion.types import RangeSample, Verdict

TAG = "bench"
WARM_UP_S = 1.0
"""Ranges flow for so long before they are counted."""
DRAIN_S = 2.0
"""What is still on its way after the end is waited for."""


class RouterEnd(msgspec.Struct, tag="router"):
    """A session in router mode with this configuration."""

    config: str


class BeaconsEnd(msgspec.Struct, tag="beacons"):
    """Beacons, each with a session of its own."""

    settings: dict[str, RangesSettings]
    """Beacon → how it connects."""
    rate_hz: float


class VehicleEnd(msgspec.Struct, tag="vehicle"):
    """A vehicle that flies with these beacons."""

    settings: RangesSettings
    beacons: list[str]
    judges: bool = False
    """Answer with what became of each range, not with what it cost."""


End = RouterEnd | BeaconsEnd | VehicleEnd


class Window(msgspec.Struct):
    """What is counted: from and to, monotonic nanoseconds, which all processes of a machine share."""

    start_ns: int
    end_ns: int


class Usage(msgspec.Struct):
    """What a process took within the window."""

    cpu_s: float
    memory_mb: float


class Sent(msgspec.Struct):
    """What beacons did: how many ranges each put."""

    usage: Usage
    ranges: dict[str, int]


class Received(msgspec.Struct):
    """What reached a vehicle."""

    usage: Usage
    latency_us: list[int]
    """From the publisher's stamp to the loop's hands, for each range that was sent within the window."""
    wire_bytes: int
    """With the headers of TCP, IP and Ethernet."""
    packets: int


class Arrival(NamedTuple):
    """A range that reached a vehicle, and what its gate makes of it."""

    t_ns: int
    age_s: float
    """Its true age."""
    by_stamp: Verdict
    by_number: Verdict
    """The same without its stamp."""


# ------------------------------------------------------------------------------------------ measuring


class _Meter:
    """CPU and memory of this process, from the first look to the second."""

    def __init__(self) -> None:
        self._cpu_s = time.process_time()

    def read(self) -> Usage:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return Usage(time.process_time() - self._cpu_s, pages * os.sysconf("SC_PAGE_SIZE") / 1e6)


class _Wire(NamedTuple):
    """What came over all TCP connections of this process (Linux: struct tcp_info)."""

    bytes_received: int = 0
    packets: int = 0

    @classmethod
    def read(cls) -> _Wire:
        total = cls()
        for path in list(Path("/proc/self/fd").iterdir()):
            with suppress(OSError), socket.socket(fileno=os.dup(int(path.name))) as tcp:
                info = tcp.getsockopt(socket.IPPROTO_TCP, 11, 192)  # TCP_INFO
                received, _, segments = struct.unpack_from("=QII", info, 128)
                total = cls(total.bytes_received + received, total.packets + segments)
        return total


_HEADERS = 14 + 20 + 32
"""Ethernet, IP, TCP with timestamps."""


def _until(t_ns: int) -> None:
    time.sleep(max(0.0, (t_ns - time.monotonic_ns()) * 1e-9))


def _say(answer: object) -> None:
    sys.stdout.buffer.write(msgspec.json.encode(answer) + b"\n")
    sys.stdout.buffer.flush()


def _order() -> Window | None:
    line = sys.stdin.buffer.readline()
    return msgspec.json.decode(line, type=Window) if line else None


# ---------------------------------------------------------------------------------------------- ends


def _router(end: RouterEnd) -> None:
    session = zenoh.open(zenoh.Config.from_json5(end.config))
    _say(time.monotonic_ns())
    while (window := _order()) is not None:
        _until(window.start_ns)
        meter = _Meter()
        _until(window.end_ns)
        _say(meter.read())
    session.close()  # type: ignore[no-untyped-call]


def _beacons(end: BeaconsEnd) -> None:
    links = {beacon: PublishLink(settings) for beacon, settings in end.settings.items()}
    for beacon, link in links.items():
        link.announce(beacon, b'{"height_m": 0.0}')
    _await(lambda: all(link.connected() for link in links.values()))
    _say(time.monotonic_ns())
    window = _order()
    if window is not None:
        usage, counts = _publish(end, links, window)
        _say(Sent(usage, counts))
        _order()
    for link in links.values():
        link.close()


def _publish(end: BeaconsEnd, links: dict[str, PublishLink], window: Window) -> tuple[Usage, dict[str, int]]:
    """One after the other, evenly, so that they do not all speak at once."""
    counts = dict.fromkeys(links, 0)
    meter = None
    last_ns = window.end_ns
    for beacon, seq, due_ns in _turns(list(links), end.rate_hz, window.start_ns - round(WARM_UP_S * 1e9)):
        if due_ns >= last_ns:
            break
        _until(due_ns)
        if meter is None and due_ns >= window.start_ns:
            meter = _Meter()
        counts[beacon] += due_ns >= window.start_ns
        message = RangeMessage("bench", seq, 5.125, 0.07, t_ns=time.time_ns())
        links[beacon].put(beacon, TAG, message)
    assert meter is not None
    return meter.read(), counts


def _turns(beacons: list[str], rate_hz: float, start_ns: int) -> Iterator[tuple[str, int, int]]:
    """Who is to put which range when, without end."""
    seq = 0
    while True:
        for number, beacon in enumerate(beacons):
            yield beacon, seq, start_ns + round((seq + number / len(beacons)) / rate_hz * 1e9)
        seq += 1


def _vehicle(end: VehicleEnd) -> None:
    bell = Bell()
    link = RangeLink(end.settings, bell.ring, end.beacons)
    _await(link.connected)
    _say(time.monotonic_ns())
    window = _order()
    if window is not None:
        _say(_judge(link, bell, window) if end.judges else _receive(link, bell, window))
        _order()
    link.close()
    bell.close()


def _receive(link: RangeLink, bell: Bell, window: Window) -> Received:
    offset_ns = time.time_ns() - time.monotonic_ns()
    first_ns, last_ns = window.start_ns + offset_ns, window.end_ns + offset_ns
    latency_us: list[int] = []
    meter, usage, wire, wired = None, None, _Wire(), _Wire()
    while (now_ns := time.monotonic_ns()) < window.end_ns + round(DRAIN_S * 1e9):
        if meter is None and now_ns >= window.start_ns:
            meter, wire = _Meter(), _Wire.read()
        if meter is not None and usage is None and now_ns >= window.end_ns:
            usage, wired = meter.read(), _Wire.read()
        select.select([bell.fileno()], [], [], 0.01)
        bell.silence()
        for event in link.receive():
            sent_ns = event.sent_t_ns if isinstance(event, RangeSample) else None
            if sent_ns is not None and first_ns <= sent_ns < last_ns:
                latency_us.append((time.time_ns() - sent_ns) // 1000)
    assert usage is not None
    packets = wired.packets - wire.packets
    bytes_ = wired.bytes_received - wire.bytes_received + packets * _HEADERS
    return Received(usage, latency_us, bytes_, packets)


def _judge(link: RangeLink, bell: Bell, window: Window) -> list[Arrival]:
    cfg = RangesSettings()
    offset_ns = time.time_ns() - time.monotonic_ns()
    arrivals: list[Arrival] = []
    stamped: dict[str, gate.Track | None] = {}
    numbered: dict[str, gate.Track | None] = {}

    def verdict(tracks: dict[str, gate.Track | None], sample: RangeSample) -> Verdict:
        before = tracks.get(sample.beacon)
        tracks[sample.beacon], told = gate.judge(cfg, before, sample, sample.range_m, 0.07, 1.0)
        return told

    while time.monotonic_ns() < window.end_ns:
        select.select([bell.fileno()], [], [], 0.01)
        bell.silence()
        for event in link.receive():
            if isinstance(event, RangeSample) and event.sent_t_ns is not None:
                age_s = 1e-9 * (event.t_ns + offset_ns - event.sent_t_ns)
                bare = msgspec.structs.replace(event, sent_t_ns=None)
                arrivals.append(Arrival(event.t_ns, age_s, verdict(stamped, event), verdict(numbered, bare)))
    return arrivals


def _await(condition: Callable[[], object]) -> None:
    while not condition():
        time.sleep(0.02)


if __name__ == "__main__":
    told: End = msgspec.json.decode(sys.argv[1], type=End)
    if isinstance(told, RouterEnd):
        _router(told)
    elif isinstance(told, BeaconsEnd):
        _beacons(told)
    else:
        _vehicle(told)
