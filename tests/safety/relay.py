"""A relay on a MAVLink link that notes what goes through: what did the app really send?"""

from __future__ import annotations

import select
import socket
import threading
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

from pymavlink.dialects.v20 import development as mavlink


class Relay:
    """Stands between the app (`udpout:` to `port`) and a mock that listens."""

    def __init__(self, mock_port: int) -> None:
        self._app = _socket()
        self._app.bind(("127.0.0.1", 0))
        self._mock = _socket()
        self._mock.connect(("127.0.0.1", mock_port))
        self.port = int(self._app.getsockname()[1])
        self.sent: list[Any] = []
        """Every message of the app since the list was cleared."""
        self.log: list[tuple[float, Any]] = []
        """Every message of the app and when it came, monotonic seconds."""
        self.up: Callable[[bytes], Iterable[bytes]] = lambda packet: (packet,)
        self.down: Callable[[bytes], Iterable[bytes]] = lambda packet: (packet,)
        """What becomes of a packet on its way to the mock (once it is noted), and from it."""
        self._mav = mavlink.MAVLink(None, srcSystem=255, srcComponent=190)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._over.set()
        self._thread.join(10.0)
        self._app.close()
        self._mock.close()

    def command(self, message: Any) -> None:
        """Say something to the mock in a person's place; not noted as the app's."""
        self._mock.send(bytes(message.pack(self._mav)))

    def _run(self) -> None:
        peer: tuple[str, int] | None = None
        while not self._over.is_set():
            for ready in select.select([self._app, self._mock], [], [], 0.1)[0]:
                with suppress(OSError):  # either end may be gone
                    if ready is self._app:
                        data, peer = self._app.recvfrom(65_535)
                        parser = mavlink.MAVLink(None)
                        parser.robust_parsing = True
                        messages = parser.parse_buffer(data) or []
                        self.sent += messages
                        self.log += [(time.monotonic(), message) for message in messages]
                        for packet in self.up(data):
                            self._mock.send(packet)
                    else:
                        data = self._mock.recv(65_535)
                        if peer is not None:
                            for packet in self.down(data):
                                self._app.sendto(packet, peer)


def _socket() -> socket.socket:
    return socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
