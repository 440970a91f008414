"""Ranges over Zenoh, as events. The callbacks note what came and when, and wake whoever takes it.

Each beacon (or wildcard, or ROS 2 topic) has a door of its own: a short backlog of which the newest are kept,
and a rate beyond which they are dropped before anybody reads them. Of a single beacon Zenoh itself lets five
times that rate through and no more: a callback into Python costs tens of microseconds, and a flood would hold
up everybody behind it (measured: 15,000 ranges of one in 0.4 s made another's 0.7 s late, and 0.6 ms so).
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from functools import partial
from typing import Final

import zenoh

from companion import wire_range
from companion.link.range_events import (
    MAX_ATTACHMENT_BYTES,
    RangeReader,
    Raw,
    info_event,
    ros2_event,
)
from companion.link.zenoh_session import Opener
from companion.network_settings import RangesSettings
from companion.types import Defect, Event, Malformed
from companion.uwb import ros2

_ZENOH_JSON: Final = zenoh.Encoding.APPLICATION_JSON
_BACKLOG = 64
"""Samples that wait at a door at most; the oldest give way. At 50 Hz that is more than a second."""
_FLOOD = 5.0
"""Zenoh lets so many times the largest rate through, so that a flood shows and is told."""
_MANY = 16
"""A door with a wildcard lets so many times more in."""
_ANSWERS = 64
"""Answers of beacons that wait, and beacons that are asked when they appear, at most."""
_ASK_AGAIN_S = 1.0
_ANSWER_S = 2.0
_ASK_PACE_S = 5.0
_MOST_ASKS = 60
"""A beacon whose ranges come and that has not told of itself is asked again, at this pace and so many times:
a question or its answer may be lost, and without its height it counts as being on the ground."""
_TELL_NS = 100_000_000
"""A flood is told so often at most, so that telling it is no flood itself."""


class Door:
    """Where the samples of one subscription come in."""

    def __init__(
        self,
        key: str,
        max_rate_hz: float,
        is_for_many: bool,
        to_event: Callable[[Raw], Event],
        reads_attachments: bool = False,
    ) -> None:
        """`reads_attachments`: `to_event` does."""
        self.key = key
        self.reads_attachments = reads_attachments
        self.is_for_many = is_for_many
        self._to_event = to_event
        self._most = _BACKLOG * (_MANY if is_for_many else 1)
        self._raw: deque[Raw] = deque(maxlen=self._most)
        self._max_rate_hz = max_rate_hz * (_MANY if is_for_many else 1)
        self._allowance = float(self._most)
        self.is_used = False
        """Something has come since this was last set to False."""
        self._t_ns: int | None = None
        self._pushed_out = 0
        """Counted by Zenoh's thread alone."""
        self._dropped = 0
        self._told = 0
        self._told_t_ns = 0

    def note(self, raw: Raw) -> None:
        """In Zenoh's thread."""
        if len(self._raw) == self._most:
            self._pushed_out += 1  # the append below pushes the oldest out
        self._raw.append(raw)
        self.is_used = True

    def is_quiet(self) -> bool:
        """Nothing waits, and nothing is to be told."""
        return not self._raw and self._dropped + self._pushed_out == self._told

    def receive(self, now_ns: int, into: list[Event]) -> None:
        """Append what has come since, as far as the rate allows: of more, the newest."""
        count = len(self._raw)
        if self._t_ns is not None:
            more = (now_ns - self._t_ns) * 1e-9 * self._max_rate_hz
            self._allowance = min(self._allowance + more, float(self._most))
        self._t_ns = now_ns
        take = min(count, int(self._allowance))
        self._allowance -= take
        for _ in range(count - take):
            self._raw.popleft()
        self._dropped += count - take
        for _ in range(take):
            into.append(self._to_event(self._raw.popleft()))

    def flood(self, now_ns: int) -> Malformed | None:
        """What was dropped, told now and then."""
        lost = self._dropped + self._pushed_out - self._told
        if not lost or now_ns - self._told_t_ns < _TELL_NS:
            return None
        self._told, self._told_t_ns = self._told + lost, now_ns
        return Malformed(t_ns=now_ns, defect=Defect.RANGE_FLOOD, detail=f"{lost} of {self.key} dropped"[:200])


