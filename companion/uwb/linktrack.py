"""Nooploop LinkTrack and LinkTrack AoA (NLink protocol): the node frames, which carry distances.

A frame: 0x55, mark, u16 length of the whole frame, a fixed part that ends with the number of nodes, the
nodes, and a checksum, the low byte of the sum of everything before it. Vendor code compares length and sum
only; here the length must also fit the number of nodes, and no node may be in a frame twice.

A node is named by the letter of its role and its id: A0 is anchor 0, T7 is tag 7.
"""

from __future__ import annotations

import re
from typing import NamedTuple

from companion.types import LineOfSight
from companion.uwb.framing import FrameParser
from companion.uwb.measured import LosRule, Measured, ParseDefect, Unreadable, distance, distinct

_ROLES = "NATCMSR"
"""Node, anchor, tag, console, data-transmission master and slave, monitor (R: it only receives)."""
_LOS_BELOW_DB = 6.0
_NLOS_ABOVE_DB = 10.0


class _Layout(NamedTuple):
    """Byte offsets of one kind of frame; those of a node count from the node."""

    fixed: int
    time: int
    node: int
    id_bytes: int
    first_path: int


_LAYOUT = {
    0x04: _Layout(fixed=119, time=102, node=13, id_bytes=1, first_path=5),  # LinkTrack NodeFrame2
    0x05: _Layout(fixed=21, time=6, node=7, id_bytes=1, first_path=5),  # LinkTrack NodeFrame3
    0x07: _Layout(fixed=21, time=6, node=11, id_bytes=1, first_path=7),  # LinkTrack AoA NodeFrame0
    0x08: _Layout(fixed=24, time=9, node=10, id_bytes=4, first_path=8),  # LinkTrack NodeFrame5
}
_START = re.compile(rb"\x55[\x04\x05\x07\x08]", re.DOTALL)
_LIMIT_BYTES = 119 + 255 * 13 + 1


class LinkTrack(FrameParser):
    """A stream of NLink frames; those without distances are skipped.

    Raises ValueError for a rule that this family has no byte for.
    """

    def __init__(self, los: LosRule = LosRule.UNKNOWN) -> None:
        if los not in (LosRule.UNKNOWN, LosRule.POWER):
            raise ValueError(f"{los.value}: LinkTrack has a pair of powers, no line-of-sight byte")
        super().__init__(_START, 2, _LIMIT_BYTES)
        self._los = los

    def _end(self, buffer: bytes, begin: int) -> int | None:
        if len(buffer) < begin + 4:
            return None
        layout = _LAYOUT[buffer[begin + 1]]
        size = int.from_bytes(buffer[begin + 2 : begin + 4], "little")
        nodes, rest = divmod(size - layout.fixed - 1, layout.node)
        if rest or not 0 <= nodes <= 255:
            raise Unreadable(ParseDefect.LENGTH)
        if len(buffer) < begin + layout.fixed:
            return None
        if buffer[begin + layout.fixed - 1] != nodes:
            raise Unreadable(ParseDefect.LENGTH)
        return begin + size if begin + size <= len(buffer) else None

    def _read(self, message: bytes) -> list[Measured]:
        if sum(message[:-1]) & 0xFF != message[-1]:
            raise Unreadable(ParseDefect.CHECKSUM)
        layout = _LAYOUT[message[1]]
        time_s = int.from_bytes(message[layout.time : layout.time + 4], "little") / 1000.0
        nodes = range(layout.fixed, len(message) - 1, layout.node)
        return distinct([self._node(message[at : at + layout.node], layout, time_s) for at in nodes])

    def _node(self, node: bytes, layout: _Layout, time_s: float) -> Measured:
        role = node[0]
        if role >= len(_ROLES):
            raise Unreadable(ParseDefect.FIELD)
        identity = int.from_bytes(node[1 : 1 + layout.id_bytes], "little")
        at = 1 + layout.id_bytes
        range_m, status = distance(int.from_bytes(node[at : at + 3], "little", signed=True) / 1000.0)
        first_path, received = node[layout.first_path], node[layout.first_path + 1]
        return Measured(
            peer=f"{_ROLES[role]}{identity}",
            range_m=range_m,
            los=self._line_of_sight(first_path, received),
            rssi_dbm=-received / 2.0 if received else None,
            status=status,
            time_s=time_s,
        )

    def _line_of_sight(self, first_path: int, received: int) -> LineOfSight:
        """The vendor's rule of thumb: a first path much weaker than the whole was in the shade."""
        if self._los is LosRule.UNKNOWN or not first_path or not received:
            return LineOfSight.UNKNOWN
        behind_db = (first_path - received) / 2.0
        if behind_db < _LOS_BELOW_DB:
            return LineOfSight.LOS
        return LineOfSight.NLOS if behind_db > _NLOS_ABOVE_DB else LineOfSight.UNKNOWN
