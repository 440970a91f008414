"""A flight as lines: `key=value` for grep, JSON for other programs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import IO

import msgspec

from companion.types import PhaseChange, Status

Told = PhaseChange | str
"""What is told once: a change of phase, or a line of text from elsewhere."""


class TextLine(msgspec.Struct, frozen=True, tag_field="output", tag="text"):
    """A line of text from elsewhere among statuses and phase changes in JSON."""

    line: str


def write_lines(stream: IO[str], lines: Iterable[str]) -> None:
    """All of them at once, so that no reader sees half a line. Raises OSError."""
    stream.write("".join(f"{line}\n" for line in lines))
    stream.flush()


def plain_lines(told: Sequence[Told], status: Status | None, t0_ns: int) -> list[str]:
    """What was told, then the status, as `change_line` and `plain_line` write them."""
    lines = [item if isinstance(item, str) else change_line(item, t0_ns) for item in told]
    return lines if status is None else [*lines, plain_line(status, t0_ns)]


def json_lines(told: Sequence[Told], status: Status | None) -> list[str]:
    """One JSON object a line: a `Status`, a `PhaseChange` or a `TextLine`."""
    items = [TextLine(item) if isinstance(item, str) else item for item in told]
    return [msgspec.json.encode(item).decode() for item in (items if status is None else [*items, status])]


def plain_line(status: Status, t0_ns: int) -> str:
    """One line of `key=value`: the keys, their order and their units do not change; `-` where not known.

    Angles are degrees here: bearings positive to the right, yaw rates positive to the left.
    """
    e = status.estimate
    fields = (
        ("t_s", number(since_s(status.t_ns, t0_ns), 1)),
        ("phase", status.phase.name),
        ("mode", status.mode.value if status.mode is not None else "-"),
        ("armed", "-" if status.armed is None else "yes" if status.armed else "no"),
        ("range_m", number(status.range_m, 2)),
        ("range_age_s", number(status.range_age_s, 2)),
        ("distance_m", number(e.distance_m if e else None, 2)),
        ("distance_sigma_m", number(e.distance_sigma_m if e else None, 2)),
        ("bearing_deg", number(_degrees(e.bearing_rad if e else None), 1)),
        ("bearing_sigma_deg", number(_degrees(e.bearing_sigma_rad if e else None), 1)),
        ("speed_m_s", number(status.speed_m_s, 2)),
        ("yaw_rate_deg_s", number(_degrees(status.yaw_rate_rad_s), 1)),
        ("height_m", number(status.height_m, 2)),
        ("path_m", number(status.path_m, 2)),
        ("engaged_s", number(status.engaged_s, 1)),
        ("captured", "yes" if status.captured else "no"),
        ("accepted", str(status.ranges_accepted)),
        ("rejected", counts(status.rejected)),
        ("malformed", counts(status.malformed)),
        ("telemetry_age_s", number(status.telemetry_age_s, 2)),
        ("awaiting", listed(status.awaited)),
        ("warnings", listed(status.warnings)),
    )
    return " ".join(f"{key}={value}" for key, value in fields)


def change_line(change: PhaseChange, t0_ns: int) -> str:
    """A phase change: `t_s=12.3 change=ACQUIRE->APPROACH severity=INFO reason=the bearing is known`."""
    return (
        f"t_s={since_s(change.t_ns, t0_ns):.1f} change={change.before.name}->{change.after.name} "
        f"severity={change.severity.name} reason={change.reason}"
    )


def since_s(t_ns: int, t0_ns: int) -> float:
    """Seconds from t0."""
    return (t_ns - t0_ns) * 1e-9


def number(value: float | None, digits: int) -> str:
    """With so many digits behind the point; `-` where not known."""
    return "-" if value is None else f"{value:.{digits}f}"


def counts(of: Mapping[str, int]) -> str:
    """`outlier:4,not_finite:1`, without those that are zero; `-` for nothing."""
    return ",".join(f"{k.replace(' ', '_')}:{n}" for k, n in sorted(of.items()) if n) or "-"


def listed(texts: Iterable[str]) -> str:
    """`ranges_of_b1;a_heartbeat`; `-` for nothing."""
    return ";".join(texts).replace(" ", "_") or "-"


def _degrees(value: float | None) -> float | None:
    return None if value is None else math.degrees(value)
