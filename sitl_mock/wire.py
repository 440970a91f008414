"""The mock in real time: the autopilot on MAVLink 2 over UDP, the beacons on Zenoh, in one thread.

The loop waits on its sockets until the next step is due. After a stall it catches up, but never by more than
half a second: what was lost is lost.
"""

from __future__ import annotations

import json
import select
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import TextIO

import msgspec
import zenoh
from pymavlink.dialects.v20 import development as mavlink

from companion.range_message import RangeMessage
from companion.types import LineOfSight
from companion.wire_range import encode, range_key
from sitl_mock.ardupilot import ArduPilot
from sitl_mock.clock import Clock
from sitl_mock.control import Control
from sitl_mock.faults import Fault, FaultAt, Faults
from sitl_mock.modes import WIRE
from sitl_mock.params import Params
from sitl_mock.protocol import Link, Protocol
from sitl_mock.px4 import Px4
from sitl_mock.scenario import Scenario
from sitl_mock.streams import Message
from sitl_mock.udp import Udp
from sitl_mock.uwb import Beacon
from sitl_mock.vehicle import STEP_S, Vehicle
from sitl_mock.visitors import Visitor, Visitors
from sitl_mock.world import start_pose

_CATCH_UP_STEPS = 50
_LOSS = 0.3
_LINK_FAULT = {Link.ONBOARD: Fault.LINK_LOSS, Link.GCS: Fault.GCS_LOSS}


@dataclass(frozen=True, slots=True)
class Endpoints:
    """Where the mock is reached. URLs are `udpout:HOST:PORT` or `udpin:HOST:PORT`; None: not at all."""

    onboard: str | None = "udpout:127.0.0.1:14540"
    gcs: str | None = "udpout:127.0.0.1:14550"
    zenoh_listen: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    zenoh_connect: tuple[str, ...] = ()
    site: str = "lab"
    tag: str = "drone"
    autopilot: str = "px4"
    """`px4` or `ardupilot`."""
    key: bytes | None = None
    """Of the onboard link, where it is signed."""


def _packed(visitor: Visitor) -> bytes:
    """The message of another one, with its ids; its sequence numbers are of no use to anybody."""
    data: bytes = visitor.message.pack(mavlink.MAVLink(None, visitor.system, visitor.component))
    return data


class RangePublisher:
    """The beacons' ranges on Zenoh. Raises ValueError where the endpoints cannot be had."""

    def __init__(self, endpoints: Endpoints, beacons: list[str]) -> None:
        config = {
            "mode": "peer",
            "listen": {"endpoints": list(endpoints.zenoh_listen)},
            "connect": {"endpoints": list(endpoints.zenoh_connect), "retry": {"period_init_ms": 100}},
            "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            # Read by `locators`, which tells the real port where 0 was asked for.
            "adminspace": {"enabled": True, "permissions": {"read": True, "write": False}},
        }
        try:
            self._session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
        except zenoh.ZError as error:
            where = ", ".join(endpoints.zenoh_listen + endpoints.zenoh_connect)
            raise ValueError(f"Zenoh endpoints {where}: {str(error).splitlines()[0]}") from None
        self._publishers = {
            beacon: self._session.declare_publisher(
                range_key(endpoints.site, beacon, endpoints.tag), encoding=zenoh.Encoding.APPLICATION_JSON
            )
            for beacon in beacons
        }

    def locators(self) -> list[str]:
        """Where it really listens."""
        for reply in self._session.get(f"@/{self._session.zid()}/peer"):
            if reply.ok is not None:
                return list(msgspec.json.decode(reply.ok.payload.to_bytes(), type=_Admin).locators)
        return []

    def put(self, beacon: str, message: RangeMessage) -> None:
        """Publish one range."""
        self._publishers[beacon].put(encode(message))

    def close(self) -> None:
        """End the session."""
        self._session.close()  # type: ignore[no-untyped-call]


class _Admin(msgspec.Struct):
    locators: list[str]


