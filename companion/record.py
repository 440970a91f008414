"""The flight as one MCAP file: every event before it is used, every output, configuration and versions.

`Recorder.write` only notes what it is given; a thread of its own encodes it and hands it to the disk every
`FLUSH_S`. What the disk cannot take is dropped, outputs first, counted and told; the flight goes on.
"""

from __future__ import annotations

import hashlib
import io
import os
import platform
import threading
import time
import zlib
from collections import deque
from contextlib import closing, suppress
from importlib import metadata
from pathlib import Path
from types import TracebackType
from typing import Protocol, get_args

import msgspec

from companion.compiled import form
from companion.foxglove import TOPICS, Views, viewer_schema
from companion.mcap_writer import McapWriter
from companion.types import AnyEvent, AnyOutput, Event, Output, Severity

METADATA = "companion.flight"
"""Name of the MCAP metadata record that makes a file a flight of ours."""
END = "companion.end"
"""Name of the metadata record of a flight that was closed: how many events and outputs there were."""
FORMAT = 1
"""Counts up when an older reader could not read the file."""
FLUSH_S = 0.75
"""A killed process, or a power cut, loses at most this, `_POLL_S` and the time that the disk takes."""
BACKLOG = 65_536
"""Events and outputs that wait for the disk at most: about four minutes of a flight, some 20 MB."""

_POLL_S = 0.15
_BATCH = 64
"""Encoded in one go at most, so that the flying loop never waits long for the interpreter."""
_BATCHES = 16
"""A turn encodes so many of them at most: whatever comes, the disk gets what there is in time."""
_SILENT_S = 3.0
"""A disk that has not answered for this long is told."""
_LIBRARIES = ("eclipse-zenoh", "mcap", "msgspec", "pymavlink")


def topic_of(kind: type[Event] | type[Output]) -> str:
    """`/event/range`, `/output/setpoint`: the topic on which a type is recorded."""
    config = kind.__struct_config__
    return f"/{config.tag_field}/{config.tag}"


RECORDED: dict[str, type[Event] | type[Output]] = {
    topic_of(kind): kind for kind in (*get_args(AnyEvent), *get_args(AnyOutput))
}
"""Topic → type of everything that is recorded as it is."""
_EVENTS = frozenset(get_args(AnyEvent))


class Start(msgspec.Struct, frozen=True):
    """What a record begins with: when, by what, with which configuration.

    The pair `unix_ns`, `monotonic_ns` is one moment on both clocks: it maps the events' `t_ns` to Unix time.
    `config` is the effective configuration as JSON; `sources` tells where a dotted key's value came from.
    """

    unix_ns: int
    monotonic_ns: int
    config: str
    digest: str
    sources: dict[str, str]
    versions: dict[str, str]
    kind: str = "flight"

    def unix_of(self, t_ns: int) -> int:
        """The local monotonic time as Unix time, ns."""
        return max(0, t_ns - self.monotonic_ns + self.unix_ns)

    def as_metadata(self) -> dict[str, str]:
        """As MCAP keeps it: text only, and unlike the rest of the file without a checksum of its own."""
        fields = {
            "format": str(FORMAT),
            "kind": self.kind,
            "unix_ns": str(self.unix_ns),
            "monotonic_ns": str(self.monotonic_ns),
            "versions": msgspec.json.encode(self.versions).decode(),
            "config_digest": self.digest,
            "config": self.config,
            "config_sources": msgspec.json.encode(self.sources).decode(),
        }
        return {**fields, "checksum": _checksum(fields)}

    @classmethod
    def from_metadata(cls, m: dict[str, str]) -> Start:
        """The reverse of `as_metadata`. Raises KeyError, ValueError."""
        if m["checksum"] != _checksum({key: value for key, value in m.items() if key != "checksum"}):
            raise ValueError("checksum of the configuration")
        return cls(
            unix_ns=int(m["unix_ns"]),
            monotonic_ns=int(m["monotonic_ns"]),
            config=m["config"],
            digest=m["config_digest"],
            sources=msgspec.json.decode(m["config_sources"], type=dict[str, str]),
            versions=msgspec.json.decode(m["versions"], type=dict[str, str]),
            kind=m["kind"],
        )


def _checksum(fields: dict[str, str]) -> str:
    return f"{zlib.crc32(msgspec.json.encode(fields, order='sorted')):08x}"


def start_now(config: msgspec.Struct, digest: str, sources: dict[str, str], kind: str = "flight") -> Start:
    """A record that begins now, with this effective configuration."""
    return Start(
        unix_ns=time.time_ns(),
        monotonic_ns=time.monotonic_ns(),
        config=msgspec.json.encode(config).decode(),
        digest=digest,
        sources=sources,
        versions=versions(),
        kind=kind,
    )


def versions() -> dict[str, str]:
    """What runs here: the app with a digest of its source, Python, the machine, the libraries."""
    return {
        "companion": metadata.version("companion"),
        "source": _source_digest(Path(__file__).parent),
        "core": form(),
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}, {' '.join(platform.libc_ver())}",
        **{name: metadata.version(name) for name in _LIBRARIES},
    }


