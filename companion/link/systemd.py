"""Telling systemd that the flight is alive (sd_notify): one datagram, sent by the loop or not at all.

READY=1 and WATCHDOG=1 go with our own HEARTBEAT, which the loop computes once a second: a loop that hangs
tells neither, and systemd ends the process. Outside systemd ($NOTIFY_SOCKET is not set) nothing is sent.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping

from companion.types import CompanionHeartbeat, Output, PhaseChange

_LONGEST_STATUS = 200


class Notifier:
    """The service's end of sd_notify. No method blocks or raises: what cannot be sent is dropped."""

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        self._address = _address(environment.get("NOTIFY_SOCKET", ""))
        self._socket: socket.socket | None = None
        if self._address is not None:
            self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
            self._socket.setblocking(False)

    def send(self, output: Output) -> None:
        """Tell systemd what an output of the loop means: a HEARTBEAT is life, a phase change the status."""
        if isinstance(output, CompanionHeartbeat):
            self._tell("READY=1\nWATCHDOG=1")  # ready again means nothing to systemd, but one may get lost
        elif isinstance(output, PhaseChange):
            self.status(f"{output.after.value}: {output.reason}")

    def status(self, text: str) -> None:
        """One line for `systemctl status`."""
        line = " ".join(text.split())[:_LONGEST_STATUS]
        self._tell(f"STATUS={line}")

    def close(self) -> None:
        """Say that the flight is over, and give the socket back."""
        self._tell("STOPPING=1")
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _tell(self, state: str) -> None:
        if self._socket is None or self._address is None:
            return
        try:
            self._socket.sendto(state.encode(errors="replace"), self._address)
        except OSError:  # systemd is gone or its buffer is full: its watchdog decides, the flight goes on
            return


def _address(name: str) -> bytes | None:
    """The socket's address: a path, or with `@` a name in the abstract namespace; None for anything else."""
    if name.startswith("/"):
        return os.fsencode(name)
    return b"\0" + os.fsencode(name[1:]) if name.startswith("@") and len(name) > 1 else None
