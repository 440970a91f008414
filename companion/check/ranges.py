"""What is heard of the ranges, and what that means for a flight."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from statistics import median

from companion import beacons, gate
from companion.beacons import Beacon, configured, told
from companion.check.report import Part, Row, State
from companion.gate import Track
from companion.guidance.station_settings import BEACONS_NEEDED
from companion.network_settings import BeaconSettings
from companion.settings import Settings
from companion.types import BeaconTold, Event, LineOfSight, Malformed, RangeSample, Verdict

_MOST_BEACONS = 64
_KEPT = 1000
_STRANGER = configured(0, BeaconSettings())
WATCH_S = 3.0
"""A beacon's rate is judged after this long."""


@dataclass(slots=True)
class Heard:
    """What came from one beacon."""

    count: int = 0
    first_ns: int = 0
    last_ns: int = 0
    believed_ns: int = 0
    """When the last one came that a flight would believe."""
    longest_gap_s: float = 0.0
    """Between two that a flight would believe."""
    session: str = ""
    sessions: set[str] = field(default_factory=set)
    switches: int = 0
    """How often the session changed: a restart does so once, two publishers do it all the time."""
    verdicts: Counter[Verdict] = field(default_factory=Counter)
    ranges_m: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT))
    sigmas_m: deque[float] = field(default_factory=lambda: deque(maxlen=_KEPT))
    blocked: int = 0
    """Marked as not in line of sight."""
    track: Track | None = None

    @property
    def rate_hz(self) -> float:
        """Mean rate from the first to the last one."""
        span_s = (self.last_ns - self.first_ns) * 1e-9
        return (self.count - 1) / span_s if span_s > 0.0 else 0.0


class RangeFindings:
    """Everything heard on the ranges' link. Memory is bounded, whatever comes."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.beacons: dict[str, Heard] = {}
        self.more_beacons = 0
        """Samples of beacons beyond those kept."""
        self.malformed: Counter[str] = Counter()
        self.known = {name: configured(0, b) for name, b in settings.beacons.items()}
        """What holds of the configured beacons, with what they have told of themselves."""
        self.examples: dict[str, str] = {}
        """One for each kind of malformed sample."""

    def take_in(self, event: Event) -> None:
        """Note one event of the ranges' link."""
        if isinstance(event, BeaconTold):
            if (ours := self._settings.beacons.get(event.beacon)) is not None:
                self.known[event.beacon] = told(configured(0, ours), ours, event)
        elif isinstance(event, Malformed):
            self.malformed[event.defect.value] += 1
            self.examples.setdefault(event.defect.value, event.detail)
        elif isinstance(event, RangeSample):
            if event.beacon not in self.beacons and len(self.beacons) >= _MOST_BEACONS:
                self.more_beacons += 1
            else:
                self._note(self.beacons.setdefault(event.beacon, Heard()), event)

    def _note(self, h: Heard, sample: RangeSample) -> None:
        if h.count:
            h.switches += sample.session != h.session
        else:
            h.first_ns = sample.t_ns
        h.count, h.last_ns, h.session = h.count + 1, sample.t_ns, sample.session
        if len(h.sessions) < _MOST_BEACONS:
            h.sessions.add(sample.session)
        cfg = self._settings
        known = self.known.get(sample.beacon, _STRANGER)
        range_m = beacons.range_m(known, sample)
        sigma_m = beacons.sigma_m(cfg.ranges, sample, known.sigma_m)
        rate_m_s = cfg.vehicle.speed_max_m_s
        h.track, verdict = gate.judge(cfg.ranges, h.track, sample, range_m, sigma_m, rate_m_s)
        h.verdicts[verdict] += 1
        if verdict is Verdict.ACCEPTED:
            since_ns = sample.t_ns - (h.believed_ns or sample.t_ns)
            h.longest_gap_s, h.believed_ns = max(h.longest_gap_s, since_ns * 1e-9), sample.t_ns
            h.ranges_m.append(range_m)
            h.blocked += sample.los is LineOfSight.NLOS
            if sample.sigma_m is not None:
                h.sigmas_m.append(sample.sigma_m)

    def is_complete(self, t_ns: int) -> bool:
        """Every configured beacon has been watched for long enough."""
        wanted = (self.beacons.get(beacon) for beacon in self._settings.beacons)
        return all(h is not None and (t_ns - h.first_ns) * 1e-9 >= WATCH_S for h in wanted)


