"""What is wrong with a router's configuration that Zenoh starts with, and says nothing about.

A policy may name a rule that is not there, a rule keys that nobody uses, a subject without a name everybody:
all of it is accepted in silence. So are listeners in the clear beside the encrypted one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime, timedelta
from pathlib import Path

import msgspec
import zenoh

from companion.keys.certificates import Role, common_name
from companion.keys.router import own_keys
from companion.keys.site import SOON, KeysError, listing
from companion.link import credentials
from companion.link.zenoh_session import words
from companion.wire_range import KEY_VERSION
from companion.wire_status import alive_key, status_key

_USED = (
    f"{KEY_VERSION}/*/*/*/range",
    f"{KEY_VERSION}/*/*/info",
    f"{KEY_VERSION}/*/*/alive",
    status_key("*"),
    alive_key("*"),
)
_TELLS = {"put", "delete", "reply", "declare_queryable", "liveliness_token"}


class _Rule(msgspec.Struct):
    id: str
    permission: str
    messages: list[str]
    key_exprs: list[str]
    flows: list[str] | None = None

    def allows(self, flow: str) -> bool:
        return self.permission == "allow" and (self.flows is None or flow in self.flows)


class _Subject(msgspec.Struct):
    id: str
    cert_common_names: list[str] | None = None


class _Policy(msgspec.Struct):
    rules: list[str]
    subjects: list[str]


class _Access(msgspec.Struct):
    enabled: bool
    default_permission: str
    rules: list[_Rule] | None = None
    subjects: list[_Subject] | None = None
    policies: list[_Policy] | None = None


class _Tls(msgspec.Struct):
    root_ca_certificate: str | None = None
    listen_certificate: str | None = None
    listen_private_key: str | None = None
    enable_mtls: bool | None = None


def lint(path: Path, now: datetime) -> list[str]:
    """Everything that is wrong with a router's configuration file, a sentence each.

    Raises KeysError where it cannot be read as one.
    """
    try:
        path.read_bytes()
        config = zenoh.Config.from_file(str(path))
    except OSError as error:
        raise KeysError(f"{path}: {error.strerror}") from None
    except zenoh.ZError as error:
        raise KeysError(f"{path}: Zenoh cannot read it: {words(error)}") from None
    access = msgspec.json.decode(config.get_json("access_control"), type=_Access)
    tls = msgspec.json.decode(config.get_json("transport/link/tls"), type=_Tls)
    return [
        *_doors(config),
        *_certificates(path.parent, tls, now),
        *_access(access),
        *_people(path.parent.parent, access),
    ]


def _doors(config: zenoh.Config) -> Iterator[str]:
    if config.get_json("mode") != '"router"':
        yield 'mode: must be "router": only a router hands ranges on between others'
    listen = msgspec.json.decode(config.get_json("listen/endpoints"))
    endpoints = listen.get("router", []) if isinstance(listen, dict) else listen
    if not endpoints:
        yield "listen.endpoints: there are none, and Zenoh then listens in the clear on every interface"
    for endpoint in endpoints:
        if not endpoint.startswith(("tls/", "quic/")):
            yield f"listen.endpoints: {endpoint} is in the clear: anybody may connect, without a certificate"
    if config.get_json("scouting/multicast/enabled") != "false":
        yield "scouting.multicast.enabled: must be false: it connects to whoever is found"


def _certificates(place: Path, tls: _Tls, now: datetime) -> Iterator[str]:
    if tls.enable_mtls is not True:
        yield "transport.link.tls.enable_mtls: must be true: without it nobody has to show a certificate"
    files = (tls.root_ca_certificate, tls.listen_certificate, tls.listen_private_key)
    if any(file is None for file in files):
        yield (
            "transport.link.tls: root_ca_certificate, listen_certificate and listen_private_key must be named"
        )
        return
    try:
        c = credentials.read_files(*(place / str(file) for file in files))
    except credentials.CredentialsError as error:
        yield str(error)
        return
    if c.until - now < SOON:
        yield f"{c.certificate}: ends on {c.until:%Y-%m-%d}: companion keys DIR --renew router"


def _access(access: _Access) -> Iterator[str]:
    if not access.enabled:
        yield "access_control.enabled: must be true: every certificate of the site may do everything"
    if access.default_permission != "deny":
        yield 'access_control.default_permission: must be "deny": what no rule names is allowed'
    rules, subjects, policies = access.rules or [], access.subjects or [], access.policies or []
    by_id = {rule.id: rule for rule in rules}
    for what, entries in (("rule", [r.id for r in rules]), ("subject", [s.id for s in subjects])):
        for name in sorted({n for n in entries if entries.count(n) > 1}):
            yield f"{what} {name!r}: there are two of this id"
        named = [n for p in policies for n in (p.rules if what == "rule" else p.subjects)]
        for name in dict.fromkeys(named):
            if name not in entries:
                yield f"a policy names the {what} {name!r}, which is not there: Zenoh says nothing of it"
        for name in dict.fromkeys(entries):
            if name not in named:
                yield f"{what} {name!r}: no policy names it, so that it does nothing"
    for rule in rules:
        yield from _rule_keys(rule)
    for subject in subjects:
        if not subject.cert_common_names:
            yield f"subject {subject.id!r}: has no cert_common_names, so that it is everybody"
            continue
        granted = [r for p in policies if subject.id in p.subjects for r in p.rules if r in by_id]
        yield from _writes(subject, [by_id[r] for r in dict.fromkeys(granted)])


def _rule_keys(rule: _Rule) -> Iterator[str]:
    if not rule.key_exprs or not rule.messages:
        yield f"rule {rule.id!r}: names no keys or no messages, so that it does nothing"
    for key in rule.key_exprs:
        expression = zenoh.KeyExpr(key)
        if not any(expression.intersects(zenoh.KeyExpr(used)) for used in _USED):
            yield f"rule {rule.id!r}: {key!r} is no key of a beacon or a vehicle, so that it names nothing"


def _writes(subject: _Subject, rules: Sequence[_Rule]) -> Iterator[str]:
    """Nobody may write more than what is their own."""
    roles = {role.value: role for role in Role}
    for who in subject.cert_common_names or ():
        role, _, name = who.partition("/")
        own = own_keys("*", roles[role], name) if role in roles else ()
        for rule in rules:
            if not rule.allows("ingress") or not _TELLS & set(rule.messages):
                continue
            for key in rule.key_exprs:
                if not any(zenoh.KeyExpr(mine).includes(zenoh.KeyExpr(key)) for mine in own):
                    yield f"rule {rule.id!r}: lets {who} write {key}, which is not its own"


def _people(directory: Path, access: _Access) -> Iterator[str]:
    """The certificates beside the router's, where this is a directory of `companion keys`."""
    if not (directory / "authority").is_dir():
        return
    members = {common_name(m.role, m.name) for m in listing(directory).members}
    named = {name for s in access.subjects or () for name in s.cert_common_names or ()}
    for who in sorted(members - named):
        yield f"{who}: has a certificate, but no rule: it connects, and nothing it says arrives"
    for who in sorted(named - members):
        yield f"{who}: has rules, but no certificate in {directory}"


def near_end(until: datetime, now: datetime) -> str:
    """Words for the end of a certificate: how long it holds, or that it has ended."""
    left: timedelta = until - now
    if left <= timedelta(0):
        return f"EXPIRED on {until:%Y-%m-%d}"
    return f"until {until:%Y-%m-%d}, {left.days} days" + (": renew it" if left < SOON else "")