def _source_digest(package: Path) -> str:
    """Tells two states of the code apart that carry the same version."""
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


# ---------------------------------------------------------------------------------------------- layout


class FlightWriter:
    """Lays a flight out as MCAP on a binary stream, at once and in the caller's thread: for simulations.

    Every event and output carries its number in the flight as MCAP's sequence: a reader sees what is missing.
    """

    def __init__(self, stream: io.BytesIO | io.BufferedWriter, start: Start) -> None:
        self._start = start
        self.number = 0
        """The next event's or output's, where none is missing."""
        self._views = Views(start.unix_of)
        self._encoder = msgspec.json.Encoder()
        self._mcap = McapWriter(stream, f"companion {start.versions.get('companion', '')}")
        self._mcap.add_metadata(METADATA, start.as_metadata())
        names = {kind: f"companion.{kind.__name__}" for kind in RECORDED.values()}
        self._channels = {kind: self._channel(topic, kind, names[kind]) for topic, kind in RECORDED.items()}
        self._view_channels = {topic: self._channel(topic, *of) for topic, of in TOPICS.items()}
        self._say(start.monotonic_ns, Severity.INFO, f"{start.kind} recorded, configuration {start.digest}")
        self.flush()  # the channels stand in a chunk of their own, at the beginning

    def _channel(self, topic: str, kind: type, name: str) -> int:
        return self._mcap.add_channel(topic, name, msgspec.json.encode(viewer_schema(kind, name)))

    def write(self, item: Event | Output) -> None:
        """Append the next event or output."""
        self.add(self.number, item)

    def add(self, number: int, item: Event | Output, noted_ns: int | None = None) -> None:
        """Append an event or output with its number and the moment at which the loop told it: MCAP's
        `publish_time`, as `log_time` is that of the event (None: the same, no clock runs in a simulation).

        Raises ValueError (a lone surrogate) or OverflowError (beyond 64 bits) where JSON cannot hold it.
        """
        self.number = number + 1
        data = self._encoder.encode(item)
        unix_ns = self._start.unix_of(item.t_ns)
        noted_ns = item.t_ns if noted_ns is None else noted_ns
        self._mcap.add_message(
            self._channels[type(item)], unix_ns, data, self._start.unix_of(noted_ns), number
        )
        for topic, view in self._views.of(item):
            self._view(topic, view, unix_ns)

    def say_lost(self, t_ns: int, count: int) -> None:
        """Tell, at this place in the file, that something is missing."""
        self._say(t_ns, Severity.CRITICAL, f"{count} records lost: the disk did not take them")

    def _say(self, t_ns: int, severity: Severity, message: str) -> None:
        self._view("/log", self._views.log(t_ns, severity, message), self._start.unix_of(t_ns))

    def _view(self, topic: str, view: msgspec.Struct, unix_ns: int) -> None:
        self._mcap.add_message(self._view_channels[topic], unix_ns, self._encoder.encode(view), unix_ns)

    def flush(self) -> None:
        """Close the chunk in progress, so that everything so far can be read."""
        self._mcap.flush()

    def finish(self, count: int | None = None) -> None:
        """End the flight, which had `count` events and outputs, and write the summary for viewers."""
        self.flush()
        self._mcap.add_metadata(END, {"records": str(self.number if count is None else count)})
        self._mcap.finish()


class _Pending(io.BytesIO):
    """Bytes for the disk."""

    def take(self) -> bytes:
        """What has come since the last time."""
        data = self.getvalue()
        self.seek(0)
        self.truncate()
        return data


# -------------------------------------------------------------------------------------------- recorder


class Disk(Protocol):
    """Where the bytes go: an unbuffered file. `write` may take fewer than it is given."""

    def write(self, data: bytes, /) -> int | None:
        """Write some of it; return how many bytes."""

    def close(self) -> None:
        """Give it back."""


_Numbered = tuple[int, int, Event | Output]
"""Number in the flight; local monotonic time at which it was told; what was told."""


