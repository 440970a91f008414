"""What is packed and read without pymavlink is what pymavlink packs and reads."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import pytest
from fastcrc.crc16 import mcrf4xx
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as mavlink
from pymavlink.generator.mavcrc import x25crc_slow

from companion.compiled import twin
from companion.link.packets import SetPositionTarget, packets
from tests.safety.test_check import KEY

BYTE = st.integers(0, 255)
SINGLE = st.floats(width=32)
FORMS = ("plain", "compiled")


def peer() -> Any:
    mav = mavlink.MAVLink(None, srcSystem=7, srcComponent=191)
    mav.robust_parsing = True
    return mav


@given(st.binary(max_size=270))
def test_the_checksum_is_mavlinks(data: bytes) -> None:
    assert mcrf4xx(data) == x25crc_slow(data).crc


@pytest.mark.parametrize("key", [None, KEY], ids=["unsigned", "signed"])
@pytest.mark.parametrize("form", [SetPositionTarget, twin(SetPositionTarget)], ids=FORMS)
@given(
    st.integers(0, 2**32 - 1),
    st.lists(SINGLE, min_size=5, max_size=5),
    st.integers(0, 2**16 - 1),
    BYTE,
    st.integers(1, 255),
    BYTE,
)
def test_a_setpoint_has_the_bytes_that_pymavlink_gives_it(
    form: Any,
    key: bytes | None,
    t_ms: int,
    numbers: list[float],
    mask: int,
    system: int,
    frame: int,
    seq: int,
) -> None:
    made = []
    z, vx, vy, vz, yaw_rate = numbers
    velocity, unused = (vx, vy, vz), (0.0, 0.0, 0.0, 0.0)
    for message in (
        form(t_ms, *numbers, mask, system, frame),
        mavlink.MAVLink_set_position_target_local_ned_message(
            t_ms, system, 1, frame, mask, 0.0, 0.0, z, *velocity, *unused, yaw_rate
        ),
    ):
        mav = peer()
        mav.seq, mav.signing.secret_key, mav.signing.sign_outgoing = seq, key, key is not None
        made.append(bytes(message.pack(mav)))
        if key is None and isinstance(message, form):
            assert message.unsigned(seq, 7, 191) == made[0]
    assert made[0] == made[1]


READ = (
    mavlink.MAVLink_attitude_message,
    mavlink.MAVLink_current_mode_message,
    mavlink.MAVLink_extended_sys_state_message,
    mavlink.MAVLink_heartbeat_message,
    mavlink.MAVLink_local_position_ned_message,
)
"""What is read without pymavlink."""
NAMES = frozenset(kind.msgname for kind in mavlink.mavlink_map.values())


@pytest.mark.parametrize("form", [packets, twin(packets)], ids=FORMS)
@pytest.mark.parametrize("kind", READ)
@given(st.binary(min_size=28, max_size=28), st.integers(1, 40), BYTE, BYTE)
def test_telemetry_reads_as_pymavlink_reads_it(
    kind: Any, form: Any, content: bytes, length: int, system: int, component: int
) -> None:
    """Whole, with zeros left out at its end, and longer than we know it."""
    payload = content.ljust(length, b"\1")[:length]
    message = kind(*[0] * len(kind.fieldnames))
    data = bytes(message._pack(mavlink.MAVLink(None, system, component), kind.crc_extra, payload))
    (ours,), (theirs,) = form(peer(), data, {kind.msgname}), peer().parse_buffer(data)
    assert (ours.name, ours.number) == (theirs.get_type(), theirs.get_msgId())
    assert (ours.system, ours.component) == (theirs.get_srcSystem(), theirs.get_srcComponent())
    assert (ours.data, ours.is_signed) == (bytes(theirs.get_msgbuf()), False)
    for name in kind.fieldnames:
        a, b = getattr(ours.fields, name), getattr(theirs, name)
        assert a == b or (math.isnan(a) and math.isnan(b))


AUTOPILOT = mavlink.MAVLink(None, 1, 1)
MESSAGES = [kind(*[1] * len(kind.fieldnames)) for kind in READ]
WHOLE = [bytes(m.pack(AUTOPILOT)) for m in MESSAGES]


def crafted(packet: bytes, kind: Any, where: int, value: int) -> bytes:
    """Another byte in its header, and the checksum that goes with it."""
    body = packet[1:where] + bytes((value,)) + packet[where + 1 : -2]
    return packet[:1] + body + mcrf4xx(body + bytes((kind.crc_extra,))).to_bytes(2, "little")


PARTS = [
    *WHOLE,
    *(packet[:n] for packet in WHOLE for n in (1, 9, 13)),
    *(packet[9:] for packet in WHOLE),
    *(a + b for a, b in pairwise(WHOLE)),
    *(bytes(m.pack(AUTOPILOT, force_mavlink1=True)) for m in MESSAGES if m.id < 256),
    *(crafted(p, kind, 2, 2) for p, kind in zip(WHOLE, READ, strict=True)),  # an unknown incompatibility flag
    *(crafted(p, kind, 1, p[1] + by) for p, kind in zip(WHOLE, READ, strict=True) for by in (-2, 2)),
]


@pytest.mark.parametrize("form", [packets, twin(packets)], ids=FORMS)
@given(st.lists(st.tuples(st.sampled_from(PARTS), st.sampled_from((0, 0, 1))), max_size=12))
def test_what_is_torn_damaged_or_odd_reads_as_pymavlink_reads_it(
    form: Any, parts: list[tuple[bytes, int]]
) -> None:
    ours, theirs = peer(), peer()
    for part, bits in parts:
        datagram = part[:-1] + bytes((part[-1] ^ bits,))
        read = [(p.name, p.data) for p in form(ours, datagram, NAMES)]
        assert read == [(m.get_type(), bytes(m.get_msgbuf())) for m in theirs.parse_buffer(datagram) or ()]


@pytest.mark.parametrize("form", [packets, twin(packets)], ids=FORMS)
def test_what_nobody_hears_is_not_read_but_damage_is_told(form: Any) -> None:
    attitude = bytes(mavlink.MAVLink_attitude_message(1, 0.0, 0.0, 0.5, 0.0, 0.0, 0.1).pack(AUTOPILOT))
    assert form(peer(), attitude, {"HEARTBEAT"}) == ()
    damaged = attitude[:20] + bytes((attitude[20] ^ 1,)) + attitude[21:]
    assert [p.name for p in form(peer(), damaged, {"HEARTBEAT"})] == ["BAD_DATA"]


@pytest.mark.parametrize("form", [packets, twin(packets)], ids=FORMS)
def test_where_there_is_a_key_a_packet_without_a_signature_is_not_read(form: Any) -> None:
    mav = peer()
    mav.signing.secret_key = KEY
    (refused,) = form(mav, WHOLE[0], NAMES)
    assert refused.name == "BAD_DATA"