def judge(
    settings: Settings,
    found: RangeFindings,
    connected: int,
    t_ns: int,
    watched_s: float,
    height_m: float | None,
) -> Iterator[Row]:
    """Every row about the ranges. `connected`: routers and peers; `height_m`: the vehicle's, now."""
    keeps = settings.mission.kind == "station"
    target = "" if keeps else settings.mission.target
    yield _zenoh(settings, connected)
    for beacon, known in found.known.items():
        h = found.beacons.get(beacon)
        if h is None:
            yield _not_heard(settings, beacon, found, watched_s)
        else:
            yield _heard(settings, _name(settings, beacon), h, t_ns, known)
            yield from _problems(settings, beacon, h, known, height_m)
    yield from _strangers(settings, found)
    for defect, count in found.malformed.items():
        yield Row(
            Part.RANGES,
            "unreadable",
            State.WARN,
            f"{count}: {defect}: {found.examples[defect]}",
            "Such samples are dropped.",
            "mend the publisher; `companion ranges schema` says what a range looks like",
        )
    if keeps:
        yield from _station(settings, found, height_m)
    elif target in found.beacons and found.beacons[target].ranges_m:
        range_m = median(found.beacons[target].ranges_m)
        yield from _reach(settings, range_m, height_m, found.known[target].height_m)


def _zenoh(settings: Settings, connected: int) -> Row:
    r = settings.ranges
    where = ", ".join([*r.connect, *(f"listening on {e}" for e in r.listen)])
    if r.multicast_scouting:
        where = f"{where}, multicast scouting" if where else "multicast scouting"
    if connected:
        number = "1 router or peer" if connected == 1 else f"{connected} routers and peers"
        return Row(Part.RANGES, "Zenoh", State.OK, f"connected to {number} ({where})")
    return Row(
        Part.RANGES,
        "Zenoh",
        State.FAIL,
        f"connected to nobody ({where or 'no endpoint configured'})",
        "Zenoh says nothing of a wrong endpoint: it keeps trying, and no range ever comes.",
        "start the router or the beacons; check ranges.connect (protocol, address, port) and ranges.listen"
        + ("; the router's certificate must be of the same site and name this address" if r.tls else ""),
    )


def _name(settings: Settings, beacon: str) -> str:
    if settings.mission.kind == "station":
        return f"{beacon} (d* {settings.beacons[beacon].station_distance_m or 0.0:g} m)"
    return f"{beacon} (target)" if beacon == settings.mission.target else beacon


def _not_heard(settings: Settings, beacon: str, found: RangeFindings, watched_s: float) -> Row:
    r = settings.ranges
    key = f"uwb/v1/{r.site}/{beacon}/{r.tag}/range"
    why = ""
    if settings.mission.kind == "capture" and beacon == settings.mission.target:
        why = "Without the target's ranges there is nothing to fly to."
    elif settings.mission.kind == "station":
        needed = len(settings.beacons) if settings.station.scheme == "station-paper" else BEACONS_NEEDED
        if len(found.beacons.keys() & settings.beacons.keys()) < needed:
            why = f"With fewer than {needed} beacons the station cannot be found."
    return Row(
        Part.RANGES,
        _name(settings, beacon),
        State.FAIL if why else State.WARN,
        f"no range on {', '.join([key, *(t.topic for t in r.ros2)])} within {watched_s:.1f} s",
        why,
        "is the beacon on, in reach, and published under this site, id and tag?"
        + (" And do the router's rules let both in: `companion keys --check` there" if r.tls else ""),
    )


