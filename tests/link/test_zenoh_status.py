"""The vehicle's status over real Zenoh on loopback: what a watcher hears, and that the flight never waits."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest
import zenoh

from companion import wire_status
from companion.link.zenoh_ranges import RangeLink
from companion.link.zenoh_status import StatusLink
from companion.link.zenoh_watch import WatchLink
from companion.network_settings import RangesSettings
from companion.settings import Settings, StatusSettings
from companion.types import Phase
from companion.wire_status import StatusMessage, alive_key, status_key
from tests.link.test_fly_process import fly, start
from tests.people.flights import status


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def until(condition: Callable[[], object], bound_s: float = 40.0) -> None:
    end = time.monotonic() + bound_s
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


class Watcher:
    """Somebody else on the network, who listens to every vehicle."""

    def __init__(self, endpoint: str) -> None:
        settings = RangesSettings(connect=(endpoint,))
        self.link = WatchLink(settings, status_key("*"), alive_key("*"), wire_status.MAX_PAYLOAD_BYTES)
        self.messages: list[StatusMessage] = []

    def heard(self) -> list[StatusMessage]:
        self.messages += [wire_status.decode(h.payload) for h in self.link.drain()]
        return self.messages


@pytest.fixture
def ends() -> Iterator[tuple[RangeLink, Watcher]]:
    """The vehicle, listening for ranges, and a watcher that is connected to it."""
    endpoint = free_endpoint()
    vehicle = RangeLink(RangesSettings(listen=(endpoint,)), lambda: None)
    watcher = Watcher(endpoint)
    until(watcher.link.connected)
    yield vehicle, watcher
    watcher.link.close()
    vehicle.close()


def test_a_watcher_hears_the_status_and_its_end(ends: tuple[RangeLink, Watcher]) -> None:
    vehicle, watcher = ends
    cfg = Settings(status=StatusSettings(uav="heron", rate_hz=0.5))
    link = StatusLink(cfg, lambda: vehicle.session, pytest.fail)
    until(lambda: watcher.link.alive() == {alive_key("heron")})
    first = status(1.0)
    while not watcher.heard():  # the first ones may go before the ends have met
        link.send(first)
        time.sleep(0.01)
    (message, *_) = watcher.messages
    assert (message.status, message.target, message.radius_m) == (first, "b1", 0.5)
    for i in range(50):  # the rate holds them back, but not what is new in kind, nor the last
        link.send(status(2.0 + 0.1 * i))
    link.send(status(8.0, phase=Phase.HOLD))
    until(lambda: watcher.heard()[-1].status.phase is Phase.HOLD)
    link.send(last := status(9.0, phase=Phase.HOLD))
    link.close()
    until(lambda: watcher.heard()[-1].status == last)
    assert len(watcher.messages) < 10
    assert [m.seq for m in watcher.messages] == sorted({m.seq for m in watcher.messages})
    until(lambda: not watcher.link.alive())


def test_a_rate_of_zero_publishes_nothing_at_all() -> None:
    link = StatusLink(Settings(status=StatusSettings(rate_hz=0.0)), lambda: pytest.fail("asked"), pytest.fail)
    link.send(status())
    link.close()


class Broken:
    """A session in which nothing works."""

    def liveliness(self) -> None:
        raise zenoh.ZError("session closed")


def test_a_broken_network_is_told_and_stops_nothing() -> None:
    told: list[str] = []
    link = StatusLink(Settings(), Broken, told.append)  # type: ignore[arg-type]
    until(lambda: told)
    for i in range(1000):
        link.send(status(i))
    link.close()
    assert told == ["status is not published any more: session closed"]


class Stalled:
    """A session in which nothing ever comes back."""

    def __init__(self) -> None:
        self.release = threading.Event()

    def liveliness(self) -> None:
        self.release.wait(60.0)
        raise zenoh.ZError("closed")


def test_a_network_that_hangs_holds_up_neither_the_loop_nor_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.link.zenoh_status._CLOSE_LIMIT_S", 0.05)
    session = Stalled()
    link = StatusLink(Settings(), lambda: session, lambda _: None)  # type: ignore[arg-type, return-value]
    for i in range(5000):  # would never return if the network were waited for
        link.send(status(i))
    link.close()
    session.release.set()


def test_without_a_network_the_end_does_not_wait() -> None:
    link = StatusLink(Settings(), lambda: None, pytest.fail)
    link.send(status())
    link.close()
    assert not any(thread.name == "status" for thread in threading.enumerate())


@pytest.mark.parametrize(
    "payload", [b"", b"{}", b"[" * 20_000, b" " * 20_000, b'{"session": "s", "seq": -1}', b"\xff"]
)
def test_what_is_no_status_is_refused_in_words(payload: bytes) -> None:
    with pytest.raises(ValueError, match=r"."):
        wire_status.decode(payload)


def test_a_flight_that_waits_tells_the_network_what_for() -> None:
    endpoint = free_endpoint()
    with start(*fly("--zenoh-listen", endpoint, "--set", "status.uav=heron")) as process:
        watcher = Watcher(endpoint)
        try:
            until(watcher.heard)
            assert "HEARTBEAT" in watcher.messages[0].status.awaited[0]
            assert watcher.link.alive() == {alive_key("heron")}
        finally:
            process.kill()
        until(lambda: not watcher.link.alive())
        watcher.link.close()
