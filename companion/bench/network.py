"""`companion bench network`: one router, many beacons, many vehicles, each a process or a session of its own.

Everything runs on this machine and shares its processors, so that the figures are a bound from below: what is
left when the beacons' and vehicles' own computers do their part is the router's.
"""

from __future__ import annotations

import json
import math
import os
import select
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

import msgspec

from companion.bench.network_ends import (
    DRAIN_S,
    WARM_UP_S,
    BeaconsEnd,
    End,
    Received,
    RouterEnd,
    Sent,
    Usage,
    VehicleEnd,
    Window,
)
from companion.link.zenoh_session import LEASE_MS
from companion.network_settings import RangesSettings

SITE = "bench"
BEACONS_IN_A_PROCESS = 25
"""A session each; a process each would fill the memory, not the network."""
_READY_S = 60.0
_Answer = TypeVar("_Answer")


class BenchError(RuntimeError):
    """A process of the bench did not come up or died; the text says which, and its last words."""


class Load(msgspec.Struct, frozen=True):
    """What is put on the network."""

    vehicles: int = 10
    beacons: int = 200
    rate_hz: float = 20.0
    """Ranges a second of each beacon."""
    each: int = 20
    """Beacons that each vehicle's configuration names."""
    seconds: float = 10.0
    tls: bool = False
    """Over mutual TLS, with the rules of `companion keys`."""

    def named(self, vehicle: int) -> list[str]:
        """The beacons that a vehicle flies with: its own stretch of the ring of all."""
        first = vehicle * self.beacons // self.vehicles
        return [f"b{(first + k) % self.beacons}" for k in range(min(self.each, self.beacons))]


class Figures(msgspec.Struct, frozen=True):
    """What came of it. CPU in per cent of one processor."""

    load: Load
    sent_hz: float
    """Ranges that all beacons put, a second."""
    wanted: int
    """Ranges that vehicles subscribed to."""
    received: int
    delivered: float
    """Share of the wanted ones that arrived."""
    latency_ms: dict[str, float]
    """p50, p95, p99 and max: from the publisher's stamp to the vehicle's loop."""
    cpu_router: float
    cpu_vehicle: float
    """Mean of all vehicles."""
    cpu_beacon: float
    router_us: float
    """CPU of the router for each delivered range."""
    vehicle_us: float
    beacon_us: float
    """CPU of the beacons for each range put."""
    router_mb: float
    vehicle_mb: float
    wire_bytes: float
    """For each range that reached a vehicle, with all headers."""
    vehicle_kbit_s: float
    machine_cpus: int
    load_average: float
    """Of the machine before it began: above zero others were at work on it."""


class Process:
    """One end, talked to by lines."""

    def __init__(self, name: str, end: End) -> None:
        self.name = name
        self._words = tempfile.TemporaryFile()  # noqa: SIM115 - closed in end()
        self._process = subprocess.Popen(
            [sys.executable, "-m", "companion.bench.network_ends", msgspec.json.encode(end).decode()],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._words,
        )

    @property
    def pid(self) -> int:
        """Its process id."""
        return self._process.pid

    def order(self, order: object) -> None:
        """Tell it to do something."""
        assert self._process.stdin is not None
        self._process.stdin.write(msgspec.json.encode(order) + b"\n")
        self._process.stdin.flush()

    def answer(self, kind: type[_Answer], patience_s: float = _READY_S) -> _Answer:
        """Its next line. Raises BenchError where it has died, or says nothing for `patience_s`."""
        assert self._process.stdout is not None
        if not select.select([self._process.stdout], [], [], patience_s)[0]:
            raise BenchError(f"{self.name} has said nothing for {patience_s:g} s")
        line = self._process.stdout.readline()
        if not line:
            self._words.seek(0)
            words = self._words.read().decode(errors="replace").splitlines() or ["without a word"]
            raise BenchError(f"{self.name} died: {words[-1][:500]}")
        return msgspec.json.decode(line, type=kind)

    def end(self) -> None:
        """Let it finish; kill it where it does not."""
        for pipe in (self._process.stdin, self._process.stdout):
            assert pipe is not None
            pipe.close()
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._words.close()

    def kill(self) -> None:
        """End it without a word."""
        self._process.kill()
        self._process.wait()
        self.end()


