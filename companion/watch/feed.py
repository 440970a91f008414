"""What the page is fed with: the past of every vehicle once, then what is new, as JSON."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import NamedTuple

import msgspec

from companion.watch.fleet import Fleet, Vehicle
from companion.watch.listen import News
from companion.wire_status import StatusMessage

HISTORY = 3000
"""Rows kept of each vehicle: ten minutes at 5 Hz."""


class Row(NamedTuple):
    """One moment of a vehicle, as an array; null where not known. Bearing positive to the right."""

    t_s: float
    """Since the first message of its session."""
    phase: str
    x_m: float | None
    y_m: float | None
    height_m: float | None
    heading_rad: float | None
    range_m: float | None
    distance_m: float | None
    distance_sigma_m: float | None
    bearing_deg: float | None
    bearing_sigma_deg: float | None
    speed_m_s: float | None
    yaw_rate_deg_s: float | None


class Now(msgspec.Struct, frozen=True):
    """How a vehicle stands at this moment."""

    uav: str
    link: str
    age_s: float | None
    lost: int
    problems: list[str]
    message: StatusMessage | None


class Story(msgspec.Struct, frozen=True):
    """Rows of one vehicle; `afresh`: earlier ones do not belong to them (it was started anew)."""

    uav: str
    afresh: bool
    rows: tuple[Row, ...]


class Feed(msgspec.Struct, frozen=True):
    """One message to the page."""

    missing: str
    turned_away: int
    now: tuple[Now, ...]
    stories: tuple[Story, ...]


class Histories:
    """The past of every vehicle, bounded."""

    def __init__(self) -> None:
        self._rows: dict[str, deque[Row]] = {}
        self._session: dict[str, str] = {}

    def add(self, news: Iterable[News]) -> tuple[Story, ...]:
        """Keep what came; the result is what is new, by vehicle."""
        fresh: dict[str, list[Row]] = {}
        anew: set[str] = set()
        for item in news:
            uav, message = item.vehicle.uav, item.message
            if self._session.get(uav) != message.session:
                self._session[uav] = message.session
                self._rows[uav] = deque(maxlen=HISTORY)
                fresh[uav] = []
                anew.add(uav)
            row = row_of(item.vehicle, message)
            self._rows[uav].append(row)
            fresh.setdefault(uav, []).append(row)
        return tuple(Story(uav, uav in anew, tuple(rows)) for uav, rows in fresh.items())

    def all(self) -> tuple[Story, ...]:
        """Everything that is kept."""
        return tuple(Story(uav, True, tuple(rows)) for uav, rows in self._rows.items())


def row_of(vehicle: Vehicle, message: StatusMessage) -> Row:
    """A status as a row; a range older than a second is none, nor are those of several beacons in turn."""
    s, e = message.status, message.status.estimate
    fresh = s.range_age_s is not None and s.range_age_s < 1.0 and not s.beacons
    return Row(
        t_s=round((s.t_ns - vehicle.t0_ns) * 1e-9, 3),
        phase=s.phase.value,
        x_m=_short(s.x_m),
        y_m=_short(s.y_m),
        height_m=_short(s.height_m),
        heading_rad=_short(s.heading_rad),
        range_m=_short(s.range_m) if fresh else None,
        distance_m=_short(e.distance_m) if e else None,
        distance_sigma_m=_short(e.distance_sigma_m) if e else None,
        bearing_deg=_short(math.degrees(e.bearing_rad)) if e else None,
        bearing_sigma_deg=_short(math.degrees(e.bearing_sigma_rad)) if e else None,
        speed_m_s=_short(s.speed_m_s),
        yaw_rate_deg_s=None if s.yaw_rate_rad_s is None else _short(math.degrees(s.yaw_rate_rad_s)),
    )


def _short(value: float | None) -> float | None:
    return None if value is None else round(value, 4)


def feed(fleet: Fleet, missing: str, stories: tuple[Story, ...], now_ns: int) -> bytes:
    """A message to the page, as JSON."""
    now = tuple(
        Now(v.uav, v.link(now_ns).value, v.age_s(now_ns), v.lost, v.problems(now_ns), v.message)
        for v in fleet.vehicles()
    )
    return msgspec.json.encode(Feed(missing, fleet.turned_away, now, stories))
