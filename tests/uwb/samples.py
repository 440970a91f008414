"""Bytes that modules sent, or that were built by hand after their documents, and what they mean."""

from __future__ import annotations

from typing import NamedTuple

from companion.types import LineOfSight
from companion.uwb.families import Family
from companion.uwb.measured import Measured

LOS, NLOS, UNKNOWN = LineOfSight.LOS, LineOfSight.NLOS, LineOfSight.UNKNOWN


def octets(*text: str) -> bytes:
    return bytes.fromhex("".join(text).replace(" ", ""))


class Sample(NamedTuple):
    """`data` of a family, and every measurement in it."""

    name: str
    family: Family
    data: bytes
    measured: list[Measured]


UCI = octets(
    "62000057 07000000 01000000 00 c8000000 01 00 00 0000000000000000 02",
    "0100 00 00 8900 80f9 64 0000 00 0000 00 0000 00 00 85 0000000000000000000000",
    "0200 21 ff ffff 0000 00 0000 00 0000 00 0000 00 04 00 0000000000000000000000",
)
TLV_TAG = octets(
    "400100 410d 0a0a0000bc0700009006000064 4929 02 511150190000",
    "64 88130000401f0000ca08000064",
    "a80c6e190000 62 00000000401f0000ca08000064",
)
TLV_ANCHOR = octets(
    "400100 410d 0a0a0000bc0700009006000064 481b 02",
    "0123456789abcdef 50190000 64",
    "1123456789abcdef 00000000 00",
)
LINKTRACK3 = octets(
    "5505 2400 02 07 40e20100 f1fb0900 00000000 7413 02", "01 00 393000 a0 9e 01 03 d6ffff aa a5 f7"
)


def with_sum(frame: bytes) -> bytes:
    """A LinkTrack frame with its checksum."""
    return frame + bytes([sum(frame) & 0xFF])


def linktrack2() -> bytes:
    """NodeFrame2 of tag 7, at 123.456 s: A0 at 12.345 m (−80/−79 dBm), A3 at 4.200 m (−95/−82.5 dBm)."""
    fixed = bytearray(119)
    fixed[0:2] = b"\x55\x04"
    fixed[2:4] = (120 + 2 * 13).to_bytes(2, "little")
    fixed[4:6] = b"\x02\x07"
    fixed[6:10] = (654_321).to_bytes(4, "little")
    fixed[102:106] = (123_456).to_bytes(4, "little")
    fixed[118] = 2
    nodes = octets("01 00 393000 a0 9e 00000000 0000", "01 03 681000 be a5 00000000 0000")
    return with_sum(bytes(fixed) + nodes)


def linktrack5() -> bytes:
    """NodeFrame5 of tag 300: local time 1 s, A70000 at 2.5 m, no powers."""
    fixed = octets("5508 2300 02 2c010000 e8030000 00000000 00000000 7413 01")
    return with_sum(fixed + octets("01 70110100 c40900 00 00"))


def linktrack_aoa() -> bytes:
    """AoA NodeFrame0 of anchor 1: local time 1 s, T2 at 3.000 m, 12.34 degrees, −80/−79 dBm."""
    fixed = octets("5507 2100 01 01 e8030000 00000000 00000000 7413 01")
    return with_sum(fixed + octets("02 02 b80b00 d204 a0 9e 0000"))


