"""The panel of a flight on a terminal: phase, target, bearing ruler, setpoint, vehicle, links."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import IO

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.text import Text

from companion.lines import Told, counts, since_s
from companion.types import Phase, Severity, Status

RULER_HALF = 26
"""Characters from straight ahead to straight behind on the bearing ruler: 7° each."""
UNSURE_RAD = 1.0
"""A bearing with a greater standard deviation is not known."""

PHASE_STYLE = {
    Phase.AWAIT: "yellow",
    Phase.STANDBY: "cyan",
    Phase.INHIBITED: "yellow",
    Phase.ACQUIRE: "bold blue",
    Phase.APPROACH: "bold magenta",
    Phase.HOLD: "bold green",
    Phase.KEEP: "bold green",
    Phase.COAST: "bold yellow",
    Phase.STALL: "bold red",
    Phase.HAND_OVER: "bold red",
    Phase.RELEASED: "yellow",
    Phase.ENDED: "bold",
}
"""How each phase looks in a terminal."""


class LivePanel:
    """The panel in place, phase changes scrolling above it; it stays when it is closed."""

    def __init__(self, stream: IO[str], console: Console | None = None) -> None:
        self._console = console or Console(file=stream, highlight=False)
        self._live = Live(
            console=self._console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
        )
        self._live.start()

    def paint(self, told: Sequence[Told], status: Status | None, t0_ns: int) -> None:
        """What was told, and the panel anew. Raises OSError."""
        for item in told:
            self._console.print(told_text(item, t0_ns), soft_wrap=True)
        if status is not None:
            self._live.update(panel(status, t0_ns), refresh=True)

    def close(self) -> None:
        """Leave the last panel where it is."""
        self._live.stop()


def told_text(item: Told, t0_ns: int) -> Text:
    """A phase change or a told line, as it scrolls above the panel."""
    if isinstance(item, str):
        return Text(item, style="dim")
    style = "bold red" if item.severity <= Severity.WARNING else PHASE_STYLE[item.after]
    return Text.assemble(
        (f"{since_s(item.t_ns, t0_ns):6.1f} s  ", "dim"),
        (item.before.value, "dim"),
        (" → ", "dim"),
        (item.after.value.upper(), style),
        f"  {item.reason}",
    )


def panel(status: Status, t0_ns: int) -> RenderableType:
    """The panel: phase, target, bearing ruler, setpoint, vehicle, links."""
    style = PHASE_STYLE[status.phase]
    rows = [_row("phase", (status.phase.value.upper(), style), (f"  {status.reason}", ""))]
    rows += [_row("awaiting", (awaited, "yellow")) for awaited in status.awaited]
    rows += [_target(status), bearing_ruler(status), _setpoint(status), _vehicle(status), _ranges(status)]
    if status.beacons:
        rows.append(_beacons(status))
    if (rejected := counts(status.rejected)) != "-":
        rows.append(_row("rejected", (rejected, "yellow")))
    if (malformed := counts(status.malformed)) != "-":
        rows.append(_row("malformed", (malformed, "red")))
    rows += [_row("warning", (warning, "bold yellow")) for warning in status.warnings]
    rows.append(
        _row(
            "flown",
            (f"{status.path_m:.2f} m in {status.engaged_s:.1f} s engaged", ""),
            (("   reached" if status.beacons else "   captured") if status.captured else "", "bold green"),
        )
    )
    title = f"companion  {since_s(status.t_ns, t0_ns):.1f} s"
    return Panel(Group(*rows), title=title, border_style=style, width=80)


def bearing_ruler(status: Status) -> Text:
    """Left … ahead … right: the estimated bearing as ●, its ±1σ as ━, straight behind at both ends."""
    cells = ["─"] * (2 * RULER_HALF + 1)
    cells[RULER_HALF] = "┼"
    cells[RULER_HALF // 2] = cells[RULER_HALF + RULER_HALF // 2] = "┴"
    span = range(0)
    if (e := status.estimate) is not None:
        at = RULER_HALF + round(e.bearing_rad / math.pi * RULER_HALF)
        half = min(round(e.bearing_sigma_rad / math.pi * RULER_HALF), RULER_HALF)
        span = range(at - half, at + half + 1)
        for i in span:
            cells[i % (2 * RULER_HALF)] = "━"  # beyond straight behind the ruler goes on at its other end
        cells[at] = "●"
    line_style = PHASE_STYLE[status.phase] if span else "dim"
    return _row("", ("left ", "dim"), ("".join(cells), line_style), (" right", "dim"))


def _row(name: str, *parts: tuple[str, str]) -> Text:
    return Text.assemble((f"{name:<8} ", "dim"), *parts, no_wrap=True, overflow="ellipsis")


def _target(status: Status) -> Text:
    e = status.estimate
    name = "station" if status.beacons else "target"
    if e is None:
        return _row(name, ("no estimate yet", "dim"))
    side = "right" if e.bearing_rad >= 0 else "left"
    unsure = e.bearing_sigma_rad > UNSURE_RAD
    return _row(
        name,
        (f"{e.distance_m:.2f} m", "bold"),
        (f" ± {e.distance_sigma_m:.2f}   ", ""),
        (f"{abs(math.degrees(e.bearing_rad)):.0f}° {side}", "bold"),
        (f" ± {math.degrees(e.bearing_sigma_rad):.0f}°", "yellow" if unsure else ""),
        ("  bearing not known" if unsure else "", "yellow"),
    )


def _setpoint(status: Status) -> Text:
    if status.speed_m_s is None or status.yaw_rate_rad_s is None:
        return _row("setpoint", ("none sent", "dim"))
    side = "left" if status.yaw_rate_rad_s >= 0 else "right"
    turn = abs(math.degrees(status.yaw_rate_rad_s))
    return _row("setpoint", (f"{status.speed_m_s:.2f} m/s forward   turn {turn:.0f}°/s {side}", ""))


def _vehicle(status: Status) -> Text:
    armed = {None: "", True: "armed  ", False: "disarmed  "}[status.armed]
    return _row(
        "vehicle",
        (status.mode.value if status.mode else "mode not known", "bold" if status.phase.is_engaged else ""),
        (f"  {armed}height {_metres(status.height_m)}", ""),
        (f"  telemetry {_age(status.telemetry_age_s)}", _age_style(status.telemetry_age_s)),
    )


def _ranges(status: Status) -> Text:
    return _row(
        "ranges",
        (f"{_metres(status.range_m)}  {_age(status.range_age_s)}", _age_style(status.range_age_s)),
        (f"  accepted {status.ranges_accepted}", ""),
    )


def _beacons(status: Status) -> Text:
    """Station keeping: each beacon with the age of its last range."""
    parts = []
    for name, age_s in status.beacons.items():
        told = "never" if age_s is None else f"{age_s:.1f} s"
        parts.append((f"{name} {told}  ", _age_style(age_s)))
    return _row("beacons", *parts)


def _metres(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f} m"


def _age(age_s: float | None) -> str:
    return "never heard" if age_s is None else f"{age_s:.2f} s ago"


def _age_style(age_s: float | None) -> str:
    return "green" if age_s is not None and age_s < 0.5 else "red"