class Wire:
    """The mock on its wires. `run` until told to stop; `faults` may be switched while it runs.

    Raises ValueError or OSError where an endpoint cannot be had.
    """

    def __init__(
        self,
        scenario: Scenario,
        seed: int,
        endpoints: Endpoints,
        faults: tuple[FaultAt, ...] = (),
        params: Params | None = None,
        truth_log: Path | None = None,
    ) -> None:
        self._truth: TextIO | None = truth_log.open("w") if truth_log is not None else None
        x, y, heading = start_pose(scenario, seed)
        params = params or Params(ardupilot=endpoints.autopilot == "ardupilot")
        self.faults = Faults(faults)
        self.vehicle = Vehicle(scenario, x, y, 0.0, heading)
        kind = ArduPilot if endpoints.autopilot == "ardupilot" else Px4
        self.px4 = kind(scenario, seed, self.vehicle, params, self.faults)
        self._protocol = Protocol(self.px4)
        self._visitors = Visitors(self.faults)
        urls = {Link.ONBOARD: endpoints.onboard, Link.GCS: endpoints.gcs}
        self.links = {
            link: Udp(url, self._protocol.system_id, endpoints.key if link is Link.ONBOARD else None)
            for link, url in urls.items()
            if url is not None
        }
        # Unlike the noise, sessions are new at every start: a beacon that restarts begins to count anew.
        self._beacons = [
            (
                Beacon(at, scenario, seed, self.faults, Random()),
                Clock(scenario.range_rate_hz, i / len(scenario.beacons)),
            )
            for i, at in enumerate(scenario.beacons)
        ]
        self._ranges = RangePublisher(endpoints, [at.id for at in scenario.beacons])
        self._loss = Random(f"{seed}/loss")
        self._truth_clock = Clock(50.0)
        self._steps = 0

    def listening(self) -> list[str]:
        """One line for every endpoint."""
        lines = [f"listening: mavlink {link.value} {udp.url}" for link, udp in self.links.items()]
        return lines + [f"listening: zenoh {locator}" for locator in self._ranges.locators()]

    def run(
        self, stopped: Callable[[], bool], wake: int | None = None, control: Control | None = None
    ) -> None:
        """Run in real time until `stopped` says so; a byte on the descriptor `wake` makes it ask at once.

        `control` switches faults meanwhile.
        """
        sockets: list[Udp | int | Control] = [*self.links.values()]
        if wake is not None:
            sockets.append(wake)
        if control is not None:
            sockets.append(control)
        start = time.monotonic()
        while not stopped():
            behind = int((time.monotonic() - start) / STEP_S) - self._steps
            if behind > _CATCH_UP_STEPS:
                start += (behind - _CATCH_UP_STEPS) * STEP_S
                behind = _CATCH_UP_STEPS
            for _ in range(behind):
                self._receive()
                self._step()
            wait_s = start + (self._steps + 1) * STEP_S - time.monotonic()
            ready = select.select(sockets, [], [], max(wait_s, 0.0))[0]
            if control is not None and control in ready and not control.read(self.faults):
                sockets.remove(control)
            if ready:
                self._receive()

    def close(self) -> None:
        """Give everything back."""
        for udp in self.links.values():
            udp.close()
        self._ranges.close()
        if self._truth is not None:
            self._truth.close()

    def _receive(self) -> None:
        for link, udp in self.links.items():
            for message in udp.receive():
                if not self._lost(link):
                    self._protocol.receive(link, message)
                    self._forward(link, message)

    def _forward(self, link: Link, message: Message) -> None:
        """Hand broadcasts of the companion to the ground station, as PX4 does (MAV_n_FORWARD of its port)."""
        gcs = self.links.get(Link.GCS)
        if link is Link.ONBOARD and gcs is not None and not hasattr(message, "target_system"):
            gcs.forward(message.get_msgbuf())

    def _step(self) -> None:
        self._steps += 1
        for udp in self.links.values():
            udp.system_id = self._protocol.system_id
            udp.sign(not self.faults.active(Fault.UNSIGNED))
        for link, message in self._protocol.step():
            if link in self.links:
                self.links[link].send(message, self._lost(link))
        for visitor in self._visitors.step(self._steps, self._protocol.system_id):
            onboard = self.links.get(Link.ONBOARD)
            if onboard is not None and not self._lost(Link.ONBOARD):
                onboard.forward(_packed(visitor))
        v = self.vehicle
        for beacon, clock in self._beacons:
            for _ in range(clock.due(self._steps)):
                r = beacon.measure(v.x_m, v.y_m, v.height_m, time.time_ns())
                if r is not None:
                    los = LineOfSight(r.los)
                    message = RangeMessage(r.session, r.seq, r.range_m, r.sigma_m, los, t_ns=r.t_ns)
                    self._ranges.put(r.beacon, message)
        if self._truth is not None and self._truth_clock.due(self._steps):
            self._log_truth(self._truth)

    def _lost(self, link: Link) -> bool:
        if self.faults.active(_LINK_FAULT[link]):
            return True
        return self.faults.active(Fault.PACKET_LOSS) and self._loss.random() < _LOSS

    def _log_truth(self, file: TextIO) -> None:
        v, at = self.vehicle, self._beacons[0][0].at
        row = {
            "t_s": round(self.px4.t_s, 3),
            "x_m": v.x_m,
            "y_m": v.y_m,
            "height_m": v.height_m,
            "heading_rad": v.heading_rad,
            "vx": v.vx_m_s,
            "vy": v.vy_m_s,
            "yaw_rate": v.yaw_rate_rad_s,
            "mode": WIRE[self.px4.mode].name.value,
            "armed": self.px4.armed,
            "d_m": ((v.x_m - at.x_m) ** 2 + (v.y_m - at.y_m) ** 2) ** 0.5,
        }
        file.write(json.dumps(row) + "\n")
        file.flush()
