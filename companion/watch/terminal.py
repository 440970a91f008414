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

from companion.view import PHASE_STYLE, ViewKind, change_line, panel, plain_line, told_text
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
        self._live.update(screen(fleet, missing, now_ns), refresh=True)

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
        self._stream.write("".join(f"{line}\n" for line in lines))
        self._stream.flush()

    def close(self) -> None:
        """Nothing is kept back."""


class JsonScreen:
    """One JSON object a line and a second for each vehicle: uav, link, age_s and the message as it came."""

    period_s = 1.0

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def show(self, fleet: Fleet, news: Sequence[News], missing: str, now_ns: int) -> None:
        """A line for each; what is awaited goes to standard error."""
        if missing and not fleet.vehicles():
            print(missing, file=sys.stderr)
        for vehicle in fleet.vehicles():
            row = {
                "uav": vehicle.uav,
                "link": vehicle.link(now_ns),
                "age_s": vehicle.age_s(now_ns),
                "message": vehicle.message,
            }
            self._stream.write(msgspec.json.encode(row).decode() + "\n")
        self._stream.flush()

    def close(self) -> None:
        """Nothing is kept back."""


# ------------------------------------------------------------------------------------------ what is shown


def vehicle_line(vehicle: Vehicle, now_ns: int) -> str:
    """`uav=… link=… age_s=…`, then the keys of `companion.view.plain_line`."""
    age_s = vehicle.age_s(now_ns)
    age = "-" if age_s is None else f"{age_s:.1f}"
    head = f"uav={vehicle.uav} link={vehicle.link(now_ns).value} age_s={age}"
    if vehicle.message is not None:
        return f"{head} {plain_line(vehicle.message.status, vehicle.t0_ns)}"
    return f"{head} unreadable={vehicle.unreadable} problem={vehicle.problem or '-'}"


def screen(fleet: Fleet, missing: str, now_ns: int) -> RenderableType:
    """Everything: what is awaited, the table, of a single vehicle its panel."""
    parts: list[RenderableType] = []
    vehicles = fleet.vehicles()
    if missing:
        parts.append(Text(missing, style="yellow"))
    if vehicles:
        parts.append(_table(vehicles, now_ns))
    if len(vehicles) == 1 and vehicles[0].message is not None and vehicles[0].link(now_ns) is Link.LIVE:
        parts.append(panel(vehicles[0].message.status, vehicles[0].t0_ns))
    else:
        parts += [Text(f"{v.uav} {line}", style="yellow") for v in vehicles for line in _lines(v)]
    parts += [
        Text(f"{v.uav}: {v.unreadable} unreadable: {v.problem}", style="red") for v in vehicles if v.problem
    ]
    if fleet.turned_away:
        parts.append(Text(f"{fleet.turned_away} messages of other ids are not shown", style="red"))
    return Group(*parts)


def _lines(vehicle: Vehicle) -> list[str]:
    """What a person should know besides the table."""
    if vehicle.message is None:
        return []
    s = vehicle.message.status
    return [f"awaits {awaited}" for awaited in s.awaited] + [f"warns: {warning}" for warning in s.warnings]


def _table(vehicles: list[Vehicle], now_ns: int) -> Table:
    table = Table(box=None, pad_edge=False, header_style="dim")
    for name in ("vehicle", "link"):
        table.add_column(name, no_wrap=True)
    for name in ("phase", "mode"):
        table.add_column(name, no_wrap=True)
    for name in ("to", "distance", "bearing", "range", "height", "speed", "path"):
        table.add_column(name, justify="right" if name != "to" else "left", no_wrap=True)
    for vehicle in vehicles:
        table.add_row(Text(vehicle.uav, style="bold"), *_cells(vehicle, now_ns))
    return table


def _cells(vehicle: Vehicle, now_ns: int) -> list[Text]:
    link, age_s = vehicle.link(now_ns), vehicle.age_s(now_ns)
    heard = (
        link.value
        if link is Link.LIVE
        else f"{link.value}, " + ("never heard" if age_s is None else f"{age_s:.0f} s ago")
    )
    if vehicle.lost:
        heard += f", {vehicle.lost} lost"
    cells = [Text(heard, style=_LINK_STYLE[link])]
    if vehicle.message is None:
        return cells
    m, s, e = vehicle.message, vehicle.message.status, vehicle.message.status.estimate
    style = "" if link is Link.LIVE else "dim"
    cells.append(Text(s.phase.value.upper(), style=PHASE_STYLE[s.phase] if link is Link.LIVE else "dim"))
    plain = [
        s.mode.value if s.mode is not None else "–",
        m.target,
        "–" if e is None else f"{e.distance_m:.2f} ± {e.distance_sigma_m:.2f} m",
        "–" if e is None else f"{_side(e.bearing_rad)} ± {math.degrees(e.bearing_sigma_rad):.0f}°",
        "–" if s.range_m is None else f"{s.range_m:.2f} m",
        "–" if s.height_m is None else f"{s.height_m:.1f} m",
        "–" if s.speed_m_s is None else f"{s.speed_m_s:.2f} m/s",
        f"{s.path_m:.1f} m",
    ]
    return cells + [Text(text, style=style) for text in plain]


def _side(bearing_rad: float) -> str:
    return f"{abs(math.degrees(bearing_rad)):.0f}° {'right' if bearing_rad >= 0.0 else 'left'}"