JAZZY = octets(
    "00010000 00f15365 80b2e60e 07000000 7577625f613100 01 0000003f 0000803e 0000c842 00004841 0ad7233c"
)
"""A sensor_msgs/Range: 12.5 m, variance 0.01 m², frame uwb_a1."""
ATTACHMENT = octets("0100000000000000 15cd853dfe9c9717 10 000102030405060708090a0b0c0d0e0f")
"""Of rmw_zenoh: sequence 1."""
LEC4 = (
    b"DIST,4,AN0,1151,5.00,8.00,2.25,6.44,AN1,0CA8,0.00,8.00,2.25,6.50,"
    b"AN2,111C,5.00,0.00,2.25,3.24,AN3,1150,0.00,0.00,2.25,3.19,POS,2.55,2.01,1.71,98\r\n"
)
LEC3 = (
    b"DIST,3,AN0,2F2F,3.05,2.68,0.00,2.20,AN1,2ED0,3.02,0.00,0.00,2.23,"
    b"AN2,2BA2,0.00,0.00,0.00,3.13,POS,1.76,1.59,0.51,40\r\n"
)
LES = (
    b"022E[7.94,8.03,0.00]=3.38 9280[7.95,0.00,0.00]=5.49 DCAE[0.00,8.03,0.00]=7.73 "
    b"5431[0.00,0.00,0.00]=9.01 le_us=3082 est[6.97,5.17,-1.77,53]\r\n"
)
NTF = (
    b"SESSION_INFO_NTF: {session_handle=1, sequence_number=39, block_index=39, n_measurements=1\r\n"
    b'\r [mac_address=0x0001, status="SUCCESS", distance[cm]=71]}\r\n'
)
NTF_ONE_LINE = (
    b"SESSION_INFO_NTF: {session_handle=1, sequence_number=39, block_index=39, n_measurements=1 "
    b'[mac_address=0x0001, status="SUCCESS", distance[cm]=71]}\n'
)
NTF_TIMEOUT = (
    b"SESSION_INFO_NTF: {session_handle=1, sequence_number=0, block_index=0, n_measurements=1\r\n"
    b'\r [mac_address=0x1234, status="RX_TIMEOUT"]}\r\n'
    b"SESSION_INFO_NTF: {session_handle=1, sequence_number=1, block_index=1, n_measurements=1\r\n"
    b'\r [mac_address=0x1234, status="SUCCESS", distance[cm]=29]}\r\n'
)
NTF_FOUR = (
    b"SESSION_INFO_NTF: {session_handle=1, sequence_number=5, block_index=5, n_measurements=4\r\n"
    b'\r [mac_address=0x0001, status="SUCCESS", distance[cm]=245];\r\n'
    b'\r [mac_address=0x0002, status="SUCCESS", distance[cm]=312];\r\n'
    b'\r [mac_address=0x0003, status="TX_FAILED"];\r\n'
    b'\r [mac_address=0x0004, status="SUCCESS", distance[cm]=403]}\r\n'
)
NTF_ANGLES = (
    b"SESSION_INFO_NTF: {session_handle=1, sequence_number=6, block_index=6, n_measurements=1\r\n"
    b'\r [mac_address=0x0001, status="SUCCESS", distance[cm]=91, loc_az_pdoa=65.35, loc_az=24.90, '
    b"loc_el_pdoa=32.12, loc_el=12.01, rmt_az=22.84, rmt_el=13.59, RSSI[dBm]=-66.5]}\r\n"
)
NTF_NONE = b"SESSION_INFO_NTF: {session_handle=1, sequence_number=7, block_index=7, n_measurements=0}\r\n"
OLD_JSON = (
    b'{"Block":1, "results":[{"Addr":"0xdc4c","Status":"Ok","D_cm":42}]}\r\n'
    b'{"Block":2, "results":[{"Addr":"0xdc4c","Status":"Err"}]}\r\n'
    b'{"Block":3, "results":[{"Addr":"0xdc4c","Status":"Ok","D_cm":61,"LPDoA_deg":0.00,"LAoA_deg":0.00,'
    b'"LFoM":0,"RAoA_deg":0.00,"CFO_100ppm":-639}],"RSSI_dBm":"-60.1","NLOS_%":3}\r\n'
)
JSON_LINES = (
    b'{"beacon":"b1","range_m":5.02,"t_s":12.4,"sigma_m":0.07,"los":"los","rssi_dbm":-80.5,"seq":7}\n'
    b'{"beacon":"b2","status":"RX_TIMEOUT","t_s":12.45}\n'
)
CSV = (
    b"# a recording\nt_s,beacon,range_m,sigma_m,los,status\n"
    b"12.40,b1,5.02,0.07,nlos,\n12.45,b2,,,,RX_TIMEOUT\r\n"
)


def _m(peer: str, range_m: float | None, sequence: int | None = None, status: str = "ok") -> Measured:
    return Measured(peer=peer, range_m=range_m, sequence=sequence, status=status)


