"""Ranges onto Zenoh, with what a beacon tells of itself; and the ear that checks somebody else's.

Quality of service, and why:

- congestion control DROP: a range is worth nothing when it is late, and a blocking put stops the module's
  reader for seconds on a link that stalls. The loss shows as a gap in `seq`.
- express: not held back to be batched with others. Ranges are small and each is awaited.
- priority REAL_TIME: in front of whatever else the link carries (pictures, logs).
- reliability is left as it is: between two hosts it is the transport's (TCP, TLS, QUIC) anyway.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import zenoh

from companion import wire_range
from companion.link.zenoh_ranges import zenoh_config
from companion.settings import RangesSettings
from companion.wire_range import RangeMessage

_ANSWER_S = 2.0


def info_key(site: str, beacon: str) -> str:
    """Where a beacon answers queries about itself."""
    return f"{wire_range.KEY_VERSION}/{site}/{beacon}/info"


def alive_key(site: str, beacon: str) -> str:
    """The liveliness token that is there while the beacon's publisher is."""
    return f"{wire_range.KEY_VERSION}/{site}/{beacon}/alive"


class PublishLink:
    """The publishing end: a session, and what was declared on it."""

    def __init__(self, settings: RangesSettings, encoding: str = wire_range.JSON) -> None:
        """Open the session. Raises zenoh.ZError where an endpoint is malformed or cannot be listened on."""
        self._session: zenoh.Session = zenoh.open(zenoh_config(settings))
        self._site = settings.site
        self._encoding = encoding
        self._publishers: dict[tuple[str, str], zenoh.Publisher] = {}
        self._announced: dict[str, tuple[zenoh.Queryable[None], zenoh.LivelinessToken]] = {}

    def announce(self, beacon: str, info: bytes) -> None:
        """Declare that a beacon is there and answer for it; `info` is JSON. Once for each beacon."""
        key = info_key(self._site, beacon)

        def answer(query: zenoh.Query) -> None:
            query.reply(key, info, encoding=wire_range.JSON)

        # In a thread of its own (indirect), since a reply is a call into Zenoh.
        queryable = self._session.declare_queryable(key, zenoh.handlers.Callback(answer), complete=True)
        token = self._session.liveliness().declare_token(alive_key(self._site, beacon))
        self._announced[beacon] = (queryable, token)

    def put(self, beacon: str, tag: str, message: RangeMessage) -> None:
        """Publish one range. Never blocks; where nobody is connected it is lost."""
        publisher = self._publishers.get((beacon, tag))
        if publisher is None:
            publisher = self._publishers[beacon, tag] = self._session.declare_publisher(
                wire_range.range_key(self._site, beacon, tag),
                encoding=self._encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,
                express=True,
            )
        publisher.put(wire_range.encode(message, self._encoding))

    def connected(self) -> int:
        """How many routers and peers there are. None at all is silent in Zenoh, and worth telling."""
        info = self._session.info
        return len(info.routers_zid()) + len(info.peers_zid())

    def close(self) -> None:
        """Leave the network: the beacons' tokens go with it."""
        self._session.close()  # type: ignore[no-untyped-call]


class Heard(NamedTuple):
    """One sample of somebody's, and how it came."""

    t_ns: int
    """Local monotonic clock."""
    unix_ns: int
    key: str
    payload: bytes
    """Empty where it was too long to look at."""
    size: int
    encoding: str
    is_put: bool
    blocks: bool
    """Congestion control BLOCK."""
    express: bool
    priority: str


class Answer(NamedTuple):
    """A reply to a query for a beacon's info."""

    payload: bytes
    encoding: str


class Ear:
    """Listens to one key expression, and asks."""

    BACKLOG = 20_000
    """Samples kept until `drain`; more are counted in `lost` and not kept."""

    def __init__(self, settings: RangesSettings, key: str) -> None:
        """Open and subscribe. Raises zenoh.ZError: an endpoint, or `key` is no key expression."""
        self._session: zenoh.Session = zenoh.open(zenoh_config(settings))
        self._heard: deque[Heard] = deque()
        self.lost = 0
        try:
            self._listen(key, self._note)
        except zenoh.ZError:
            self._session.close()  # type: ignore[no-untyped-call]
            raise

    def _listen(self, key: str, note: Callable[[zenoh.Sample], None]) -> zenoh.Subscriber[None]:
        return self._session.declare_subscriber(key, zenoh.handlers.Callback(note, indirect=False))

    def _note(self, sample: zenoh.Sample) -> None:
        """In Zenoh's thread: no parsing, no waiting."""
        if len(self._heard) >= self.BACKLOG:
            self.lost += 1
            return
        payload = sample.payload
        size = len(payload)
        self._heard.append(
            Heard(
                t_ns=time.monotonic_ns(),
                unix_ns=time.time_ns(),
                key=str(sample.key_expr),
                payload=payload.to_bytes() if size <= wire_range.MAX_PAYLOAD_BYTES else b"",
                size=size,
                encoding=str(sample.encoding),
                is_put=sample.kind == zenoh.SampleKind.PUT,
                blocks=sample.congestion_control == zenoh.CongestionControl.BLOCK,
                express=sample.express,
                priority=str(sample.priority).rpartition(".")[2],
            )
        )

    def drain(self) -> list[Heard]:
        """Everything heard since the last call."""
        return [self._heard.popleft() for _ in range(len(self._heard))]

    def connected(self) -> int:
        """How many routers and peers there are."""
        info = self._session.info
        return len(info.routers_zid()) + len(info.peers_zid())

    def ask(self, key: str) -> Answer | None:
        """The first answer to a query; None where nobody answers."""
        for reply in self._session.get(key, timeout=_ANSWER_S):
            if reply.ok is not None:
                return Answer(reply.ok.payload.to_bytes(), str(reply.ok.encoding))
        return None

    def is_alive(self, key: str) -> bool:
        """True where somebody holds this liveliness token."""
        return any(r.ok is not None for r in self._session.liveliness().get(key, timeout=_ANSWER_S))

    def other_keys(self, seconds: float, limit: int = 10) -> list[str]:
        """The keys that anything at all is published on within this time: asks the network for everything."""
        keys: set[str] = set()

        def note(sample: zenoh.Sample) -> None:
            if len(keys) < limit:
                keys.add(str(sample.key_expr))

        subscriber = self._listen("**", note)
        time.sleep(seconds)
        subscriber.undeclare()  # type: ignore[no-untyped-call]
        return sorted(keys)

    def close(self) -> None:
        """Leave the network."""
        self._session.close()  # type: ignore[no-untyped-call]
