"""The command line, and the only place where everything is put together.

Each command imports what it needs when it runs, so that `--help` is quick and a flight loads nothing of the
desk's tools.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import sys
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from companion import cli_publish
from companion.exits import MEANING, Exit

if TYPE_CHECKING:
    from companion.config import Loaded

_EXITS = "exit status:\n" + "\n".join(f"  {int(e):3d}  {text}" for e, text in MEANING.items())


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; the result is the process's exit status."""
    parser = _parser()
    args = parser.parse_args(argv)
    command: Callable[[argparse.Namespace], int] = args.command
    try:
        return command(args)
    except _UsageError as error:
        print(f"companion: {error}", file=sys.stderr)
        return Exit.USAGE
    except BrokenPipeError:  # the reader of our output (head, less) has gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return Exit.OK


class _UsageError(Exception):
    """A wrong command line or configuration, in one line."""


# -------------------------------------------------------------------------------------------- commands


def _fly(args: argparse.Namespace) -> int:
    from companion.fly import fly
    from companion.record import Recorder, start_now
    from companion.view import ViewKind, open_view

    loaded = _load(args.config, _link_overrides(args))
    view = open_view(sys.stdout, ViewKind(args.view))
    path = args.record or Path("flights") / f"{datetime.now(UTC):%Y-%m-%dT%H-%M-%SZ}.mcap"
    recorder = Recorder.open(path, start_now(loaded.config, loaded.digest, loaded.sources))
    return fly(loaded.config, view, recorder, json_file=args.json, png_file=args.png)


def _replay(args: argparse.Namespace) -> int:
    import msgspec

    from companion.config import ConfigError, load
    from companion.recording import RecordError, read
    from companion.replay import replay

    try:
        recording = read(args.file)
        settings = None
        if args.config or args.set:
            recorded = json.loads(recording.start.config)
            settings = load(args.config, {}, args.set, recorded=recorded).config
        result = replay(recording, settings)
    except (RecordError, ConfigError) as error:
        raise _UsageError(str(error)) from error
    print(msgspec.json.encode(result).decode() if args.json else result.text())
    return Exit.OK if result.equal or settings is not None else Exit.DIFFERENT


def _link_overrides(args: argparse.Namespace) -> list[str]:
    """`--set`, then the options of the two links."""
    overrides = list(args.set)
    if args.mavlink:
        overrides.append(f"vehicle.mavlink={json.dumps(args.mavlink)}")
    if args.zenoh_connect:
        overrides.append(f"ranges.connect={json.dumps(args.zenoh_connect)}")
    if args.zenoh_listen:
        overrides.append(f"ranges.listen={json.dumps(args.zenoh_listen)}")
    return overrides


def _check(args: argparse.Namespace) -> int:
    from companion.check import check, text

    loaded = _load(args.config, _link_overrides(args))
    if sys.stderr.isatty():
        print("looking and asking; nothing is moved ...", file=sys.stderr)
    try:
        report = check(loaded.config, args.patience)
    except KeyboardInterrupt:
        return Exit.INTERRUPTED
    if args.json:
        print(report.json().decode())
    else:
        width = min(shutil.get_terminal_size((110, 24)).columns, 120)
        print(text(report, width, colour=sys.stdout.isatty() and "NO_COLOR" not in os.environ))
    return Exit.OK if report.ready else Exit.NOT_READY


