"""Records a flight while it is flown: every event before it is used, every output, on a disk that may fail.

`Recorder.write` only notes what it is given; a thread of its own encodes it and hands it to the disk every
`FLUSH_S`. What the disk cannot take is dropped, outputs first, counted and told; the flight goes on.
"""

from __future__ import annotations

import io
import os
import threading
import time
from collections import deque
from contextlib import closing
from pathlib import Path
from types import TracebackType
from typing import Protocol

from companion.flight_writer import FlightWriter
from companion.record import EVENTS, Start
from companion.types import Event, Output

FLUSH_S = 0.75
"""A killed process, or a power cut, loses at most this and the time that encoding and the disk take."""
BACKLOG = 65_536
"""Events and outputs that wait for the disk at most: about four minutes of a flight, some 20 MB."""

_BATCH = 64
"""Encoded in one go at most, so that the flying loop never waits long for the interpreter."""
_PAUSE_S = 0.001
"""Between two batches: time enough for whoever waits for the interpreter to wake up and take it."""
_BATCHES = 96
"""A turn encodes so many of them at most: whatever comes, the disk gets what there is in time."""
_SILENT_S = 3.0
"""A disk that has not answered for this long is told."""


class Disk(Protocol):
    """Where the bytes go: an unbuffered file. `write` may take fewer than it is given."""

    def write(self, data: bytes, /) -> int | None:
        """Write some of it; return how many bytes."""

    def close(self) -> None:
        """Give it back."""


_Numbered = tuple[int, int, Event | Output]
"""Number in the flight; local monotonic time at which it was told; what was told."""


class _Queue:
    """Events, or outputs, that wait. The flying loop appends and drops; the recorder's thread takes."""

    def __init__(self) -> None:
        self.waiting: deque[_Numbered] = deque()
        self.dropped = 0
        self._oldest: _Numbered | None = None
        """The thread's already, out of reach of `drop`."""

    def drop(self) -> None:
        """Drop the oldest that waits."""
        try:
            self.waiting.popleft()
        except IndexError:  # the thread has just taken the last one: there is room
            return
        self.dropped += 1

    def oldest(self) -> _Numbered | None:
        """The oldest, which stays until it is taken; None where nothing waits."""
        if self._oldest is None and self.waiting:
            try:
                self._oldest = self.waiting.popleft()
            except IndexError:  # the loop has dropped it just now
                return None
        return self._oldest

    def take(self) -> None:
        """The oldest no longer waits."""
        self._oldest = None


class Recorder:
    """Records a flight while it is flown. `write` is for one thread at a time; it never waits."""

    def __init__(self, disk: Disk | None, start: Start, name: str, trouble: str | None = None) -> None:
        """`disk` None: nothing is recorded, for the reason given as `trouble`. See also `open`."""
        self.name = name
        self._start = start
        self._disk = disk
        self._trouble = trouble
        self._count = 0
        self._events, self._outputs = _Queue(), _Queue()
        self._spoilt = self._missing = 0
        self._encoded = self._saved = 0
        self._rest = b""
        self._t_alive = time.monotonic()
        self._stop = threading.Event()
        # Not `_thread`: the compiler makes a C name of it, and that one is taken.
        self._worker = threading.Thread(target=self._work, name="recorder", daemon=True)
        if disk is not None:
            self._worker.start()

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
        queue = self._events if type(item) in EVENTS else self._outputs
        queue.waiting.append((self._count, time.monotonic_ns(), item))
        self._count += 1
        if len(self._events.waiting) + len(self._outputs.waiting) > BACKLOG:
            # Outputs first: they can be computed again from the events.
            (self._outputs if self._outputs.waiting else self._events).drop()

    @property
    def lost(self) -> int:
        """How many events and outputs are known not to be in the file."""
        return self._events.dropped + self._outputs.dropped + self._spoilt + self._missing

    @property
    def problem(self) -> str | None:
        """Why the record is not complete, in one line, or None. Cheap to ask, at any time until the end."""
        parts = []
        silent_s = time.monotonic() - self._t_alive
        if self._trouble is not None:
            parts.append(self._trouble)
        elif self._worker.is_alive() and silent_s > _SILENT_S:
            parts.append(f"the disk has not answered for {silent_s:.0f} s")
        events, outputs = self._events.dropped, self._outputs.dropped
        if events or outputs:
            parts.append(f"{events} events and {outputs} outputs dropped")
        if self._spoilt:
            parts.append(f"{self._spoilt} could not be written as JSON")
        if self._missing:
            parts.append(f"the last {self._missing} events and outputs are missing")
        return f"{self.name}: {'; '.join(parts)}" if parts else None

    def close(self, patience_s: float = 5.0) -> None:
        """Write what is left and the summary; for a disk that does not answer wait `patience_s` at most."""
        self._stop.set()
        if self._disk is not None:
            self._worker.join(patience_s)
        known = self._events.dropped + self._outputs.dropped + self._spoilt
        self._missing = max(0, self._count - self._saved - known)
        if self._worker.is_alive():
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
        pending = io.BytesIO()
        writer = FlightWriter(pending, self._start)
        self._put(disk, pending)
        while not self._stop.wait(FLUSH_S):  # seldom, since a thread that has slept runs on cold caches
            self._t_alive = time.monotonic()
            if not self._rest:  # else the disk refuses: what comes waits in the backlog
                for _ in range(_BATCHES):
                    if not self._encode(writer):
                        break
                    time.sleep(_PAUSE_S)
            writer.flush()
            self._put(disk, pending)
        if self._put(disk, pending):
            while self._encode(writer):
                pass
        writer.finish(self._count)
        self._put(disk, pending)

    def _encode(self, writer: FlightWriter) -> bool:
        """Encode a batch of what waits, in order; False where that was all."""
        until = self._count  # everything with a smaller number has been appended, or dropped
        for _ in range(_BATCH):
            numbered = self._take(until)
            if numbered is None:
                return False
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
        """The oldest that waits, with a number below `until`."""
        queue, oldest = self._events, self._events.oldest()
        output = self._outputs.oldest()
        if oldest is None or (output is not None and output[0] < oldest[0]):
            queue, oldest = self._outputs, output
        if oldest is None or oldest[0] >= until:
            return None
        queue.take()
        return oldest

    def _put(self, disk: Disk, pending: io.BytesIO) -> bool:
        """Hand all that is encoded to the disk; False where it refuses: then it is kept for the next time."""
        self._rest += pending.getvalue()
        pending.seek(0)
        pending.truncate()
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
