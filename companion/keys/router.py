"""The router's configuration: TLS on both sides, and who may do what, by the common name of the certificate.

Everything is denied that no rule allows. Seen from the router, `ingress` is what somebody sends and `egress`
what somebody is told. A beacon must be told of subscribers and queries for the whole site: Zenoh compares key
expressions as they were declared, and where it is not told that anybody listens it sends nothing.
"""

from __future__ import annotations

import json
from typing import Any, NamedTuple

from companion.keys.certificates import Role, common_name
from companion.link.zenoh_session import LEASE_MS
from companion.wire_range import KEY_VERSION
from companion.wire_status import KEY_VERSION as VEHICLE_KEYS
from companion.wire_status import alive_key, status_key

BEGIN = "  // access control: written by `companion keys`, anew whenever somebody is added"
END = "  // end of access control"

_TELLS = ("put", "reply", "declare_queryable", "liveliness_token")
_ASKS = ("declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber")


class Site(NamedTuple):
    """Who there is at a site, by id."""

    name: str
    members: tuple[tuple[Role, str], ...]

    @property
    def keys(self) -> str:
        """All that the site's beacons publish."""
        return f"{KEY_VERSION}/{self.name}/**"


def router_config(site: Site, port: int) -> str:
    """A whole configuration for zenohd, to be started in the directory of its certificate."""
    return _HEAD % {"site": site.name, "port": port, "lease": LEASE_MS} + access_control(site) + _TAIL


def with_access_control(text: str, site: Site) -> str:
    """An existing configuration with the rules of today; the rest stays. Raises ValueError: no marks."""
    before, begin, rest = text.partition(BEGIN + "\n")
    _, end, after = rest.partition(END + "\n")
    if not begin or not end:
        raise ValueError(f"the lines {BEGIN.strip()!r} and {END.strip()!r} are gone")
    return before + access_control(site) + after


def access_control(site: Site) -> str:
    """The block between the two marks."""
    rules, subjects, policies = _rules(site)
    lines = [
        BEGIN,
        "  access_control: {",
        "    enabled: true,",
        '    default_permission: "deny",',
        *_list("rules", rules),
        *_list("subjects", subjects),
        *_list("policies", policies),
        "  },",
        END,
    ]
    return "\n".join(lines) + "\n"


def _rules(site: Site) -> tuple[list[Any], list[Any], list[Any]]:
    everything = (site.keys, f"{VEHICLE_KEYS}/**")
    rules = [
        _rule("ask", "ingress", _ASKS, *everything),
        _rule("be answered", "egress", _TELLS, *everything),
        _rule("be asked", "egress", _ASKS, *everything),
    ]
    subjects, policies = [], []
    for role, name in site.members:
        who = common_name(role, name)
        if own := own_keys(site.name, role, name):
            messages = ("put", "liveliness_token") if role is Role.VEHICLE else _TELLS
            rules.append(_rule(f"{who} tells", "ingress", messages, *own))
        subjects.append({"id": who, "cert_common_names": [who]})
        policies.append({"subjects": [who], "rules": [*_MAY[role], *([f"{who} tells"] if own else [])]})
    return rules, subjects, policies


_MAY = {
    Role.ROUTER: ("ask", "be answered", "be asked"),
    Role.BEACON: ("be asked",),
    Role.TAG: ("be asked",),
    Role.VEHICLE: ("ask", "be answered", "be asked"),
    Role.WATCHER: ("ask", "be answered"),
}


def own_keys(site: str, role: Role, name: str) -> tuple[str, ...]:
    """What one may write. Another router hands on what it let in by the same rules."""
    return {
        Role.ROUTER: (f"{KEY_VERSION}/{site}/**", f"{VEHICLE_KEYS}/**"),
        Role.BEACON: (f"{KEY_VERSION}/{site}/{name}/**",),
        Role.TAG: (f"{KEY_VERSION}/{site}/*/{name}/range",),
        Role.VEHICLE: (status_key(name), alive_key(name)),
        Role.WATCHER: (),
    }[role]


def _rule(name: str, flow: str, messages: tuple[str, ...], *keys: str) -> dict[str, Any]:
    return {
        "id": name,
        "permission": "allow",
        "flows": [flow],
        "messages": list(messages),
        "key_exprs": list(keys),
    }


def _list(name: str, entries: list[Any]) -> list[str]:
    return [f"    {name}: [", *(f"      {json.dumps(entry)}," for entry in entries), "    ],"]


_HEAD = """\
// Router of the site %(site)s: mutual TLS, and nobody does what is not allowed below.
//
//   cd DIRECTORY_OF_THIS_FILE && zenohd -c zenoh.json5
//
// After a change: companion keys --check zenoh.json5, and start the router again. It reads this once.
{
  mode: "router",
  listen: { endpoints: ["tls/0.0.0.0:%(port)d"], exit_on_failure: true },
  scouting: { multicast: { enabled: false }, gossip: { enabled: false } },
  adminspace: { enabled: false },
  transport: {
    link: {
      protocols: ["tls"],
      // a connection on which nothing has come for so long is given up, milliseconds
      tx: { lease: %(lease)d },
      tls: {
        root_ca_certificate: "ca.pem",
        enable_mtls: true,
        listen_certificate: "certificate.pem",
        listen_private_key: "key.pem",
        // to other routers
        connect_certificate: "certificate.pem",
        connect_private_key: "key.pem",
        verify_name_on_connect: true,
        // nobody stays in on a certificate that has expired
        close_link_on_expiration: true,
      },
    },
  },
"""
_TAIL = "}\n"