_Q = Family.QORVO_CLI
SAMPLES = [
    Sample("ntf", _Q, NTF, [_m("0x0001", 0.71, 39)]),
    Sample("ntf on one line", _Q, NTF_ONE_LINE, [_m("0x0001", 0.71, 39)]),
    Sample("ntf timeout", _Q, NTF_TIMEOUT, [_m("0x1234", None, 0, "RX_TIMEOUT"), _m("0x1234", 0.29, 1)]),
    Sample(
        "ntf of four",
        _Q,
        NTF_FOUR,
        [
            _m("0x0001", 2.45, 5),
            _m("0x0002", 3.12, 5),
            _m("0x0003", None, 5, "TX_FAILED"),
            _m("0x0004", 4.03, 5),
        ],
    ),
    Sample(
        "ntf with angles",
        _Q,
        NTF_ANGLES,
        [Measured(peer="0x0001", range_m=0.91, rssi_dbm=-66.5, sequence=6)],
    ),
    Sample("ntf of none", _Q, NTF_NONE, []),
    Sample(
        "old JSON",
        _Q,
        OLD_JSON,
        [
            _m("0xdc4c", 0.42, 1),
            _m("0xdc4c", None, 2, "Err"),
            Measured(peer="0xdc4c", range_m=0.61, rssi_dbm=-60.1, sequence=3),
        ],
    ),
    Sample(
        "uci",
        Family.FIRA_UCI,
        UCI,
        [
            Measured(peer="0x0001", range_m=1.37, rssi_dbm=-66.5, sequence=7),
            _m("0x0002", None, 7, "RX_TIMEOUT"),
        ],
    ),
    Sample(
        "lec of four",
        Family.DWM1001_SHELL,
        LEC4,
        [_m("1151", 6.44), _m("0CA8", 6.50), _m("111C", 3.24), _m("1150", 3.19)],
    ),
    Sample(
        "lec of three",
        Family.DWM1001_SHELL,
        LEC3,
        [_m("2F2F", 2.20), _m("2ED0", 2.23), _m("2BA2", 3.13)],
    ),
    Sample(
        "les",
        Family.DWM1001_SHELL,
        LES,
        [_m("022E", 3.38), _m("9280", 5.49), _m("DCAE", 7.73), _m("5431", 9.01)],
    ),
    Sample("tlv, tag", Family.DWM1001_TLV, TLV_TAG, [_m("1151", 6.48), _m("0CA8", 6.51)]),
    Sample(
        "tlv, anchor",
        Family.DWM1001_TLV,
        TLV_ANCHOR,
        [_m("EFCDAB8967452301", 6.48), _m("EFCDAB8967452311", None, None, "NOT_POSITIVE")],
    ),
    Sample(
        "LinkTrack NodeFrame3",
        Family.LINKTRACK,
        LINKTRACK3,
        [
            Measured(peer="A0", range_m=12.345, rssi_dbm=-79.0, time_s=123.456),
            Measured(peer="A3", rssi_dbm=-82.5, time_s=123.456, status="NOT_POSITIVE"),
        ],
    ),
    Sample(
        "LinkTrack NodeFrame2",
        Family.LINKTRACK,
        linktrack2(),
        [
            Measured(peer="A0", range_m=12.345, rssi_dbm=-79.0, time_s=123.456),
            Measured(peer="A3", range_m=4.2, rssi_dbm=-82.5, time_s=123.456),
        ],
    ),
    Sample(
        "LinkTrack NodeFrame5",
        Family.LINKTRACK,
        linktrack5(),
        [Measured(peer="A70000", range_m=2.5, time_s=1.0)],
    ),
    Sample(
        "LinkTrack AoA NodeFrame0",
        Family.LINKTRACK,
        linktrack_aoa(),
        [Measured(peer="T2", range_m=3.0, rssi_dbm=-79.0, time_s=1.0)],
    ),
    Sample(
        "JSON lines",
        Family.JSON_LINES,
        JSON_LINES,
        [
            Measured("b1", 5.02, 0.07, LOS, -80.5, sequence=7, time_s=12.4),
            Measured(peer="b2", status="RX_TIMEOUT", time_s=12.45),
        ],
    ),
    Sample(
        "CSV",
        Family.CSV,
        CSV,
        [
            Measured("b1", 5.02, 0.07, NLOS, time_s=12.4),
            Measured(peer="b2", status="RX_TIMEOUT", time_s=12.45),
        ],
    ),
]
