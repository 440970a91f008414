"""The ranges of a beacon from a file: a recorded flight, JSON lines, CSV, or a module's own output."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path

from companion.calibrate import CalibrationError, Point
from companion.recording import RecordError, read
from companion.types import LineOfSight, RangeSample
from companion.uwb.families import Family, open_parser

_MCAP = b"\x89MCAP"


def points(path: Path, beacon: str, family: Family | None = None) -> list[Point]:
    """The beacon's ranges as they were measured, without those marked as not in line of sight.

    Raises CalibrationError: no such file, nothing that can be read, or no range of this beacon.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise CalibrationError(f"{path}: {error.strerror or error}") from error
    found = _recorded(path) if data.startswith(_MCAP) else _parsed(path, data, family)
    others: Counter[str] = Counter()
    hidden = 0
    chosen: list[tuple[float | None, float, float | None]] = []
    for name, t_s, range_m, los, power_dbm in found:
        if name != beacon:
            others[name] += 1
        elif los is LineOfSight.NLOS:
            hidden += 1
        else:
            chosen.append((t_s, range_m, power_dbm))
    if not chosen:
        known = ", ".join(f"{name} ({count})" for name, count in others.most_common(8)) or "none at all"
        seen = f"all {hidden} are marked as not in line of sight" if hidden else f"ranges of {known}"
        raise CalibrationError(f"{path}: no range of beacon {beacon!r} to use; {seen}")
    first_s = next((t_s for t_s, *_ in chosen if t_s is not None), 0.0)
    return [
        Point(float(i) if t_s is None else t_s - first_s, range_m, power_dbm)
        for i, (t_s, range_m, power_dbm) in enumerate(chosen)
    ]


_Range = tuple[str, float | None, float, LineOfSight, float | None]
"""Beacon, seconds, metres, line of sight, dBm."""


def _recorded(path: Path) -> Iterable[_Range]:
    try:
        steps = read(path).steps
    except RecordError as error:
        raise CalibrationError(str(error)) from error
    for step in steps:
        e = step.event
        if isinstance(e, RangeSample):
            yield e.beacon, e.t_ns * 1e-9, e.range_m, e.los, e.rssi_dbm


def _parsed(path: Path, data: bytes, family: Family | None) -> Iterable[_Range]:
    if family is None:
        family = Family.JSON_LINES if data.lstrip()[:1] == b"{" else Family.CSV
    parser = open_parser(family)
    measured = parser.feed(data) + parser.feed(b"\n")
    if not measured:
        what = ", ".join(f"{defect.value} {n}×" for defect, n in parser.defects.items()) or "nothing in it is"
        raise CalibrationError(
            f"{path}: no range as {family.value}: {what}; expected an MCAP flight, JSON lines or CSV with "
            "`beacon` and `range_m` (`companion publish --save` writes them), or --format"
        )
    for m in measured:
        if m.range_m is not None:
            yield m.peer, m.time_s, m.range_m, m.los, m.rssi_dbm
