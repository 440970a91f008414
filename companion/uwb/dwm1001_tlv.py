"""Decawave/Qorvo DWM1001 with PANS firmware, TLV mode: the answer to `dwm_loc_get` (0C 00).

Type, length, value: `40 01 00` (no error), `41 0D` own position, then `49 LL` on a tag (ids of 2 bytes, each
distance with the anchor's position) or `48 LL` on an anchor (ids of 8 bytes). There is no checksum: every
length and count has to fit. LEAPS firmware answers the same command in another layout, which is refused
here because its lengths differ (a time and flags come before the count).
"""

from __future__ import annotations

import re
import struct

from companion.uwb.framing import FrameParser
from companion.uwb.measured import Measured, ParseDefect, Unreadable, distance, distinct

LOC_GET = b"\x0c\x00"
"""The request; the module answers once to each."""

_POSITION_BYTES = 13
_START = re.compile(rb"\x40\x01\x00\x41\x0d", re.DOTALL)
_HEAD_BYTES = 5 + _POSITION_BYTES + 2
_TAG, _ANCHOR = 0x49, 0x48
_LAYOUT = {_TAG: (struct.Struct("<HIB13x"), 4), _ANCHOR: (struct.Struct("<QIB"), 16)}
"""Type → one distance: id, mm, quality in %, (position); hexadecimal digits of the id."""


class Dwm1001Tlv(FrameParser):
    """The module's answers in TLV mode."""

    def __init__(self) -> None:
        super().__init__(_START, 5, _HEAD_BYTES + 255)

    def _end(self, buffer: bytes, begin: int) -> int | None:
        at = begin + _HEAD_BYTES
        if len(buffer) <= at:
            return None
        kind, size, count = buffer[at - 2], buffer[at - 1], buffer[at]
        if kind not in _LAYOUT:
            raise Unreadable(ParseDefect.FIELD)
        if size != 1 + count * _LAYOUT[kind][0].size:
            raise Unreadable(ParseDefect.LENGTH)
        return at + size if at + size <= len(buffer) else None

    def _read(self, message: bytes) -> list[Measured]:
        layout, digits = _LAYOUT[message[_HEAD_BYTES - 2]]
        if message[_HEAD_BYTES - 3] > 100:  # the position's quality, in %
            raise Unreadable(ParseDefect.FIELD)
        measured = []
        for identity, millimetres, quality in layout.iter_unpack(message[_HEAD_BYTES + 1 :]):
            if quality > 100:
                raise Unreadable(ParseDefect.FIELD)
            range_m, status = distance(millimetres / 1000.0)
            measured.append(Measured(peer=f"{identity:0{digits}X}", range_m=range_m, status=status))
        return distinct(measured)
