"""A router on a free loopback port, and a publisher that runs beside the test."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import msgspec
import zenoh

from companion.exits import Exit
from companion.publish import Publication, publish

LIMIT_S = 40.0
"""A loaded machine takes its time; what takes longer has failed."""


class _Admin(msgspec.Struct):
    locators: list[str]


class Router:
    """A Zenoh session in router mode. `endpoint` is where it listens."""

    def __init__(self, endpoint: str = "tcp/127.0.0.1:0") -> None:
        config = {
            "mode": "router",
            "listen": {"endpoints": [endpoint]},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}},
        }
        self.session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        (reply,) = self.session.get(f"@/{self.session.zid()}/router")
        assert reply.ok is not None
        self.endpoint = msgspec.json.decode(reply.ok.payload.to_bytes(), type=_Admin).locators[0]


@contextmanager
def router(endpoint: str = "tcp/127.0.0.1:0") -> Iterator[Router]:
    r = Router(endpoint)
    try:
        yield r
    finally:
        r.session.close()  # type: ignore[no-untyped-call]


def until(condition: Callable[[], bool], what: str) -> None:
    """Wait for it, not for ever."""
    deadline = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < deadline, f"not within {LIMIT_S} s: {what}"
        time.sleep(0.01)


class Running(NamedTuple):
    """A publisher in a thread; `ended` holds its exit once it has ended."""

    said: list[str]
    ended: list[Exit]
    stop: threading.Event


@contextmanager
def publishing(publication: Publication) -> Iterator[Running]:
    running = Running([], [], threading.Event())

    def run() -> None:
        running.ended.append(publish(publication, running.said.append, running.stop))

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield running
    finally:
        running.stop.set()
        thread.join(LIMIT_S)
        assert not thread.is_alive()
