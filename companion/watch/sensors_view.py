"""The sensor network in a terminal: a table, painted in place or once; elsewhere plain lines or JSON."""

from __future__ import annotations

from collections.abc import Sequence
from typing import IO

import msgspec
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from companion.lines import counts, listed, number, write_lines
from companion.types import LineOfSight
from companion.uwb.info import BeaconInfo
from companion.watch.fleet import Link
from companion.watch.sensors import BeaconRow

_LINK_STYLE = {Link.LIVE: "green", Link.SILENT: "bold red", Link.GONE: "red"}
_LOS_STYLE = {LineOfSight.LOS: "green", LineOfSight.NLOS: "yellow", LineOfSight.UNKNOWN: "dim"}


class TableScreen:
    """A table in place, four times a second; it stays when the screen is closed."""

    period_s = 0.25

    def __init__(self, stream: IO[str]) -> None:
        self._live = Live(console=Console(file=stream, highlight=False), auto_refresh=False)
        self._live.start()

    def show(self, rows: Sequence[BeaconRow], missing: str) -> None:
        """Paint. `missing`: what is awaited, '' for nothing."""
        self._live.update(table(rows, missing), refresh=True)

    def close(self) -> None:
        """Leave the last picture where it is."""
        self._live.stop()


class LineScreen:
    """A line of `key=value` a second for each beacon and tag, made for grep."""

    period_s = 1.0

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream
        self._missing = ""

    def show(self, rows: Sequence[BeaconRow], missing: str) -> None:
        """A line for each; what is awaited once."""
        lines = [missing] if missing and missing != self._missing else []
        self._missing = missing
        write_lines(self._stream, [*lines, *map(beacon_line, rows)])

    def close(self) -> None:
        """Nothing is kept back."""


class JsonScreen:
    """One JSON object a second: `{"missing": …, "beacons": […]}`."""

    period_s = 1.0

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def show(self, rows: Sequence[BeaconRow], missing: str) -> None:
        """A line."""
        write_lines(self._stream, [msgspec.json.encode({"missing": missing, "beacons": rows}).decode()])

    def close(self) -> None:
        """Nothing is kept back."""


class OnceScreen:
    """Nothing until it is closed, then what was shown last: a table, or one JSON object."""

    period_s = 0.25

    def __init__(self, stream: IO[str], json: bool) -> None:
        self._stream = stream
        self._json = json
        self._last: tuple[Sequence[BeaconRow], str] = ((), "")

    def show(self, rows: Sequence[BeaconRow], missing: str) -> None:
        """Keep it."""
        self._last = (rows, missing)

    def close(self) -> None:
        """Print; as wide as it needs to be where the stream is no terminal."""
        if self._json:
            JsonScreen(self._stream).show(*self._last)
            return
        width = None if self._stream.isatty() else 200
        Console(file=self._stream, highlight=False, width=width).print(table(*self._last))


SensorScreen = TableScreen | LineScreen | JsonScreen | OnceScreen


def open_screen(stream: IO[str], once: bool, json: bool) -> SensorScreen:
    """What was asked for: by default the table on a terminal, lines elsewhere."""
    if once:
        return OnceScreen(stream, json)
    if json:
        return JsonScreen(stream)
    return TableScreen(stream) if stream.isatty() else LineScreen(stream)


def beacon_line(row: BeaconRow) -> str:
    """One line of `key=value`: the keys and their order do not change; `-` where not known."""
    fields = (
        ("beacon", row.beacon),
        ("tag", row.tag or "-"),
        ("link", row.link.value),
        ("alive", "yes" if row.alive else "no"),
        ("rate_hz", f"{row.rate_hz:.1f}"),
        ("age_s", number(row.age_s, 2)),
        ("range_m", number(row.range_m, 2)),
        ("sigma_m", number(row.sigma_m, 3)),
        ("los", "-" if row.los is None else row.los.value),
        ("rssi_dbm", number(row.rssi_dbm, 1)),
        ("sessions", str(len(row.sessions))),
        ("believed", str(row.believed)),
        ("refused", counts(row.refused)),
        ("malformed", counts(row.malformed)),
        ("lost", str(row.lost)),
        ("notes", listed(row.notes)),
    )
    return " ".join(f"{key}={value}" for key, value in fields)


_LEFT = ("beacon", "tag", "link", "sight")
_RIGHT = ("Hz", "age", "range", "σ", "dBm", "good", "bad")


def table(rows: Sequence[BeaconRow], missing: str) -> RenderableType:
    """What is awaited, the table, and what is to be said of each."""
    parts: list[RenderableType] = [Text(missing, style="yellow")] if missing else []
    if rows:
        grid = Table(box=None, pad_edge=False, header_style="dim")
        for name in (*_LEFT, *_RIGHT):
            grid.add_column(name, justify="right" if name in _RIGHT else "left", no_wrap=True)
        for row in rows:
            grid.add_row(*_cells(row))
        parts.append(grid)
    parts += [line for row in rows for line in _lines(row)]
    return Group(*parts)


def _cells(row: BeaconRow) -> list[Text]:
    los = row.los or LineOfSight.UNKNOWN
    bad = sum(row.refused.values()) + sum(row.malformed.values()) + row.lost
    return [
        Text(row.beacon, style="bold"),
        Text(row.tag or "–"),
        Text(row.link.value, style=_LINK_STYLE[row.link]),
        Text("–" if row.los is None else los.value, style=_LOS_STYLE[los]),
        Text(f"{row.rate_hz:.1f}"),
        Text("–" if row.age_s is None else f"{row.age_s:.2f} s"),
        Text("–" if row.range_m is None else f"{row.range_m:.2f} m", style="bold"),
        Text("–" if row.sigma_m is None else f"{row.sigma_m:.3f} m"),
        Text("–" if row.rssi_dbm is None else f"{row.rssi_dbm:.0f}"),
        Text(str(row.believed)),
        Text(str(bad), style="yellow" if bad else "dim"),
    ]


def _lines(row: BeaconRow) -> list[Text]:
    """What the table has no room for."""
    name = f"{row.beacon} to {row.tag}" if row.tag else row.beacon
    bad = {**row.refused, **row.malformed, **({"lost": row.lost} if row.lost else {})}
    lines = []
    if bad:
        why = ", ".join(f"{reason} {count}" for reason, count in sorted(bad.items()))
        lines.append(Text(f"{name}: {why}", style="yellow"))
    if row.link is Link.LIVE and not row.alive:
        lines.append(
            Text(f"{name}: no liveliness token: its end shows only when ranges stop", style="yellow")
        )
    lines += [Text(f"{name}: {note}", style="yellow") for note in row.notes]
    if row.info is not None and (told := _info(row.info)):
        lines.append(Text(f"{name}: tells {told}", style="dim"))
    return lines


def _info(about: BeaconInfo) -> str:
    told = (
        (about.height_m, "height {:g} m"),
        (about.bias_m, "bias {:g} m"),
        (about.sigma_m, "σ {:g} m"),
    )
    return ", ".join(form.format(value) for value, form in told if value is not None)
