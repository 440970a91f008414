"""FiRa UCI: the notification SESSION_INFO_NTF (RANGE_DATA_NTF in older texts), two-way ranging.

A packet is 4 bytes of header (message type, segment flag, group; opcode; reserved; payload length) and the
payload, raw on a serial port: no escaping, no checksum. A long notification comes in segments. Layout after
the public packet descriptions of Pica and Android (`uci_packets.pdl`); numbers are little endian.

Without a checksum, a lost byte shows only in lengths, types and counts; all of them are checked.
"""

from __future__ import annotations

import re
import struct

from companion.types import LineOfSight
from companion.uwb.framing import FrameParser
from companion.uwb.measured import OK, LosRule, Measured, ParseDefect, Unreadable, distance, distinct

_START = re.compile(rb"[\x62\x72]\x00\x00", re.DOTALL)
"""Notification (type 3) of group 2, session control, opcode 0."""
_SEGMENT = 0x10
"""Set in the first byte: not the last segment."""
_HEADER_BYTES = 4
_HEAD = struct.Struct("<IIBIBxB8xB")
"""Sequence, session, control indicator, interval in ms, kind, address mode, number of blocks."""
_BLOCK_BYTES = 31
_TWO_WAY = 1
_LIMIT_BYTES = 16_384
_NO_DISTANCE = 0xFFFF
_STATUS = {
    0x00: OK,
    0x1B: "NEGATIVE_DISTANCE",
    0x20: "TX_FAILED",
    0x21: "RX_TIMEOUT",
    0x22: "RX_PHY_DEC_FAILED",
    0x23: "RX_PHY_TOA_FAILED",
    0x24: "RX_PHY_STS_FAILED",
    0x25: "RX_MAC_DEC_FAILED",
    0x26: "RX_MAC_IE_DEC_FAILED",
    0x27: "RX_MAC_IE_MISSING",
}
_LOS = {
    LosRule.UNKNOWN: {},
    LosRule.ZERO_IS_LOS: {0: LineOfSight.LOS, 1: LineOfSight.NLOS},
    LosRule.ONE_IS_LOS: {1: LineOfSight.LOS, 0: LineOfSight.NLOS},
}


class FiraUci(FrameParser):
    """A stream of UCI packets. Raises ValueError for a rule that this family has no byte for."""

    def __init__(self, los: LosRule = LosRule.UNKNOWN) -> None:
        if los not in _LOS:
            raise ValueError(f"{los.value}: UCI has a line-of-sight byte, no pair of powers")
        super().__init__(_START, 3, _LIMIT_BYTES)
        self._los: dict[int, LineOfSight] = _LOS[los]

    def _end(self, buffer: bytes, begin: int) -> int | None:
        at = begin
        while at + _HEADER_BYTES <= min(len(buffer), begin + _LIMIT_BYTES):
            if not _START.match(buffer, at):
                raise Unreadable(ParseDefect.LENGTH)
            size = buffer[at + 3]
            if size < _HEAD.size and (at == begin or buffer[at] & _SEGMENT):
                raise Unreadable(ParseDefect.LENGTH)
            last = not buffer[at] & _SEGMENT
            at += _HEADER_BYTES + size
            if last:
                return at if at <= len(buffer) else None
        return None

    def _read(self, message: bytes) -> list[Measured]:
        payload = b""
        while message:
            end = _HEADER_BYTES + message[3]
            payload += message[_HEADER_BYTES:end]
            message = message[end:]
        sequence, _, _, _, kind, mode, count = _HEAD.unpack_from(payload)
        if kind > 3 or mode > 1:
            raise Unreadable(ParseDefect.FIELD)
        if kind != _TWO_WAY:  # one-way, DL-TDoA and angle-only sessions measure no distance
            self.skipped_bytes += len(payload)
            return []
        # Vendor data may follow the blocks.
        if len(payload) < _HEAD.size + count * _BLOCK_BYTES:
            raise Unreadable(ParseDefect.LENGTH)
        blocks = (payload[_HEAD.size + i * _BLOCK_BYTES :][:_BLOCK_BYTES] for i in range(count))
        return distinct([self._block(block, 2 if mode == 0 else 8, sequence) for block in blocks])

    def _block(self, block: bytes, address_bytes: int, sequence: int) -> Measured:
        address = int.from_bytes(block[:address_bytes], "little")
        peer = f"0x{address:0{2 * address_bytes}x}"
        code, nlos, distance_cm = struct.unpack_from("<BBH", block, address_bytes)
        status = _STATUS.get(code, f"STATUS_0x{code:02X}")
        if status != OK:
            return Measured(peer=peer, status=status, sequence=sequence)
        if distance_cm == _NO_DISTANCE:
            return Measured(peer=peer, status="NO_DISTANCE", sequence=sequence)
        range_m, status = distance(distance_cm / 100.0)
        # After status, NLOS and distance: four angles with a figure of merit each, the slot, the power.
        raw_rssi = block[address_bytes + 4 + 4 * 3 + 1]
        return Measured(
            peer=peer,
            range_m=range_m,
            los=self._los.get(nlos, LineOfSight.UNKNOWN),
            rssi_dbm=-raw_rssi / 2.0 if raw_rssi else None,
            status=status,
            sequence=sequence,
        )
