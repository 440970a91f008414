"""The message that makes up a flight's traffic, packed without pymavlink's objects; `telemetry_frames` reads.

Its objects cost 10 to 20 µs each in a tight loop, and ten times that after a sleep, when the caches are cold.
Everything else, and every signed link, goes through pymavlink; its tables (formats, checksums' seeds) are
used here as well.
"""

from __future__ import annotations

import struct
from typing import Any, NamedTuple

from pymavlink.dialects.v20 import development as mavlink

V2 = 0xFD
HEADER = struct.Struct("<BBBBBBBHB")
CHECKSUM = struct.Struct("<H")


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
        packet: bytes = HEADER.pack(V2, len(payload), 0, 0, *ids) + payload
        return packet + CHECKSUM.pack(checksum(packet[1:], kind))


def checksum(data: bytes, kind: Any) -> int:
    """MAVLink's, of everything after the first byte, seeded by the message's kind."""
    return int(mavlink.x25crc(data + bytes((kind.crc_extra,))).crc)
