"""What is known of the vehicles on the network: the newest status of each, and whether it is there."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from enum import Enum

from companion import wire_status
from companion.link.zenoh_publish import Heard
from companion.network_settings import is_name
from companion.types import PhaseChange, Severity
from companion.wire_status import StatusMessage

MOST_VEHICLES = 64
"""More are not followed: ids without end must not fill the memory."""
SILENT_S = 2.0
"""A vehicle that is there and has not been heard for this long is silent."""


class Link(Enum):
    """Whether a vehicle is heard."""

    LIVE = "live"
    SILENT = "silent"
    """Its app is there, and says nothing: it hangs, or the network loses what it says."""
    GONE = "gone"
    """Its app has ended, or is out of reach."""


@dataclass(slots=True)
class Vehicle:
    """One vehicle, by the id in its key."""

    uav: str
    message: StatusMessage | None = None
    """The newest one; None where only its token was seen, or nothing of it could be read."""
    t_ns: int | None = None
    """When that came, by the local clock."""
    t0_ns: int = 0
    """The vehicle's own clock at the first message of this session."""
    is_alive: bool = False
    """Its liveliness token is held."""
    lost: int = 0
    """Messages of this session that never came."""
    unreadable: int = 0
    problem: str = ""
    """Why the last unreadable message could not be read."""
    rival_t_ns: int | None = None
    """When another app was heard under this id last, while the one that is shown was there."""

    def age_s(self, now_ns: int) -> float | None:
        """Seconds since it was heard last."""
        return None if self.t_ns is None else (now_ns - self.t_ns) * 1e-9

    def problems(self, now_ns: int) -> list[str]:
        """What is wrong with what it says, in words."""
        told = [f"{self.unreadable} unreadable: {self.problem}"] if self.problem else []
        if self.rival_t_ns is not None and now_ns - self.rival_t_ns < SILENT_S * 1e9:
            told.append("another app publishes under this id, too: give each vehicle a status.uav of its own")
        return told

    def link(self, now_ns: int) -> Link:
        """Whether it is heard."""
        age_s = self.age_s(now_ns)
        if self.is_alive or (age_s is not None and age_s < SILENT_S):
            return Link.LIVE if age_s is not None and age_s < SILENT_S else Link.SILENT
        return Link.GONE


class Fleet:
    """Every vehicle heard of, fed with what came."""

    def __init__(self) -> None:
        self._vehicles: dict[str, Vehicle] = {}
        self.turned_away = 0
        """Messages and tokens of vehicles beyond `MOST_VEHICLES`, or of ids that are none."""

    def vehicles(self) -> list[Vehicle]:
        """In the order of their ids."""
        return [self._vehicles[uav] for uav in sorted(self._vehicles)]

    def get(self, uav: str) -> Vehicle | None:
        """The vehicle with this id, if it was heard of."""
        return self._vehicles.get(uav)

    def alive(self, keys: Iterable[str]) -> None:
        """The liveliness tokens that are held now."""
        there = {uav for key in keys if (uav := wire_status.uav_of(key))}
        for uav in there:
            self._vehicle(uav)
        for vehicle in self._vehicles.values():
            vehicle.is_alive = vehicle.uav in there

    def take(self, heard: Heard) -> PhaseChange | None:
        """Take in one sample; the result is the change of phase that it shows, if it does."""
        vehicle = self._vehicle(wire_status.uav_of(heard.key))
        if vehicle is None or not heard.is_put:
            return None
        try:
            if heard.size > wire_status.MAX_PAYLOAD_BYTES:
                raise ValueError(f"{heard.size} bytes")
            message = wire_status.decode(heard.payload)
        except ValueError as error:
            vehicle.unreadable += 1
            vehicle.problem = "".join(c if c.isprintable() else "?" for c in str(error)[:200])
            return None
        before = vehicle.message
        if before is not None and before.session != message.session:
            age_s = vehicle.age_s(heard.t_ns)
            if age_s is not None and age_s < SILENT_S:  # one after the other would be a restart
                vehicle.rival_t_ns = heard.t_ns
                return None
        vehicle.message, vehicle.t_ns = message, heard.t_ns
        if before is None or before.session != message.session:
            vehicle.t0_ns, vehicle.lost = message.status.t_ns, 0
            return None
        vehicle.lost += max(message.seq - before.seq - 1, 0)
        if message.status.phase is before.status.phase:
            return None
        s = message.status
        return PhaseChange(s.t_ns, before.status.phase, s.phase, s.reason, Severity.INFO)

    def _vehicle(self, uav: str) -> Vehicle | None:
        if (vehicle := self._vehicles.get(uav)) is not None:
            return vehicle
        if not is_name(uav) or len(self._vehicles) >= MOST_VEHICLES:
            self.turned_away += 1
            return None
        vehicle = self._vehicles[uav] = Vehicle(uav)
        return vehicle
