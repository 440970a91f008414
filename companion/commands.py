"""What each command does, put together from the parts that it needs.

Each imports what it needs when it runs, so that `--help` is quick and a flight loads nothing of the desk's
tools. All take the parsed options and return the process's exit status; UsageError stops with status 2.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from companion import cli_calibrate, cli_keys, cli_publish, cli_watch
from companion.exits import Exit

if TYPE_CHECKING:
    from rich.progress import Progress

    from companion.config import Loaded


T = TypeVar("T")


class UsageError(Exception):
    """A wrong command line or configuration, in one line."""


def fly(args: argparse.Namespace) -> int:
    """Fly the vehicle."""
    from companion.compiled import twin
    from companion.fly import fly
    from companion.record import start_now
    from companion.recorder import Recorder
    from companion.view import ViewKind, open_view

    shadow = ["mission.shadow=true"] if args.shadow else []
    loaded = _load(args.config, _link_overrides(args) + shadow)
    path = args.record or Path("flights") / f"{datetime.now(UTC):%Y-%m-%dT%H-%M-%SZ}.mcap"
    recorder = twin(Recorder).open(path, start_now(loaded.config, loaded.digest, loaded.sources))
    if args.record is not None and recorder.problem is not None:
        raise UsageError(f"--record {recorder.problem}; name another file, or leave it out")
    view = open_view(sys.stdout, ViewKind(args.view))
    return fly(loaded.config, view, recorder, json_file=args.json, png_file=args.png)


def replay(args: argparse.Namespace) -> int:
    """Replay a recorded flight."""
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
        raise UsageError(str(error)) from error
    print(msgspec.json.encode(result).decode() if args.json else result.text())
    if result.stopped is not None and not result.compared:
        return Exit.USAGE  # as a file of which nothing can be read
    return Exit.OK if result.equal or settings is not None else Exit.DIFFERENT


def report(args: argparse.Namespace) -> int:
    """A recorded flight as one page."""
    import msgspec

    from companion.picture import PictureError, draw_flight
    from companion.recording import RecordError, read
    from companion.report.page import PageError, write

    try:
        recording = read(args.file)
        page = args.output or args.file.with_suffix(".html")
        if page.is_dir():
            page = page / args.file.with_suffix(".html").name
        if page.exists() and page.samefile(args.file):
            raise UsageError(f"{page}: the page would overwrite the flight; name another file with -o")
        flight = write(page, recording)
    except (RecordError, PageError) as error:
        raise UsageError(str(error)) from error
    except OSError as error:
        raise UsageError(f"{page}: {error.strerror or error}") from error
    print(msgspec.json.encode(flight.figures).decode() if args.json else flight.figures.text())
    if not args.json:
        print(f"page: {page}")
    if args.png is not None:
        try:
            draw_flight(args.png, flight.told, title=flight.figures.headline)
            if not args.json:
                print(f"picture: {args.png}")
        except (PictureError, OSError) as error:
            print(f"companion: no picture: {error}", file=sys.stderr)
            return Exit.USAGE
    return Exit.OK


def _link_overrides(args: argparse.Namespace) -> list[str]:
    """`--set`, then the options of the two links."""
    overrides = list(args.set)
    if getattr(args, "mavlink", None):
        overrides.append(f"vehicle.mavlink={json.dumps(args.mavlink)}")
    if args.zenoh_connect:
        overrides.append(f"ranges.connect={json.dumps(args.zenoh_connect)}")
    if args.zenoh_listen:
        overrides.append(f"ranges.listen={json.dumps(args.zenoh_listen)}")
    if args.tls:
        overrides.append(f"ranges.tls={json.dumps(args.tls)}")
    return overrides


def check(args: argparse.Namespace) -> int:
    """Look whether everything is ready to fly."""
    import shutil

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


def sim(args: argparse.Namespace) -> int:
    """Simulate many flights."""
    from companion.config import ConfigError
    from companion.goal import true_goal
    from companion.simulate import fly_many, statistics

    loaded = _load(args.config, args.set)
    with _Progress("simulated flights", quiet=args.json) as progress:
        try:
            true_goal(loaded.config)
        except ConfigError as error:
            raise UsageError(str(error)) from error
        results = fly_many(
            loaded.config, args.runs, args.seed, lambda done: progress.told("", done, args.runs)
        )
    figures = statistics(results)
    print(json.dumps(figures, indent=2) if args.json else _table(figures, loaded.config.mission.kind))
    return Exit.OK


def _table(figures: dict[str, Any], kind: str) -> str:
    from companion.simulate import KEEP_S

    station = kind == "station"
    done = "reached the station" if station else "captured the target"
    then = f"kept it for {KEEP_S:g} s" if station else "came to rest inside the capture radius"
    lines = [
        f"{figures['captured']} of {figures['runs']} flights {done}, {figures['rests_inside']} {then}",
        f"{'':28}{'median':>9}{'p95':>9}{'max':>9}{'mean':>9}",
    ]
    rows = {
        "time_s": "time, s",
        "path_ratio": "path ÷ shortest path",
        "extra_path_m": "extra path, m",
        "rest_m": "distance at rest, m",
    }
    if station:
        rows |= {"hold_rms_m": "distance while kept, rms, m", "hold_worst_m": "and at most, m"}
    for key, name in rows.items():
        values = (figures[key][column] for column in ("median", "p95", "max", "mean"))
        lines.append(f"{name:28}" + "".join("        –" if v is None else f"{v:9.3f}" for v in values))
    lines += [f"not {done.split()[0]}: seed {n['seed']}: {n['ended']}" for n in figures["not_captured"]]
    return "\n".join(lines)


class _Progress:
    """A progress bar on standard error, where that is a terminal."""

    def __init__(self, what: str, quiet: bool) -> None:
        self._what = what
        self._bar: Progress | None = None
        self._quiet = quiet or not sys.stderr.isatty()

    def __enter__(self) -> _Progress:
        if not self._quiet:
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

            text = TextColumn(self._what + " {task.description}")
            columns = (text, BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self._bar.add_task("", total=None)
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def told(self, what: str, done: int, total: int) -> None:
        """So much of it is done."""
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], description=what, completed=done, total=total)


def config_show(args: argparse.Namespace) -> int:
    """Every value and its source."""
    from companion.config import flat

    loaded = _load(args.config, args.set)
    for key, value in flat(loaded.config).items():
        print(f"{key} = {json.dumps(value)}  # {loaded.sources.get(key, 'default')}")
    print(f"# digest {loaded.digest}")
    return Exit.OK


def config_schema(_: argparse.Namespace) -> int:
    """The configuration's JSON Schema."""
    from companion.config import schema

    print(json.dumps(schema(), indent=2))
    return Exit.OK


