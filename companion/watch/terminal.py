"""Vehicles in a terminal: a table and, of a single one, its panel; elsewhere plain lines."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from typing import IO, Protocol

import msgspec
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from companion.lines import change_line, listed, number, plain_line, write_lines
from companion.panel import PHASE_STYLE, panel, told_text
from companion.view import ViewKind
from companion.watch.fleet import Fleet, Link, Vehicle
from companion.watch.listen import News

_LINK_STYLE = {Link.LIVE: "green", Link.SILENT: "bold red", Link.GONE: "red"}


class Screen(Protocol):
    """How the fleet is shown."""

    period_s: float

    def show(self, fleet: Fleet, news: Sequence[News], missing: str, now_ns: int) -> None:
        """Once a period. `news`: what came since; `missing`: what is awaited, '' for nothing."""

    def close(self) -> None:
        """Give the stream back."""


def open_screen(stream: IO[str], kind: ViewKind) -> Screen:
    """A screen on this stream; AUTO asks the stream whether it is a terminal."""
    if kind is ViewKind.AUTO:
        kind = ViewKind.LIVE if stream.isatty() else ViewKind.PLAIN
    if kind is ViewKind.LIVE:
        return LiveScreen(stream)
    return PlainScreen(stream) if kind is ViewKind.PLAIN else JsonScreen(stream)


class LiveScreen:
    """Painted in place, four times a second; phase changes scroll above."""

    period_s = 0.25

    def __init__(self, stream: IO[str], console: Console | None = None) -> None:
        self._console = console or Console(file=stream, highlight=False)
        self._live = Live(console=self._console, auto_refresh=False)
        self._live.start()

    def show(self, fleet: Fleet, news: Sequence[News], missing: str, now_ns: int) -> None:
        """Print the changes, paint the rest."""
        for item in news:
            if item.change is not None:
                told = told_text(item.change, item.vehicle.t0_ns)
                self._console.print(Text(f"{item.vehicle.uav} ", style="bold") + told, soft_wrap=True)
        self._live.update(screen(fleet, missing, now_ns, self._console.width), refresh=True)

    def close(self) -> None:
        """Leave the last picture where it is."""
        self._live.stop()


class PlainScreen:
    """A line of `key=value` a second for each vehicle and one for each phase change, made for grep."""

    period_s = 1.0

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream
        self._missing = ""

    def show(self, fleet: Fleet, news: Sequence[News], missing: str, now_ns: int) -> None:
        """What is awaited, once; the changes; a line for each vehicle."""
        lines = [missing] if missing and missing != self._missing else []
        self._missing = missing
        for vehicle, _, change in news:
            if change is not None:
                lines.append(f"uav={vehicle.uav} {change_line(change, vehicle.t0_ns)}")
        lines += [vehicle_line(vehicle, now_ns) for vehicle in fleet.vehicles()]
        write_lines(self._stream, lines)

    def close(self) -> None:
        """Nothing is kept back."""


class JsonScreen:
    """One JSON object a line and a second for each vehicle: uav, link, age_s, problems and the message."""

    period_s = 1.0

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def show(self, fleet: Fleet, news: Sequence[News], missing: str, now_ns: int) -> None:
        """A line for each; what is awaited goes to standard error."""
        if missing and not fleet.vehicles():
            print(missing, file=sys.stderr)
        rows = [
            {
                "uav": vehicle.uav,
                "link": vehicle.link(now_ns),
                "age_s": vehicle.age_s(now_ns),
                "problems": vehicle.problems(now_ns),
                "message": vehicle.message,
            }
            for vehicle in fleet.vehicles()
        ]
        write_lines(self._stream, [msgspec.json.encode(row).decode() for row in rows])

    def close(self) -> None:
        """Nothing is kept back."""


# ------------------------------------------------------------------------------------------ what is shown


def vehicle_line(vehicle: Vehicle, now_ns: int) -> str:
    """`uav=… link=… age_s=… problems=…`, then the keys of `companion.lines.plain_line`."""
    age_s, problems = number(vehicle.age_s(now_ns), 1), listed(vehicle.problems(now_ns))
    head = f"uav={vehicle.uav} link={vehicle.link(now_ns).value} age_s={age_s} problems={problems}"
    if vehicle.message is None:
        return head
    return f"{head} {plain_line(vehicle.message.status, vehicle.t0_ns)}"


def screen(fleet: Fleet, missing: str, now_ns: int, width: int = 120) -> RenderableType:
    """Everything: what is awaited, the table, of a single vehicle its panel."""
    parts: list[RenderableType] = []
    vehicles = fleet.vehicles()
    if missing:
        parts.append(Text(missing, style="yellow"))
    if vehicles:
        parts.append(_table(vehicles, now_ns, width))
    if len(vehicles) == 1 and vehicles[0].message is not None and vehicles[0].link(now_ns) is Link.LIVE:
        parts.append(panel(vehicles[0].message.status, vehicles[0].t0_ns))
    else:
        parts += [Text(f"{v.uav} {line}", style="yellow") for v in vehicles for line in _lines(v)]
    parts += [Text(f"{v.uav}: {line}", style="red") for v in vehicles for line in v.problems(now_ns)]
    if fleet.turned_away:
        parts.append(Text(f"{fleet.turned_away} messages of other ids are not shown", style="red"))
    return Group(*parts)


def _lines(vehicle: Vehicle) -> list[str]:
    """What a person should know besides the table."""
    if vehicle.message is None:
        return []
    s = vehicle.message.status
    return [f"awaits {awaited}" for awaited in s.awaited] + [f"warns: {warning}" for warning in s.warnings]


_NARROW = 104
"""Columns of a terminal in which everything has its place."""
_DISPENSABLE = frozenset({"to", "height", "speed", "path"})
"""What is left out in a narrower one."""


def _table(vehicles: list[Vehicle], now_ns: int, width: int) -> Table:
    table = Table(box=None, pad_edge=False, header_style="dim")
    left_out = _DISPENSABLE if width < _NARROW else frozenset()
    rows = [{k: v for k, v in _cells(vehicle, now_ns).items() if k not in left_out} for vehicle in vehicles]
    for name in max(rows, key=len):
        numeric = name in ("distance", "bearing", "range", "height", "speed", "path")
        table.add_column(name, justify="right" if numeric else "left", no_wrap=True)
    for row in rows:
        table.add_row(*row.values())
    return table


def _cells(vehicle: Vehicle, now_ns: int) -> dict[str, Text]:
    """What stands in each column; the first two alone where nothing was heard."""
    link, age_s = vehicle.link(now_ns), vehicle.age_s(now_ns)
    heard = link.value
    if link is not Link.LIVE:
        heard += ", never heard" if age_s is None else f", {age_s:.0f} s ago"
    if vehicle.lost:
        heard += f", {vehicle.lost} lost"
    cells = {"vehicle": Text(vehicle.uav, style="bold"), "link": Text(heard, style=_LINK_STYLE[link])}
    if vehicle.message is None:
        return cells
    m, s, e = vehicle.message, vehicle.message.status, vehicle.message.status.estimate
    style = "" if link is Link.LIVE else "dim"
    cells["phase"] = Text(s.phase.value.upper(), style=style or PHASE_STYLE[s.phase])
    plain = {
        "mode": s.mode.value if s.mode is not None else "–",
        "to": m.target,
        "distance": "–" if e is None else f"{e.distance_m:.2f} ± {e.distance_sigma_m:.2f} m",
        "bearing": "–" if e is None else f"{_side(e.bearing_rad)} ± {math.degrees(e.bearing_sigma_rad):.0f}°",
        "range": "–" if s.range_m is None else f"{s.range_m:.2f} m",
        "height": "–" if s.height_m is None else f"{s.height_m:.1f} m",
        "speed": "–" if s.speed_m_s is None else f"{s.speed_m_s:.2f} m/s",
        "path": f"{s.path_m:.1f} m",
    }
    return cells | {name: Text(text, style=style) for name, text in plain.items()}


def _side(bearing_rad: float) -> str:
    return f"{abs(math.degrees(bearing_rad)):.0f}° {'right' if bearing_rad >= 0.0 else 'left'}"
