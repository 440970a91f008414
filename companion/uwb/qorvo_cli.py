r"""Qorvo DWM3001CDK, command-line firmware: what it prints while it ranges, in both known forms.

Newer SDKs (DW3_QM33_SDK 1.0.2 and later), 1 + n lines a notification, the continuation after CR and a space:

    SESSION_INFO_NTF: {session_handle=1, sequence_number=39, block_index=39, n_measurements=1
     [mac_address=0x0001, status="SUCCESS", distance[cm]=71]}

Older SDKs (2023), one line of JSON:

    {"Block":1, "results":[{"Addr":"0xdc4c","Status":"Ok","D_cm":42}]}

Which SDK prints which is disputed, so the content decides. Distances come in whole centimetres, without a
variance, a time or a line-of-sight byte. A message is framed by its braces, because the parts of the newer
form are separated by CR LF, LF or a space once a line reader or a log has seen them. Firmware cuts a
notification that does not fit its buffer: fewer entries than announced, and all of it is dropped.
"""

from __future__ import annotations

import re

import msgspec

from companion.uwb.framing import FrameParser
from companion.uwb.measured import Measured, ParseDefect, Unreadable, distance, distinct

_START = re.compile(rb'SESSION_INFO_NTF: \{|\{"Block":')
_BRACE = re.compile(rb"[{}]")
_HEAD = re.compile(
    rb"session_handle=\d{1,10}, sequence_number=(\d{1,10}), block_index=\d{1,10}, n_measurements=(\d{1,3})"
)
_FIELD = rb", ([A-Za-z_]++(?:\[\w++\])?+)=(-?\w++(?:\.\d++)?+)"
_FIELDS = re.compile(_FIELD)
_ENTRY = re.compile(
    rb'\[mac_address=0x([0-9A-Fa-f]{4}|[0-9A-Fa-f]{16}), status="([A-Z][A-Za-z_]{0,31})"((?:'
    + _FIELD
    + rb")*+)\]"
)
_LIMIT_BYTES = 4096
"""Twice what the firmware's buffer of 256 bytes a peer holds for its eight peers."""


class QorvoCli(FrameParser):
    """The output of the command-line firmware."""

    def __init__(self) -> None:
        super().__init__(_START, len(b"SESSION_INFO_NTF: {"), _LIMIT_BYTES)

    def _end(self, buffer: bytes, begin: int) -> int | None:
        deepest = 2 if buffer.startswith(b"{", begin) else 1
        depth = 0
        for brace in _BRACE.finditer(buffer, begin, begin + _LIMIT_BYTES):
            depth += 1 if brace.group() == b"{" else -1
            if depth == 0:
                return brace.end()
            if depth > deepest:  # the next notification began before this one had ended
                raise Unreadable(ParseDefect.LENGTH)
        return None

    def _read(self, message: bytes) -> list[Measured]:
        return distinct(_json(message) if message.startswith(b"{") else _notification(message))


def _notification(message: bytes) -> list[Measured]:
    body = message[message.index(b"{") + 1 : -1]
    head = _HEAD.match(body)
    if head is None:
        raise Unreadable(ParseDefect.FIELD)
    sequence, announced = int(head[1]), int(head[2])
    rest = body[head.end() :].strip()
    entries = [_entry(text.strip(), sequence) for text in rest.split(b";")] if rest else []
    if len(entries) != announced:
        raise Unreadable(ParseDefect.LENGTH)
    return entries


def _entry(text: bytes, sequence: int) -> Measured:
    entry = _ENTRY.fullmatch(text)
    if entry is None:
        raise Unreadable(ParseDefect.FIELD)
    peer, word = f"0x{entry[1].decode().lower()}", entry[2].decode()
    if word != "SUCCESS":
        return Measured(peer=peer, status=word, sequence=sequence)
    fields = dict(_FIELDS.findall(entry[3]))
    range_m, status = distance(_number(fields.get(b"distance[cm]")) / 100.0)
    rssi = fields.get(b"RSSI[dBm]")
    return Measured(
        peer=peer,
        range_m=range_m,
        rssi_dbm=_power(_number(rssi)) if rssi is not None else None,
        status=status,
        sequence=sequence,
    )


def _number(text: bytes | None) -> float:
    try:
        return float(text or b"")
    except ValueError:
        raise Unreadable(ParseDefect.FIELD) from None


def _power(dbm: float) -> float:
    if not -300.0 <= dbm <= 100.0:
        raise Unreadable(ParseDefect.FIELD)
    return dbm


class _Result(msgspec.Struct, gc=False):
    Addr: str
    Status: str
    D_cm: float | None = None


class _Block(msgspec.Struct, gc=False):
    Block: int
    results: list[_Result]
    RSSI_dBm: str | None = None


_decode = msgspec.json.Decoder(_Block).decode
_ADDRESS = re.compile(r"0x[0-9a-fA-F]{4}(?:[0-9a-fA-F]{12})?")


def _json(message: bytes) -> list[Measured]:
    try:
        block = _decode(message)
    except (msgspec.DecodeError, UnicodeDecodeError):
        raise Unreadable(ParseDefect.FIELD) from None
    if block.Block < 0:
        raise Unreadable(ParseDefect.FIELD)
    # The power stands beside the list: with several peers nothing says whose it is.
    told = block.RSSI_dBm if len(block.results) == 1 else None
    rssi = None if told is None or told == "Invalid" else _power(_number(told.encode()))
    measured = []
    for result in block.results:
        if _ADDRESS.fullmatch(result.Addr) is None:
            raise Unreadable(ParseDefect.FIELD)
        if result.Status == "Err":
            m = Measured(peer=result.Addr.lower(), status=result.Status, sequence=block.Block)
        elif result.Status != "Ok" or result.D_cm is None:
            raise Unreadable(ParseDefect.FIELD)
        else:
            range_m, status = distance(result.D_cm / 100.0)
            m = Measured(
                peer=result.Addr.lower(),
                range_m=range_m,
                rssi_dbm=rssi,
                status=status,
                sequence=block.Block,
            )
        measured.append(m)
    return measured
