"""One MAVLink channel over UDP, signed or not."""

from __future__ import annotations

import socket
import struct
import time

from pymavlink.dialects.v20 import development as mavlink

from sitl_mock.streams import Message

_DATAGRAM_BYTES = 65_535
_RECEIVE_BUFFER_BYTES = 1 << 20
_SIGNING_EPOCH_S = 1_420_070_400
"""2015-01-01: signing counts units of 10 µs from there."""
_UNSIGNED = frozenset({mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAVLINK_MSG_ID_RADIO_STATUS})


def read_key(text: bytes) -> bytes:
    """A key of 32 bytes, raw or as 64 hexadecimal digits; raise ValueError for anything else."""
    if len(text) == 32:
        return text
    try:
        key = bytes.fromhex(text.decode("ascii").strip())
    except (UnicodeDecodeError, ValueError):
        key = b""
    if len(key) != 32:
        raise ValueError("a signing key is 32 bytes, raw or as 64 hexadecimal digits")
    return key


def _signing(key: bytes) -> mavlink.MAVLinkSigning:
    signing = mavlink.MAVLinkSigning()
    signing.secret_key = key
    signing.timestamp = int((time.time() - _SIGNING_EPOCH_S) * 1e5)
    signing.allow_unsigned_callback = lambda _, message_id: message_id in _UNSIGNED
    return signing


def _parse(datagram: bytes, verifying: mavlink.MAVLinkSigning | None) -> list[Message]:
    """The messages in a datagram. Each begins afresh: garbage in one does not swallow the next."""
    parser = mavlink.MAVLink(None)
    parser.robust_parsing = True
    if verifying is not None:
        parser.signing = verifying
    try:
        messages = parser.parse_buffer(datagram) or []
    except (mavlink.MAVError, struct.error, ValueError):
        return []
    return [m for m in messages if m.get_type() != "BAD_DATA" and not m.get_type().startswith("UNKNOWN")]


class Udp:
    """One MAVLink channel over UDP with exactly one peer.

    `udpout` sends to a peer from the start, as PX4 does; `udpin` waits for the first one that speaks.
    With a key it signs what it sends and hears signed messages only, but for HEARTBEAT and RADIO_STATUS,
    which PX4 accepts unsigned. Raises ValueError for what is no such URL, OSError where the port cannot be
    had.
    """

    def __init__(self, url: str, system_id: int, key: bytes | None = None) -> None:
        kind, _, where = url.partition(":")
        host, _, port = where.removeprefix("//").rpartition(":")
        if kind not in ("udpin", "udpout") or not host or not port.isdecimal() or int(port) > 65_535:
            raise ValueError(f"MAVLink URL {url!r}: must be udpout:HOST:PORT or udpin:HOST:PORT")
        if kind == "udpout" and not int(port):
            raise ValueError(f"MAVLink URL {url!r}: the peer's port must be above 0")
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER_BYTES)
        self._socket.setblocking(False)
        address = (socket.gethostbyname(host), int(port))
        self._peer: tuple[str, int] | None = None
        if kind == "udpin":
            self._socket.bind(address)
            address = self._socket.getsockname()
        else:
            self._peer = address
        self.url = f"{kind}:{address[0]}:{address[1]}"
        """Where it really is: the port is the system's choice if 0 was asked for."""
        self._mav = mavlink.MAVLink(None, srcSystem=system_id, srcComponent=mavlink.MAV_COMP_ID_AUTOPILOT1)
        self._verifying = None if key is None else _signing(key)
        if key is not None:
            self._mav.signing = _signing(key)
            self._mav.signing.sign_outgoing = True

    def sign(self, on: bool) -> None:
        """With a key: sign what is sent, or leave it for now."""
        if self._verifying is not None:
            self._mav.signing.sign_outgoing = on

    @property
    def system_id(self) -> int:
        """The autopilot's id in what is sent."""
        number: int = self._mav.srcSystem
        return number

    @system_id.setter
    def system_id(self, number: int) -> None:
        self._mav.srcSystem = number

    def fileno(self) -> int:
        """The descriptor to wait on."""
        return self._socket.fileno()

    def send(self, message: Message, lost: bool = False) -> None:
        """Send one message; nothing before a peer is known. A lost one leaves its gap in the sequence."""
        if self._peer is None:
            return
        data = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256  # pack() leaves it alone
        if not lost:
            self.forward(data)

    def forward(self, data: bytes) -> None:
        """Send a packet as it is, with its sender's ids."""
        if self._peer is None:
            return
        try:
            self._socket.sendto(data, self._peer)
        except OSError:  # nobody there, buffer full, no route: UDP loses packets
            return

    def receive(self) -> list[Message]:
        """Every message that has come from the peer. Garbage and strangers are ignored."""
        messages: list[Message] = []
        while True:
            try:
                data, sender = self._socket.recvfrom(_DATAGRAM_BYTES)
            except (BlockingIOError, ConnectionRefusedError):
                return messages
            if self._peer is not None and sender != self._peer:
                continue
            good = _parse(data, self._verifying)
            if good and self._peer is None:
                self._peer = sender
            messages += good

    def close(self) -> None:
        """Give the port back."""
        self._socket.close()
