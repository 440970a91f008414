"""What stands in the record of a flight: events and outputs by topic, and how it begins.

`companion.flight_writer` lays it out, `companion.recorder` keeps it while flying, `companion.recording` reads
it back.
"""

from __future__ import annotations

import hashlib
import platform
import time
import zlib
from importlib import metadata
from pathlib import Path
from typing import get_args

import msgspec

from companion.compiled import form
from companion.types import AnyEvent, AnyOutput, Event, Output

METADATA = "companion.flight"
"""Name of the MCAP metadata record that makes a file a flight of ours."""
END = "companion.end"
"""Name of the metadata record of a flight that was closed: how many events and outputs there were."""
FORMAT = 1
"""Counts up when an older reader could not read the file."""
_LIBRARIES = ("eclipse-zenoh", "mcap", "msgspec", "pymavlink")


def topic_of(kind: type[Event] | type[Output]) -> str:
    """`/event/range`, `/output/setpoint`: the topic on which a type is recorded."""
    config = kind.__struct_config__
    return f"/{config.tag_field}/{config.tag}"


RECORDED: dict[str, type[Event] | type[Output]] = {
    topic_of(kind): kind for kind in (*get_args(AnyEvent), *get_args(AnyOutput))
}
"""Topic → type of everything that is recorded as it is."""
EVENTS = frozenset(get_args(AnyEvent))
"""Those of them that are events."""


class Start(msgspec.Struct, frozen=True):
    """What a record begins with: when, by what, with which configuration.

    The pair `unix_ns`, `monotonic_ns` is one moment on both clocks: it maps the events' `t_ns` to Unix time.
    `config` is the effective configuration as JSON; `sources` tells where a dotted key's value came from.
    """

    unix_ns: int
    monotonic_ns: int
    config: str
    digest: str
    sources: dict[str, str]
    versions: dict[str, str]
    kind: str = "flight"

    def unix_of(self, t_ns: int) -> int:
        """The local monotonic time as Unix time, ns."""
        return max(0, t_ns - self.monotonic_ns + self.unix_ns)

    def as_metadata(self) -> dict[str, str]:
        """As MCAP keeps it: text only, and unlike the rest of the file without a checksum of its own."""
        fields = {
            "format": str(FORMAT),
            "kind": self.kind,
            "unix_ns": str(self.unix_ns),
            "monotonic_ns": str(self.monotonic_ns),
            "versions": msgspec.json.encode(self.versions).decode(),
            "config_digest": self.digest,
            "config": self.config,
            "config_sources": msgspec.json.encode(self.sources).decode(),
        }
        return {**fields, "checksum": _checksum(fields)}

    @classmethod
    def from_metadata(cls, m: dict[str, str]) -> Start:
        """The reverse of `as_metadata`. Raises KeyError, ValueError."""
        if m["checksum"] != _checksum({key: value for key, value in m.items() if key != "checksum"}):
            raise ValueError("checksum of the configuration")
        return cls(
            unix_ns=int(m["unix_ns"]),
            monotonic_ns=int(m["monotonic_ns"]),
            config=m["config"],
            digest=m["config_digest"],
            sources=msgspec.json.decode(m["config_sources"], type=dict[str, str]),
            versions=msgspec.json.decode(m["versions"], type=dict[str, str]),
            kind=m["kind"],
        )


def _checksum(fields: dict[str, str]) -> str:
    return f"{zlib.crc32(msgspec.json.encode(fields, order='sorted')):08x}"


def start_now(config: msgspec.Struct, digest: str, sources: dict[str, str], kind: str = "flight") -> Start:
    """A record that begins now, with this effective configuration."""
    return Start(
        unix_ns=time.time_ns(),
        monotonic_ns=time.monotonic_ns(),
        config=msgspec.json.encode(config).decode(),
        digest=digest,
        sources=sources,
        versions=versions(),
        kind=kind,
    )


def versions() -> dict[str, str]:
    """What runs here: the app with a digest of its source, Python, the machine, the libraries."""
    return {
        "companion": metadata.version("companion"),
        "source": _source_digest(Path(__file__).parent),
        "core": form(),
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}, {' '.join(platform.libc_ver())}",
        **{name: metadata.version(name) for name in _LIBRARIES},
    }


def _source_digest(package: Path) -> str:
    """Tells two states of the code apart that carry the same version."""
    digest = hashlib.sha256()
    for path in sorted(package.rglob("*.py")):
        digest.update(path.relative_to(package).as_posix().encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