class Recorder:
    """Records a flight while it is flown. `write` is for one thread at a time; it never waits."""

    def __init__(self, disk: Disk | None, start: Start, name: str, trouble: str | None = None) -> None:
        """`disk` None: nothing is recorded, for the reason given as `trouble`. See also `open`."""
        self.name = name
        self._start = start
        self._disk = disk
        self._trouble = trouble
        self._count = 0
        self._events: deque[_Numbered] = deque()
        self._outputs: deque[_Numbered] = deque()
        self._dropped_events = self._dropped_outputs = self._spoilt = self._missing = 0
        self._next_event: _Numbered | None = None
        self._next_output: _Numbered | None = None
        self._encoded = self._saved = 0
        self._rest = b""
        self._t_alive = time.monotonic()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="recorder", daemon=True)
        if disk is not None:
            self._thread.start()

    @classmethod
    def open(cls, path: Path, start: Start) -> Recorder:
        """Record into a new file. Never raises: where that cannot be, `problem` says why."""
        try:
            if not path.parent.exists():
                path.parent.mkdir(parents=True)
            return cls(path.open("xb", buffering=0), start, str(path))
        except OSError as error:
            return cls(None, start, str(path), _reason(error))

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def write(self, item: Event | Output) -> None:
        """Note an event or output: less than a microsecond, whatever the disk does."""
        queue = self._events if type(item) in _EVENTS else self._outputs
        queue.append((self._count, time.monotonic_ns(), item))
        self._count += 1
        if len(self._events) + len(self._outputs) > BACKLOG:
            self._drop_oldest()

    def _drop_oldest(self) -> None:
        """Outputs first: they can be computed again from the events."""
        with suppress(IndexError):  # the thread has just taken the last one: there is room
            if self._outputs:
                self._outputs.popleft()
                self._dropped_outputs += 1
            else:
                self._events.popleft()
                self._dropped_events += 1

    @property
    def lost(self) -> int:
        """How many events and outputs are known not to be in the file."""
        return self._dropped_events + self._dropped_outputs + self._spoilt + self._missing

    @property
    def problem(self) -> str | None:
        """Why the record is not complete, in one line, or None. Cheap to ask, at any time until the end."""
        parts = []
        silent_s = time.monotonic() - self._t_alive
        if self._trouble is not None:
            parts.append(self._trouble)
        elif self._thread.is_alive() and silent_s > _SILENT_S:
            parts.append(f"the disk has not answered for {silent_s:.0f} s")
        if self._dropped_events or self._dropped_outputs:
            parts.append(f"{self._dropped_events} events and {self._dropped_outputs} outputs dropped")
        if self._spoilt:
            parts.append(f"{self._spoilt} could not be written as JSON")
        if self._missing:
            parts.append(f"the last {self._missing} events and outputs are missing")
        return f"{self.name}: {'; '.join(parts)}" if parts else None

    def close(self, patience_s: float = 5.0) -> None:
        """Write what is left and the summary; for a disk that does not answer wait `patience_s` at most."""
        self._stop.set()
        if self._disk is not None:
            self._thread.join(patience_s)
        dropped = self._dropped_events + self._dropped_outputs + self._spoilt
        self._missing = max(0, self._count - self._saved - dropped)
        if self._thread.is_alive():
            self._trouble = "the disk does not answer"

    # ------------------------------------------------------------------------------------- the thread

    def _work(self) -> None:
        assert self._disk is not None
        try:
            with closing(self._disk):
                self._record(self._disk)
        except Exception as error:  # whatever it is, it must not end the flight: it is told instead
            self._trouble = f"the recorder failed: {error!r}"

    def _record(self, disk: Disk) -> None:
        pending = _Pending()
        writer = FlightWriter(pending, self._start)
        self._put(disk, pending)
        t_flush = time.monotonic() + FLUSH_S
        while not self._stop.wait(_POLL_S):
            self._t_alive = time.monotonic()
            if not self._rest:  # else the disk refuses: what comes waits in the backlog
                for _ in range(_BATCHES):
                    if not self._encode(writer):
                        break
                    time.sleep(0.0)  # between batches whoever waits for the interpreter gets it
            if self._t_alive >= t_flush:
                t_flush = self._t_alive + FLUSH_S
                writer.flush()
                self._put(disk, pending)
        writer.flush()
        if self._put(disk, pending):
            while self._encode(writer):
                pass
        writer.finish(self._count)
        self._put(disk, pending)

    def _encode(self, writer: FlightWriter) -> bool:
        """Encode a batch of what waits, in order; False if nothing waited."""
        until = self._count  # everything with a smaller number has been appended, or dropped
        for done in range(_BATCH):
            numbered = self._take(until)
            if numbered is None:
                return done > 0
            number, noted_ns, item = numbered
            if number > writer.number:
                writer.say_lost(item.t_ns, number - writer.number)
            try:
                writer.add(number, item, noted_ns)
                self._encoded += 1
            except (ValueError, OverflowError):
                self._spoilt += 1
        return True

    def _take(self, until: int) -> _Numbered | None:
        """The oldest that waits. The oldest of either kind is kept here, out of reach of `_drop_oldest`."""
        with suppress(IndexError):  # none waits
            self._next_event = self._next_event or self._events.popleft()
        with suppress(IndexError):
            self._next_output = self._next_output or self._outputs.popleft()
        event, output = self._next_event, self._next_output
        if event is not None and event[0] < until and (output is None or event[0] < output[0]):
            self._next_event = None
            return event
        if output is not None and output[0] < until:
            self._next_output = None
            return output
        return None

    def _put(self, disk: Disk, pending: _Pending) -> bool:
        """Hand all that is encoded to the disk; False where it refuses: then it is kept for the next time."""
        self._rest += pending.take()
        encoded = self._encoded
        try:
            while self._rest:
                self._rest = self._rest[disk.write(self._rest) or 0 :]
            if isinstance(disk, io.FileIO):
                os.fdatasync(disk.fileno())
        except OSError as error:
            self._trouble = _reason(error)
            return False
        self._trouble = None
        self._saved = encoded
        return True


def _reason(error: OSError) -> str:
    return error.strerror or str(error)
