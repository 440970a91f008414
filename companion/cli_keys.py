"""The command line of `companion keys`: a site's certificates and its router's configuration."""

from __future__ import annotations

import argparse
import sys
from datetime import UTC, datetime
from pathlib import Path

from companion.exits import Exit

EXAMPLES = (
    "companion keys lab-keys --site lab --router 192.168.1.10 --beacon b1 --beacon b2 --vehicle uav1\n"
    "  companion keys lab-keys --beacon b3                # one more; the others stay as they are\n"
    "  companion keys lab-keys                            # who there is, and until when\n"
    "  companion keys lab-keys --renew beacon/b1          # a new key and certificate for it\n"
    "  companion keys --check lab-keys/router/zenoh.json5 # what Zenoh would not tell"
)


def options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    parser.add_argument("directory", metavar="DIR", type=Path, nargs="?", help="the site's directory")
    parser.add_argument(
        "--check", metavar="FILE", type=Path, help="say what is wrong with a router's configuration"
    )
    site = parser.add_argument_group("a new site")
    site.add_argument("--site", metavar="NAME", help="as in ranges.site")
    site.add_argument(
        "--router", metavar="HOST", action="append", default=[], help="address that the router is reached at"
    )
    site.add_argument("--port", type=int, default=7447, help="of the router (%(default)s)")
    who = parser.add_argument_group("who is to connect; each may be repeated")
    who.add_argument("--beacon", metavar="ID", action="append", default=[], help="writes its own ranges only")
    who.add_argument(
        "--tag",
        metavar="ID",
        action="append",
        default=[],
        help="a vehicle's module: writes ranges to this tag",
    )
    who.add_argument(
        "--vehicle", metavar="ID", action="append", default=[], help="reads, and writes its own status"
    )
    who.add_argument("--watcher", metavar="ID", action="append", default=[], help="reads only")
    who.add_argument("--renew", metavar="ROLE/ID", action="append", default=[], help="a new certificate")
    who.add_argument("--days", type=int, default=365, help="a new certificate holds so long (%(default)s)")


def run(args: argparse.Namespace) -> int:
    """Make, show or check. Raises ValueError for what cannot be meant."""
    try:
        from companion.keys.site import KeysError
    except ModuleNotFoundError as error:
        raise ValueError(f"{error.name} is not installed: pip install 'companion[keys]'") from None
    try:
        if args.check is not None:
            return _check(args.check)
        if args.directory is None:
            raise ValueError("which site? companion keys DIR, or companion keys --check FILE")
        _make(args)
        return _show(args.directory)
    except KeysError as error:
        raise ValueError(str(error)) from error
    except OSError as error:
        raise ValueError(f"{error.filename}: {error.strerror}") from error


def _make(args: argparse.Namespace) -> None:
    from companion.keys import site
    from companion.keys.certificates import Role

    directory, now = args.directory, datetime.now(UTC)
    if not 1 <= args.days <= site.AUTHORITY_DAYS:
        raise ValueError(f"--days {args.days}: 1 to {site.AUTHORITY_DAYS}")
    if not 1 <= args.port <= 65535:
        raise ValueError(f"--port {args.port}: 1 to 65535")
    wanted = [
        (role, name)
        for role, names in (
            (Role.BEACON, args.beacon),
            (Role.TAG, args.tag),
            (Role.VEHICLE, args.vehicle),
            (Role.WATCHER, args.watcher),
        )
        for name in dict.fromkeys(names)
    ]
    for role, name in wanted:
        site.check_name(role.value, name)
    for address in args.router:
        site.check_address(address)
    if not (directory / "authority").exists():
        if args.site is None or not args.router:
            raise ValueError(f"{directory}: there is no site yet; name it: --site NAME --router HOST")
        site.create(directory, args.site, now)
        print(f"{directory}/authority: made; keep it offline, whoever has ca.key lets anybody in")
    before = site.listing(directory)
    if args.site not in (None, before.site):
        raise ValueError(f"--site {args.site}: {directory} is the site {before.site}")
    known = {m.who: m for m in before.members}
    has = known["router"].addresses if "router" in known and "router" not in args.renew else None
    if args.router and has is not None and set(args.router) != set(has):
        raise ValueError(
            f"--router: its certificate names {', '.join(has)}; with --renew router it gets another"
        )
    for who in args.renew:
        if who not in known:
            raise ValueError(f"--renew {who}: there is none; there are {', '.join(known)}")
        member = known[who]
        if member.role is Role.ROUTER and args.router:
            member = member._replace(addresses=tuple(args.router))
        site.renew(directory, member, now, args.days)
        print(f"{who}: renewed; the old key is deleted here, and the old certificate holds until it expires")
    if "router" not in known:
        if not args.router:
            raise ValueError(f"{directory}: has no router yet: --router HOST")
        site.add(directory, Role.ROUTER, before.site, now, args.days, tuple(args.router))
    for role, name in wanted:
        if f"{role.value}/{name}" in known:
            print(f"{role.value}/{name}: is there already, and stays as it is")
        else:
            member = site.add(directory, role, name, now, args.days)
            print(f"{member.who}: made; copy {directory}/{role.value}-{name} to it")
    if done := site.write_router_file(directory, args.port):
        print(done)


def _show(directory: Path) -> int:
    from companion.keys.lint import lint, near_end
    from companion.keys.site import ROUTER_FILE, listing

    now = datetime.now(UTC)
    found = listing(directory)
    width = max(len(m.who) for m in found.members)
    print(f"\nsite {found.site}: authority {near_end(found.until, now)}")
    for m in found.members:
        where = f"  ({', '.join(m.addresses)})" if m.addresses else ""
        print(f"  {m.who:{width}}  {near_end(m.until, now)}{where}")
    problems = lint(directory / "router" / ROUTER_FILE, now)
    _tell(problems)
    ended = any(m.until <= now for m in found.members) or found.until <= now
    return Exit.FAULTY if problems or ended else Exit.OK


def _check(path: Path) -> int:
    from companion.keys.lint import lint

    problems = lint(path, datetime.now(UTC))
    _tell(problems)
    if not problems:
        print(f"{path}: nothing wrong")
    return Exit.FAULTY if problems else Exit.OK


def _tell(problems: list[str]) -> None:
    for problem in problems:
        print(f"wrong: {problem}", file=sys.stderr)
