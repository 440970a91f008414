"""The two telemetry messages that come most often, read without pymavlink's objects (see `frames`)."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Collection, Sequence
from typing import Any

from pymavlink.dialects.v20 import development as mavlink

from companion.link.frames import CHECKSUM, HEADER, V2, checksum

_FRAME_BYTES = HEADER.size + CHECKSUM.size


class _Told:
    """What is read here answers as pymavlink's messages do."""

    __slots__ = ()
    kind: Any
    src: tuple[int, int]

    def get_type(self) -> str:
        return str(self.kind.msgname)

    def get_msgId(self) -> int:  # noqa: N802
        return int(self.kind.id)

    def get_srcSystem(self) -> int:  # noqa: N802
        return self.src[0]

    def get_srcComponent(self) -> int:  # noqa: N802
        return self.src[1]


def _told(kind: Any) -> type:
    fields = namedtuple(kind.msgname, [*kind.ordered_fieldnames, "src"])  # type: ignore[misc]
    return type(kind.msgname, (_Told, fields), {"__slots__": (), "kind": kind})


_READ = {
    kind.id: _told(kind)
    for kind in (mavlink.MAVLink_attitude_message, mavlink.MAVLink_local_position_ned_message)
}


def messages(mav: Any, data: bytes, wanted: Collection[str]) -> Sequence[Any]:
    """What has been received, as pymavlink's messages or alike; BAD_DATA among them where it is damaged.

    Where a datagram is one sound packet, it is dropped unless its name is `wanted`.
    """
    kind = _kind_of(mav, data)
    if kind is None:
        return mav.parse_buffer(data) or ()
    if kind.msgname not in wanted:
        return ()
    told = _READ.get(kind.id)
    if told is None:
        return mav.parse_buffer(data) or ()
    size = kind.unpacker.size
    payload = data[HEADER.size : -CHECKSUM.size].ljust(size, b"\0")[:size]
    return (told(*kind.unpacker.unpack(payload), (data[5], data[6])),)


def _kind_of(mav: Any, data: bytes) -> Any:
    """pymavlink's class for a datagram that is one sound, unsigned packet; None: let pymavlink look."""
    if len(data) < _FRAME_BYTES or data[0] != V2 or data[2] or len(data) != _FRAME_BYTES + data[1]:
        return None
    if mav.signing.secret_key is not None or mav.buf_len():
        return None
    kind = mavlink.mavlink_map.get(int.from_bytes(data[7:10], "little"))
    if kind is None or checksum(data[1:-2], kind) != int.from_bytes(data[-2:], "little"):
        return None
    return kind
