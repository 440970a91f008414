"""The outcome of the matrix as one table: for the terminal, as Markdown, as JSON."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from typing import NamedTuple, Protocol

import msgspec
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from companion.types import Phase
from tests.safety.faults.flight import Outcome
from tests.safety.faults.rules import EVERY, Rule
from tests.safety.faults.watch import Limits

_SHOWN_STEPS = 4
_WIDE = 120
"""Columns of a terminal that has room for everything."""


class Described(Protocol):
    """What the table tells of a fault, simulated or on the wire."""

    @property
    def name(self) -> str: ...
    @property
    def family(self) -> str: ...
    @property
    def what(self) -> str: ...
    @property
    def rules(self) -> Mapping[Phase, Rule]: ...


class Row(NamedTuple):
    """What a fault came to in one phase or in several, over all seeds."""

    fault: str
    family: str
    what: str
    phases: tuple[str, ...]
    did: str
    took_s: float | None
    limits: str
    rule: str
    flights: int
    broken: tuple[str, ...]


def did(outcome: Outcome) -> str:
    """What the app did after the strike, in words."""
    if outcome.not_struck:
        return outcome.not_struck
    names = [step.phase.value for step in outcome.steps]
    if len(names) > _SHOWN_STEPS:
        names[_SHOWN_STEPS - 1 : -1] = ["…"]
    if outcome.dead:
        names.append("dead")
    return " → ".join(names) or f"stays in {outcome.struck_in.value}"


def rows(faults: Mapping[str, Described], outcomes: Iterable[Outcome]) -> list[Row]:
    """One row for every fault and kind of outcome: phases that came to the same stand together."""
    cells: dict[tuple[str, int], list[Outcome]] = {}
    for outcome in outcomes:
        cells.setdefault((outcome.fault, EVERY.index(outcome.struck_in)), []).append(outcome)
    merged: dict[tuple[str, str, str, tuple[str, ...]], list[Outcome]] = {}
    for (name, number), cell in sorted(cells.items(), key=lambda c: (list(faults).index(c[0][0]), c[0][1])):
        usual, _ = Counter(map(did, cell)).most_common(1)[0]
        rule = faults[name].rules[EVERY[number]].says
        merged.setdefault((name, usual, rule, _broken(cell)), []).extend(cell)
    return [_row(faults[key[0]], key[1], key[2], key[3], cell) for key, cell in merged.items()]


def _broken(cell: list[Outcome]) -> tuple[str, ...]:
    told = [
        f"{what} (seed {o.seed}, {o.struck_in.value})"
        for o in cell
        for what in (*o.judgement.broken, *o.law_broken, o.not_struck)
        if what
    ]
    return tuple(told)


def _row(fault: Described, usual: str, rule: str, broken: tuple[str, ...], cell: list[Outcome]) -> Row:
    alike = sum(did(o) == usual for o in cell)
    took = [o.judgement.took_s for o in cell if o.judgement.took_s is not None]
    worst = Limits()
    for outcome in cell:
        worst = worst.and_also(outcome.limits)
    return Row(
        fault.name,
        fault.family,
        fault.what,
        tuple(dict.fromkeys(o.struck_in.value for o in cell)),
        usual if alike == len(cell) else f"{usual} ({alike} of {len(cell)})",
        max(took) if took else None,
        limits(worst),
        rule,
        len(cell),
        broken,
    )


def limits(worst: Limits) -> str:
    """The most that the vehicle did in OFFBOARD, in words."""
    if not worst.height_max_m:
        return "not in OFFBOARD"
    return (
        f"{worst.speed_m_s:.2f} m/s, {worst.yaw_rate_rad_s:.2f} rad/s, "
        f"{worst.height_min_m:.1f}–{worst.height_max_m:.1f} m high, {worst.distance_m:.1f} m away"
    )


_COLUMNS = ("fault", "what happens", "in phase", "the app did", "within", "most in OFFBOARD", "rule", "held")


def _cells(row: Row) -> tuple[str, ...]:
    took = "" if row.took_s is None else f"{row.took_s:.2f} s"
    held = f"{row.flights} of {row.flights}" if not row.broken else "BROKEN: " + row.broken[0]
    return row.fault, row.what, ", ".join(row.phases), row.did, took, row.limits, row.rule, held


def markdown(table: list[Row], headline: str) -> str:
    """The table as Markdown."""
    lines = [headline, "", "| " + " | ".join(_COLUMNS) + " |", "|---" * len(_COLUMNS) + "|"]
    lines += ["| " + " | ".join(_cells(row)) + " |" for row in table]
    return "\n".join(lines) + "\n"


def as_json(table: list[Row]) -> bytes:
    """The table as a JSON array of objects."""
    return msgspec.json.format(msgspec.json.encode([row._asdict() for row in table]))


def headline(table: list[Row], took_s: float) -> str:
    """All of it in a sentence."""
    flown = sum(row.flights for row in table)
    faults = len({row.fault for row in table})
    broken = sum(bool(row.broken) for row in table)
    verdict = "every rule held" if not broken else f"{broken} rows with a BROKEN RULE"
    return f"{faults} faults, {flown} flights, {took_s:.0f} s: {verdict}"


def show(table: list[Row], words: str, console: Console) -> None:
    """Print the table for people, and in full what was broken."""
    wide = console.width >= _WIDE
    shown = Table(box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1), header_style="bold")
    shown.add_column("fault", min_width=26 if wide else 16, ratio=3)
    shown.add_column("in phase", min_width=9, ratio=2)
    shown.add_column("the app did", ratio=3)
    shown.add_column("within", justify="right", no_wrap=True)
    if wide:
        shown.add_column("most in OFFBOARD", ratio=3)
    shown.add_column("rule", ratio=3)
    shown.add_column("held", no_wrap=True, min_width=4)
    name = ""
    for row in table:
        fault, what, phases, did_, took, most, rule, _ = _cells(row)
        held = Text("yes", "green") if not row.broken else Text("NO", "bold red")
        title = Text("") if fault == name else Text.assemble((fault, "bold"), "\n", (what, "dim"))
        shown.add_row(title, phases, did_, took, *([most] if wide else []), rule, held)
        name = fault
    console.print(shown)
    for row in table:
        for what in row.broken:
            console.print(f"BROKEN: {row.fault}: {what}", style="red", highlight=False)
    console.print(words, style="bold", highlight=False)
