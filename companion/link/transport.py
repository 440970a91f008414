"""Bytes to and from an autopilot: UDP in, UDP out, TCP and serial behind one small interface."""

from __future__ import annotations

import select
import socket
from typing import Protocol

import serial

_DATAGRAM_BYTES = 65_535
_RECEIVE_BUFFER_BYTES = 1 << 20
"""The kernel's default overflows at about 300 small packets, one second of a default PX4 link."""
ECHOES = 256
"""So many packets are known again where a bridge sends them back: a few seconds of them."""
_PEER_GONE_NS = 2_000_000_000
"""A vehicle that has been silent for so long may speak from another address (a router that was restarted)."""


class Transport(Protocol):
    """A link that can be waited on. No call blocks; what cannot be sent is dropped."""

    def fileno(self) -> int:
        """The descriptor to wait on."""

    def receive(self) -> bytes:
        """What has come, or b'' where there is nothing (more)."""

    def send(self, data: bytes) -> None:
        """Send one packet."""

    def close(self) -> None:
        """Give the port back."""


class Udp:
    """A datagram socket; unbound (`udpout`) it knows its peer, bound (`udpin`) it answers who spoke last.

    Once it has settled on a peer nobody else is answered, until that one has been silent for a while: a
    stranger's packet must not lead the setpoints astray.
    """

    def __init__(self, bind: tuple[str, int] | None, peer: tuple[str, int] | None) -> None:
        self._peer = None if peer is None else (socket.gethostbyname(peer[0]), peer[1])
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
        if bind is not None:
            self._socket.bind(bind)
        self._socket.setblocking(False)
        self._arrived = select.poll()
        self._arrived.register(self._socket, select.POLLIN)
        self._answers_anybody = peer is None
        self._source: tuple[str, int] | None = None
        self._t_peer_ns: int | None = None

    def fileno(self) -> int:
        """The descriptor to wait on."""
        return self._socket.fileno()

    def receive(self) -> bytes:
        """One datagram."""
        try:
            data, self._source = self._socket.recvfrom(_DATAGRAM_BYTES)
        except (BlockingIOError, ConnectionRefusedError):
            return b""
        if self._answers_anybody:
            self._peer = self._source
        return data

    def has_more(self) -> bool:
        """Whether a datagram waits. An exception would tell it too, at five times the price."""
        return bool(self._arrived.poll(0))

    def is_from_peer(self, t_ns: int) -> bool:
        """Whether the last datagram came from the peer's address."""
        if self._source != self._peer:
            return False
        self._t_peer_ns = t_ns
        return True

    def settle(self, t_ns: int) -> bool:
        """Make the last datagram's sender the peer, where it is none other's turn."""
        is_taken = self._t_peer_ns is not None and t_ns - self._t_peer_ns < _PEER_GONE_NS
        if self._source != self._peer and is_taken:
            return False
        self._peer, self._answers_anybody, self._t_peer_ns = self._source, False, t_ns
        return True

    def send(self, data: bytes) -> None:
        """One datagram; nothing before a peer is known."""
        if self._peer is not None:
            try:
                self._socket.sendto(data, self._peer)
            except OSError:  # no route, no listener, full buffer: UDP may lose packets, and the silence shows
                return

    def close(self) -> None:
        """Give the port back."""
        self._socket.close()


class Tcp:
    """A client connection; when it breaks, nothing comes any more and the vehicle counts as gone."""

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.create_connection((host, port), timeout=5.0)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setblocking(False)

    def fileno(self) -> int:
        """The descriptor to wait on."""
        return self._socket.fileno()

    def receive(self) -> bytes:
        """Up to one buffer of the stream. Raises ConnectionError when the peer has closed it."""
        try:
            data = self._socket.recv(_DATAGRAM_BYTES)
        except BlockingIOError:
            return b""
        if not data:
            raise ConnectionError("the autopilot's TCP connection was closed")
        return data

    def send(self, data: bytes) -> None:
        """Part of the stream; dropped where the buffer is full. A packet cut short is resynchronised."""
        try:
            self._socket.send(data)
        except BlockingIOError:
            return

    def close(self) -> None:
        """End the connection."""
        self._socket.close()


class Serial:
    """A serial port, 8N1."""

    def __init__(self, device: str, baud: int) -> None:
        self._port = serial.Serial(device, baud, timeout=0, write_timeout=0)

    def fileno(self) -> int:
        """The descriptor to wait on."""
        return int(self._port.fileno())

    def receive(self) -> bytes:
        """What the port's buffer holds."""
        return bytes(self._port.read(4096))

    def send(self, data: bytes) -> None:
        """Part of the stream; dropped where the buffer is full."""
        try:
            self._port.write(data)
        except serial.SerialTimeoutException:
            return

    def close(self) -> None:
        """Give the port back."""
        self._port.close()


def has_more(transport: Transport) -> bool:
    """Whether it is worth while to receive again at once. Only a datagram socket can tell."""
    return not isinstance(transport, Udp) or transport.has_more()


def is_from_peer(transport: Transport, t_ns: int) -> bool:
    """Whether what was received last came from where is sent to: anybody may send a datagram."""
    return not isinstance(transport, Udp) or transport.is_from_peer(t_ns)


def settle(transport: Transport, t_ns: int) -> bool:
    """What was received last is the vehicle's: send there from now on. False: it is known to be elsewhere."""
    return not isinstance(transport, Udp) or transport.settle(t_ns)


_FORMS = "udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD"


def parse_url(url: str) -> tuple[str, str, int]:
    """Split a URL into kind, host or device, and port or baud rate. Raises ValueError."""
    kind, _, rest = url.partition(":")
    where, _, number = rest.removeprefix("//").rpartition(":")
    limit = 65_535 if kind != "serial" else 20_000_000
    if kind not in ("udpin", "udpout", "tcp", "serial") or not where or not number.isdecimal():
        raise ValueError(f"{url!r} is no MAVLink URL: {_FORMS}")
    if not 0 < int(number) <= limit:
        raise ValueError(f"{url!r}: {number} is not between 1 and {limit}")
    return kind, where, int(number)


def open_transport(url: str) -> Transport:
    """Open what a MAVLink URL names. Raises ValueError (not a URL) or OSError (cannot be opened)."""
    kind, where, number = parse_url(url)
    if kind == "serial":
        return Serial(where, number)
    if kind == "tcp":
        return Tcp(where, number)
    return Udp((where, number), None) if kind == "udpin" else Udp(None, (where, number))
