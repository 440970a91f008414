"""The outcome of a check: rows with a verdict each, as a table for people and as JSON for programs."""

from __future__ import annotations

import textwrap
from enum import Enum

import msgspec


class State(Enum):
    """A verdict. Only `FAIL` keeps a flight from being ready."""

    OK = "ok"
    WARN = "warn"
    FAIL = "fail"


class Part(Enum):
    """What a row is about, in the order of the table."""

    LINK = "link"
    AUTOPILOT = "autopilot"
    ESTIMATE = "estimate"
    TELEMETRY = "telemetry"
    PARAMETERS = "parameters"
    RANGES = "ranges"
    CONFIGURATION = "configuration"


class Row(msgspec.Struct, frozen=True):
    """One thing looked at: what was found, and where it is not fine, why that matters and what to do."""

    part: Part
    subject: str
    state: State
    found: str
    why: str = ""
    do: str = ""


def never_came(part: Part, name: str, watched_s: float, why: str, state: State = State.WARN) -> Row:
    """Something never came, by name, after its time."""
    return Row(
        part,
        name,
        state,
        f"never came within {watched_s:.1f} s of asking",
        why,
        "the link may lose packets or be too slow, or this autopilot has no such thing: ask it with a ground "
        "station",
    )


class CheckReport(msgspec.Struct, frozen=True):
    """Every row, in the order of the table."""

    rows: tuple[Row, ...]

    @property
    def ready(self) -> bool:
        """True where nothing failed."""
        return not any(row.state is State.FAIL for row in self.rows)

    def count(self, state: State) -> int:
        """How many rows have this verdict."""
        return sum(row.state is state for row in self.rows)

    def json(self) -> bytes:
        """`{"ready": …, "rows": [{part, subject, state, found, why, do}, …]}`."""
        return msgspec.json.format(msgspec.json.encode({"ready": self.ready, "rows": self.rows}), indent=2)


_COLOUR = {State.OK: "\x1b[32m", State.WARN: "\x1b[33m", State.FAIL: "\x1b[1;31m"}
_PLAIN = "\x1b[0m"
_LABEL = {State.OK: "ok", State.WARN: "warn", State.FAIL: "FAIL"}


def text(report: CheckReport, width: int = 110, colour: bool = False) -> str:
    """The table. What is fine takes one line; what is not says why and what to do."""
    indent = 2 + 6 + max((len(row.subject) for row in report.rows), default=0) + 2
    lines: list[str] = []
    for part in Part:
        rows = [row for row in report.rows if row.part is part]
        if rows:
            lines += ["", part.value]
        for row in rows:
            label = f"{_LABEL[row.state]:4}"
            if colour:
                label = f"{_COLOUR[row.state]}{label}{_PLAIN}"
            found = _wrap(row.found, width - indent) or [""]
            head = f"{row.subject:{indent - 8}}"
            lines.append(f"  {label}  {head}{found[0]}")
            more = found[1:] + _wrap(row.why, width - indent) + _wrap(row.do, width - indent, "→ ")
            lines += [" " * indent + line for line in more]
    failed, odd = report.count(State.FAIL), report.count(State.WARN)
    look = f"{odd} to look at" if odd else "nothing to look at"
    ending = f"READY to fly, {look}." if report.ready else f"NOT READY: {failed} to mend, {look}."
    return "\n".join([*lines[1:], "", ending])


def _wrap(words: str, width: int, mark: str = "") -> list[str]:
    words = "".join(c if c.isprintable() else " " for c in words)  # ids come from the wire
    return textwrap.wrap(
        words,
        max(width, 30),
        initial_indent=mark,
        subsequent_indent=" " * len(mark),
        break_long_words=False,
        break_on_hyphens=False,  # a path is to be copied
    )
