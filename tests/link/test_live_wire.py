"""The loop between real Zenoh and real UDP: in which thread a range is answered."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import pytest
from pymavlink.dialects.v20 import development as mavlink

from companion.link.mavlink import VehicleLink
from companion.link.zenoh_ranges import RangeLink
from companion.live import Bell, Loop
from companion.network_settings import RangesSettings
from companion.settings import Settings, VehicleSettings
from companion.types import Event, Output, RangeSample, Setpoint, Status
from companion.wire_range import JSON, range_key
from tests.link.test_mavlink_link import LOITER, Autopilot
from tests.sitl_mock.process import free_udp_port
from tests.uwb.network import LIMIT_S, Router, router, until


class Taken(NamedTuple):
    """An event or output, and the thread that took it in or sent it."""

    item: Event | Output
    thread: int


class Flight:
    """A loop in a thread of its own, which stands for the main one; a beacon; an autopilot in the air."""

    def __init__(self, network: Router) -> None:
        port = free_udp_port()
        self.settings = Settings(
            vehicle=VehicleSettings(mavlink=f"udpin:127.0.0.1:{port}"),
            ranges=RangesSettings(connect=(network.endpoint,)),
        )
        self.bell = Bell()
        self.vehicle = VehicleLink.open(self.settings.vehicle)
        self.ranges = RangeLink(self.settings.ranges, self.bell.ring, self.settings.beacons)
        self.taken: list[Taken] = []
        self.told: set[int] = set()
        self.may_work = threading.Event()
        self.may_work.set()
        self.is_held = threading.Event()
        loop = Loop(self.settings, self.vehicle, self.ranges, self.bell, self._tell, self._record)
        wake, waiting = self.ranges.wake, self.ranges._doors[0]._raw
        self._knocked: set[int] = set()

        def knock() -> None:
            here = [json.loads(raw.payload)["seq"] for raw in waiting.copy()]
            wake()
            self._knocked.update(here)

        self.ranges.wake = knock
        self._thread = threading.Thread(target=loop.fly)
        self._thread.start()
        self.main: int = self._thread.ident or 0
        self.autopilot = Autopilot(port)
        self.autopilot.socket.setblocking(False)
        self._put = network.session.declare_publisher(range_key("lab", "b1", "tag"), encoding=JSON).put
        self._seq = self._t_ms = 0
        self._put_s = 0.0
        self.stamps_ms: set[int] = set()

    def _record(self, item: Event | Output) -> None:
        self.taken.append(Taken(item, threading.get_ident()))

    def _tell(self, output: Output) -> None:
        self.told.add(threading.get_ident())
        if isinstance(output, Status) and not self.may_work.is_set():
            self.is_held.set()
            self.may_work.wait(LIMIT_S)

    def put(self) -> None:
        """A range. Of two within 4 ms Zenoh lets one through."""
        self._put_s = time.monotonic()
        self._seq += 1
        self._put(json.dumps({"session": "s", "seq": self._seq, "range_m": 10.0}))

    def live(self) -> None:
        """A moment of the vehicle: telemetry, and what has come of setpoints."""
        self._t_ms += 10
        self.autopilot.heartbeat(mode=LOITER)
        self.autopilot.say(mavlink.MAVLink_current_mode_message(0, LOITER, LOITER))
        self.autopilot.say(mavlink.MAVLink_extended_sys_state_message(0, mavlink.MAV_LANDED_STATE_IN_AIR))
        self.autopilot.say(mavlink.MAVLink_attitude_message(self._t_ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0))
        self.autopilot.say(
            mavlink.MAVLink_local_position_ned_message(self._t_ms, 0.0, 0.0, -3.0, 0.0, 0.0, 0.0)
        )
        while True:
            try:
                message = self.autopilot.hear()
            except BlockingIOError:
                return
            if message.get_type() == "SET_POSITION_TARGET_LOCAL_NED":
                self.stamps_ms.add(message.time_boot_ms)

    def has_knocked(self) -> bool:
        """Zenoh's thread has been there with the last range; one that was lost is put anew."""
        if self._seq in self._knocked:
            return True
        if time.monotonic() - self._put_s > 0.5:
            self.put()
        return False

    def answered_elsewhere(self) -> bool:
        """A range was taken in another thread, and the autopilot has heard the setpoint that answers it."""
        return any(
            isinstance(before.item, RangeSample)
            and isinstance(after.item, Setpoint)
            and after.item.t_ns // 10**6 in self.stamps_ms
            and before.thread == after.thread != self.main
            for before, after in pairwise(list(self.taken))
        )

    def took(self) -> int | None:
        """The thread that took the last range."""
        for item, thread in list(self.taken):
            if isinstance(item, RangeSample) and item.seq == self._seq:
                return thread
        return None

    def close(self) -> None:
        self.may_work.set()
        self.bell.ask_stop()
        self._thread.join(LIMIT_S)
        assert not self._thread.is_alive()
        self.ranges.close()
        self.vehicle.close()
        self.bell.close()
        self.autopilot.socket.close()


@pytest.fixture
def flight() -> Iterator[Flight]:
    with router() as network:
        made = Flight(network)
        yield made
        made.close()


def test_a_range_is_answered_in_zenohs_thread_unless_the_loop_is_busy(flight: Flight) -> None:
    def answered_elsewhere() -> bool:
        flight.live()
        time.sleep(0.01)  # what was said just now keeps the loop awake
        flight.put()
        return flight.answered_elsewhere()

    until(answered_elsewhere, "a setpoint from Zenoh's thread")

    flight.may_work.clear()
    until(flight.is_held.is_set, "that the loop is held up")
    held = len(flight.taken)
    flight.put()
    until(flight.has_knocked, "that the last range has come, and Zenoh's thread gone")
    assert len(flight.taken) == held
    flight.may_work.set()
    until(lambda: flight.took() is not None, "that the loop takes it")
    assert flight.took() == flight.main
    assert flight.told == {flight.main}
