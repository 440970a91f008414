"""MCAP as a flight needs it: chunks that are closed often, in little time and memory.

The `mcap` library, which reads these files, would keep an object for every chunk and channel until the end,
6 MiB for every hour of flight; here the index of the chunks waits packed and compressed. The layout and the
records' names are those of the specification, https://mcap.dev/spec
"""

from __future__ import annotations

import struct
import zlib
from typing import Protocol

import zstandard
from mcap.opcode import Opcode

_MAGIC = b"\x89MCAP0\r\n"
_ENVELOPE = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<BQHIQQ")
_MESSAGE_BYTES = _MESSAGE.size - _ENVELOPE.size
_ENTRY = struct.Struct("<QQ")
_LEVEL = 1
"""Of a flight's small chunks it makes no more bytes than zstd's default, in half the time and less memory."""
_CHUNK_BYTES = 1 << 20
"""A chunk that has grown to this is closed."""


class Stream(Protocol):
    """Where the bytes go."""

    def write(self, data: bytes, /) -> object:
        """Append."""

    def flush(self) -> None:
        """Hand on what is buffered."""


class McapWriter:
    """Appends messages in chunks (zstd), and ends with an index that viewers seek by."""

    def __init__(self, stream: Stream, library: str) -> None:
        """Begin at the beginning of a stream; `library` tells who wrote it."""
        self._stream = stream
        self._at = 0
        self._schemas: list[bytes] = []
        self._channels: list[bytes] = []
        self._metadata: list[bytes] = []
        self._chunk = bytearray()
        self._entries: dict[int, bytearray] = {}
        """Of the chunk in progress: channel → times and offsets of its messages."""
        self._first_ns = self._last_ns = 0
        # One for all chunks: with a new one for each the memory of a long flight grows by 1 MiB/h more.
        self._compressor = zstandard.ZstdCompressor(level=_LEVEL)
        self._packer = zlib.compressobj(1)
        self._packed = bytearray()
        """The records of all chunks' index, compressed."""
        self._chunk_count = 0
        self._counts: dict[int, int] = {}
        self._begin_ns = self._end_ns = 0
        self._put(_MAGIC)
        self._put(_record(Opcode.HEADER, _text("") + _text(library)))

    def add_metadata(self, name: str, metadata: dict[str, str]) -> None:
        """Append a metadata record, beside the chunks."""
        pairs = b"".join(_text(key) + _text(value) for key, value in metadata.items())
        record = _record(Opcode.METADATA, _text(name) + _sized(pairs))
        index = struct.pack("<QQ", self._at, len(record)) + _text(name)
        self._metadata.append(_record(Opcode.METADATA_INDEX, index))
        self._put(record)

    def add_channel(self, topic: str, name: str, schema: bytes) -> int:
        """Append a channel of JSON messages with their JSON Schema, named so. Returns the channel's id."""
        number = len(self._channels) + 1
        head = struct.pack("<H", number) + _text(name) + _text("jsonschema")
        self._schemas.append(_record(Opcode.SCHEMA, head + _sized(schema)))
        ids = struct.pack("<HH", number, number)
        self._channels.append(_record(Opcode.CHANNEL, ids + _text(topic) + _text("json") + _sized(b"")))
        self._chunk += self._schemas[-1] + self._channels[-1]
        return number

    def add_message(self, channel: int, log_ns: int, data: bytes, publish_ns: int, sequence: int = 0) -> None:
        """Append a message to the chunk in progress."""
        chunk, entries = self._chunk, self._entries
        if not entries:
            self._first_ns = self._last_ns = log_ns
        elif log_ns < self._first_ns:
            self._first_ns = log_ns
        elif log_ns > self._last_ns:
            self._last_ns = log_ns
        index = entries.get(channel)
        if index is None:
            index = entries[channel] = bytearray()
        index += _ENTRY.pack(log_ns, len(chunk))
        size = _MESSAGE_BYTES + len(data)
        chunk += _MESSAGE.pack(Opcode.MESSAGE, size, channel, sequence, log_ns, publish_ns)
        chunk += data
        if len(chunk) > _CHUNK_BYTES:
            self._close_chunk()

    def flush(self) -> None:
        """Close the chunk in progress, so that everything so far can be read."""
        self._close_chunk()
        self._stream.flush()

    def finish(self) -> None:
        """Write the index and the end. The stream stays open."""
        self._close_chunk()
        self._put(_record(Opcode.DATA_END, struct.pack("<I", 0)))
        self._packed += self._packer.flush()
        groups = {
            Opcode.SCHEMA: b"".join(self._schemas),
            Opcode.CHANNEL: b"".join(self._channels),
            Opcode.STATISTICS: self._statistics(),
            Opcode.CHUNK_INDEX: zlib.decompress(self._packed),
            Opcode.METADATA_INDEX: b"".join(self._metadata),
        }
        start, summary, offsets = self._at, b"", b""
        for opcode, records in groups.items():
            place = struct.pack("<BQQ", opcode, start + len(summary), len(records))
            offsets += _record(Opcode.SUMMARY_OFFSET, place)
            summary += records
        footer = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, start + len(summary))
        summary += offsets + footer
        self._put(summary + struct.pack("<I", zlib.crc32(summary)) + _MAGIC)
        self._stream.flush()

    def _put(self, data: bytes) -> None:
        self._stream.write(data)
        self._at += len(data)

    def _close_chunk(self) -> None:
        """Write the chunk, then the index of its messages; keep what the index of chunks says of it."""
        if not self._entries:
            return
        first_ns, last_ns, entries = self._first_ns, self._last_ns, self._entries
        plain = bytes(self._chunk)
        data = self._compressor.compress(plain)
        times = struct.pack("<QQ", first_ns, last_ns)
        checked = struct.pack("<QI", len(plain), zlib.crc32(plain))
        size = struct.pack("<Q", len(data))
        chunk = _record(Opcode.CHUNK, times + checked + _text("zstd") + size + data)
        place = struct.pack("<QQ", self._at, len(chunk))
        self._put(chunk)
        offsets, indices = b"", b""
        for channel, of in entries.items():
            offsets += struct.pack("<HQ", channel, self._at + len(indices))
            indices += _record(Opcode.MESSAGE_INDEX, struct.pack("<H", channel) + _sized(of))
            self._counts[channel] = self._counts.get(channel, 0) + len(of) // _ENTRY.size
        self._put(indices)
        sizes = struct.pack("<QQ", len(data), len(plain))
        index = times + place + _sized(offsets) + struct.pack("<Q", len(indices)) + _text("zstd") + sizes
        self._packed += self._packer.compress(_record(Opcode.CHUNK_INDEX, index))
        self._begin_ns = min(self._begin_ns, first_ns) if self._chunk_count else first_ns
        self._end_ns = max(self._end_ns, last_ns)
        self._chunk_count += 1
        self._chunk, self._entries = bytearray(), {}

    def _statistics(self) -> bytes:
        numbers = (len(self._schemas), len(self._channels), 0, len(self._metadata), self._chunk_count)
        times = (self._begin_ns, self._end_ns)
        head = struct.pack("<QHIIIIQQ", sum(self._counts.values()), *numbers, *times)
        counts = b"".join(struct.pack("<HQ", channel, n) for channel, n in self._counts.items())
        return _record(Opcode.STATISTICS, head + _sized(counts))


def _record(opcode: Opcode, content: bytes) -> bytes:
    return _ENVELOPE.pack(opcode, len(content)) + content


def _sized(data: bytes | bytearray) -> bytes:
    return struct.pack("<I", len(data)) + data


def _text(text: str) -> bytes:
    return _sized(text.encode())
