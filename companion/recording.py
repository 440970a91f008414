"""A recorded flight read back from its file, as far as the file is sound."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import msgspec
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Metadata
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC

from companion.record import END, FORMAT, METADATA, RECORDED, Start
from companion.settings import Settings
from companion.types import Event, Output

_ENVELOPE = struct.Struct("<BQ")
_CHUNK_LIMIT = 1 << 28
"""A chunk that claims to be larger is damaged: ours are a thousand times smaller."""
_DAMAGED = (McapError, ValueError, struct.error, zstandard.ZstdError, MemoryError, OverflowError)
"""What reading damaged bytes as MCAP raises."""


class RecordError(Exception):
    """Nothing can be made of the file; the text is one line that says why."""


class Step(NamedTuple):
    """One event and the outputs that followed from it.

    `number` counts events and outputs together; `slots[i]` is the place of `outputs[i]` after the event, with
    gaps where outputs were lost. `lost`: how many records are missing between this event and the next.
    `delays_s[i]`: how long after the event the loop told `outputs[i]`, just before it was sent; 0 where no
    clock was read (simulations, records of earlier versions).
    """

    number: int
    event: Event
    outputs: tuple[Output, ...]
    slots: tuple[int, ...]
    lost: int
    delays_s: tuple[float, ...]


class Recording(NamedTuple):
    """A flight as it was recorded. `problems`: what is wrong with the file, one line each."""

    name: str
    start: Start
    steps: tuple[Step, ...]
    finished: bool
    lost: int
    lost_at_first: int
    problems: tuple[str, ...]

    @property
    def settings(self) -> Settings:
        """The settings that were flown. Raises RecordError where this version does not know them."""
        try:
            raw = msgspec.json.decode(self.start.config, type=dict[str, object])
            raw.pop("sim", None)  # the simulated world is none of the pilot's business
            return msgspec.convert(raw, Settings)
        except msgspec.DecodeError as error:
            raise RecordError(
                f"{self.name}: its configuration cannot be used here: {error} "
                f"(recorded by companion {self.start.versions.get('companion', '?')})"
            ) from error

    @property
    def duration_s(self) -> float:
        """From the first event to the last."""
        return self.t_s(self.steps[-1].event.t_ns) if self.steps else 0.0

    def t_s(self, t_ns: int) -> float:
        """Seconds since the first event."""
        return (t_ns - self.steps[0].event.t_ns) * 1e-9


def read(path: Path) -> Recording:
    """Read a flight. Raises RecordError in one line where it is none; damage is told in `problems`."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordError(f"{path}: {error.strerror or error}") from error
    if not data:
        raise RecordError(f"{path}: the file is empty")
    if not data.startswith(MCAP0_MAGIC):
        raise RecordError(f"{path}: not an MCAP file")
    reader = _Reader(str(path))
    for at, opcode, content in reader.envelopes(data):
        reader.take(at, opcode, content)
    if reader.start is None:
        if reader.problems:
            raise RecordError(f"{path}: no flight can be read: {reader.problems[0]}")
        topics = ", ".join(sorted(reader.topics)[:4]) or "none"
        raise RecordError(f"{path}: an MCAP file, but not a flight of this app; topics: {topics}")
    flight = reader.recording(reader.start)
    if flight.problems and not flight.steps:
        raise RecordError(f"{path}: nothing of the flight can be read: {'; '.join(flight.problems[:2])}")
    return flight


