"""The command line of `companion watch` and `companion beacons`: looking on, from anywhere on the network."""

from __future__ import annotations

import argparse
import signal
import sys
import threading
import time
from contextlib import ExitStack

from companion.exits import Exit
from companion.settings import RangesSettings

WATCH_EXAMPLES = (
    "companion watch --zenoh-connect tcp/192.168.1.10:7447\n"
    "  companion watch --zenoh-connect tcp/192.168.1.10:7447 --uav uav1 --view plain --seconds 60\n"
    "  companion watch --zenoh-connect tcp/192.168.1.10:7447 --web 8080   # http://127.0.0.1:8080/"
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
    parser.add_argument("--seconds", metavar="S", type=float, help="end after this long (default: Ctrl-C)")


def watch(args: argparse.Namespace, settings: RangesSettings) -> int:
    """Watch until Ctrl-C. Raises ValueError for what cannot be meant."""
    from companion.view import ViewKind
    from companion.watch.listen import Listener
    from companion.watch.terminal import open_screen

    _check(settings)
    if args.uav != "*":
        _name(args.uav)
    try:
        with ExitStack() as stack:
            stop = _until_signal(stack)
            listener = Listener(settings, args.uav)
            stack.callback(listener.close)
            screen = open_screen(sys.stdout, ViewKind(args.view))
            stack.callback(screen.close)
            end = time.monotonic() + args.seconds if args.seconds is not None else None
            while True:
                for news in listener.poll():
                    if news.change is not None:
                        screen.note(news.vehicle, news.change)
                screen.show(listener.fleet, listener.missing(), time.monotonic_ns())
                left_s = screen.period_s if end is None else min(screen.period_s, end - time.monotonic())
                if left_s <= 0.0 or stop.wait(left_s):
                    break
            heard = any(vehicle.message is not None for vehicle in listener.fleet.vehicles())
            return Exit.OK if heard or stop.is_set() else Exit.NO_VEHICLE
    except OSError as error:
        print(f"companion: {error}", file=sys.stderr)
        return Exit.LINK


def _check(settings: RangesSettings) -> None:
    if not (settings.connect or settings.listen or settings.multicast_scouting):
        raise ValueError(
            "nowhere to listen: name a router or a vehicle with --zenoh-connect tcp/HOST:7447, or a --config "
            "that has ranges.connect"
        )


def _name(text: str) -> None:
    import msgspec

    from companion.settings import Name

    try:
        msgspec.convert(text, Name)
    except msgspec.ValidationError:
        raise ValueError(f"--uav {text!r}: letters, digits, `_`, `.`, `-`, at most 64 of them") from None


def _until_signal(stack: ExitStack) -> threading.Event:
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        stack.callback(signal.signal, number, signal.signal(number, lambda *_: stop.set()))
    return stop
