"""The command line of `companion publish`: a UWB module, a file or a simulated beacon onto Zenoh."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from companion.exits import Exit

if TYPE_CHECKING:
    from companion.publish import Publication
    from companion.uwb.info import BeaconInfo
    from companion.uwb.sources import Source

FAMILIES = ("qorvo-cli", "fira-uci", "dwm1001-shell", "dwm1001-tlv", "linktrack", "jsonl", "csv")
LOS_RULES = ("unknown", "zero-is-los", "one-is-los", "power")
EXAMPLES = (
    "companion publish --serial /dev/ttyACM0 --format qorvo-cli --map 0x0001=b1 "
    "--zenoh-connect tcp/192.168.1.10:7447\n"
    "  companion publish --simulate --zenoh-listen tcp/127.0.0.1:7447\n"
    "  companion publish --check 'uwb/v1/lab/*/*/range' --zenoh-connect tcp/192.168.1.10:7447"
)


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--serial", metavar="DEVICE", help="a UWB module on a serial port")
    what.add_argument("--file", metavar="FILE", type=Path, help="a recording, at its pace")
    what.add_argument("--stdin", action="store_true", help="standard input, as it comes")
    what.add_argument("--simulate", action="store_true", help="a beacon that is not there")
    what.add_argument("--check", metavar="KEY", help="say what is wrong with somebody else's publisher")

    ranges = parser.add_argument_group("what is read")
    ranges.add_argument("--format", choices=FAMILIES, help="the module's, or the file's, format")
    ranges.add_argument(
        "--los", choices=LOS_RULES, default="unknown", help="how a line-of-sight hint is read"
    )
    ranges.add_argument(
        "--map", metavar="PEER=ID", action="append", default=[], help="the module's name=beacon"
    )
    ranges.add_argument("--sigma", metavar="M", type=float, help="one sigma of ranges that do not tell it")
    ranges.add_argument("--no-stamp", action="store_true", help="no t_ns: this computer's clock is not set")

    where = parser.add_argument_group("where it goes")
    where.add_argument("--site", default="lab")
    where.add_argument("--tag", default="drone", help="the module is this tag, its peers are beacons")
    where.add_argument("--beacon", metavar="ID", help="the module is this beacon, its peers are tags")
    where.add_argument("--msgpack", action="store_true", help="MessagePack instead of JSON")
    where.add_argument("--zenoh-connect", metavar="ENDPOINT", action="append", default=[])
    where.add_argument("--zenoh-listen", metavar="ENDPOINT", action="append", default=[])
    where.add_argument("--tls", metavar="DIR", default="", help="certificates of `companion keys`")
    where.add_argument("--save", metavar="FILE", type=Path, help="keep what was measured, as JSON lines")

    about = parser.add_argument_group("what the beacon tells of itself (queryable .../info)")
    about.add_argument("--height", metavar="M", type=float, help="antenna above the take-off point")
    about.add_argument("--antenna-delay", metavar="TICKS", type=int)
    about.add_argument("--bias", metavar="M", type=float, help="mean of measured less true distance")
    about.add_argument(
        "--info",
        metavar="FILE",
        type=Path,
        help='of several beacons, each its own, as JSON: {"b1": {"height_m": 1.2, "bias_m": 0.3}, …}',
    )

    serial = parser.add_argument_group("--serial")
    serial.add_argument("--baud", type=int, help="default: the module's usual one")
    serial.add_argument(
        "--command", dest="typed", metavar="TEXT", action="append", help="typed when nothing comes by itself"
    )
    serial.add_argument("--poll", metavar="HZ", type=float, default=10.0, help="dwm1001-tlv: ask this often")

    file = parser.add_argument_group("--file, --stdin")
    file.add_argument("--speed", metavar="X", type=float, help="faster or slower than recorded")
    file.add_argument(
        "--rate", metavar="HZ", type=float, help="pace of ranges without times; --simulate: rate"
    )

    simulated = parser.add_argument_group("--simulate")
    simulated.add_argument("--id", default="b1")
    simulated.add_argument("--distance", metavar="M", type=float, default=10.0)
    simulated.add_argument("--radius", metavar="M", type=float, default=0.0, help="the tag flies this circle")
    simulated.add_argument("--period", metavar="S", type=float, default=30.0)
    simulated.add_argument("--dropout", metavar="SHARE", type=float, default=0.0)
    simulated.add_argument("--seed", type=int, default=1)

    check = parser.add_argument_group("--check")
    check.add_argument("--seconds", metavar="S", type=float, help="listen this long (5)")
    check.add_argument("--strict", action="store_true", help="advice counts as wrong, too")


def run(args: argparse.Namespace) -> int:
    """Publish, or check a publisher. Raises ValueError for what cannot be meant."""
    from companion import publish

    if args.check is None:
        if args.seconds is not None or args.strict:
            raise ValueError("--seconds and --strict are for --check; a publisher ends with Ctrl-C")
        return publish.publish(publication(args), _say)
    report = publish.check(
        args.check,
        _say,
        seconds=5.0 if args.seconds is None else args.seconds,
        connect=tuple(args.zenoh_connect),
        listen=tuple(args.zenoh_listen),
        tls=args.tls,
        strict=args.strict,
    )
    return {
        publish.Verdict.FINE: Exit.OK,
        publish.Verdict.WRONG: Exit.FAULTY,
        publish.Verdict.NOTHING_HEARD: Exit.NO_RANGES,
        publish.Verdict.NOT_CONNECTED: Exit.LINK,
    }[report.verdict]


def publication(args: argparse.Namespace) -> Publication:
    """What the options mean. Raises ValueError."""
    from companion import wire_range
    from companion.publish import Publication
    from companion.uwb.families import Family
    from companion.uwb.info import BeaconInfo
    from companion.uwb.measured import LosRule

    names = dict(_pair(text) for text in args.map)
    return Publication(
        source=_source(args),
        family=None if args.format is None else Family(args.format),
        los=LosRule(args.los),
        site=args.site,
        tag=args.tag,
        beacon=args.beacon,
        names=names,
        sigma_m=args.sigma,
        infos=_infos(args.info),
        info=BeaconInfo(height_m=args.height, antenna_delay_ticks=args.antenna_delay, bias_m=args.bias),
        stamped=not args.no_stamp,
        encoding=wire_range.MSGPACK if args.msgpack else wire_range.JSON,
        connect=tuple(args.zenoh_connect),
        listen=tuple(args.zenoh_listen),
        tls=args.tls,
        save=args.save,
    )


def _infos(path: Path | None) -> dict[str, BeaconInfo]:
    from companion.uwb.info import decode_many

    if path is None:
        return {}
    try:
        return decode_many(path.read_bytes())
    except OSError as error:
        raise ValueError(f"--info {path}: {error.strerror or error}") from error
    except ValueError as error:
        raise ValueError(f"--info {path}: {error}") from error


def _source(args: argparse.Namespace) -> Source:
    from companion.uwb.sources import Recording, SerialPort, Simulated

    if args.serial is not None:
        commands = None if args.typed is None else tuple(args.typed)
        return SerialPort(args.serial, args.baud, commands, args.poll)
    if args.simulate:
        return Simulated(
            beacon=args.id,
            distance_m=args.distance,
            radius_m=args.radius,
            period_s=args.period,
            rate_hz=20.0 if args.rate is None else args.rate,
            sigma_m=0.07 if args.sigma is None else args.sigma,
            dropout=args.dropout,
            seed=args.seed,
        )
    return Recording(args.file, args.speed, args.rate)


def _pair(text: str) -> tuple[str, str]:
    peer, separator, name = text.partition("=")
    if not separator or not peer or not name:
        raise ValueError(f"--map {text}: expected PEER=ID")
    return peer, name


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
