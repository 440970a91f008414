"""Ranges as text: JSON lines and CSV, from a script's output or a recording.

JSON lines, one object a line:

    {"beacon": "b1", "range_m": 5.02, "t_s": 12.40, "sigma_m": 0.07, "los": "los"}

CSV, a line that names the columns first, in any order; no quotes; an empty cell is a field left out; lines
that begin with `#` are comments:

    t_s,beacon,range_m,sigma_m
    12.40,b1,5.02,0.07

Fields, in both: `beacon` (text), `range_m` (metres), and where known `t_s` (seconds of any origin: the pace
of a recording), `sigma_m`, `los` (los, nlos, unknown), `rssi_dbm`, `seq`, `status` (anything but ok: there is
no range, and `range_m` is left out). Others are ignored.
"""

from __future__ import annotations

import msgspec

from companion.uwb.framing import LineParser
from companion.uwb.measured import OK, Measured, ParseDefect, Unreadable

_decode = msgspec.json.Decoder(Measured).decode
_NEEDED = {"beacon", "range_m"}


class JsonLines(LineParser):
    """One JSON object a line."""

    def _read(self, line: bytes) -> list[Measured] | None:
        if not line.strip():
            return None
        try:
            return [_checked(_decode(line))]
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
            raise Unreadable(ParseDefect.FIELD) from None


class Csv(LineParser):
    """Comma-separated values with a header. Nothing is a range before a header has come."""

    def __init__(self) -> None:
        super().__init__()
        self._columns: list[str] | None = None

    def _read(self, line: bytes) -> list[Measured] | None:
        text = line.decode("utf-8", "replace").lstrip("\ufeff").strip()
        if not text or text.startswith("#"):
            return None
        cells = [cell.strip() for cell in text.split(",")]
        if self._columns is None or set(cells) >= _NEEDED:  # recordings may be joined end to end
            if not set(cells) >= _NEEDED or len(set(cells)) != len(cells):
                raise Unreadable(ParseDefect.FIELD)
            self._columns = cells
            return None
        if len(cells) != len(self._columns):
            raise Unreadable(ParseDefect.LENGTH)
        row = {name: cell for name, cell in zip(self._columns, cells, strict=True) if cell}
        try:
            return [_checked(msgspec.convert(row, Measured, strict=False))]
        except msgspec.ValidationError:
            raise Unreadable(ParseDefect.FIELD) from None


def _checked(m: Measured) -> Measured:
    if (m.range_m is None) == (m.status == OK):
        raise Unreadable(ParseDefect.FIELD)
    return m
