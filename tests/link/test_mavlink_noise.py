"""Sound packets with any content, damaged ones and torn ones: read, counted or dropped, and never a crash."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as mavlink

from companion import pilot
from companion.compiled import twin
from companion.link.ground_station import GroundStation
from companion.link.mavlink import VehicleLink
from companion.link.survey import VehicleSurvey
from companion.settings import Settings
from companion.types import Defect, Malformed
from tests.link.test_mavlink_link import LOITER

READ = (
    "HEARTBEAT", "CURRENT_MODE", "ATTITUDE", "LOCAL_POSITION_NED", "EXTENDED_SYS_STATE", "SYS_STATUS",
    "BATTERY_STATUS", "ESTIMATOR_STATUS", "STATUSTEXT", "EVENT", "POSITION_TARGET_LOCAL_NED",
    "SET_POSITION_TARGET_LOCAL_NED", "SET_ATTITUDE_TARGET", "PARAM_VALUE", "AUTOPILOT_VERSION",
    "EKF_STATUS_REPORT",
)  # fmt: skip
KINDS = {kind.msgname: kind for kind in mavlink.mavlink_map.values()}
HEARTBEAT = bytes(
    mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 128, LOITER, 4, 3).pack(
        mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    )
)


class Wire:
    """A transport in memory."""

    def __init__(self) -> None:
        self.incoming: list[bytes] = []

    def fileno(self) -> int:
        return -1

    def receive(self) -> bytes:
        return self.incoming.pop(0) if self.incoming else b""

    def send(self, data: bytes) -> None:
        pass

    def close(self) -> None:
        pass


def packet(rnd: random.Random) -> bytes:
    """A message that is read, from anybody, with any content of any length; one in seven is damaged."""
    kind = KINDS[rnd.choice(READ)]
    number = kind.id
    size = rnd.choice([kind.unpacker.size, rnd.randint(1, 255)])
    payload = bytes(rnd.choice([0, 127, 128, 255, rnd.randrange(256)]) for _ in range(size))
    ids = rnd.choice([1, 1, 1, 2, 255]), rnd.choice([1, 1, 191, 190])
    data = struct.pack("<BBBBBBHB", size, 0, 0, rnd.randrange(256), *ids, number & 0xFFFF, number >> 16)
    checksum = mavlink.x25crc(data + payload + bytes([kind.crc_extra])).crc
    whole = bytearray(b"\xfd" + data + payload + struct.pack("<H", checksum))
    if rnd.random() < 0.1:
        whole[rnd.randrange(len(whole))] ^= 1 << rnd.randrange(8)
    return bytes(whole[: rnd.randrange(len(whole))] if rnd.random() < 0.05 else whole)


@pytest.mark.parametrize(("seed", "form"), [(1, lambda plain: plain), (2, twin)], ids=["plain", "compiled"])
def test_no_packet_crashes_a_flight_or_a_check(seed: int, form: Callable[[Any], Any]) -> None:
    rnd, settings = random.Random(seed), Settings()
    flying, looking = Wire(), Wire()
    link = form(VehicleLink)(settings.vehicle, flying, ground=form(GroundStation)(settings))
    survey = VehicleSurvey(settings.vehicle, looking)
    plan = pilot.plan(settings)
    state = pilot.initial(plan)
    t_ns, defects = 1_000_000_000, set()
    for count in range(2000):
        came = [HEARTBEAT, packet(rnd)] if count % 20 == 0 else [packet(rnd)]
        flying.incoming += came
        looking.incoming += came
        t_ns += 10_000_000
        for event in link.receive(lambda now=t_ns: now):
            defects |= {event.defect} if isinstance(event, Malformed) else set()
            state, outputs = pilot.step(plan, state, event)
            for output in outputs:
                link.send(output)
        survey.receive(lambda now=t_ns: now)  # type: ignore[misc]
        survey.ask(t_ns)
    assert {Defect.MAVLINK_BYTES, Defect.MAVLINK_FIELD} <= defects
    assert survey.found.t_found_ns is not None
