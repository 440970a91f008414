"""What is derived for viewers while a flight is recorded: poses, path, log, statistics of the links.

Replay ignores all of it.
"""

from __future__ import annotations

import math

from companion.foxglove import (
    BeaconStatistics,
    FrameTransform,
    LinkStatistics,
    Log,
    Pose,
    PoseInFrame,
    PosesInFrame,
    Quaternion,
    Time,
    Vector3,
    View,
)
from companion.types import (
    Attitude,
    Event,
    LocalMotion,
    Malformed,
    Output,
    PhaseChange,
    RangeSample,
    Setpoint,
    Severity,
    Status,
)

LOCAL_FRAME = "local"
"""The autopilot's local frame: x East, y North, z up, metres."""
VEHICLE_FRAME = "vehicle"
"""x forward, y left, z up."""

_PATH_POINTS = 256
"""Points of the path kept; when it is full every second one is dropped and the spacing doubled."""
_PATH_SPACING_M = 0.1
_PATH_PERIOD_NS = 5_000_000_000
_LINKS_PERIOD_NS = 1_000_000_000
_TIMED = (Attitude, LocalMotion)
"""What bears the autopilot's own time."""
_BEACONS_AT_MOST = 64
"""Beacons told in one `LinkStatistics`, so that a flood of made-up ids takes bounded memory."""


def time_of(unix_ns: int) -> Time:
    """Nanoseconds since 1970 as Foxglove writes them."""
    return Time(unix_ns // 1_000_000_000, unix_ns % 1_000_000_000)


def log(unix_ns: int, severity: Severity, message: str) -> Log:
    """One line of Foxglove's log panel."""
    level = 4 if severity <= Severity.CRITICAL else 3 if severity <= Severity.WARNING else 2
    return Log(time_of(unix_ns), level, message)


class Views:
    """Derives, from a flight's events and outputs in their order, what `companion.foxglove.TOPICS` lists."""

    def __init__(self) -> None:
        self._path: list[Pose] = []
        self._spacing_m = _PATH_SPACING_M
        self._t_path_ns: int | None = None
        self._links = _Links()

    def of(self, item: Event | Output, unix_ns: int) -> list[tuple[str, View]]:
        """The topics and messages that follow from the next event or output; `unix_ns` is its Unix time."""
        views: list[tuple[str, View]] = []
        if isinstance(item, Status):
            views += self._status(item, unix_ns)
        elif isinstance(item, PhaseChange):
            words = f"{item.before.value} → {item.after.value}: {item.reason}"
            views.append(("/log", log(unix_ns, item.severity, words)))
        links = self._links.take(item, unix_ns)
        if links is not None:
            views.append(("/links", links))
        return views

    def _status(self, s: Status, unix_ns: int) -> list[tuple[str, View]]:
        if s.x_m is None or s.y_m is None or s.heading_rad is None:
            return []
        time = time_of(unix_ns)
        pose = _pose(s.x_m, s.y_m, s.height_m or 0.0, s.heading_rad)
        views: list[tuple[str, View]] = [
            ("/pose", PoseInFrame(time, LOCAL_FRAME, pose)),
            ("/tf", FrameTransform(time, LOCAL_FRAME, VEHICLE_FRAME, pose.position, pose.orientation)),
        ]
        if s.estimate is not None:
            azimuth_rad = s.heading_rad - s.estimate.bearing_rad
            x_m = s.x_m + s.estimate.distance_m * math.cos(azimuth_rad)
            y_m = s.y_m + s.estimate.distance_m * math.sin(azimuth_rad)
            views.append(("/target", PoseInFrame(time, LOCAL_FRAME, _pose(x_m, y_m, 0.0, 0.0))))
        self._extend(pose)
        if self._t_path_ns is None or s.t_ns - self._t_path_ns >= _PATH_PERIOD_NS or s.phase.is_final:
            self._t_path_ns = s.t_ns
            views.append(("/path", PosesInFrame(time, LOCAL_FRAME, tuple(self._path))))
        return views

    def _extend(self, pose: Pose) -> None:
        if self._path:
            a, b = self._path[-1].position, pose.position
            if math.dist((a.x, a.y, a.z), (b.x, b.y, b.z)) < self._spacing_m:
                return
        self._path.append(pose)
        if len(self._path) >= _PATH_POINTS:
            del self._path[1::2]
            self._spacing_m *= 2.0


def _pose(x_m: float, y_m: float, z_m: float, heading_rad: float) -> Pose:
    """Millimetres are enough for the eye, and the file stays small."""
    half = heading_rad / 2.0
    return Pose(
        Vector3(round(x_m, 3), round(y_m, 3), round(z_m, 3)),
        Quaternion(0.0, 0.0, round(math.sin(half), 4), round(math.cos(half), 4)),
    )


class _Sender:
    """How often somebody was heard in a period, and how far our clock was ahead of theirs."""

    def __init__(self) -> None:
        self.count = 0
        self.least_s: float | None = None
        self.greatest_s: float | None = None

    def ahead(self, by_s: float) -> None:
        """Our clock at a message's reception − theirs at its sending."""
        if self.least_s is None or by_s < self.least_s:
            self.least_s = by_s
        if self.greatest_s is None or by_s > self.greatest_s:
            self.greatest_s = by_s

    @property
    def jitter_s(self) -> float | None:
        """Greatest − least."""
        return None if self.least_s is None or self.greatest_s is None else self.greatest_s - self.least_s


class _Links:
    """Counts and clock offsets, begun anew every period."""

    def __init__(self) -> None:
        self._since_ns: int | None = None
        self._reset()

    def _reset(self) -> None:
        self._counts: dict[type, int] = {}
        self._vehicle = _Sender()
        self._beacons: dict[str, _Sender] = {}

    def take(self, item: Event | Output, unix_ns: int) -> LinkStatistics | None:
        """Count one event or output; the statistics when a period is over."""
        result = None
        if self._since_ns is None:
            self._since_ns = item.t_ns
        elif item.t_ns - self._since_ns >= _LINKS_PERIOD_NS:
            result = self._statistics((item.t_ns - self._since_ns) * 1e-9)
            self._since_ns = item.t_ns
            self._reset()
        kind = type(item)
        self._counts[kind] = self._counts.get(kind, 0) + 1
        if isinstance(item, RangeSample):
            self._range(item, unix_ns)
        elif isinstance(item, _TIMED):
            self._vehicle.ahead((item.t_ns - item.boot_ms * 1_000_000) * 1e-9)
        return result

    def _range(self, sample: RangeSample, unix_ns: int) -> None:
        if sample.beacon not in self._beacons:
            if len(self._beacons) == _BEACONS_AT_MOST:
                return
            self._beacons[sample.beacon] = _Sender()
        beacon = self._beacons[sample.beacon]
        beacon.count += 1
        if sample.sent_t_ns is not None:
            beacon.ahead((unix_ns - sample.sent_t_ns) * 1e-9)

    def _statistics(self, period_s: float) -> LinkStatistics:
        return LinkStatistics(
            period_s=period_s,
            attitudes=self._counts.get(Attitude, 0),
            motions=self._counts.get(LocalMotion, 0),
            ranges=self._counts.get(RangeSample, 0),
            malformed=self._counts.get(Malformed, 0),
            setpoints=self._counts.get(Setpoint, 0),
            vehicle_boot_s=self._vehicle.least_s,
            vehicle_jitter_s=self._vehicle.jitter_s,
            beacons=tuple(
                [
                    BeaconStatistics(name, beacon.count, beacon.least_s, beacon.jitter_s)
                    for name, beacon in sorted(self._beacons.items())
                ]
            ),
        )
