"""What is around a flying process while it is measured: a publisher and an autopilot, each a process.

Publisher and autopilot share the pose of a simple vehicle, so that the app flies as it would. Both write down
when a range was put and when a setpoint's bytes were received, on the one monotonic clock of the machine.
"""

from __future__ import annotations

import math
import multiprocessing
import os
import select
import socket
import struct
import time
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from random import Random
from typing import Any, NamedTuple

import zenoh
from pymavlink.dialects.v20 import development as mavlink

from companion.link.zenoh_session import zenoh_config
from companion.network_settings import RangesSettings
from companion.range_message import RangeMessage
from companion.wire_range import JSON, encode, range_key

PRIORITY = 10
"""As in config/companion.service, of the policy SCHED_RR."""
_BEACON_HEIGHT_M, _HEIGHT_M = 1.5, 3.0
_STEP_NS = 20_000_000
_LAG_S = 0.5
_OFFBOARD_AFTER_NS = 1_000_000_000
_STREAM_LOST_NS = 500_000_000
_SETPOINT, _HEARTBEAT = 84, 0
"""Message ids on the wire."""
_LOITER, _OFFBOARD = 4 << 16 | 3 << 24, 6 << 16
_BODY = struct.Struct("<I11f")
"""SET_POSITION_TARGET_LOCAL_NED: time, position, velocity, acceleration, yaw, yaw rate; then what is not
looked at. MAVLink 2 leaves out zeros at the end."""


class Beacon(NamedTuple):
    """Where a beacon is, East and North of the start."""

    name: str
    x_m: float
    y_m: float


class Heard(NamedTuple):
    """What the autopilot received: a setpoint's bytes at `t_ns`, with the time in them (ms, 32 bits)."""

    t_ns: int
    stamp_ms: int


class Rig:
    """The two processes. Close it, or use it as a context."""

    def __init__(self, beacons: Sequence[Beacon]) -> None:
        context = multiprocessing.get_context("spawn")
        pose = context.RawArray("d", 3)
        self.zenoh = f"tcp/127.0.0.1:{_free_port()}"
        """Where the publisher listens."""
        self._pipes: list[Connection] = []
        self._processes = []
        for run in (_autopilot, _publisher):
            here, there = context.Pipe()
            arguments = (there, pose, tuple(beacons), self.zenoh)
            process = context.Process(target=run, args=arguments, daemon=True)
            process.start()
            self._pipes.append(here)
            self._processes.append(process)
        self.mavlink_port: int = self._ask(0)
        """Where the autopilot listens."""
        self._ask(1)

    def __enter__(self) -> Rig:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._processes:
            process.kill()
            process.join()

    def _ask(self, which: int, *words: object) -> Any:
        if words:
            self._pipes[which].send(words)
        if not self._pipes[which].poll(20.0):
            raise TimeoutError("the benchmark's own processes do not answer")
        return self._pipes[which].recv()

    def begin(self, rate_hz: float) -> None:
        """Put the vehicle back to the start; publish ranges of every beacon at this rate."""
        self._ask(0, "begin")
        self._ask(1, "begin", rate_hz)

    def first_heartbeat_ns(self) -> int | None:
        """When the first heartbeat since `begin` was received."""
        heartbeat: int | None = self._ask(0, "heartbeat")
        return heartbeat

    def count(self) -> int:
        """Setpoints since `begin`."""
        number: int = self._ask(0, "count")
        return number

    def end(self) -> tuple[list[int], list[Heard]]:
        """When ranges were put, and the setpoints, since `begin`."""
        puts: list[int] = self._ask(1, "end")
        heard: list[Heard] = self._ask(0, "end")
        return puts, heard


def precede(pid: int = 0) -> bool:
    """Give a process (0: this one) the precedence that config/companion.service gives; False: not allowed.

    The threads that it starts from now on inherit it.
    """
    try:
        os.sched_setscheduler(pid, os.SCHED_RR, os.sched_param(PRIORITY))
    except PermissionError:
        return False
    return True


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


# ------------------------------------------------------------------------------------------- autopilot


class _Vehicle:
    """NED velocity and yaw rate follow their commands with one lag."""

    def __init__(self, pose: Any) -> None:
        self._pose = pose
        self.north = self.east = self.yaw = 0.0
        self.vn = self.ve = self.r = 0.0
        self.wanted = (0.0, 0.0, 0.0)
        self._write()

    def step(self, dt_s: float) -> None:
        share = dt_s / _LAG_S
        wanted_n, wanted_e, wanted_r = self.wanted
        self.vn += share * (wanted_n - self.vn)
        self.ve += share * (wanted_e - self.ve)
        self.r += share * (wanted_r - self.r)
        self.north += self.vn * dt_s
        self.east += self.ve * dt_s
        self.yaw = math.remainder(self.yaw + self.r * dt_s, 2.0 * math.pi)
        self._write()

    def _write(self) -> None:
        self._pose[:] = (self.east, self.north, _HEIGHT_M)


