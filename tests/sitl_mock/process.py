"""Runs the mock in a process of its own, and finds ports for it."""

from __future__ import annotations

import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import NamedTuple

START_LIMIT_S = 60.0


class RunningMock(NamedTuple):
    """A mock that listens, and what it said of each endpoint: kind → address."""

    process: subprocess.Popen[str]
    endpoints: dict[str, str]


def free_udp_port() -> int:
    """A UDP port on the loopback interface that nobody had a moment ago."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@contextmanager
def running_mock(*arguments: str, endpoints: int = 3) -> Iterator[RunningMock]:
    """Start `sitl-mock` with these arguments, wait for its `listening` lines, end it afterwards."""
    command = [sys.executable, "-m", "sitl_mock", "--zenoh-listen", "tcp/127.0.0.1:0", *arguments]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1)
    try:
        yield RunningMock(process, _listening(process, endpoints))
    finally:
        by_itself = process.poll()
        process.terminate()
        try:
            _, said = process.communicate(timeout=10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            _, said = process.communicate()
    assert by_itself in (None, 0, -signal.SIGKILL), f"the mock ended by itself with {by_itself}: {said}"


def _listening(process: subprocess.Popen[str], count: int) -> dict[str, str]:
    assert process.stdout is not None
    assert process.stderr is not None
    descriptor = process.stdout.fileno()
    deadline = time.monotonic() + START_LIMIT_S
    said = ""
    while said.count("\n") < count:
        ready, _, _ = select.select([descriptor], [], [], max(deadline - time.monotonic(), 0.0))
        # Not readline(): what it buffers beyond a line is invisible to select().
        data = os.read(descriptor, 4096).decode() if ready else ""
        if not data:
            process.kill()
            raise AssertionError(f"the mock does not listen: {said!r} {process.stderr.read()}")
        said += data
    lines = [line.removeprefix("listening: ").rpartition(" ") for line in said.splitlines()]
    return {kind: address for kind, _, address in lines}
