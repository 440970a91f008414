"""The command line, and the only place where everything is put together.

Each command imports what it needs when it runs, so that `--help` is quick and a flight loads nothing of the
desk's tools.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from companion import cli_calibrate, cli_keys, cli_publish, cli_watch, commands
from companion.exits import MEANING, Exit

_EXITS = "exit status:\n" + "\n".join(f"  {int(e):3d}  {text}" for e, text in MEANING.items())


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; the result is the process's exit status."""
    parser = _parser()
    args = parser.parse_args(argv)
    command: Callable[[argparse.Namespace], int] = args.command
    try:
        return command(args)
    except commands.UsageError as error:
        print(f"companion: {error}", file=sys.stderr)
        return Exit.USAGE
    except KeyboardInterrupt:  # Ctrl-C where nothing more orderly is needed
        return Exit.INTERRUPTED
    except BrokenPipeError:  # the reader of our output (head, less) has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return Exit.OK


# ---------------------------------------------------------------------------------------------- parser


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="companion",
        description="Fly a drone to a target from distances alone: UWB ranges in over Zenoh, "
        "OFFBOARD setpoints out over MAVLink.",
        epilog=_EXITS,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action=_Version)
    verbs = parser.add_subparsers(metavar="COMMAND", required=True)

    fly = _command(
        verbs,
        "fly",
        commands.fly,
        "fly the vehicle on a MAVLink link to the target",
        "companion fly --config config/capture.toml --mavlink udpin:0.0.0.0:14540 "
        "--zenoh-connect tcp/192.168.1.10:7447\n"
        "  companion fly --config config/capture.toml --mavlink serial:/dev/ttyAMA0:921600 "
        "--set guidance.speed_m_s=0.4\n"
        "  companion fly --config config/capture.toml --shadow   # look first: nothing is steered",
        _EXITS,
    )
    _config_options(fly)
    _link_options(fly)
    fly.add_argument(
        "--shadow",
        action="store_true",
        help="compute, show and record everything while somebody else flies; send nothing but the heartbeat",
    )
    fly.add_argument(
        "--view",
        choices=("auto", "live", "plain", "json", "none"),
        default="auto",
        help="what to show (auto: live on a terminal, else a line per second)",
    )
    fly.add_argument(
        "--record", metavar="FILE", type=Path, help="MCAP file of the flight (default: flights/TIME.mcap)"
    )
    fly.add_argument("--json", metavar="FILE", type=Path, help="write summary and trail as JSON at the end")
    fly.add_argument("--png", metavar="FILE", type=Path, help="draw the flight at the end")

    replay = _command(
        verbs,
        "replay",
        commands.replay,
        "feed a recorded flight to the pilot again and compare every output, bit for bit",
        "companion replay flights/2026-11-22T10-15-00Z.mcap\n"
        "  companion replay FLIGHT.mcap --set guidance.speed_m_s=0.4   # what would have been commanded",
        _EXITS,
    )
    replay.add_argument("file", metavar="FLIGHT.mcap", type=Path)
    _config_options(replay)
    replay.add_argument("--json", action="store_true", help="print one JSON object")

    report = _command(
        verbs,
        "report",
        commands.report,
        "a recorded flight as one page with map and plots that works offline, and as figures",
        "companion report flights/2026-11-22T10-15-00Z.mcap          # writes ….html beside it\n"
        "  companion report FLIGHT.mcap -o flight.html --png flight.png\n"
        "  companion report FLIGHT.mcap --json | jq .summary.path_ratio",
        _EXITS,
    )
    report.add_argument("file", metavar="FLIGHT.mcap", type=Path)
    report.add_argument(
        "-o",
        "--output",
        metavar="FILE",
        type=Path,
        help="the page, or a directory for it (default: beside the flight, ending in .html)",
    )
    report.add_argument("--png", metavar="FILE", type=Path, help="draw a still picture too")
    report.add_argument("--json", action="store_true", help="print the figures as one JSON object")

    check = _command(
        verbs,
        "check",
        commands.check,
        "look whether everything is there for a flight; nothing is moved",
        "companion check --config config/capture.toml\n  companion check --config config/capture.toml --json",
        _EXITS,
    )
    _config_options(check)
    _link_options(check)
    check.add_argument(
        "--patience",
        metavar="S",
        type=_positive,
        default=10.0,
        help="wait so long for an autopilot, then for what it is asked (%(default)s)",
    )
    check.add_argument("--json", action="store_true", help="print one JSON object")

    sim = _command(
        verbs,
        "sim",
        commands.sim,
        "simulate many flights of the same pilot, faster than real time",
        "companion sim --config config/capture.toml --runs 200 --seed 1\n"
        "  companion sim --config config/station.toml --runs 20",
    )
    _config_options(sim)
    sim.add_argument("--runs", metavar="N", type=_at_least_one, default=20, help="number of flights")
    sim.add_argument("--seed", metavar="S", type=int, default=1, help="seed of the first flight")
    sim.add_argument("--json", action="store_true", help="print one JSON object")

    config = verbs.add_parser("config", help="the effective configuration, or its JSON Schema")
    actions = config.add_subparsers(metavar="ACTION", required=True)
    show = _command(
        actions,
        "show",
        commands.config_show,
        "every value and where it came from",
        "companion config show --config config/capture.toml",
    )
    _config_options(show)
    _command(
        actions,
        "schema",
        commands.config_schema,
        "the JSON Schema of the configuration file",
        "companion config schema",
    )

    ranges = verbs.add_parser("ranges", help="the range message on the wire")
    actions = ranges.add_subparsers(metavar="ACTION", required=True)
    _command(
        actions,
        "schema",
        commands.ranges_schema,
        "the JSON Schema of a range",
        "companion ranges schema",
    )

    status = verbs.add_parser("status", help="the status message on the wire")
    actions = status.add_subparsers(metavar="ACTION", required=True)
    _command(
        actions,
        "schema",
        commands.status_schema,
        "the JSON Schema of a vehicle's status",
        "companion status schema",
    )

    watch = _command(
        verbs,
        "watch",
        commands.watch,
        "look on while one or many vehicles fly, from any machine on their Zenoh network",
        cli_watch.WATCH_EXAMPLES,
        _EXITS,
    )
    _config_options(watch)
    _zenoh_options(watch)
    cli_watch.watch_options(watch)

    beacons = _command(
        verbs,
        "beacons",
        commands.beacons,
        "a live table of the sensor network: every beacon and tag, as a vehicle would judge their ranges",
        cli_watch.BEACONS_EXAMPLES,
        _EXITS,
    )
    _config_options(beacons)
    _zenoh_options(beacons)
    cli_watch.beacons_options(beacons)

    operator = _command(
        verbs,
        "operator",
        commands.operator,
        "the ground side in a script: arm, take off, select OFFBOARD, watch, land",
        "companion operator --mavlink udpin:127.0.0.1:14550 --height 3\n"
        "  companion operator --mavlink udpin:127.0.0.1:14550 --take-over-after 10",
    )
    operator.add_argument("--mavlink", metavar="URL", required=True, help="the ground-station link")
    operator.add_argument("--height", metavar="M", type=_positive, default=3.0, help="climb to this height")
    operator.add_argument(
        "--take-over-after", metavar="S", type=_positive, help="select AUTO.LOITER this long after OFFBOARD"
    )
    operator.add_argument(
        "--rest",
        metavar="S",
        type=_positive,
        default=2.5,
        help="land after this long at rest (%(default)s); longer where a station is to be kept",
    )
    operator.add_argument(
        "--timeout", metavar="S", type=_positive, default=600.0, help="land after this long at the latest"
    )

    publish = _command(
        verbs,
        "publish",
        commands.publish,
        "put ranges on Zenoh: from a UWB module, a file or a simulated beacon",
        cli_publish.EXAMPLES,
        _EXITS,
    )
    cli_publish.options(publish)

    keys = _command(
        verbs,
        "keys",
        commands.keys,
        "make the certificates of a site, and its router's configuration",
        cli_keys.EXAMPLES,
        _EXITS,
    )
    cli_keys.options(keys)

    calibrate = _command(
        verbs,
        "calibrate",
        commands.calibrate,
        "bias and noise of a beacon from ranges over known distances, as configuration",
        cli_calibrate.EXAMPLES,
        _EXITS,
    )
    cli_calibrate.options(calibrate)

    design = _command(
        verbs,
        "design",
        commands.design,
        "gains over the range, closed-loop poles, gain, phase and delay margins",
        "companion design --config config/capture.toml --plots design",
    )
    _config_options(design)
    design.add_argument("--plots", metavar="DIR", type=Path, help="write plots into this directory")

    bench = verbs.add_parser("bench", help="measurements on the desk")
    actions = bench.add_subparsers(metavar="ACTION", required=True)
    guidance = _command(
        actions,
        "guidance",
        commands.bench_guidance,
        "every guidance scheme on every plant, from the same starts",
        "companion bench guidance --runs 1000 --plots plots\n"
        "  companion bench guidance --case nominal --scheme companion --runs 10000\n"
        "  companion bench guidance --case station --case station-drift-0.2 --runs 1000   # some minutes",
    )
    _config_options(guidance)
    guidance.add_argument("--runs", metavar="N", type=_at_least_one, default=1000, help="flights of each")
    guidance.add_argument("--seed", metavar="S", type=int, default=1, help="of starts and noise")
    guidance.add_argument("--case", metavar="NAME", action="append", help="only this case; may be repeated")
    guidance.add_argument(
        "--scheme", metavar="NAME", action="append", help="only this scheme; may be repeated"
    )
    guidance.add_argument("--json", action="store_true", help="print one JSON object")
    guidance.add_argument(
        "--plots", metavar="DIR", type=Path, help="draw ECDFs, heat maps and the paper's figures"
    )

    system = _command(
        actions,
        "system",
        commands.bench_system,
        "the whole app beside the least that the same libraries can do",
        "companion bench system --plots plots      # about half an hour\n"
        "  companion bench system --short           # some minutes, good for ratios\n"
        "  companion bench system --only step --only size --json",
        "Latency, jitter, CPU, memory, start, pilot.step, simulated flights, size of the installation.\n"
        "A floor program runs in turn with the app; where a ratio is twice its goal in every turn, the exit\n"
        "status is 10.",
    )
    system.add_argument("--short", action="store_true", help="a few minutes instead of half an hour")
    system.add_argument(
        "--only",
        metavar="PART",
        action="append",
        help="only this part; may be repeated: latency, jitter, cpu, step, memory, start, simulation, size",
    )
    system.add_argument("--json", action="store_true", help="print one JSON object")
    system.add_argument("--plots", metavar="DIR", type=Path, help="draw the latencies' ECDFs")

    network = _command(
        actions,
        "network",
        commands.bench_network,
        "one router, many beacons, many vehicles on this machine: share delivered, latency, cost of a range",
        "companion bench network --vehicles 10 --beacons 200 --seconds 10\n"
        "  companion bench network --tls --json",
    )
    for option, count, what in (
        ("--vehicles", 10, "how many"),
        ("--beacons", 200, "how many"),
        ("--each", 20, "beacons of each vehicle"),
    ):
        network.add_argument(
            option, metavar="N", type=_at_least_one, default=count, help=f"{what} (%(default)s)"
        )
    network.add_argument(
        "--rate", metavar="HZ", type=_positive, default=20.0, help="of each beacon (%(default)s)"
    )
    network.add_argument(
        "--seconds", metavar="S", type=_positive, default=10.0, help="measure for so long (%(default)s)"
    )
    network.add_argument("--tls", action="store_true", help="mutual TLS and access control")
    network.add_argument("--json", action="store_true", help="print one JSON object")

    recovery = _command(
        actions,
        "recovery",
        commands.bench_recovery,
        "router killed, router frozen, network down: when ranges are believed again, and that no old one is",
        "companion bench recovery\n  companion bench recovery --json",
    )
    recovery.add_argument("--json", action="store_true", help="print one JSON array")

    demo = _command(
        verbs,
        "demo",
        commands.demo,
        "mock autopilot, operator and companion in one go: a whole flight on this machine",
        "companion demo",
        _EXITS,
    )
    demo.add_argument("--config", metavar="FILE", type=Path, help="configuration (default: the demo's own)")
    return parser