class _Session:
    """What was heard since the last `begin`."""

    def __init__(self, pose: Any) -> None:
        self.vehicle = _Vehicle(pose)
        self.heard: list[Heard] = []
        self.heartbeat_ns: int | None = None
        self.is_offboard = False
        self.peer: tuple[str, int] | None = None

    def receive(self, data: bytes, t_ns: int) -> None:
        """One datagram of one message, as the app sends them."""
        kind = int.from_bytes(data[7:10], "little")
        if kind == _SETPOINT:
            body = data[10 : 10 + data[1]].ljust(_BODY.size + 5, b"\0")
            stamp_ms, _, _, _, vn, ve, *_, r = _BODY.unpack_from(body)
            self.heard.append(Heard(t_ns, stamp_ms))
            self.vehicle.wanted = (vn, ve, r) if self.is_offboard else (0.0, 0.0, 0.0)
        elif kind == _HEARTBEAT and self.heartbeat_ns is None:
            self.heartbeat_ns = t_ns

    def look(self, now_ns: int) -> None:
        """A person selects OFFBOARD once setpoints have streamed; a vehicle without setpoints stands."""
        if not self.heard:
            return
        if now_ns - self.heard[0].t_ns > _OFFBOARD_AFTER_NS:
            self.is_offboard = True
        if now_ns - self.heard[-1].t_ns > _STREAM_LOST_NS:
            self.vehicle.wanted = (0.0, 0.0, 0.0)


def _autopilot(pipe: Connection, pose: Any, _beacons: Sequence[Beacon], _endpoint: str) -> None:
    precede()  # it stands for another computer
    sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    sock.bind(("127.0.0.1", 0))
    sock.setblocking(False)
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    session = _Session(pose)
    pipe.send(sock.getsockname()[1])
    number, next_ns = 0, time.monotonic_ns()
    while True:
        wait_s = max(0.0, (next_ns - time.monotonic_ns()) * 1e-9)
        waiting = select.select([sock.fileno(), pipe.fileno()], [], [], wait_s)[0]
        if sock.fileno() in waiting:
            data, session.peer = sock.recvfrom(2048)
            session.receive(data, time.monotonic_ns())
            continue
        if pipe.fileno() in waiting:
            (word,) = pipe.recv()
            if word == "begin":
                session = _Session(pose)
            told = {"heartbeat": session.heartbeat_ns, "count": len(session.heard), "end": session.heard}
            pipe.send(told.get(word))
        now_ns = time.monotonic_ns()
        if now_ns >= next_ns:
            next_ns = max(next_ns + _STEP_NS, now_ns)
            number += 1
            session.vehicle.step(_STEP_NS * 1e-9)
            session.look(now_ns)
            if session.peer is not None:
                for message in _telemetry(session, number):
                    data = message.pack(mav)
                    mav.seq = (mav.seq + 1) % 256
                    sock.sendto(data, session.peer)


def _telemetry(session: _Session, number: int) -> list[Any]:
    """What is due in this 50th of a second."""
    v, t_ms = session.vehicle, number * 20
    mode = _OFFBOARD if session.is_offboard else _LOITER
    due = [
        mavlink.MAVLink_attitude_message(t_ms, 0.0, 0.0, v.yaw, 0.0, 0.0, v.r),
        mavlink.MAVLink_local_position_ned_message(t_ms, v.north, v.east, -_HEIGHT_M, v.vn, v.ve, 0.0),
    ]
    if number % 5 == 0:
        due.append(mavlink.MAVLink_current_mode_message(0, mode, mode))
    if number % 10 == 0:
        due.append(mavlink.MAVLink_extended_sys_state_message(0, mavlink.MAV_LANDED_STATE_IN_AIR))
    if number % 50 == 0:
        due.append(mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 128 | 1, mode, 4, 3))
    return due


# ------------------------------------------------------------------------------------------- publisher


def _publisher(pipe: Connection, pose: Any, beacons: Sequence[Beacon], endpoint: str) -> None:
    precede()  # as the autopilot, and before Zenoh starts its threads
    with zenoh.open(zenoh_config(RangesSettings(listen=(endpoint,)))) as session:
        pipe.send("listening")
        put = _putter(session, pose, beacons)
        puts: list[int] = []
        period_ns, next_ns, turn = 0, 0, 0
        while True:
            wait_s = None if not period_ns else max(0.0, (next_ns - time.monotonic_ns()) * 1e-9)
            if pipe.poll(wait_s):
                word, *rest = pipe.recv()
                pipe.send(puts)
                puts, period_ns = [], 0
                if word == "begin":
                    period_ns = round(1e9 / (rest[0] * len(beacons)))
                    next_ns = time.monotonic_ns() + period_ns
                continue
            next_ns += period_ns
            puts.append(put(turn))
            turn += 1


def _putter(session: zenoh.Session, pose: Any, beacons: Sequence[Beacon]) -> Callable[[int], int]:
    """Puts one range of the beacons in turn; returns when."""
    random, name = Random(1), f"{os.getpid():08x}"
    publishers = [session.declare_publisher(range_key("lab", b.name, "tag"), encoding=JSON) for b in beacons]

    def put(turn: int) -> int:
        number = turn % len(beacons)
        b = beacons[number]
        true_m = math.dist(tuple(pose), (b.x_m, b.y_m, _BEACON_HEIGHT_M))
        range_m = max(true_m + random.gauss(0.0, 0.05), 0.05)
        message = RangeMessage(name, turn // len(beacons), range_m, 0.07, t_ns=time.time_ns())
        data = encode(message)
        t_ns = time.monotonic_ns()
        publishers[number].put(data)
        return t_ns

    return put