def free_port() -> int:
    """A TCP port of loopback that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def plain_router(port: int) -> RouterEnd:
    """A router in the clear."""
    quiet = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    listen = {"endpoints": [f"tcp/127.0.0.1:{port}"]}
    link = {"tx": {"lease": LEASE_MS}}
    config = {"mode": "router", "listen": listen, "scouting": quiet, "transport": {"link": link}}
    return RouterEnd(json.dumps(config))


def bench_network(load: Load, say: Callable[[str], None]) -> Figures:
    """Put a load on a network of processes, and measure. Raises BenchError."""
    with ExitStack() as stack:
        average = os.getloadavg()[0]
        port = free_port()
        router, keys = plain_router(port), Path()
        if load.tls:
            keys = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="companion-bench-")))
            router = _secure_router(load, keys, port)

        def settings(who: str) -> RangesSettings:
            if load.tls:
                return RangesSettings(SITE, connect=(f"tls/127.0.0.1:{port}",), tls=str(keys / who))
            return RangesSettings(SITE, connect=(f"tcp/127.0.0.1:{port}",))

        def start(name: str, end: End) -> Process:
            process = Process(name, end)
            stack.callback(process.end)
            return process

        say(f"starting a router, {load.beacons} beacons and {load.vehicles} vehicles ...")
        r = start("router", router)
        _ready([r])
        names = [f"b{k}" for k in range(load.beacons)]
        groups = [names[k : k + BEACONS_IN_A_PROCESS] for k in range(0, len(names), BEACONS_IN_A_PROCESS)]
        beacons = [
            start(
                f"beacons {group[0]} to {group[-1]}",
                BeaconsEnd({b: settings(f"beacon-{b}") for b in group}, load.rate_hz),
            )
            for group in groups
        ]
        vehicles = [
            start(f"vehicle {k}", VehicleEnd(settings(f"vehicle-u{k}"), load.named(k)))
            for k in range(load.vehicles)
        ]
        _ready([*beacons, *vehicles])
        start_ns = time.monotonic_ns() + round((WARM_UP_S + 1.0) * 1e9)
        window = Window(start_ns, start_ns + round(load.seconds * 1e9))
        for process in (r, *beacons, *vehicles):
            process.order(window)
        say(f"measuring for {load.seconds:g} s ...")
        patience_s = WARM_UP_S + load.seconds + DRAIN_S + _READY_S
        sent = [process.answer(Sent, patience_s) for process in beacons]
        received = [process.answer(Received, patience_s) for process in vehicles]
        return _figures(load, r.answer(Usage), sent, received, average)


def _secure_router(load: Load, keys: Path, port: int) -> RouterEnd:
    """The very configuration that `companion keys` makes, with its paths made absolute."""
    import zenoh

    from companion.keys import site
    from companion.keys.certificates import Role

    now = datetime.now(UTC)
    site.create(keys, SITE, now)
    site.add(keys, Role.ROUTER, SITE, now, 1, ("127.0.0.1",))
    for k in range(load.beacons):
        site.add(keys, Role.BEACON, f"b{k}", now, 1)
    for k in range(load.vehicles):
        site.add(keys, Role.VEHICLE, f"u{k}", now, 1)
    site.write_router_file(keys, port)
    config = zenoh.Config.from_file(str(keys / "router" / site.ROUTER_FILE))
    config.insert_json5("listen/endpoints", json.dumps([f"tls/127.0.0.1:{port}"]))
    tls = json.loads(config.get_json("transport/link/tls"))
    for name, value in tls.items():
        if isinstance(value, str):
            tls[name] = str(keys / "router" / value)
    config.insert_json5("transport/link/tls", json.dumps({k: v for k, v in tls.items() if v is not None}))
    return RouterEnd(str(config))


def _ready(processes: list[Process]) -> None:
    for process in processes:
        process.answer(int)


def _figures(
    load: Load, router: Usage, sent: list[Sent], received: list[Received], average: float
) -> Figures:
    put = {beacon: count for s in sent for beacon, count in s.ranges.items()}
    wanted = sum(put[b] for k in range(load.vehicles) for b in load.named(k))
    latency_us = sorted(us for r in received for us in r.latency_us)
    got, total = len(latency_us), sum(put.values())
    vehicle_s, beacon_s = sum(r.usage.cpu_s for r in received), sum(s.usage.cpu_s for s in sent)
    wire = sum(r.wire_bytes for r in received)

    def share(cpu_s: float) -> float:
        return 100.0 * cpu_s / load.seconds

    def each(cpu_s: float, count: int) -> float:
        return 1e6 * cpu_s / max(count, 1)

    return Figures(
        load=load,
        sent_hz=total / load.seconds,
        wanted=wanted,
        received=got,
        delivered=got / max(wanted, 1),
        latency_ms={name: _quantile(latency_us, q) for name, q in _QUANTILES.items()},
        cpu_router=share(router.cpu_s),
        cpu_vehicle=share(vehicle_s / load.vehicles),
        cpu_beacon=share(beacon_s / load.beacons),
        router_us=each(router.cpu_s, got),
        vehicle_us=each(vehicle_s, got),
        beacon_us=each(beacon_s, total),
        router_mb=router.memory_mb,
        vehicle_mb=sum(r.usage.memory_mb for r in received) / load.vehicles,
        wire_bytes=wire / max(got, 1),
        vehicle_kbit_s=8e-3 * wire / load.vehicles / load.seconds,
        machine_cpus=len(os.sched_getaffinity(0)),
        load_average=average,
    )


_QUANTILES = {"p50": 0.5, "p95": 0.95, "p99": 0.99, "max": 1.0}


def _quantile(latency_us: list[int], q: float) -> float:
    """Milliseconds; NaN where nothing came."""
    if not latency_us:
        return math.nan
    return 1e-3 * latency_us[min(len(latency_us) - 1, int(q * len(latency_us)))]


def table(f: Figures) -> str:
    """The figures for a person."""
    load, ms = f.load, f.latency_ms
    rows = {
        "sent": f"{f.sent_hz:.0f} ranges/s",
        "delivered": f"{100.0 * f.delivered:.2f} % ({f.received} of {f.wanted})",
        "latency": f"median {ms['p50']:.2f} ms, p95 {ms['p95']:.2f}, p99 {ms['p99']:.2f}, "
        f"max {ms['max']:.1f}",
        "router": f"{f.cpu_router:.0f} % CPU, {f.router_us:.0f} µs a range, {f.router_mb:.0f} MB",
        "vehicle": f"{f.cpu_vehicle:.1f} % CPU each, {f.vehicle_us:.0f} µs a range, {f.vehicle_mb:.0f} MB, "
        f"{f.vehicle_kbit_s:.0f} kbit/s ({f.wire_bytes:.0f} bytes a range, headers included)",
        "beacon": f"{f.cpu_beacon:.2f} % CPU each, {f.beacon_us:.0f} µs a range",
        "machine": f"{f.machine_cpus} processors, load average {f.load_average:.1f} before it began",
    }
    door = "mutual TLS" if load.tls else "in the clear"
    head = (
        f"{load.beacons} beacons at {load.rate_hz:g} Hz, {load.vehicles} vehicles that subscribe to "
        f"{load.each} each, one router, {door}, {load.seconds:g} s"
    )
    return "\n".join([head, *(f"  {name:11} {text}" for name, text in rows.items())])