def _heard(settings: Settings, name: str, h: Heard, t_ns: int, known: Beacon) -> Row:
    """The figures of one beacon, and whether they are good enough to fly on."""
    coast_s = settings.loss.coast_after_s
    age_s = max(t_ns - h.believed_ns, 0) * 1e-9
    accepted = h.verdicts[Verdict.ACCEPTED]
    figures = f"{h.rate_hz:.1f} Hz"
    if accepted:
        sigma = f"told sigma {median(h.sigmas_m):.2f} m" if h.sigmas_m else f"sigma {known.sigma_m:.2f} m"
        ages = f"longest gap {h.longest_gap_s:.2f} s, last one {age_s:.2f} s old"
        figures = f"{median(h.ranges_m):.2f} m, {sigma}, {figures}, {ages}"
    refused = ", ".join(f"{n} {v.value}" for v, n in h.verdicts.items() if v is not Verdict.ACCEPTED)
    if refused:
        figures += f"; refused: {refused}"
    state, why, do = State.OK, "", ""
    if not accepted:
        state, why = State.FAIL, "Not one of them would be believed."
        do = "mend the publisher: sequence numbers must rise, ranges must be fresh and plausible"
    elif age_s > coast_s:
        state, why = State.FAIL, "It has fallen silent, or sends nothing that would be believed."
        do = "check the beacon's power and its line of sight, and that its sequence numbers rise"
    elif h.longest_gap_s > coast_s:
        state = State.WARN
        why = f"After {coast_s:g} s without a range the app flies on its prediction (loss.coast_after_s)."
        do = "look for blocked signals, a lossy network, or a publisher that stalls"
    elif accepted < 0.7 * h.count:
        state, why = State.WARN, "Many would not be believed."
        do = (
            "late ranges come of a backlog on the way, repeated ones of a publisher that sends its last again"
        )
    return Row(Part.RANGES, name, state, figures, why, do)


def _problems(
    settings: Settings, beacon: str, h: Heard, known: Beacon, height_m: float | None
) -> Iterator[Row]:
    """What is wrong with a beacon besides its rate."""
    if known.contradiction:
        yield Row(
            Part.RANGES,
            beacon,
            State.WARN,
            known.contradiction,
            "One of the two is wrong, and both decide how far away the beacon seems.",
            f"measure it, and correct [beacons.{beacon}] or what the beacon tells",
        )
    if h.switches >= len(h.sessions) > 1:
        yield Row(
            Part.RANGES,
            beacon,
            State.FAIL,
            f"{len(h.sessions)} publishers at once: the session changed {h.switches} times",
            "In flight the one that is heard first is believed, whichever that is; the others are dropped.",
            "stop one of them"
            + ("; with several tags at this site, set ranges.tag" if settings.ranges.tag == "*" else ""),
        )
    if not h.ranges_m:
        return
    if h.blocked > 0.5 * len(h.ranges_m):
        yield Row(
            Part.RANGES,
            beacon,
            State.WARN,
            f"{h.blocked} of {len(h.ranges_m)} ranges are marked as not in line of sight",
            "They are too long, by up to metres.",
            "see what stands between beacon and vehicle",
        )
    sigma_m = median(h.sigmas_m) if h.sigmas_m else known.sigma_m
    if height_m is not None:
        above_m = abs(height_m - known.height_m)
        range_m = median(h.ranges_m)
        if range_m + 3.0 * sigma_m + settings.vehicle.height_sigma_m < above_m:
            yield Row(
                Part.RANGES,
                beacon,
                State.FAIL,
                f"range {range_m:.2f} m, but the vehicle is {above_m:.2f} m above or below the beacon",
                "A slant range cannot be shorter than the difference of the heights.",
                f"check beacons.{beacon}.height_m: its antenna's height above the take-off point",
            )


