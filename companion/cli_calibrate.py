"""The command line of `companion calibrate`: ranges over known distances become a beacon's bias and noise."""

from __future__ import annotations

import argparse
import math
import re
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from companion.cli_publish import FAMILIES
from companion.exits import Exit

if TYPE_CHECKING:
    from companion.calibrate import Group

EXAMPLES = (
    "companion publish --serial /dev/ttyACM0 --format qorvo-cli --zenoh-listen tcp/127.0.0.1:0 "
    "--save near.jsonl\n"
    "  companion calibrate near.jsonl far.jsonl --distance 5 --distance 20 --beacon 0x0001 --as b1 "
    "-o b1.toml --png b1.png\n"
    "  companion calibrate FLIGHT.mcap --beacon b1 --distance 5@0-60 --distance 20@80-140"
)


class Known(NamedTuple):
    """A known distance, and the seconds of the recording that it holds for."""

    distance_m: float
    from_s: float
    to_s: float


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument(
        "files",
        metavar="FILE",
        type=Path,
        nargs="+",
        help="a recorded flight (MCAP), JSON lines or CSV of ranges, or a module's own output (--format)",
    )
    parser.add_argument("--beacon", metavar="ID", required=True, help="the beacon, as the file names it")
    parser.add_argument(
        "--distance",
        metavar="M[@FROM-TO]",
        type=_known,
        action="append",
        required=True,
        help="true distance between the antennas: one for each FILE, in order; or several of one FILE, each "
        "with the seconds from its first range that it holds for",
    )
    parser.add_argument("--as", dest="name", metavar="ID", help="the beacon's id in the configuration")
    parser.add_argument("--format", choices=FAMILIES, help="format of files that are not MCAP")
    parser.add_argument(
        "--fit",
        choices=("auto", "constant", "distance", "power"),
        default="auto",
        help="what the bias depends on (auto: the simplest that explains the means)",
    )
    parser.add_argument("-o", "--output", metavar="FILE", type=Path, help="write the configuration there too")
    parser.add_argument("--png", metavar="FILE", type=Path, help="draw errors, spread and fit")


def _known(text: str) -> Known:
    number = r"\d+(?:\.\d*)?|\.\d+"
    match = re.fullmatch(rf"({number})(?:@({number})-({number}))?", text)
    if match is None:
        raise argparse.ArgumentTypeError(
            f"{text}: expected metres, or metres@from-to in seconds, such as 5@0-60"
        )
    distance_m = float(match[1])
    from_s, to_s = (0.0, math.inf) if match[2] is None else (float(match[2]), float(match[3]))
    if not 0.0 < distance_m <= 10_000.0 or not from_s < to_s:
        raise argparse.ArgumentTypeError(f"{text}: a distance is above 0 m, a span ends after it begins")
    return Known(distance_m, from_s, to_s)


def run(args: argparse.Namespace) -> Exit:
    """Calibrate. Raises ValueError or CalibrationError in one line for a person."""
    from companion.calibrate import CalibrationError, Fit, calibrate, text

    if args.output is not None and args.output.exists():
        raise CalibrationError(f"{args.output} is there already: name another file, or remove it")
    if args.png is not None and not args.png.parent.is_dir():
        raise CalibrationError(f"{args.png}: no such directory")
    found = calibrate(_name(args.name or args.beacon), _groups(args), Fit(args.fit))
    toml = text(found, _command(args))
    print(toml, end="")
    try:
        if args.output is not None:
            args.output.write_text(toml, encoding="utf-8")
            print(f"wrote {args.output}", file=sys.stderr)
        if args.png is not None:
            _draw(args.png, found)
    except OSError as error:
        raise CalibrationError(f"{error.filename}: {error.strerror or error}") from error
    return Exit.OK


def _command(args: argparse.Namespace) -> str:
    """How the same is found again."""
    words = ["companion", "calibrate", *map(str, args.files), "--beacon", args.beacon]
    for k in args.distance:
        words += [
            "--distance",
            f"{k.distance_m:g}" + (f"@{k.from_s:g}-{k.to_s:g}" if k.to_s < math.inf else ""),
        ]
    return shlex.join(words if args.fit == "auto" else [*words, "--fit", args.fit])


def _groups(args: argparse.Namespace) -> list[Group]:
    from companion.calibrate import CalibrationError, group
    from companion.calibrate.source import points
    from companion.uwb.families import Family

    files: list[Path] = args.files
    known: list[Known] = args.distance
    family = None if args.format is None else Family(args.format)
    if len(files) == 1:
        files = files * len(known)
    if len(files) != len(known):
        raise CalibrationError(
            f"{len(args.files)} files, {len(known)} distances: one --distance for each FILE, in their order"
        )
    if len(args.files) == 1 and len(known) > 1 and any(k.to_s == math.inf for k in known):
        raise CalibrationError("several distances of one file need their seconds: --distance 5@0-60")
    read = {path: points(path, args.beacon, family) for path in dict.fromkeys(files)}
    return [
        group(k.distance_m, [p for p in read[path] if k.from_s <= p.t_s <= k.to_s], str(path))
        for path, k in zip(files, known, strict=True)
    ]


def _name(text: str) -> str:
    from companion.network_settings import NAME_RULE, is_name

    if not is_name(text):
        raise ValueError(f"{text[:80]!r} is no id for the configuration ({NAME_RULE}): name one with --as")
    return text


def _draw(path: Path, found: object) -> None:
    from companion.calibrate import Calibration, CalibrationError

    assert isinstance(found, Calibration)
    try:
        from companion.calibrate.picture import draw
    except ImportError as error:
        raise CalibrationError(f"no picture: {error}; pip install 'companion[design]'") from error
    draw(path, found)
    print(f"wrote {path}", file=sys.stderr)
