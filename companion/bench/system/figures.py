"""The figures of the benchmark: what was measured, what it is held against, as a table, JSON and Markdown."""

from __future__ import annotations

import os
import platform
import sysconfig
from collections.abc import Iterable

import msgspec

from companion.compiled import form

ALL_ON = "`companion fly` as it stands, with record, status, ground station's messages and live view"


class Figure(msgspec.Struct, frozen=True):
    """One measured quantity. `is_ratio`: it is held against the floor, not on its own.

    `least_ratio`: the smallest ratio of all turns. A neighbour disturbs one turn, or the other.
    """

    key: str
    what: str
    unit: str
    value: float
    goal: float
    floor: float | None = None
    is_ratio: bool = False
    at_least: bool = False
    least_ratio: float | None = None

    @property
    def ratio(self) -> float | None:
        """How many times the floor; None: it has none."""
        return None if not self.floor else self.value / self.floor

    @property
    def judged(self) -> float:
        """What the goal is about: the ratio or the value."""
        ratio = self.ratio
        return ratio if self.is_ratio and ratio is not None else self.value

    @property
    def reached(self) -> bool:
        """True where the goal is met."""
        return self.judged >= self.goal if self.at_least else self.judged <= self.goal

    @property
    def failed(self) -> bool:
        """True where a ratio is twice its goal in every turn: no machine and no neighbour explains that."""
        least = self.judged if self.least_ratio is None else self.least_ratio
        return self.is_ratio and min(self.judged, least) > 2.0 * self.goal


class Machine(msgspec.Struct, frozen=True):
    """Where it was measured. `load`: processes that wanted a core, before the benchmark began.

    `core`: that of this app, "compiled" or "not compiled".
    """

    python: str
    system: str
    cores: int
    load: float
    core: str = "not compiled"


class Report(msgspec.Struct, frozen=True):
    """All figures of one run.

    `latencies_s`: quantiles in even steps from 0 to 1, for each program and rate.
    """

    short: bool
    machine: Machine
    figures: tuple[Figure, ...]
    sizes_mib: dict[str, float]
    latencies_s: dict[str, tuple[float, ...]]
    not_measured: tuple[str, ...]

    @property
    def failed(self) -> list[Figure]:
        """Ratios that are twice their goal."""
        return [figure for figure in self.figures if figure.failed]


def table(report: Report) -> str:
    """For a terminal."""
    m = report.machine
    lines = [
        f"Python {m.python}, core {m.core}, {m.system}, {m.cores} cores, load {m.load:.1f} before"
        + (", short form: good for ratios only" if report.short else ""),
        f"{'':62}{'companion':>11}{'floor':>9}{'ratio':>7}   goal",
    ]
    for f in report.figures:
        floor = "" if f.floor is None else _number(f.floor)
        ratio = "" if f.ratio is None else f"{f.ratio:.2f}"
        lines.append(
            f"{f.what + ', ' + f.unit:62}{_number(f.value):>11}{floor:>9}{ratio:>7}   "
            f"{_goal(f):14}{'' if f.reached else ' missed'}"
        )
    if report.sizes_mib:
        total = sum(report.sizes_mib.values())
        parts = ", ".join(f"{name} {mib:.1f}" for name, mib in report.sizes_mib.items() if mib >= 0.05)
        lines.append(f"installed for a flight, without extras: {total:.0f} MiB ({parts})")
    lines.append(f"all on: {ALL_ON}")
    lines += [f"not measured: {words}" for words in report.not_measured]
    return "\n".join(lines)


def markdown(report: Report) -> str:
    """For the README."""
    m = report.machine
    lines = [
        f"Measured with Python {m.python}, the core {m.core}, on {m.cores} cores ({m.system}), "
        f"load {m.load:.1f} before"
        f"{', short form' if report.short else ''}.",
        f"All on: {ALL_ON}.",
        "Bold: the goal is missed.",
        "",
        "| | companion | floor | ratio | goal |",
        "|---|---|---|---|---|",
    ]
    for f in report.figures:
        floor = "" if f.floor is None else f"{_number(f.floor)} {f.unit}"
        ratio = "" if f.ratio is None else f"{f.ratio:.2f}"
        goal = _goal(f) if f.reached else f"**{_goal(f)}**"
        lines.append(f"| {f.what} | {_number(f.value)} {f.unit} | {floor} | {ratio} | {goal} |")
    if report.sizes_mib:
        largest = ", ".join(f"{name} {mib:.0f}" for name, mib in list(report.sizes_mib.items())[:4])
        total = sum(report.sizes_mib.values())
        lines.append(f"| installed for a flight, without extras | {total:.0f} MiB ({largest}) | | | |")
    return "\n".join(lines) + "\n"


def _goal(f: Figure) -> str:
    return f"{'≥' if f.at_least else '≤'} {f.goal:g}{' ×' if f.is_ratio else ' ' + f.unit}"


def _number(value: float) -> str:
    return f"{value:.0f}" if abs(value) >= 99.5 else f"{value:.3g}"


def here(load: float) -> Machine:
    """This machine."""
    system = f"{platform.system()} {platform.machine()}"
    is_optimised = "--enable-optimizations" in str(sysconfig.get_config_var("CONFIG_ARGS"))
    built = "" if is_optimised else " (built without --enable-optimizations)"
    return Machine(platform.python_version() + built, system, os.cpu_count() or 1, round(load, 1), form())


def quantile(values: Iterable[float], share: float) -> float:
    """The nearest rank."""
    ordered = sorted(values)
    return ordered[min(int(share * len(ordered)), len(ordered) - 1)]