def ranges_schema(_: argparse.Namespace) -> int:
    """A range's JSON Schema."""
    from companion.wire_range import schema

    print(json.dumps(schema(), indent=2))
    return Exit.OK


def status_schema(_: argparse.Namespace) -> int:
    """A status message's JSON Schema."""
    from companion.wire_status import schema

    print(json.dumps(schema(), indent=2))
    return Exit.OK


def watch(args: argparse.Namespace) -> int:
    """Look on while vehicles fly."""
    loaded = _load(args.config, _link_overrides(args))
    try:
        return cli_watch.watch(args, loaded.config.ranges)
    except ValueError as error:
        raise UsageError(str(error)) from error


def beacons(args: argparse.Namespace) -> int:
    """Look at the sensor network."""
    loaded = _load(args.config, _link_overrides(args))
    try:
        return cli_watch.beacons(args, loaded.config)
    except ValueError as error:
        raise UsageError(str(error)) from error


def operator(args: argparse.Namespace) -> int:
    """The ground side in a script."""
    from companion.ground import GroundLinkError
    from companion.operator import operate

    try:
        result = operate(
            args.mavlink,
            height_m=args.height,
            take_over_after_s=args.take_over_after,
            timeout_s=args.timeout,
            rest_s=args.rest,
            say=lambda line: print(line, flush=True),
        )
    except ValueError as error:
        raise UsageError(str(error)) from error
    except GroundLinkError as error:
        print(f"companion: {error}", file=sys.stderr)
        return Exit.LINK
    print(result.value, flush=True)
    return result.exit_status


def publish(args: argparse.Namespace) -> int:
    """Put ranges on Zenoh, or check who does."""
    try:
        return cli_publish.run(args)
    except ValueError as error:
        raise UsageError(str(error)) from error


def keys(args: argparse.Namespace) -> int:
    """Make, show or check the certificates of a site."""
    try:
        return cli_keys.run(args)
    except ValueError as error:
        raise UsageError(str(error)) from error


def calibrate(args: argparse.Namespace) -> int:
    """Bias and noise of a beacon."""
    from companion.calibrate import CalibrationError

    try:
        return cli_calibrate.run(args)
    except (CalibrationError, ValueError) as error:
        raise UsageError(str(error)) from error