def _command(
    verbs: Any,
    name: str,
    run: Callable[[argparse.Namespace], int],
    summary: str,
    example: str,
    more: str = "",
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = verbs.add_parser(
        name,
        help=summary,
        description=summary[0].upper() + summary[1:] + ".",
        epilog=f"examples:\n  {example}" + (f"\n\n{more}" if more else ""),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.set_defaults(command=run)
    return parser


def _config_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", metavar="FILE", type=Path, help="TOML file; see `companion config show`")
    parser.add_argument(
        "--set",
        metavar="TABLE.KEY=VALUE",
        action="append",
        default=[],
        help="override one value (file < environment COMPANION_TABLE__KEY < this); may be repeated",
    )


def _link_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--mavlink", metavar="URL", help="vehicle link; overrides vehicle.mavlink")
    _zenoh_options(parser)


def _zenoh_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--zenoh-connect",
        metavar="ENDPOINT",
        action="append",
        help="Zenoh endpoint; overrides ranges.connect; may be repeated",
    )
    parser.add_argument(
        "--zenoh-listen",
        metavar="ENDPOINT",
        action="append",
        help="listen here for beacons; overrides ranges.listen; may be repeated",
    )
    parser.add_argument("--tls", metavar="DIR", help="certificates of `companion keys`; overrides ranges.tls")


class _Version(argparse.Action):
    """Prints the version; it is looked up only when asked for."""

    def __init__(self, option_strings: Sequence[str], dest: str) -> None:
        super().__init__(option_strings, dest, nargs=0, help="print the version")

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib import metadata

        from companion.compiled import why_not

        print(f"companion {metadata.version('companion')}, core {why_not() or 'compiled'}")
        parser.exit()


def _at_least_one(text: str) -> int:
    try:
        value = int(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: must be a whole number") from None
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value}: must be at least 1")
    return value


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r}: must be a number") from None
    if not 0.0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"{text}: must be above 0 and below a million")
    return value
