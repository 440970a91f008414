"""Decawave/Qorvo DWM1001 with PANS firmware, shell mode: the streams of the commands `lec` and `les`.

    DIST,2,AN0,1151,5.00,8.00,2.25,6.44,AN1,0CA8,0.00,8.00,2.25,6.50,POS,2.55,2.01,1.71,98
    022E[7.94,8.03,0.00]=3.38 9280[7.95,0.00,0.00]=5.49 le_us=3082 est[6.97,5.17,-1.77,53]

Anchor ids are four hexadecimal digits; positions and distances are metres with two decimals; the position is
absent while there is no solution. At high update rates the firmware prints broken lines (a piece repeated, a
number cut), so a line counts only when it is right to the last character.
"""

from __future__ import annotations

import re

from companion.uwb.framing import LineParser
from companion.uwb.measured import Measured, ParseDefect, Unreadable, distance, distinct

_NUMBER = rb"\d{1,5}\.\d\d"
_COORDINATES = rb"-?N,-?N,-?N".replace(b"N", _NUMBER)
_ESTIMATE = rb"(?:" + _COORDINATES + rb"|-?nan,-?nan,-?nan),\d{1,3}"
_LEC_ANCHOR = rb",AN\d{1,2},([0-9A-F]{4})," + _COORDINATES + rb",(" + _NUMBER + rb")"
_LES_ANCHOR = rb"([0-9A-F]{4})\[" + _COORDINATES + rb"\]=(" + _NUMBER + rb") ?"


def _repeated(anchor: bytes) -> bytes:
    """Any number of anchors, as one group."""
    return rb"((?:" + re.sub(rb"\((?!\?)", rb"(?:", anchor) + rb")*)"


_PROMPT = re.compile(rb"(?:dwm> *)+")
_LEC = re.compile(rb"DIST,(\d{1,2})" + _repeated(_LEC_ANCHOR) + rb"(?:,POS," + _ESTIMATE + rb")? *")
_LES = re.compile(
    rb"(?=[0-9A-F]{4}\[)"
    + _repeated(_LES_ANCHOR)
    + rb"(?:le_us=\d{1,10} ?)?(?:est\["
    + _ESTIMATE
    + rb"\])? *"
)
_LEC_ANCHORS, _LES_ANCHORS = re.compile(_LEC_ANCHOR), re.compile(_LES_ANCHOR)
_LOOKS_LIKE_RANGES = re.compile(rb"DIST|,AN\d|\]=")


class Dwm1001Shell(LineParser):
    """Lines of the shell; prompts, echoes and the answers to other commands are skipped."""

    def __init__(self) -> None:
        super().__init__(limit_bytes=1024)

    def _read(self, line: bytes) -> list[Measured] | None:
        prompt = _PROMPT.match(line)
        if prompt is not None:
            line = line[prompt.end() :]
        if lec := _LEC.fullmatch(line):
            found = _LEC_ANCHORS.findall(lec[2])
            if len(found) != int(lec[1]):
                raise Unreadable(ParseDefect.LENGTH)
        elif les := _LES.fullmatch(line):
            found = _LES_ANCHORS.findall(les[1])
        elif _LOOKS_LIKE_RANGES.search(line):
            raise Unreadable(ParseDefect.FIELD)
        else:
            return None
        measured = []
        for peer, metres in found:
            range_m, status = distance(float(metres))
            measured.append(Measured(peer=peer.decode(), range_m=range_m, status=status))
        return distinct(measured)
