"""What is known of the sensor network: every beacon's ranges to every tag, as a vehicle judges them."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import msgspec

from companion import beacons, gate
from companion.beacons import Beacon
from companion.link.range_events import Raw, range_event
from companion.link.zenoh_publish import Answer, Heard
from companion.network_settings import BeaconSettings, is_name
from companion.settings import Settings
from companion.types import LineOfSight, Malformed, RangeSample, Verdict
from companion.uwb import info
from companion.uwb.info import BeaconInfo
from companion.watch.fleet import SILENT_S, Link

MOST_PAIRS = 256
"""Beacons times tags that are followed: ids without end must not fill the memory."""
WINDOW_S = 3.0
"""Rates and sessions are those of the last so many seconds."""
_KEPT = 1024


class BeaconRow(msgspec.Struct, frozen=True):
    """One beacon and tag at this moment. `tag` is '' for a beacon of which no range was heard."""

    beacon: str
    tag: str
    link: Link
    alive: bool
    """Its liveliness token is held."""
    rate_hz: float
    age_s: float | None
    range_m: float | None
    sigma_m: float | None
    """As the range tells it."""
    los: LineOfSight | None
    rssi_dbm: float | None
    sessions: tuple[str, ...]
    """Of the last seconds; more than one that do not end are so many publishers."""
    believed: int
    refused: dict[str, int]
    """By the reason that a vehicle would have for it, the observer's outliers not among them."""
    malformed: dict[str, int]
    lost: int
    """Sequence numbers that never came."""
    info: BeaconInfo | None
    notes: tuple[str, ...]


@dataclass(slots=True)
class _Pair:
    beacon: str
    tag: str
    known: Beacon
    last: RangeSample | None = None
    track: gate.Track | None = None
    times: deque[tuple[int, str]] = field(default_factory=lambda: deque(maxlen=_KEPT))
    """When each of the last ranges came, and of which session."""
    believed: int = 0
    refused: Counter[str] = field(default_factory=Counter)
    malformed: Counter[str] = field(default_factory=Counter)
    detail: str = ""
    lost: int = 0
    seq: dict[str, int] = field(default_factory=dict)