class RangeLink:
    """Subscriptions to the ranges of some beacons, or of a whole site, and to ROS 2 topics.

    `wake` is called from Zenoh's threads when something came, and may receive it there and then; `receive` is
    for one thread at a time. One subscription for each beacon that is flown with: a router then sends no
    other, however many there are at the site.
    """

    def __init__(
        self, settings: RangesSettings, wake: Callable[[], None], beacons: Iterable[str] = ("*",)
    ) -> None:
        """Open the session.

        Raises zenoh.ZError where an endpoint is malformed or cannot be listened on, or an id cannot be part
        of a key; CredentialsError where `ranges.tls` lets nobody in.
        """
        self._settings = settings
        self.wake = wake
        self._doors: list[Door] = []
        self._told: deque[Raw] = deque(maxlen=_ANSWERS)
        self._asked: dict[str, float] = {}
        self._answered: set[str] = set()
        self._closing = threading.Event()
        self._beacons = tuple(beacons)
        for beacon in self._beacons:
            key = wire_range.range_key(settings.site, beacon, settings.tag)
            self._doors.append(Door(key, settings.max_rate_hz, "*" in beacon, RangeReader().event))
        for topic in settings.ros2:
            key = ros2.subscription(ros2.Bridge(topic.bridge), topic.topic, topic.domain)
            to_event = partial(ros2_event, topic)
            self._doors.append(Door(key, settings.max_rate_hz, "*" in topic.topic, to_event, True))
        for door in self._doors:
            zenoh.KeyExpr(door.key)  # raises here, not in the thread that opens the session
        # Not with a wildcard: a module tells several beacons at once, and Zenoh would let through the first.
        caps_hz = {d.key: _FLOOD * settings.max_rate_hz for d in self._doors if not d.is_for_many}
        self._opener = Opener(settings, self._listen, caps_hz)

    def _listen(self, session: zenoh.Session) -> None:
        # Not indirect: a thread and its unbounded queue less between the wire and the loop.
        for door in self._doors:
            note = partial(self._note, door)
            session.declare_subscriber(door.key, zenoh.handlers.Callback(note, indirect=False))
        for beacon in self._beacons if self._settings.ask_beacons else ():
            alive = wire_range.alive_key(self._settings.site, beacon)
            # Indirect, in a thread of its own, since a question is a call into Zenoh.
            ask = zenoh.handlers.Callback(partial(self._ask, session), indirect=True)
            session.liveliness().declare_subscriber(alive, ask, history=True)
            self._query(session, wire_range.info_key(self._settings.site, beacon))
        if self._settings.ask_beacons:
            threading.Thread(target=self._insist, args=(session,), name="zenoh-asker", daemon=True).start()

    def _insist(self, session: zenoh.Session) -> None:
        """Ask again, in a thread of its own, since a question is a call into Zenoh."""
        doors = {
            beacon: door
            for beacon, door in zip(self._beacons, self._doors, strict=False)
            if "*" not in beacon
        }
        for _ in range(_MOST_ASKS):
            doors = {beacon: door for beacon, door in doors.items() if beacon not in self._answered}
            if not doors or self._closing.wait(_ASK_PACE_S):
                return
            for beacon, door in doors.items():
                if door.is_used:
                    door.is_used = False
                    try:
                        self._query(session, wire_range.info_key(self._settings.site, beacon))
                    except zenoh.ZError:  # the session was closed
                        return

    def _note(self, door: Door, sample: zenoh.Sample) -> None:
        """In Zenoh's thread: no logging, no waiting."""
        door.note(_raw(sample, door.reads_attachments))
        self.wake()

    def _ask(self, session: zenoh.Session, token: zenoh.Sample) -> None:
        """A beacon has appeared. One that comes and goes all the time is asked now and then."""
        beacon, now = str(token.key_expr).split("/")[-2], time.monotonic()
        if token.kind != zenoh.SampleKind.PUT or now - self._asked.get(beacon, -_ASK_AGAIN_S) < _ASK_AGAIN_S:
            return
        if beacon in self._asked or len(self._asked) < _ANSWERS:
            self._asked[beacon] = now
            self._query(session, wire_range.info_key(self._settings.site, beacon))

    def _query(self, session: zenoh.Session, key: str) -> None:
        session.get(key, zenoh.handlers.Callback(self._note_answer, indirect=False), timeout=_ANSWER_S)

    def _note_answer(self, reply: zenoh.Reply) -> None:
        """In Zenoh's thread."""
        if reply.ok is not None:
            raw = _raw(reply.ok, False)
            self._answered |= {raw.key.split("/")[-2]} & set(self._beacons)
            self._told.append(raw)
            self.wake()

    def receive(self, clock: Callable[[], int] = time.monotonic_ns) -> list[Event]:
        """Everything that has come since, as events, in order."""
        told: list[Event] = [info_event(self._told.popleft()) for _ in range(len(self._told))]
        now_ns = clock()
        came: list[Event] = []
        floods: list[Event] = []
        for door in self._doors:
            if not door.is_quiet():
                door.receive(now_ns, came)
                flood = door.flood(now_ns)
                if flood is not None:
                    floods.append(flood)
        if len(came) > 1:
            came.sort(key=_t_ns)
        return told + came + floods if told or floods else came

    @property
    def session(self) -> zenoh.Session | None:
        """The session, once it is open: what else leaves on Zenoh leaves by it."""
        return self._opener.session

    @property
    def reason(self) -> str:
        """Why there is no session yet."""
        return self._opener.reason

    def connected(self) -> int:
        """How many routers and peers there are. None at all is silent in Zenoh, and worth telling."""
        return self._opener.connected()

    def close(self) -> None:
        """Leave the network."""
        self._closing.set()
        self._opener.close()


def _t_ns(event: Event) -> int:
    return event.t_ns


def _raw(sample: zenoh.Sample, with_attachment: bool) -> Raw:
    """As it came, now; what is too long to be a range is not copied."""
    t_ns = time.monotonic_ns()
    payload, encoding = sample.payload, sample.encoding
    size = len(payload)
    data = payload.to_bytes() if size <= wire_range.MAX_PAYLOAD_BYTES else b""
    told = None
    if with_attachment and (attachment := sample.attachment) is not None:
        told = attachment.to_bytes() if len(attachment) <= MAX_ATTACHMENT_BYTES else b""
    # The usual one is known at a look; to make its text would take five times as long.
    said = wire_range.JSON if encoding == _ZENOH_JSON else str(encoding)
    return Raw(t_ns, str(sample.key_expr), data, size, said, told)
