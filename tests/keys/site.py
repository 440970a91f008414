"""A site as `companion keys` makes it, and its router as a process of its own."""

from __future__ import annotations

import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from companion import cli

BOUND_S = 40.0
NOW = datetime.now(UTC)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def keys(*arguments: str | int | Path) -> int:
    """`companion keys …`; the result is its exit status."""
    return cli.main(["keys", *map(str, arguments)])


def make(directory: Path, port: int = 7447) -> Path:
    """A site with two beacons, a tag, a vehicle and a watcher."""
    members = ["--beacon", "b1", "--beacon", "b2", "--tag", "t1", "--vehicle", "u1", "--watcher", "desk"]
    assert keys(directory, "--site", "lab", "--router", "127.0.0.1", "--port", port, *members) == 0
    return directory


@contextmanager
def router(directory: Path, file: str = "zenoh.json5") -> Iterator[None]:
    """zenohd's stand-in, with the very file and in the directory that it would be started in."""
    code = (
        f"import sys, zenoh; s = zenoh.open(zenoh.Config.from_file('{file}'));"
        "print(); sys.stdin.read(); s.close()"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", code],
        cwd=directory / "router",
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
    )
    assert process.stdin is not None and process.stdout is not None
    try:
        assert process.stdout.readline() == b"\n"
        yield
    finally:
        process.stdin.close()
        process.wait(BOUND_S)
        process.stdout.close()
