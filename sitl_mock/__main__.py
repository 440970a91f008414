"""The command line of the mock: `sitl-mock`."""

from __future__ import annotations

import argparse
import os
import re
import signal
import socket
import sys
import tomllib
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import NoReturn, get_args

import msgspec

from sitl_mock.control import Control
from sitl_mock.faults import Fault, FaultAt, parse_fault
from sitl_mock.params import Params
from sitl_mock.scenario import KEY_PART, BeaconAt, Scenario, TelemetryKind

_DESCRIPTION = """\
A stand-in for a PX4 (or ArduCopter) quadrotor and its UWB beacons: MAVLink 2 over UDP on an onboard and a
ground station's link, ranges over Zenoh under uwb/v1/{site}/{beacon}/{tag}/range. It starts on the ground,
disarmed."""

_EPILOG = f"""\
examples:
  sitl-mock                                            a vehicle at the usual ports, one beacon
  sitl-mock --seed 7 --scenario config/capture.toml    its [sim] table says where things are
  sitl-mock --fault range-loss@20:3 --fault rc-switch@40
  sitl-mock --control                                  then type: gps-lost on
  sitl-mock --gcs none --mavlink udpin:127.0.0.1:14580 --zenoh-listen tcp/127.0.0.1:0

faults: {", ".join(fault.value for fault in Fault)}
exit status: 0 ended by SIGINT or SIGTERM, 2 bad input or an endpoint that cannot be had"""


def load_scenario(path: Path) -> Scenario:
    """Read the `[sim]` table of a TOML file; other tables are not looked at.

    Raises ValueError that names the file, the key, the value and what is allowed.
    """
    try:
        table = tomllib.loads(path.read_text()).get("sim", {})
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: {error}") from None
    if isinstance(table, dict):  # msgspec names an unknown key, but neither its value nor the known ones
        unknown = sorted(set(table) - set(Scenario.__struct_fields__))
        if unknown:
            allowed = ", ".join(Scenario.__struct_fields__)
            raise ValueError(
                f"{path}: sim.{unknown[0]} = {table[unknown[0]]!r}: no such key; allowed: {allowed}"
            )
    try:
        return msgspec.convert(table, Scenario)
    except msgspec.ValidationError as error:
        what, _, where = str(error).partition(" - at `$")
        keys = where.rstrip("`")
        raise ValueError(f"{path}: sim{keys} = {_value_at(table, keys)!r}: {what}{_allowed(what)}") from None


def _value_at(table: object, keys: str) -> object:
    """What stands at a path like `.beacons[0].x_m`."""
    for key in keys.replace("[", ".[").split("."):
        if key.startswith("[") and isinstance(table, list):
            table = table[int(key[1:-1])]
        elif isinstance(table, dict) and key:
            table = table[key]
    return table


def _allowed(what: str) -> str:
    """What msgspec does not say by itself."""
    if "enum" in what:
        return f"; allowed: {', '.join(get_args(TelemetryKind))}"
    return f"; allowed: {', '.join(BeaconAt.__struct_fields__)}" if "unknown field" in what else ""


def _endpoint(text: str) -> str | None:
    return None if text == "none" else text


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="sitl-mock",
        description=_DESCRIPTION,
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add(
        "--mavlink",
        metavar="URL",
        default="udpout:127.0.0.1:14540",
        help="onboard link (%(default)s), or none",
    )
    add(
        "--gcs", metavar="URL", default="udpout:127.0.0.1:14550", help="ground station (%(default)s), or none"
    )
    add("--zenoh-listen", metavar="EP", action="append", help="tcp/127.0.0.1:7447 unless one is connected to")
    add("--zenoh-connect", metavar="EP", action="append", default=[], help="a peer or router to connect to")
    add(
        "--autopilot",
        choices=("px4", "ardupilot"),
        default="px4",
        help="whose rules: PX4, as recorded, or ArduCopter's GUIDED, from its source (%(default)s)",
    )
    add("--site", default="lab", help="the site in the ranges' key (%(default)s)")
    add("--tag", default="drone", help="the tag in the ranges' key (%(default)s)")
    add("--seed", type=int, default=1, help="of every random draw (%(default)s)")
    add("--scenario", metavar="FILE", type=Path, help="TOML file with a [sim] table")
    add("--param", metavar="NAME=VALUE", action="append", default=[], help="set an autopilot parameter")
    add(
        "--fault",
        metavar="NAME@T[:DURATION]",
        action="append",
        default=[],
        help="let something fail, seconds",
    )
    add(
        "--sign-key",
        metavar="FILE",
        type=Path,
        help="sign the onboard link, and hear signed messages only: a file of 32 bytes, raw or hexadecimal",
    )
    add(
        "--control",
        action="store_true",
        help="switch faults by lines on standard input: NAME on, or NAME off",
    )
    add("--truth-log", metavar="FILE", type=Path, help="write the true motion, one JSON object every 20 ms")
    add("--version", action="version", version=f"sitl-mock {version('companion')}")
    return parser


