"""Cutting messages out of a byte stream that may begin anywhere and lose anything."""

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections import Counter

from companion.uwb.measured import Measured, ParseDefect, Unreadable


class FrameParser(ABC):
    """Messages that begin with known bytes and tell where they end.

    A message that turns out to be none costs its first byte only: the next one may begin inside it.
    """

    def __init__(self, start: re.Pattern[bytes], start_bytes: int, limit_bytes: int) -> None:
        """`start` matches the first bytes of a message, at most `start_bytes` of them."""
        self.defects: Counter[ParseDefect] = Counter()
        self.skipped_bytes = 0
        self._start = start
        self._start_bytes = start_bytes
        self._limit_bytes = limit_bytes
        self._rest = b""

    @property
    def held_bytes(self) -> int:
        """Bytes kept until the rest of their message comes."""
        return len(self._rest)

    @property
    def limit_bytes(self) -> int:
        """The longest message."""
        return self._limit_bytes

    def feed(self, data: bytes) -> list[Measured]:
        """The measurements that these bytes complete, in order."""
        buffer = self._rest + data
        measured: list[Measured] = []
        at = 0
        while True:
            match = self._start.search(buffer, at)
            # Without a beginning, its first bytes may still be the last that have come.
            begin = match.start() if match else max(at, len(buffer) - self._start_bytes + 1)
            self.skipped_bytes += begin - at
            at = begin
            if match is None:
                break
            try:
                end = self._end(buffer, begin)
                if end is None or end - begin > self._limit_bytes:
                    if end is None and len(buffer) - begin < self._limit_bytes:
                        break
                    raise Unreadable(ParseDefect.TOO_LONG)
                measured += self._read(buffer[begin:end])
                at = end
            except Unreadable as error:
                self.defects[error.defect] += 1
                self.skipped_bytes += 1
                at = begin + 1
        self._rest = buffer[at:]
        return measured

    @abstractmethod
    def _end(self, buffer: bytes, begin: int) -> int | None:
        """Where the message that begins here ends; None where more bytes are needed.

        Raises Unreadable where it cannot be one. The answer may depend on the message's bytes only.
        """

    @abstractmethod
    def _read(self, message: bytes) -> list[Measured]:
        """The measurements of a whole message. Raises Unreadable."""


class LineParser(ABC):
    """Messages that are lines, ended by CR, LF or both."""

    def __init__(self, limit_bytes: int = 4096) -> None:
        self.defects: Counter[ParseDefect] = Counter()
        self.skipped_bytes = 0
        self._limit_bytes = limit_bytes
        self._rest = b""
        self._discarding = False

    @property
    def held_bytes(self) -> int:
        """Bytes kept until the rest of their line comes."""
        return len(self._rest)

    @property
    def limit_bytes(self) -> int:
        """The longest line."""
        return self._limit_bytes

    def feed(self, data: bytes) -> list[Measured]:
        """The measurements of the lines that these bytes complete, in order."""
        *lines, rest = _LINE_END.split(self._rest + data)
        measured: list[Measured] = []
        for line in lines:
            if self._discarding:  # the end of a line that was too long
                self._discarding = False
                self.skipped_bytes += len(line)
            elif len(line) > self._limit_bytes:
                self._give_up(line)
            elif line:
                measured += self._line(line)
        if self._discarding:
            self.skipped_bytes += len(rest)
            rest = b""
        elif len(rest) > self._limit_bytes:
            self._give_up(rest)
            self._discarding, rest = True, b""
        self._rest = rest
        return measured

    def _line(self, line: bytes) -> list[Measured]:
        try:
            measured = self._read(line)
        except Unreadable as error:
            self.defects[error.defect] += 1
            self.skipped_bytes += len(line)
            return []
        if measured is None:
            self.skipped_bytes += len(line)
            return []
        return measured

    def _give_up(self, line: bytes) -> None:
        self.defects[ParseDefect.TOO_LONG] += 1
        self.skipped_bytes += len(line)

    @abstractmethod
    def _read(self, line: bytes) -> list[Measured] | None:
        """The measurements of a line; None where it is another kind of line. Raises Unreadable."""


_LINE_END = re.compile(rb"[\r\n]")
