"""The ear of `companion watch`: Zenoh into a fleet, and what to say while there is nothing to see."""

from __future__ import annotations

import time
from typing import NamedTuple

from companion import wire_status
from companion.link.zenoh_watch import WatchLink
from companion.network_settings import RangesSettings
from companion.types import PhaseChange
from companion.watch.fleet import Fleet, Link, Vehicle
from companion.wire_status import StatusMessage, alive_key, status_key


class News(NamedTuple):
    """A message that came just now, and the change of phase that it shows, if it does."""

    vehicle: Vehicle
    message: StatusMessage
    change: PhaseChange | None


def unanswered(who: str, settings: RangesSettings, reason: str) -> str:
    """That nobody answers; `reason` is Zenoh's, told where it says more than that."""
    endpoints = ", ".join(settings.connect + settings.listen) or "whoever multicast finds"
    why = f": {reason}" if reason and not reason.startswith("Unable to connect") else ""
    return f"awaiting a router or {who} on {endpoints}: nobody answers there{why}"


class Listener:
    """Follows the vehicles of a network. Single-threaded but for Zenoh's own threads."""

    def __init__(self, settings: RangesSettings, uav: str) -> None:
        """`uav`: one vehicle's id, or `*`. Raises OSError where an endpoint cannot be used."""
        self.fleet = Fleet()
        self._uav = uav
        self._settings = settings
        self._link = WatchLink(settings, status_key(uav), alive_key(uav), wire_status.MAX_PAYLOAD_BYTES)

    def poll(self) -> list[News]:
        """Take in what has come since."""
        self.fleet.alive(self._link.alive())
        news = []
        for heard in self._link.drain():
            change = self.fleet.take(heard)
            vehicle = self.fleet.get(wire_status.uav_of(heard.key))
            if vehicle is not None and vehicle.message is not None and vehicle.t_ns == heard.t_ns:
                news.append(News(vehicle, vehicle.message, change))
        return news

    def missing(self) -> str:
        """What is awaited, and from where; '' where some vehicle is heard or at least there."""
        links = {v.link(time.monotonic_ns()) for v in self.fleet.vehicles()}
        if Link.LIVE in links:
            return ""
        if not self._link.connected():
            return unanswered("a vehicle", self._settings, self._link.reason)
        if Link.SILENT in links:
            return ""
        if links:
            return f"every vehicle is gone; awaiting one on {status_key(self._uav)}"
        return f"connected; awaiting a vehicle: nothing on {status_key(self._uav)} yet"

    def close(self) -> None:
        """Leave the network."""
        self._link.close()