def _key(path: Path | None) -> bytes | None:
    if path is None:
        return None
    from sitl_mock.udp import read_key

    try:
        return read_key(path.read_bytes())
    except OSError as error:
        raise ValueError(f"--sign-key {path}: {error.strerror}") from None
    except ValueError as error:
        raise ValueError(f"--sign-key {path}: {error}") from None


def _params(texts: list[str], ardupilot: bool) -> Params:
    params = Params(ardupilot=ardupilot)
    for text in texts:
        name, _, value = text.partition("=")
        try:
            known = params.set(name, float(value))
        except ValueError:
            raise ValueError(f"parameter {text!r}: must be NAME=VALUE with a number") from None
        if not known:
            raise ValueError(f"parameter {name!r}: no such parameter; allowed: {', '.join(params.names())}")
    return params


def main(argv: list[str] | None = None) -> int:
    """Run the mock until SIGINT or SIGTERM; returns the exit status."""
    args = _parser().parse_args(argv)
    listen = args.zenoh_listen or ([] if args.zenoh_connect else ["tcp/127.0.0.1:7447"])
    try:
        scenario = load_scenario(args.scenario) if args.scenario is not None else Scenario()
        for name, part in (("--site", args.site), ("--tag", args.tag)):
            if not re.match(KEY_PART, part):
                raise ValueError(f"{name} {part!r}: must be one part of a key, without / * $ ? # or spaces")
        faults: tuple[FaultAt, ...] = tuple(parse_fault(text) for text in args.fault)
        params = _params(args.param, args.autopilot == "ardupilot")
        from sitl_mock.wire import Endpoints, Wire  # zenoh and pymavlink only once the input is good

        endpoints = Endpoints(
            _endpoint(args.mavlink),
            _endpoint(args.gcs),
            tuple(listen),
            tuple(args.zenoh_connect),
            args.site,
            args.tag,
            args.autopilot,
            _key(args.sign_key),
        )
        wire = Wire(scenario, args.seed, endpoints, faults, params, args.truth_log)
    except (ValueError, OSError) as error:
        print(f"sitl-mock: {error}", file=sys.stderr)
        return 2
    stopping = False

    def stop(_signum: int, _frame: object) -> None:
        nonlocal stopping
        stopping = True

    awake, wake = socket.socketpair()
    awake.setblocking(False)
    signal.set_wakeup_fd(awake.fileno(), warn_on_full_buffer=False)
    signal.signal(signal.SIGINT, stop)
    signal.signal(signal.SIGTERM, stop)
    for line in wire.listening():
        print(line, flush=True)
    try:
        control = Control(sys.stdin.fileno(), lambda line: print(line, flush=True)) if args.control else None
        wire.run(lambda: stopping, wake.fileno(), control)
    finally:
        wire.close()
    return 0


def run() -> NoReturn:
    """The mock, and the end of the process without the interpreter's own, which threads of Zenoh's may abort.

    See `companion.__main__`, from which nothing is imported here.
    """
    status = main()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError):  # nobody reads any more
            stream.flush()
    os._exit(status)


if __name__ == "__main__":
    run()