class _Reader:
    """Collects what is sound."""

    def __init__(self, name: str) -> None:
        self._name = name
        self.start: Start | None = None
        self.topics: set[str] = set()
        self.problems: list[str] = []
        self._finished = False
        self._count: int | None = None
        self._decoders: dict[int, tuple[str, msgspec.json.Decoder[Event | Output]]] = {}
        self._messages: list[Message] = []

    def envelopes(self, data: bytes) -> Iterator[tuple[int, int, bytes]]:
        """Offset, opcode and content of every whole record."""
        at = len(MCAP0_MAGIC)
        while at < len(data) and not self._finished:
            end = at + _ENVELOPE.size
            opcode, length = _ENVELOPE.unpack_from(data, at) if end <= len(data) else (0, 0)
            if end + length > len(data):
                break
            yield at, opcode, data[end : end + length]
            at = end + length
            self._finished = opcode == Opcode.FOOTER
        if not self._finished:
            self.problems.append(f"the end is missing: it stops at byte {at} of {len(data)}")

    def take(self, at: int, opcode: int, content: bytes) -> None:
        """Use one record of the file."""
        stream = ReadDataStream(BytesIO(content))
        try:
            if opcode == Opcode.METADATA:
                self._metadata(Metadata.read(stream))
            elif opcode == Opcode.CHUNK:
                self._chunk(Chunk.read(stream))
            elif opcode == Opcode.CHANNEL:  # the summary's, in case that the first chunk is damaged
                self._channel(Channel.read(stream))
        except KeyError as error:
            self.problems.append(f"damaged at byte {at}: {error} is missing")
        except _DAMAGED as error:
            self.problems.append(f"damaged at byte {at}: {error or type(error).__name__}")

    def _metadata(self, m: Metadata) -> None:
        if m.name == METADATA:
            written = int(m.metadata["format"])
            if written > FORMAT:
                raise RecordError(f"{self._name}: a flight in format {written}; this version reads {FORMAT}")
            self.start = Start.from_metadata(m.metadata)
        elif m.name == END:
            self._count = int(m.metadata["records"])

    def _chunk(self, chunk: Chunk) -> None:
        if chunk.uncompressed_size > _CHUNK_LIMIT:
            raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
        for record in breakup_chunk(chunk, validate_crc=True):
            if isinstance(record, Channel):
                self._channel(record)
            elif isinstance(record, Message):
                self._messages.append(record)

    def _channel(self, channel: Channel) -> None:
        self.topics.add(channel.topic)
        kind = RECORDED.get(channel.topic)
        if kind is not None:
            self._decoders[channel.id] = channel.topic, msgspec.json.Decoder(kind)

    def recording(self, start: Start) -> Recording:
        """What was read, with each output at its event."""
        items: list[_Item] = []
        unreadable: Counter[str] = Counter()
        for message in self._messages:
            topic, decoder = self._decoders.get(message.channel_id, ("", None))
            if decoder is None:
                continue  # derived for viewers
            try:
                delay_ns = message.publish_time - message.log_time
                items.append(_Item(message.sequence, decoder.decode(message.data), delay_ns * 1e-9))
            except msgspec.DecodeError as error:
                unreadable[f"{topic}: {error}"] += 1
        problems = [*self.problems, *(f"{n} × unreadable {what}" for what, n in unreadable.items())]
        events = [i for i, item in enumerate(items) if isinstance(item.item, Event)]
        steps = [_step(items[a:b], items[b].number) for a, b in pairwise(events)]
        if events:
            steps.append(_step(items[events[-1] :], self._count))
        lost = max(self._count or 0, items[-1].number + 1 if items else 0) - len(items)
        if lost:
            problems.append(f"{lost} records are missing")
        return Recording(
            name=self._name,
            start=start,
            steps=tuple(steps),
            finished=self._finished,
            lost=lost,
            lost_at_first=steps[0].number if steps else 0,
            problems=tuple(problems),
        )


class _Item(NamedTuple):
    """A recorded event or output, its number, and how long after its time it was told."""

    number: int
    item: Event | Output
    delay_s: float


def _step(items: list[_Item], next_number: int | None) -> Step:
    """An event with its outputs; `next_number` is the next event's."""
    number, event, _ = items[0]
    assert isinstance(event, Event)
    outputs = [(of.number - number - 1, of.item, of.delay_s) for of in items if isinstance(of.item, Output)]
    return Step(
        number=number,
        event=event,
        outputs=tuple(output for _, output, _ in outputs),
        slots=tuple(slot for slot, _, _ in outputs),
        lost=0 if next_number is None else next_number - number - len(items),
        delays_s=tuple(delay_s for _, _, delay_s in outputs),
    )
