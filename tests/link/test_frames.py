"""What is packed and read without pymavlink is what pymavlink packs and reads."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as mavlink

from companion.link.frames import SetPositionTarget
from companion.link.mavlink import VehicleLink
from companion.link.telemetry_frames import messages
from companion.settings import VehicleSettings
from companion.types import Malformed
from tests.safety.test_check import Wire

BYTE = st.integers(0, 255)
SINGLE = st.floats(width=32)


def peer() -> Any:
    mav = mavlink.MAVLink(None, srcSystem=7, srcComponent=191)
    mav.robust_parsing = True
    return mav


@given(st.integers(0, 2**32 - 1), st.lists(SINGLE, min_size=11, max_size=11), BYTE, BYTE, BYTE, BYTE)
def test_a_setpoint_has_the_bytes_that_pymavlink_gives_it(
    t_ms: int, numbers: list[float], mask: int, system: int, frame: int, seq: int
) -> None:
    m = SetPositionTarget._make((t_ms, *numbers, mask, system, 1, frame))
    mav = peer()
    mav.seq = seq
    theirs = mavlink.MAVLink_set_position_target_local_ned_message(**m._asdict())
    assert m.pack(mav) == bytes(theirs.pack(mav))


@given(st.integers(0, 2**32 - 1), st.lists(SINGLE, min_size=6, max_size=6), BYTE, BYTE)
@pytest.mark.parametrize(
    "kind", [mavlink.MAVLink_attitude_message, mavlink.MAVLink_local_position_ned_message]
)
def test_telemetry_reads_as_pymavlink_reads_it(
    kind: Any, t_ms: int, numbers: list[float], system: int, component: int
) -> None:
    data = bytes(kind(t_ms, *numbers).pack(mavlink.MAVLink(None, system, component)))
    (ours,), (theirs,) = messages(peer(), data, {kind.msgname}), peer().parse_buffer(data)
    for name in ("get_type", "get_msgId", "get_srcSystem", "get_srcComponent"):
        assert getattr(ours, name)() == getattr(theirs, name)()
    for name in kind.fieldnames:
        a, b = getattr(ours, name), getattr(theirs, name)
        assert a == b or (math.isnan(a) and math.isnan(b))


def test_damage_is_told_and_what_nobody_wants_is_not_read() -> None:
    autopilot = mavlink.MAVLink(None, 1, 1)
    attitude = bytes(mavlink.MAVLink_attitude_message(1, 0.0, 0.0, 0.5, 0.0, 0.0, 0.1).pack(autopilot))
    damaged = attitude[:20] + bytes((attitude[20] ^ 1,)) + attitude[21:]
    link = VehicleLink(VehicleSettings(), wire := Wire())
    wire.incoming = [damaged]
    assert [type(e) for e in link.receive(lambda: 1)] == [Malformed]
    assert messages(peer(), attitude, {"HEARTBEAT"}) == ()
    two = messages(peer(), attitude + attitude, {"ATTITUDE"})
    assert [m.get_type() for m in two] == ["ATTITUDE", "ATTITUDE"], "several in one datagram"
    mav = peer()
    assert not messages(mav, attitude[:9], {"ATTITUDE"})
    (whole,) = messages(mav, attitude[9:], {"ATTITUDE"})
    assert whole.yaw == 0.5, "a packet in two parts"