class Sensors:
    """Every beacon heard of at a site, fed with what came."""

    def __init__(self, settings: Settings, known: Mapping[str, BeaconSettings] | None) -> None:
        """`known`: the beacons that the vehicle is configured for; None: not to be held against any."""
        self._settings = settings
        self._known = known
        self._pairs: dict[tuple[str, str], _Pair] = {}
        self._alive: set[str] = set()
        self._info: dict[str, BeaconInfo | str] = {}
        self.turned_away = 0
        """Samples of pairs beyond `MOST_PAIRS`, or of ids that are none."""

    def alive(self, keys: Iterable[str]) -> None:
        """The liveliness tokens that are held now."""
        names = (key.split("/")[-2] for key in keys if key.count("/") >= 2)
        self._alive = {name for name in names if is_name(name)}

    def told(self, answers: Mapping[str, Answer]) -> None:
        """What beacons tell of themselves, by key."""
        for key, answer in answers.items():
            name = key.split("/")[-2] if key.count("/") >= 2 else ""
            if is_name(name):
                try:
                    self._info[name] = info.decode(answer.payload)
                except ValueError as error:
                    self._info[name] = _printable(f"info is unreadable: {error}")

    def take(self, heard: Heard) -> None:
        """Take in one sample."""
        parts = heard.key.split("/")
        pair = self._pair(parts[3], parts[4]) if len(parts) == 6 else None
        if pair is None or not heard.is_put:
            return
        event = range_event(Raw(heard.t_ns, heard.key, heard.payload, heard.size, heard.encoding))
        if isinstance(event, Malformed):
            pair.malformed[event.defect.value] += 1
            pair.detail = _printable(event.detail.partition(": ")[2])
        elif isinstance(event, RangeSample):
            self._judge(pair, event)

    def _judge(self, pair: _Pair, sample: RangeSample) -> None:
        before = pair.seq.get(sample.session)
        if before is not None:
            pair.lost += max(sample.seq - before - 1, 0)
        elif len(pair.seq) >= _KEPT:
            pair.seq.clear()
        pair.seq[sample.session] = max(sample.seq, before or 0)
        pair.last = sample
        pair.times.append((sample.t_ns, sample.session))
        ranges = self._settings.ranges
        pair.track, verdict = gate.judge(
            ranges,
            pair.track,
            sample,
            beacons.range_m(pair.known, sample),
            beacons.sigma_m(ranges, sample, pair.known.sigma_m),
            self._settings.vehicle.speed_max_m_s,
        )
        if verdict is Verdict.ACCEPTED:
            pair.believed += 1
        else:
            pair.refused[verdict.value] += 1

    def _pair(self, beacon: str, tag: str) -> _Pair | None:
        if (pair := self._pairs.get((beacon, tag))) is not None:
            return pair
        is_named = is_name(beacon) and is_name(tag)
        if not is_named or len(self._pairs) >= MOST_PAIRS:
            self.turned_away += 1
            return None
        b = (self._known or {}).get(beacon)
        known = beacons.configured(0, BeaconSettings() if b is None else b)
        pair = self._pairs[beacon, tag] = _Pair(beacon, tag, known)
        return pair

    def rows(self, now_ns: int) -> list[BeaconRow]:
        """How everything stands: beacons with ranges, those only alive, those only configured."""
        rows = [self._row(pair, now_ns) for pair in self._pairs.values()]
        heard = {row.beacon for row in rows}
        silent = (self._alive | set(self._known or ())) - heard
        rows += [self._row(_Pair(beacon, "", Beacon(0, 0.0)), now_ns) for beacon in silent]
        return sorted(rows, key=lambda row: (row.beacon, row.tag))

    def _row(self, pair: _Pair, now_ns: int) -> BeaconRow:
        last = pair.last
        age_s = None if last is None else (now_ns - last.t_ns) * 1e-9
        recent = [at for at in pair.times if now_ns - at[0] < WINDOW_S * 1e9]
        span_s = (recent[-1][0] - recent[0][0]) * 1e-9 if recent else 0.0
        is_alive = pair.beacon in self._alive
        link = Link.SILENT if is_alive else Link.GONE
        if age_s is not None and age_s < SILENT_S:
            link = Link.LIVE
        told = self._info.get(pair.beacon)
        return BeaconRow(
            beacon=pair.beacon,
            tag=pair.tag,
            link=link,
            alive=is_alive,
            rate_hz=(len(recent) - 1) / span_s if span_s > 0.0 else 0.0,
            age_s=age_s,
            range_m=None if last is None else last.range_m,
            sigma_m=None if last is None else last.sigma_m,
            los=None if last is None else last.los,
            rssi_dbm=None if last is None else last.rssi_dbm,
            sessions=tuple(sorted({_printable(session) for _, session in recent})),
            believed=pair.believed,
            refused=dict(pair.refused),
            malformed=dict(pair.malformed),
            lost=pair.lost,
            info=told if isinstance(told, BeaconInfo) else None,
            notes=self._notes(pair, recent, told),
        )

    def _notes(
        self, pair: _Pair, recent: list[tuple[int, str]], told: BeaconInfo | str | None
    ) -> tuple[str, ...]:
        notes = []
        if (count := publishers([session for _, session in recent])) > 1:
            notes.append(f"{count} publishers use this id: give each beacon its own")
        if self._known is not None and pair.beacon not in self._known:
            notes.append("not in [beacons]: a vehicle with this configuration refuses it")
        if pair.last is None and not pair.malformed:
            notes.append(
                "no range heard" + ("" if pair.beacon in self._alive else ", and no publisher is there")
            )
        if pair.detail:
            notes.append(f"unreadable: {pair.detail}")
        if isinstance(told, str):
            notes.append(told)
        return tuple(notes)


def publishers(sessions: list[str]) -> int:
    """How many send at the same time: sessions that come again after another one (a restart does not)."""
    seen: list[str] = []
    again: set[str] = set()
    for session in sessions:
        if seen and session != seen[-1] and session in seen:
            again |= set(seen[seen.index(session) :])
        if session in seen:
            seen.remove(session)
        seen.append(session)
    return len(again) or 1


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text[:200])