def design(args: argparse.Namespace) -> int:
    """Gains, poles and margins."""
    from companion.bench.design import design, plot, table

    loaded = _load(args.config, args.set)
    vehicle = loaded.config.vehicle
    report = design(loaded.config.guidance, vehicle.yaw_rate_lag_s, vehicle.response_delay_s)
    print(table(report))
    if args.plots is not None:
        print(f"wrote {plot(report, args.plots)}")
    return Exit.OK


def bench_guidance(args: argparse.Namespace) -> int:
    """Compare guidance schemes."""
    from companion.bench import guidance, station
    from companion.bench.cases import CASES

    config = _load(args.config, args.set).config
    asked = args.case or ()
    try:
        (cases, schemes), stations = station.chosen(
            asked, args.scheme or (), tuple(CASES), tuple(guidance.CONTENDERS)
        )
    except ValueError as error:
        raise UsageError(str(error)) from error
    layouts = args.runs if asked else min(args.runs, station.MOST_UNASKED)
    capture = kept = None
    with _Progress("flights", quiet=args.json) as progress:
        if cases:
            capture = guidance.bench_guidance(
                cases, schemes, args.runs, args.seed, progress.told, config.guidance
            )
        if stations[0]:
            kept = station.bench_station(
                *stations, layouts, args.seed, progress.told, config.guidance, config.station
            )
    if args.json:
        told = {} if capture is None else guidance.as_json(capture)
        print(json.dumps(told if kept is None else told | {"station": station.as_json(kept)}, indent=2))
    else:
        tables = [] if capture is None else [guidance.table(capture)]
        print("\n\n".join(tables if kept is None else [*tables, station.table(kept)]))
    if args.plots is not None:
        from companion.bench.pictures import plots
        from companion.bench.station_pictures import station_plots

        written = [] if capture is None else plots(capture, args.plots)
        for path in written if kept is None else [*written, *station_plots(kept, args.plots)]:
            print(f"wrote {path}", file=sys.stderr)
    return Exit.OK


def bench_system(args: argparse.Namespace) -> int:
    """The whole app beside the floor."""
    import msgspec

    from companion.bench.system import bench_system as measure
    from companion.bench.system.figures import table

    with _Progress("measuring", quiet=args.json) as progress:
        try:
            report = measure(args.short, args.only or (), progress.told)
        except (ValueError, RuntimeError, TimeoutError) as error:
            raise UsageError(str(error)) from error
    text = msgspec.json.format(msgspec.json.encode(report)).decode() if args.json else table(report)
    print(text)
    if args.plots is not None:
        from companion.bench.system.pictures import plot

        path = plot(report, args.plots)
        print(f"wrote {path}" if path else "no plot: the latency was not measured", file=sys.stderr)
    for figure in report.failed:
        times = f"{figure.judged:.2f} times the floor, more than twice its goal"
        print(f"companion: {figure.what}: {times}", file=sys.stderr)
    return Exit.TOO_SLOW if report.failed else Exit.OK


def bench_network(args: argparse.Namespace) -> int:
    """Load a network of processes."""
    from companion.bench.network import Load, bench_network, table

    load = Load(args.vehicles, args.beacons, args.rate, args.each, args.seconds, args.tls)
    return _measured(partial(bench_network, load), None if args.json else table)


def bench_recovery(args: argparse.Namespace) -> int:
    """Let the network fail and come back."""
    from companion.bench.recovery import FAULTS, bench_recovery, table

    return _measured(partial(bench_recovery, FAULTS), None if args.json else table)


def _measured(measure: Callable[[Callable[[str], None]], T], table: Callable[[T], str] | None) -> int:
    """What a network of processes came to, as a table or, without one, as JSON; progress goes to stderr."""
    import msgspec

    from companion.bench.network import BenchError

    try:
        found = measure(lambda line: print(line, file=sys.stderr, flush=True))
    except BenchError as error:
        print(f"companion: {error}", file=sys.stderr)
        return Exit.LINK
    print(msgspec.json.encode(found).decode() if table is None else table(found))
    return Exit.OK


def demo(args: argparse.Namespace) -> int:
    """A whole flight on this machine."""
    from companion.config import ConfigError
    from companion.demo import demo

    try:
        return demo(args.config)
    except ConfigError as error:
        raise UsageError(str(error)) from error


def _load(path: Path | None, overrides: Sequence[str]) -> Loaded:
    from companion.config import ConfigError, load

    try:
        return load(path, os.environ, overrides)
    except ConfigError as error:
        raise UsageError(str(error)) from error