def _sim(args: argparse.Namespace) -> int:
    from companion.simulate import fly_many, statistics

    loaded = _load(args.config, args.set)
    if args.json or not sys.stderr.isatty():
        results = fly_many(loaded.config, args.runs, args.seed)
    else:
        from rich.console import Console
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

        columns = ("simulated flights", BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("", total=args.runs)
            results = fly_many(
                loaded.config, args.runs, args.seed, lambda done: bar.update(task, completed=done)
            )
    figures = statistics(results)
    print(json.dumps(figures, indent=2) if args.json else _table(figures))
    return Exit.OK


def _table(figures: dict[str, Any]) -> str:
    lines = [
        f"{figures['captured']} of {figures['runs']} flights captured the target, "
        f"{figures['rests_inside']} came to rest inside the capture radius",
        f"{'':28}{'median':>9}{'p95':>9}{'max':>9}{'mean':>9}",
    ]
    rows = {
        "time_s": "time, s",
        "path_ratio": "path ÷ shortest path",
        "extra_path_m": "extra path, m",
        "rest_m": "distance at rest, m",
    }
    for key, name in rows.items():
        values = (figures[key][column] for column in ("median", "p95", "max", "mean"))
        lines.append(f"{name:28}" + "".join("        –" if v is None else f"{v:9.3f}" for v in values))
    lines += [f"not captured: seed {n['seed']}: {n['ended']}" for n in figures["not_captured"]]
    return "\n".join(lines)


def _config_show(args: argparse.Namespace) -> int:
    from companion.config import flat

    loaded = _load(args.config, args.set)
    for key, value in flat(loaded.config).items():
        print(f"{key} = {json.dumps(value)}  # {loaded.sources.get(key, 'default')}")
    print(f"# digest {loaded.digest}")
    return Exit.OK


def _config_schema(_: argparse.Namespace) -> int:
    from companion.config import schema

    print(json.dumps(schema(), indent=2))
    return Exit.OK


def _ranges_schema(_: argparse.Namespace) -> int:
    from companion.wire_range import schema

    print(json.dumps(schema(), indent=2))
    return Exit.OK


def _operator(args: argparse.Namespace) -> int:
    from companion.ground import GroundLinkError
    from companion.operator import operate

    try:
        result = operate(
            args.mavlink,
            height_m=args.height,
            take_over_after_s=args.take_over_after,
            timeout_s=args.timeout,
            say=lambda line: print(line, flush=True),
        )
    except ValueError as error:
        raise _UsageError(str(error)) from error
    except GroundLinkError as error:
        print(f"companion: {error}", file=sys.stderr)
        return Exit.LINK
    print(result.value, flush=True)
    return result.exit_status


def _publish(args: argparse.Namespace) -> int:
    try:
        return cli_publish.run(args)
    except ValueError as error:
        raise _UsageError(str(error)) from error


def _design(args: argparse.Namespace) -> int:
    from companion.bench.design import design, plot, table

    loaded = _load(args.config, args.set)
    vehicle = loaded.config.vehicle
    report = design(loaded.config.guidance, vehicle.yaw_rate_lag_s, vehicle.response_delay_s)
    print(table(report))
    if args.plots is not None:
        print(f"wrote {plot(report, args.plots)}")
    return Exit.OK


def _demo(args: argparse.Namespace) -> int:
    from companion.config import ConfigError
    from companion.demo import demo

    try:
        return demo(args.config)
    except ConfigError as error:
        raise _UsageError(str(error)) from error


def _load(path: Path | None, overrides: Sequence[str]) -> Loaded:
    from companion.config import ConfigError, load

    try:
        return load(path, os.environ, overrides)
    except ConfigError as error:
        raise _UsageError(str(error)) from error


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
    commands = parser.add_subparsers(metavar="COMMAND", required=True)

    fly = _command(
        commands,
        "fly",
        _fly,
        "fly the vehicle on a MAVLink link to the target",
        "companion fly --config config/capture.toml --mavlink udpin:0.0.0.0:14540 "
        "--zenoh-connect tcp/192.168.1.10:7447\n"
        "  companion fly --config config/capture.toml --mavlink serial:/dev/ttyAMA0:921600 "
        "--set guidance.speed_m_s=0.4",
        _EXITS,
    )
    _config_options(fly)
    _link_options(fly)
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
        commands,
        "replay",
        _replay,
        "feed a recorded flight to the pilot again and compare every output, bit for bit",
        "companion replay flights/2026-11-22T10-15-00Z.mcap\n"
        "  companion replay FLIGHT.mcap --set guidance.speed_m_s=0.4   # what would have been commanded",
        _EXITS,
    )
    replay.add_argument("file", metavar="FLIGHT.mcap", type=Path)
    _config_options(replay)
    replay.add_argument("--json", action="store_true", help="print one JSON object")

    check = _command(
        commands,
        "check",
        _check,
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
        commands,
        "sim",
        _sim,
        "simulate many flights of the same pilot, faster than real time",
        "companion sim --config config/capture.toml --runs 200 --seed 1",
    )
    _config_options(sim)
    sim.add_argument("--runs", metavar="N", type=_at_least_one, default=20, help="number of flights")
    sim.add_argument("--seed", metavar="S", type=int, default=1, help="seed of the first flight")
    sim.add_argument("--json", action="store_true", help="print one JSON object")

    config = commands.add_parser("config", help="the effective configuration, or its JSON Schema")
    actions = config.add_subparsers(metavar="ACTION", required=True)
    show = _command(
        actions,
        "show",
        _config_show,
        "every value and where it came from",
        "companion config show --config config/capture.toml",
    )
    _config_options(show)
    _command(
        actions,
        "schema",
        _config_schema,
        "the JSON Schema of the configuration file",
        "companion config schema",
    )

    ranges = commands.add_parser("ranges", help="the range message on the wire")
    actions = ranges.add_subparsers(metavar="ACTION", required=True)
    _command(
        actions,
        "schema",
        _ranges_schema,
        "the JSON Schema of a range",
        "companion ranges schema",
    )

    operator = _command(
        commands,
        "operator",
        _operator,
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
        "--timeout", metavar="S", type=_positive, default=600.0, help="land after this long at the latest"
    )

    publish = _command(
        commands,
        "publish",
        _publish,
        "put ranges on Zenoh: from a UWB module, a file or a simulated beacon",
        cli_publish.EXAMPLES,
        _EXITS,
    )
    cli_publish.options(publish)

    design = _command(
        commands,
        "design",
        _design,
        "gains over the range, closed-loop poles, gain, phase and delay margins",
        "companion design --config config/capture.toml --plots design",
    )
    _config_options(design)
    design.add_argument("--plots", metavar="DIR", type=Path, help="write plots into this directory")

    demo = _command(
        commands,
        "demo",
        _demo,
        "mock autopilot, operator and companion in one go: a whole flight on this machine",
        "companion demo",
        _EXITS,
    )
    demo.add_argument("--config", metavar="FILE", type=Path, help="configuration (default: the demo's own)")
    return parser


def _command(
    commands: Any,
    name: str,
    run: Callable[[argparse.Namespace], int],
    summary: str,
    example: str,
    more: str = "",
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = commands.add_parser(
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


class _Version(argparse.Action):
    """Prints the version; it is looked up only when asked for."""

    def __init__(self, option_strings: Sequence[str], dest: str) -> None:
        super().__init__(option_strings, dest, nargs=0, help="print the version")

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        print(f"companion {metadata.version('companion')}")
        parser.exit()


def _at_least_one(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{value}: must be at least 1")
    return value


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value < 1e6:
        raise argparse.ArgumentTypeError(f"{text}: must be above 0 and below a million")
    return value
