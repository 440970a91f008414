"""The few messages that make up a flight's traffic, packed and read without pymavlink's objects.

Its objects cost 10 to 20 µs each in a tight loop, and ten times that after a sleep, when the caches are cold.
Everything else, and every signed link, goes through pymavlink; its tables (formats, checksums' seeds) are
used here as well.
"""

from __future__ import annotations

import struct
from collections import namedtuple
from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import development as mavlink

_V2 = 0xFD
_HEADER = struct.Struct("<BBBBBBBHB")
_CHECKSUM = struct.Struct("<H")
_FRAME_BYTES = _HEADER.size + _CHECKSUM.size


class SetPositionTarget(NamedTuple):
    """SET_POSITION_TARGET_LOCAL_NED, its fields in their order on the wire; sent like pymavlink's own."""

    time_boot_ms: int
    x: float
    y: float
    z: float
    vx: float
    vy: float
    vz: float
    afx: float
    afy: float
    afz: float
    yaw: float
    yaw_rate: float
    type_mask: int
    target_system: int
    target_component: int
    coordinate_frame: int

    def get_msgId(self) -> int:  # noqa: N802 - pymavlink's name
        """The message's id."""
        return int(mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED)

    def pack(self, mav: Any) -> bytes:
        """The packet, with pymavlink's sequence number and ids."""
        kind = mavlink.MAVLink_set_position_target_local_ned_message
        if mav.signing.sign_outgoing:
            return bytes(kind(**self._asdict()).pack(mav))
        payload = kind.unpacker.pack(*self).rstrip(b"\0")  # MAVLink 2 leaves out zeros at the end
        ids = (mav.seq, mav.srcSystem, mav.srcComponent, kind.id & 0xFFFF, kind.id >> 16)
        packet: bytes = _HEADER.pack(_V2, len(payload), 0, 0, *ids) + payload
        return packet + _CHECKSUM.pack(_checksum(packet[1:], kind))


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
    payload = data[_HEADER.size : -_CHECKSUM.size].ljust(size, b"\0")[:size]
    return (told(*kind.unpacker.unpack(payload), (data[5], data[6])),)


def _kind_of(mav: Any, data: bytes) -> Any:
    """pymavlink's class for a datagram that is one sound, unsigned packet; None: let pymavlink look."""
    if len(data) < _FRAME_BYTES or data[0] != _V2 or data[2] or len(data) != _FRAME_BYTES + data[1]:
        return None
    if mav.signing.secret_key is not None or mav.buf_len():
        return None
    kind = mavlink.mavlink_map.get(int.from_bytes(data[7:10], "little"))
    if kind is None or _checksum(data[1:-2], kind) != int.from_bytes(data[-2:], "little"):
        return None
    return kind


def _checksum(data: bytes, kind: Any) -> int:
    return int(mavlink.x25crc(data + bytes((kind.crc_extra,))).crc)
