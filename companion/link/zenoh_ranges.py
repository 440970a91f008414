"""Ranges over Zenoh, as events. The callback only notes what came and when; everything else is the loop's."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import NamedTuple

import msgspec
import zenoh

from companion import wire_range
from companion.link.zenoh_session import Opener
from companion.settings import RangesSettings
from companion.types import Defect, Event, Malformed, RangeSample

_BACKLOG = 256
"""Samples that wait for the loop at most; the oldest give way. At 50 Hz and 5 beacons that is a second."""


class _Raw(NamedTuple):
    t_ns: int
    key: str
    payload: bytes
    """Empty where it was too long to look at."""
    size: int
    encoding: str


class RangeLink:
    """A subscription to the ranges of a site. `wake` is called from Zenoh's thread when something came."""

    def __init__(self, settings: RangesSettings, wake: Callable[[], None]) -> None:
        """Open the session. Raises zenoh.ZError where an endpoint is malformed or cannot be listened on."""
        self._raw: deque[_Raw] = deque(maxlen=_BACKLOG)
        self._flood = 0
        self._wake = wake
        self._key = wire_range.range_key(settings.site, "*", settings.tag)
        self._opener = Opener(settings, self._listen)

    def _listen(self, session: zenoh.Session) -> None:
        # Not indirect: a thread and its unbounded queue less between the wire and the loop.
        session.declare_subscriber(self._key, zenoh.handlers.Callback(self._note, indirect=False))

    def _note(self, sample: zenoh.Sample) -> None:
        """In Zenoh's thread: no parsing, no logging, no waiting."""
        t_ns = time.monotonic_ns()
        if len(self._raw) == _BACKLOG:
            self._flood += 1  # the append below pushes the oldest out
        payload = sample.payload
        size = len(payload)
        data = payload.to_bytes() if size <= wire_range.MAX_PAYLOAD_BYTES else b""
        self._raw.append(_Raw(t_ns, str(sample.key_expr), data, size, str(sample.encoding)))
        self._wake()

    def receive(self, clock: Callable[[], int] = time.monotonic_ns) -> Iterator[Event]:
        """Everything that has come since, as events, in order."""
        for _ in range(len(self._raw)):
            yield to_event(self._raw.popleft())
        if self._flood:
            lost, self._flood = self._flood, 0
            yield Malformed(t_ns=clock(), defect=Defect.RANGE_FLOOD, detail=f"{lost} dropped")

    @property
    def session(self) -> zenoh.Session | None:
        """The session, once it is open: what else leaves on Zenoh leaves by it."""
        return self._opener.session

    def connected(self) -> int:
        """How many routers and peers there are. None at all is silent in Zenoh, and worth telling."""
        return self._opener.connected()

    def close(self) -> None:
        """Leave the network."""
        self._opener.close()


def to_event(raw: _Raw) -> Event:
    """One sample as a range, or as the reason why it is none. Never raises."""
    t_ns = raw.t_ns
    if raw.size > wire_range.MAX_PAYLOAD_BYTES:
        return Malformed(t_ns=t_ns, defect=Defect.RANGE_TOO_LONG, detail=f"{raw.key}: {raw.size} bytes"[:200])
    try:
        m = wire_range.decode(raw.payload, raw.encoding)
    except msgspec.ValidationError as error:
        return Malformed(t_ns=t_ns, defect=Defect.RANGE_FIELD, detail=f"{raw.key}: {error}"[:200])
    except msgspec.DecodeError as error:
        return Malformed(t_ns=t_ns, defect=Defect.RANGE_PAYLOAD, detail=f"{raw.key}: {error}"[:200])
    except ValueError as error:
        return Malformed(t_ns=t_ns, defect=Defect.RANGE_ENCODING, detail=f"{raw.key}: {error}"[:200])
    if m.status is not None and m.status.lower() not in _GOOD:
        return Malformed(t_ns=t_ns, defect=Defect.RANGE_STATUS, detail=f"{raw.key}: {m.status}"[:200])
    return RangeSample(
        t_ns=t_ns,
        beacon=wire_range.beacon_of(raw.key),
        session=m.session,
        seq=m.seq,
        range_m=m.range_m,
        sigma_m=m.sigma_m,
        los=m.los,
        rssi_dbm=m.rssi_dbm,
        sent_t_ns=m.t_ns,
    )


_GOOD = frozenset({"ok", "success"})
