"""The command line of `companion watch` and `companion beacons`: looking on, from anywhere on the network."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from contextlib import ExitStack
from typing import TYPE_CHECKING

from companion.exits import Exit

if TYPE_CHECKING:
    from companion.network_settings import RangesSettings
    from companion.settings import Settings
    from companion.watch.terminal import Screen

WATCH_EXAMPLES = (
    "companion watch --zenoh-connect tcp/192.168.1.10:7447\n"
    "  companion watch --zenoh-connect tcp/192.168.1.10:7447 --uav uav1 --view plain --seconds 60\n"
    "  companion watch --zenoh-connect tcp/192.168.1.10:7447 --web 8080   # http://127.0.0.1:8080/"
)

BEACONS_EXAMPLES = (
    "companion beacons --zenoh-connect tcp/192.168.1.10:7447\n"
    "  companion beacons --config config/capture.toml --zenoh-connect tcp/192.168.1.10:7447\n"
    "  companion beacons --zenoh-connect tcp/192.168.1.10:7447 --once --json"
)


def watch_options(parser: argparse.ArgumentParser) -> None:
    """Add the options, but for the configuration's and Zenoh's."""
    parser.add_argument("--uav", metavar="ID", default="*", help="only this vehicle (default: all)")
    parser.add_argument(
        "--view",
        choices=("auto", "live", "plain", "json"),
        default="auto",
        help="what to show (auto: live on a terminal, else a line per second)",
    )
    parser.add_argument(
        "--web",
        metavar="PORT",
        type=int,
        help="show a page at http://127.0.0.1:PORT/ instead; 0: any free port",
    )
    parser.add_argument(
        "--bind",
        metavar="ADDRESS",
        default="127.0.0.1",
        help="--web: listen here; 0.0.0.0 lets every machine of the network look on (default: %(default)s)",
    )
    parser.add_argument("--seconds", metavar="S", type=float, help="end after this long (default: Ctrl-C)")


def watch(args: argparse.Namespace, settings: RangesSettings) -> int:
    """Watch until Ctrl-C. Raises ValueError for what cannot be meant."""
    from companion.watch.listen import Listener

    _check(settings)
    if args.uav != "*":
        _check_name(args.uav)
    with ExitStack() as stack:
        stop = _until_signal(stack)
        try:
            listener = Listener(settings, args.uav)
            stack.callback(listener.close)
            screen = _screen(args)
        except OSError as error:
            print(f"companion: {error}", file=sys.stderr)
            return Exit.LINK
        stack.callback(screen.close)
        end = time.monotonic() + args.seconds if args.seconds is not None else None
        while True:
            screen.show(listener.fleet, listener.poll(), listener.missing(), time.monotonic_ns())
            left_s = screen.period_s if end is None else min(screen.period_s, end - time.monotonic())
            if left_s <= 0.0 or stop.wait(left_s):
                break
        heard = any(vehicle.message is not None for vehicle in listener.fleet.vehicles())
        return Exit.OK if heard or stop.is_set() else Exit.NO_VEHICLE


def beacons_options(parser: argparse.ArgumentParser) -> None:
    """Add the options, but for the configuration's and Zenoh's."""
    parser.add_argument("--once", action="store_true", help="listen for --seconds, print one table, end")
    parser.add_argument("--json", action="store_true", help="JSON objects, one a second (with --once: one)")
    parser.add_argument(
        "--seconds", metavar="S", type=float, help="end after this long (default: Ctrl-C; with --once: 3)"
    )


def beacons(args: argparse.Namespace, settings: Settings) -> int:
    """Watch the sensor network until Ctrl-C. Raises ValueError for what cannot be meant."""
    from companion.watch.sensors_listen import SensorListener
    from companion.watch.sensors_view import open_screen

    _check(settings.ranges)
    is_configured = args.config is not None or any(item.startswith("beacons.") for item in args.set)
    with ExitStack() as stack:
        stop = _until_signal(stack)
        try:
            listener = SensorListener(settings, settings.beacons if is_configured else None)
        except OSError as error:
            print(f"companion: {error}", file=sys.stderr)
            return Exit.LINK
        stack.callback(listener.close)
        screen = open_screen(sys.stdout, args.once, args.json)
        stack.callback(screen.close)
        seconds = 3.0 if args.once and args.seconds is None else args.seconds
        end = time.monotonic() + seconds if seconds is not None else None
        while True:
            listener.poll()
            rows = listener.sensors.rows(time.monotonic_ns())
            screen.show(rows, listener.missing())
            left_s = screen.period_s if end is None else min(screen.period_s, end - time.monotonic())
            if left_s <= 0.0 or stop.wait(left_s):
                break
        heard = any(row.range_m is not None for row in rows)
        return Exit.OK if heard or (stop.is_set() and not args.once) else Exit.NO_RANGES


def _screen(args: argparse.Namespace) -> Screen:
    """The terminal, or the page, said where. Raises OSError, ValueError."""
    from companion.view import ViewKind
    from companion.watch.page import Page
    from companion.watch.terminal import open_screen

    if args.web is None:
        return open_screen(sys.stdout, ViewKind(args.view))
    if not 0 <= args.web <= 65_535:
        raise ValueError(f"--web {args.web}: a port is between 0 and 65535")
    try:
        page = Page(args.bind, args.web)
    except OSError as error:
        raise OSError(f"--web: cannot listen on {args.bind} port {args.web}: {error.strerror}") from None
    print(f"watching on {page.url} until Ctrl-C", flush=True)
    return page


def _check(settings: RangesSettings) -> None:
    if not (settings.connect or settings.listen or settings.multicast_scouting):
        raise ValueError(
            "nowhere to listen: name a router or a vehicle with --zenoh-connect tcp/HOST:7447, or a --config "
            "that has ranges.connect"
        )


def _check_name(uav: str) -> None:
    from companion.network_settings import NAME_RULE, is_name

    if not is_name(uav):
        raise ValueError(f"--uav {uav[:80]!r}: {NAME_RULE}")


def _until_signal(stack: ExitStack) -> threading.Event:
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        stack.callback(signal.signal, number, signal.signal(number, lambda *_: stop.set()))
    return stop
