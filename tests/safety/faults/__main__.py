"""The fault matrix from the command line: `python -m tests.safety.faults`."""

from __future__ import annotations

import argparse
import itertools
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from time import monotonic

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from tests.safety.faults import report, wire
from tests.safety.faults.batch import Flown, flights, fly_all
from tests.safety.faults.flight import Outcome
from tests.safety.faults.matrix import FAULTS
from tests.safety.faults.rules import EVERY
from tests.safety.faults.wire import WIRE

_DESCRIPTION = """\
Lets every fault strike in every phase. What the app does is held against the rule for that fault, and
against the law for all: limits, no speed without OFFBOARD, armed, heading and ranges, no setpoint twice.
Faults named wire/… run the app and the mock as processes, over UDP and Zenoh, in real time, one by one."""
_EPILOG = """\
examples:
  python -m tests.safety.faults                                   all of it, five seeds each
  python -m tests.safety.faults --only range-loss held-up-3s      some faults
  python -m tests.safety.faults --phase approach --seeds 50       one phase, many seeds
  python -m tests.safety.faults --only wire/kill-9 wire/sigstop   real processes
exit status: 0 every rule held, 1 a rule was broken, 2 wrong command line"""

KNOWN: Mapping[str, report.Described] = {**FAULTS, **WIRE}
"""Every fault, in the order of the table."""


def main(argv: Sequence[str] | None = None) -> int:
    """Fly the matrix; returns the exit status."""
    args = _parser().parse_args(argv)
    names = args.only or [name for name in KNOWN if not (args.simulated and name in WIRE)]
    phases = args.phase or [phase.value for phase in EVERY]
    todo = flights([n for n in names if n in FAULTS], phases, range(1, args.seeds + 1))
    on_wire = [WIRE[n] for n in names if n in WIRE and "approach" in phases]
    if not todo and not on_wire:
        print("faults: none of these strikes in such a phase: see --only and --phase", file=sys.stderr)
        return 2
    began = monotonic()
    outcomes = list(_shown(itertools.chain(fly_all(todo, args.jobs), map(wire.fly, on_wire)), todo, on_wire))
    table = report.rows(KNOWN, outcomes)
    headline = report.headline(table, monotonic() - began)
    if args.out is not None:
        args.out.mkdir(parents=True, exist_ok=True)
        (args.out / "faults.md").write_text(report.markdown(table, headline), encoding="utf-8")
        (args.out / "faults.json").write_bytes(report.as_json(table))
    if args.json:
        sys.stdout.write(report.as_json(table).decode() + "\n")
    else:
        report.show(table, headline, Console(width=None if sys.stdout.isatty() else 150))
        if args.out is not None:
            print(f"written: {args.out / 'faults.md'}, {args.out / 'faults.json'}")
    return 1 if any(row.broken for row in table) else 0


def _shown(
    outcomes: Iterator[Outcome], todo: list[Flown], on_wire: list[wire.WireFault]
) -> Iterator[Outcome]:
    """The same, with a progress bar on a terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    errors = Console(stderr=True)
    with Progress(*columns, console=errors, transient=True, disable=not errors.is_terminal) as progress:
        simulated = progress.add_task("simulated flights", total=len(todo), visible=bool(todo))
        real = progress.add_task("flights on the wire", total=len(on_wire), visible=bool(on_wire))
        for outcome in outcomes:
            progress.advance(real if outcome.fault in WIRE else simulated)
            yield outcome


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tests.safety.faults",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    phases = [phase.value for phase in EVERY]
    parser.add_argument(
        "--only",
        metavar="FAULT",
        nargs="+",
        choices=list(KNOWN),
        help="these faults only (as named in the table)",
    )
    parser.add_argument("--simulated", action="store_true", help="leave out the faults on the wire")
    parser.add_argument("--phase", metavar="PHASE", nargs="+", choices=phases, help=", ".join(phases))
    parser.add_argument(
        "--seeds", metavar="N", type=_at_least_one, default=5, help="seeds 1 to N (%(default)s)"
    )
    parser.add_argument(
        "--jobs", metavar="N", type=_at_least_one, default=os.cpu_count() or 1, help="processes"
    )
    parser.add_argument("--out", metavar="DIR", type=Path, help="write faults.md and faults.json there")
    parser.add_argument("--json", action="store_true", help="print the table as JSON")
    return parser


def _at_least_one(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError("must be at least 1")
    return number


if __name__ == "__main__":
    sys.exit(main())