def _strangers(settings: Settings, found: RangeFindings) -> Iterator[Row]:
    strange = {b: h for b, h in found.beacons.items() if b not in settings.beacons}
    if strange or found.more_beacons:
        heard = ", ".join(f"{beacon or '(none)'} {h.rate_hz:.1f} Hz" for beacon, h in sorted(strange.items()))
        yield Row(
            Part.RANGES,
            "other beacons",
            State.WARN,
            f"not in the configuration: {heard}{' and more' if found.more_beacons else ''}",
            "Their ranges are not used.",
            "is an id misspelt? Each beacon has a table [beacons.ID], a target is mission.target",
        )


def _station(settings: Settings, found: RangeFindings, height_m: float | None) -> Iterator[Row]:
    """Is the station within the budgets? Each beacon says that it is between |d − d*| and d + d* away."""
    least_m, most_m = 0.0, math.inf
    for beacon, known in settings.beacons.items():
        h = found.beacons.get(beacon)
        if h is not None and h.ranges_m and known.station_distance_m is not None:
            above_m = (settings.vehicle.height_m if height_m is None else height_m) - found.known[
                beacon
            ].height_m
            d_m = math.sqrt(max(median(h.ranges_m) ** 2 - above_m**2, 0.0))
            least_m = max(least_m, abs(d_m - known.station_distance_m))
            most_m = min(most_m, d_m + known.station_distance_m)
    if most_m == math.inf:
        return
    name, v_m_s, limits = "way to the station", settings.guidance.speed_m_s, settings.limits
    text = f"{least_m:.0f} to {most_m:.0f} m away, {least_m / v_m_s:.0f} to {most_m / v_m_s:.0f} s"
    if least_m > most_m + 1.0:
        yield Row(
            Part.RANGES,
            name,
            State.FAIL,
            f"at least {least_m:.1f} m away by one beacon, at most {most_m:.1f} m by another",
            "No place has the distances that are configured.",
            "check beacons.ID.station_distance_m, and that no two beacons are mixed up",
        )
        return
    limit_m = min(limits.from_start_m, limits.distance_m, limits.flight_time_s * v_m_s)
    state = State.FAIL if least_m > limit_m else State.WARN if most_m > limit_m else State.OK
    why = "" if state is State.OK else f"The budgets of [limits] end the flight after {limit_m:g} m."
    do = "" if state is State.OK else "raise the limits, or start nearer"
    yield Row(Part.RANGES, name, state, text, why, do)


def _reach(settings: Settings, range_m: float, height_m: float | None, beacon_m: float) -> Iterator[Row]:
    """Is the target within the budgets of the flight?"""
    limits, v, g = settings.limits, settings.vehicle, settings.guidance
    above_m = (v.height_m if height_m is None else height_m) - beacon_m
    if range_m < abs(above_m):
        return
    there_m = math.sqrt(range_m**2 - above_m**2)
    needs_s = there_m / g.speed_m_s
    found = f"about {there_m:.0f} m away, {needs_s:.0f} s at {g.speed_m_s:g} m/s"
    over = [
        f"{name} = {limit:g}"
        for name, limit, need in (
            ("limits.from_start_m", limits.from_start_m, there_m),
            ("limits.distance_m", limits.distance_m, there_m),
            ("limits.flight_time_s", limits.flight_time_s, needs_s),
            ("ranges.max_range_m", settings.ranges.max_range_m, math.hypot(there_m, v.height_m - beacon_m)),
        )
        if need > limit
    ]
    if over:
        yield Row(
            Part.RANGES,
            "way to the target",
            State.FAIL,
            f"{found}: more than {', '.join(over)}",
            "The flight would end in a hand-over on the way.",
            "raise the limit, or start nearer",
        )
    else:
        yield Row(Part.RANGES, "way to the target", State.OK, f"{found}: within the limits")
