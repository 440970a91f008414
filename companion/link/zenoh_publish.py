"""Ranges onto Zenoh, with what a beacon tells of itself; and the ear that checks somebody else's.

Quality of service, and why:

- congestion control DROP: a range is worth nothing when it is late, and a blocking put stops the module's
  reader for seconds on a link that stalls (1.2 s measured). The loss shows as a gap in `seq`.
- priority REAL_TIME: in front of whatever else the session sends. With 100 kB blobs filling a link of
  10 Mbit/s, 591 of 591 ranges arrived, against 139 of 575 with the default priority.
- not express: on an idle link it gains nothing (0.3 to 0.4 ms at the median either way), and on the full one
  497 of 589 arrived, since each express message takes a place of its own in the queue.
- reliability is left as it is: over TCP, TLS and QUIC it is the transport's.

What delays ranges on a full link is the kernel's send buffer, behind all priorities: 3 s as the system sizes
it, 0.07 s with `#so_sndbuf=32768` after the endpoint (as in the figures above).
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from typing import NamedTuple

import zenoh

from companion import wire_range
from companion.link.zenoh_session import Opener, is_client, neighbours, zenoh_config
from companion.network_settings import RangesSettings
from companion.range_message import RangeMessage
from companion.wire_range import alive_key, info_key

_ANSWER_S = 2.0


class PublishLink:
    """The publishing end: a session, and what was declared on it.

    Where it only connects, the session is opened beside it, again and again until a router or a vehicle is
    there, so that a module can be read meanwhile.
    """

    def __init__(self, settings: RangesSettings, encoding: str = wire_range.JSON) -> None:
        """Raises zenoh.ZError where an endpoint is malformed or cannot be listened on."""
        self._site = settings.site
        self._encoding = encoding
        self._infos: dict[str, bytes] = {}
        self._publishers: dict[tuple[str, str], zenoh.Publisher] = {}
        self._declared: list[zenoh.Queryable[None] | zenoh.LivelinessToken] = []
        self._session: zenoh.Session | None = None
        self._opener = Opener(settings, lambda _: None)

    @property
    def reason(self) -> str:
        """Why there is no session yet."""
        return self._opener.reason

    def _ready(self) -> zenoh.Session | None:
        """The session, once it is there; then everything is declared that was announced before."""
        if self._session is None and self._opener.session is not None:
            self._session = self._opener.session
            for beacon, info in self._infos.items():
                self._declare(self._session, beacon, info)
        return self._session

    def announce(self, beacon: str, info: bytes) -> None:
        """Declare that a beacon is there and answer for it; `info` is JSON. Once for each beacon."""
        session = self._ready()
        self._infos[beacon] = info
        if session is not None:
            self._declare(session, beacon, info)

    def _declare(self, session: zenoh.Session, beacon: str, info: bytes) -> None:
        key = info_key(self._site, beacon)

        def answer(query: zenoh.Query) -> None:
            query.reply(key, info, encoding=wire_range.JSON)

        # In a thread of its own (indirect), since a reply is a call into Zenoh.
        queryable = session.declare_queryable(key, zenoh.handlers.Callback(answer), complete=True)
        token = session.liveliness().declare_token(alive_key(self._site, beacon))
        self._declared += [queryable, token]

    def put(self, beacon: str, tag: str, message: RangeMessage) -> None:
        """Publish one range. Never blocks; where nobody is connected it is lost."""
        session = self._ready()
        if session is None:
            return
        publisher = self._publishers.get((beacon, tag))
        if publisher is None:
            publisher = self._publishers[beacon, tag] = session.declare_publisher(
                wire_range.range_key(self._site, beacon, tag),
                encoding=self._encoding,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.REAL_TIME,
                express=False,
            )
        publisher.put(wire_range.encode(message, self._encoding))

    def connected(self) -> int:
        """How many routers and peers there are. None at all is silent in Zenoh, and worth telling."""
        self._ready()
        return self._opener.connected()

    def is_heard(self) -> bool:
        """True where somebody subscribes to what is published.

        Zenoh sends nothing where it is told of no subscriber: with no vehicle there, and with a certificate
        that the router's rules do not name.
        """
        publishers = self._publishers.values()
        return any(p.matching_status.matching for p in publishers)  # type: ignore[attr-defined]  # its stub errs

    def close(self) -> None:
        """Leave the network: the beacons' tokens go with it."""
        self._opener.close()


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
    priority: str


def heard(sample: zenoh.Sample, most_bytes: int) -> Heard:
    """A sample as it came, now; for a callback in Zenoh's thread."""
    payload = sample.payload
    size = len(payload)
    return Heard(
        t_ns=time.monotonic_ns(),
        unix_ns=time.time_ns(),
        key=str(sample.key_expr),
        payload=payload.to_bytes() if size <= most_bytes else b"",
        size=size,
        encoding=str(sample.encoding),
        is_put=sample.kind == zenoh.SampleKind.PUT,
        blocks=sample.congestion_control == zenoh.CongestionControl.BLOCK,
        priority=str(sample.priority).rpartition(".")[2],
    )


class Answer(NamedTuple):
    """A reply to a query for a beacon's info."""

    payload: bytes
    encoding: str


class Ear:
    """Listens to one key expression, and asks."""

    BACKLOG = 20_000
    """Samples kept until `drain`; more are counted in `lost` and not kept."""

    def __init__(self, settings: RangesSettings, key: str) -> None:
        """Open and subscribe. Raises zenoh.ZError: nobody answers, or `key` is no key expression."""
        config = zenoh_config(settings)
        if is_client(settings):
            config.insert_json5("connect/timeout_ms", "3000")
        self._session: zenoh.Session = zenoh.open(config)
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
        self._heard.append(heard(sample, wire_range.MAX_PAYLOAD_BYTES))

    def drain(self) -> list[Heard]:
        """Everything heard since the last call."""
        return [self._heard.popleft() for _ in range(len(self._heard))]

    def connected(self) -> int:
        """How many routers and peers there are."""
        return neighbours(self._session)

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
