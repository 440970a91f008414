"""MAVLink 2 packets: those that make up a flight's traffic are read and packed without pymavlink's objects.

Its objects cost 10 to 20 µs each in a tight loop, and ten times that after a sleep, when the caches are cold.
Everything else, and every signed link, goes through pymavlink; its tables (formats, checksums' seeds) are
used here as well.
"""

from __future__ import annotations

import struct
from collections import namedtuple
from collections.abc import Collection, Sequence
from typing import Any, Final

import msgspec
from fastcrc.crc16 import mcrf4xx
from pymavlink.dialects.v20 import development as mavlink

_V2 = 0xFD
_HEADER_BYTES = 10
_FRAME_BYTES = 12
"""Header and checksum."""

# SET_POSITION_TARGET_LOCAL_NED: its number, its payload's size, the checksum's seed, to whom.
_SETPOINT = 84
_SETPOINT_BYTES = 53
_SETPOINT_SEED = 143
_AUTOPILOT = 1
_pack_setpoint: Final = struct.Struct("<B2x3BHx I8x4f16xf H3B B").pack
"""What the checksum is of: the header after its first byte; the payload, in which x, y, the accelerations and
the yaw stay 0; the seed."""
_seal_setpoint: Final = struct.Struct("<B62sH").pack
"""The first byte, the 62 from there up to the seed, the checksum."""

_FIELDS = {
    kind.id: namedtuple(kind.msgname, kind.ordered_fieldnames)
    for kind in (
        mavlink.MAVLink_attitude_message,
        mavlink.MAVLink_current_mode_message,
        mavlink.MAVLink_extended_sys_state_message,
        mavlink.MAVLink_heartbeat_message,
        mavlink.MAVLink_local_position_ned_message,
    )
}
"""By number, what is read here: it comes often, and has neither arrays nor texts."""


class _Kind(msgspec.Struct, frozen=True):
    """A message as pymavlink knows it, looked up once."""

    name: str
    number: int
    seed: bytes
    """What the checksum goes on with after the packet."""
    fields: Any
    """What its values are read into; None: left to pymavlink."""
    unpack: Any
    payload_bytes: int
    """Zeros at its end may have been left out, and a later dialect may add to it."""


_KINDS: Final = {
    kind.id: _Kind(
        kind.msgname,
        kind.id,
        bytes((kind.crc_extra,)),
        _FIELDS.get(kind.id),
        kind.unpacker.unpack,
        kind.unpacker.size,
    )
    for kind in mavlink.mavlink_map.values()
}


class Packet(msgspec.Struct, frozen=True):
    """A packet that has come."""

    data: bytes
    name: str
    """Its message's; "BAD_DATA" for what is none."""
    number: int
    system: int
    component: int
    is_signed: bool
    """The signature was verified: only such a one is believed about modes, where there is a key."""
    fields: Any
    """The message's, by their names; of "BAD_DATA" its `reason`."""


def packets(mav: Any, data: bytes, heard: Collection[str]) -> Sequence[Packet]:
    """What has been received, "BAD_DATA" where it is damaged.

    Where a datagram is one sound packet, it is dropped unless its name is `heard`.
    """
    kind = _kind_of(mav, data)
    if kind is not None and kind.name not in heard:
        return ()
    if kind is None or kind.fields is None:
        return [_parsed(message) for message in mav.parse_buffer(data) or ()]
    payload, size = data[_HEADER_BYTES:-2], kind.payload_bytes
    if len(payload) != size:
        payload = payload.ljust(size, b"\0")[:size]
    values = tuple.__new__(kind.fields, kind.unpack(payload))  # as `_make`, but for a call of Python
    return (Packet(data, kind.name, kind.number, data[5], data[6], False, values),)


def _kind_of(mav: Any, data: bytes) -> _Kind | None:
    """The message of a datagram that is one sound, unsigned packet; None: let pymavlink look."""
    if len(data) < _FRAME_BYTES or data[0] != _V2 or data[2] or len(data) != _FRAME_BYTES + data[1]:
        return None
    if mav.signing.secret_key is not None or mav.buf:  # the parser waits for the rest of a packet
        return None
    kind = _KINDS.get(data[7] | data[8] << 8 | data[9] << 16)
    if kind is None or mcrf4xx(data[1:-2] + kind.seed) != data[-2] | data[-1] << 8:
        return None
    return kind


def _parsed(m: Any) -> Packet:
    """pymavlink's message as a packet."""
    ids = (m.get_msgId(), m.get_srcSystem(), m.get_srcComponent())
    return Packet(bytes(m.get_msgbuf()), m.get_type(), *ids, m.get_signed(), m)


class SetPositionTarget(msgspec.Struct, frozen=True):
    """SET_POSITION_TARGET_LOCAL_NED for our autopilot, as far as it is used; sent like pymavlink's own."""

    time_boot_ms: int
    z: float
    vx: float
    vy: float
    vz: float
    yaw_rate: float
    type_mask: int
    target_system: int
    coordinate_frame: int

    def get_msgId(self) -> int:  # noqa: N802 - pymavlink's name
        """The message's id."""
        return int(mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED)

    def pack(self, mav: Any) -> bytes:
        """The packet as pymavlink makes it: signed, where it signs."""
        message = mavlink.MAVLink_set_position_target_local_ned_message(
            self.time_boot_ms, self.target_system, mavlink.MAV_COMP_ID_AUTOPILOT1, self.coordinate_frame,
            self.type_mask, 0.0, 0.0, self.z, self.vx, self.vy, self.vz, 0.0, 0.0, 0.0, 0.0, self.yaw_rate,
        )  # fmt: skip
        return bytes(message.pack(mav))

    def unsigned(self, seq: int, system: int, component: int) -> bytes:
        """The same packet without a signature, from the system and component given. The frame is never 0:
        MAVLink 2 would leave out zeros at the end."""
        summed = _pack_setpoint(
            _SETPOINT_BYTES, seq, system, component, _SETPOINT,
            self.time_boot_ms, self.z, self.vx, self.vy, self.vz, self.yaw_rate,
            self.type_mask, self.target_system, _AUTOPILOT, self.coordinate_frame, _SETPOINT_SEED,
        )  # fmt: skip
        return _seal_setpoint(_V2, summed, mcrf4xx(summed))
