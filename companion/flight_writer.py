"""A flight laid out as MCAP: every event and output as it is, and what is derived for viewers beside it."""

from __future__ import annotations

import io

import msgspec

from companion.foxglove import TOPICS, viewer_schema
from companion.foxglove_views import Views, log
from companion.mcap_writer import McapWriter
from companion.record import END, METADATA, RECORDED, Start
from companion.types import Event, Output, Severity


class FlightWriter:
    """Lays a flight out as MCAP on a binary stream, at once and in the caller's thread: for simulations.

    Every event and output carries its number in the flight as MCAP's sequence: a reader sees what is missing.
    """

    def __init__(self, stream: io.BytesIO | io.BufferedWriter, start: Start) -> None:
        self._start = start
        self.number = 0
        """The next event's or output's, where none is missing."""
        self._views = Views()
        self._encoder = msgspec.json.Encoder()
        self._mcap = McapWriter(stream, f"companion {start.versions.get('companion', '')}")
        self._mcap.add_metadata(METADATA, start.as_metadata())
        names = {kind: f"companion.{kind.__name__}" for kind in RECORDED.values()}
        self._channels = {kind: self._channel(topic, kind, names[kind]) for topic, kind in RECORDED.items()}
        self._view_channels = {
            topic: self._channel(topic, kind, name) for topic, (kind, name) in TOPICS.items()
        }
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
        publish_ns = unix_ns if noted_ns is None else self._start.unix_of(noted_ns)
        self._mcap.add_message(self._channels[type(item)], unix_ns, data, publish_ns, number)
        for topic, view in self._views.of(item, unix_ns):
            self._view(topic, view, unix_ns)

    def say_lost(self, t_ns: int, count: int) -> None:
        """Tell, at this place in the file, that something is missing."""
        self._say(t_ns, Severity.CRITICAL, f"{count} records lost: the disk did not take them")

    def _say(self, t_ns: int, severity: Severity, message: str) -> None:
        unix_ns = self._start.unix_of(t_ns)
        self._view("/log", log(unix_ns, severity, message), unix_ns)

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
