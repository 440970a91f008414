"""The ear of `companion beacons`: Zenoh into what is known of the sensor network."""

from __future__ import annotations

import time
from collections.abc import Mapping

from companion import wire_range
from companion.link.zenoh_watch import WatchLink
from companion.network_settings import BeaconSettings
from companion.settings import Settings
from companion.watch.fleet import Link
from companion.watch.listen import unanswered
from companion.watch.sensors import Sensors

_ASK_S = 5.0
"""Beacons are asked what they tell of themselves this often."""


class SensorListener:
    """Follows the beacons of a site."""

    def __init__(self, settings: Settings, known: Mapping[str, BeaconSettings] | None) -> None:
        """`known`: as in `Sensors`. Raises OSError where an endpoint cannot be used, CredentialsError."""
        self._ranges = ranges = settings.ranges
        self.sensors = Sensors(settings, known)
        self._key = wire_range.range_key(ranges.site, "*", ranges.tag)
        tokens = wire_range.alive_key(ranges.site, "*")
        self._link = WatchLink(ranges, self._key, tokens, wire_range.MAX_PAYLOAD_BYTES)
        self._ask_at = 0.0

    def poll(self) -> None:
        """Take in what has come since, and ask who has not been asked for a while."""
        now = time.monotonic()
        if self._link.is_open and now >= self._ask_at:
            self._ask_at = now + _ASK_S
            self._link.ask(wire_range.info_key(self._ranges.site, "*"))
        for heard in self._link.drain():
            self.sensors.take(heard)
        self.sensors.alive(self._link.alive())
        self.sensors.told(self._link.answers())

    def missing(self) -> str:
        """What is awaited, and from where; '' where any beacon is there."""
        links = {row.link for row in self.sensors.rows(time.monotonic_ns())}
        if Link.LIVE in links:
            return ""
        if not self._link.connected():
            return unanswered("a beacon", self._ranges, self._link.reason)
        if Link.SILENT in links:
            return ""
        return f"connected; awaiting ranges: nothing on {self._key}"

    def close(self) -> None:
        """Leave the network."""
        self._link.close()
