"""`companion bench recovery`: the network fails and comes back; when are ranges believed again, and which?

Real processes: a router, five beacons at 20 Hz, a vehicle's link and gate. The partition needs Linux with
`unshare` and `ip`: it is made in a network namespace of its own, whose loopback goes down and up.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from enum import Enum

import msgspec

from companion.bench.network import SITE, BenchError, Process, free_port, plain_router
from companion.bench.network_ends import WARM_UP_S, Arrival, BeaconsEnd, VehicleEnd, Window
from companion.network_settings import RangesSettings
from companion.types import Verdict

RATE_HZ = 20.0
BEACONS = 5


class Fault(Enum):
    """What happens to the network."""

    ROUTER_KILLED = "router killed, started again"
    ROUTER_FROZEN = "router frozen"
    PARTITION = "network down"


FAULTS = (
    (Fault.ROUTER_KILLED, 1.0),
    (Fault.ROUTER_FROZEN, 3.0),
    (Fault.ROUTER_FROZEN, 15.0),
    (Fault.PARTITION, 3.0),
    (Fault.PARTITION, 8.0),
    (Fault.PARTITION, 15.0),
)
"""With how long it lasts, seconds; a Zenoh session is given up after 10."""


class Recovery(msgspec.Struct, frozen=True):
    """What came of one fault."""

    fault: Fault
    lasted_s: float
    """From the fault until all is well again; where a router is started again, until it is up."""
    back_s: float | None
    """From then to the first believed range; None: not within the time that it was given."""
    late: int
    """Ranges that arrived more than `ranges.max_age_s` old."""
    refused: int
    """Of these, refused by their stamp."""
    refused_bare: int
    """Of these, refused where they tell no time, by their number."""
    oldest_s: float
    """True age of the oldest range that was believed since the fault, by its stamp."""
    oldest_bare_s: float
    """And by its number."""


def bench_recovery(faults: tuple[tuple[Fault, float], ...], say: Callable[[str], None]) -> list[Recovery]:
    """Measure each. Raises BenchError."""
    found = []
    for fault, seconds in faults:
        say(f"{fault.value}, {seconds:g} s ...")
        if fault is Fault.PARTITION:
            if shutil.which("unshare") is None or shutil.which("ip") is None:
                say("  not measured: it needs the commands unshare and ip")
                continue
            found.append(_apart(fault, seconds))
        else:
            found.append(measure(fault, seconds))
    return found


def _apart(fault: Fault, seconds: float) -> Recovery:
    """In a network namespace of its own, so that nobody else's network goes down."""
    command = ["unshare", "-rn", sys.executable, "-m", "companion.bench.recovery", fault.name, str(seconds)]
    done = subprocess.run(command, capture_output=True, check=False)
    if done.returncode:
        raise BenchError(f"{fault.value}: {done.stderr.decode(errors='replace').strip()[-500:]}")
    return msgspec.json.decode(done.stdout, type=Recovery)


def measure(fault: Fault, seconds: float, before_s: float = 3.0, after_s: float = 12.0) -> Recovery:
    """One fault, with processes of its own; all is well for `before_s`, and it has `after_s` to recover."""
    with ExitStack() as stack:
        port = free_port()
        settings = RangesSettings(SITE, connect=(f"tcp/127.0.0.1:{port}",))
        router = [Process("router", plain_router(port))]
        stack.callback(lambda: router[0].end())
        router[0].answer(int)
        names = [f"b{k}" for k in range(BEACONS)]
        beacons = Process("beacons", BeaconsEnd(dict.fromkeys(names, settings), RATE_HZ))
        stack.callback(beacons.end)
        vehicle = Process("vehicle", VehicleEnd(settings, names, judges=True))
        stack.callback(vehicle.end)
        for process in (beacons, vehicle):
            process.answer(int)
        start_ns = time.monotonic_ns() + round(WARM_UP_S * 1e9)
        all_s = before_s + seconds + after_s
        window = Window(start_ns, start_ns + round(all_s * 1e9))
        for process in (beacons, vehicle):
            process.order(window)
        time.sleep(WARM_UP_S + before_s)
        fault_ns = time.monotonic_ns()
        if fault is Fault.ROUTER_KILLED:
            router[0].kill()
            time.sleep(seconds)
            router[0] = Process("router", plain_router(port))
            back_ns = router[0].answer(int)
        elif fault is Fault.ROUTER_FROZEN:
            os.kill(router[0].pid, signal.SIGSTOP)
            time.sleep(seconds)
            back_ns = time.monotonic_ns()
            os.kill(router[0].pid, signal.SIGCONT)
        else:
            _loopback("down")
            time.sleep(seconds)
            _loopback("up")
            back_ns = time.monotonic_ns()
        arrivals = vehicle.answer(list[Arrival], all_s + 30.0)
    return _recovery(fault, fault_ns, back_ns, arrivals)


def _loopback(state: str) -> None:
    subprocess.run(["ip", "link", "set", "lo", state], check=True)


def _recovery(fault: Fault, fault_ns: int, back_ns: int, arrivals: list[Arrival]) -> Recovery:
    since = [a for a in arrivals if a.t_ns >= fault_ns]
    late = [a for a in since if a.age_s > RangesSettings().max_age_s]
    believed = [a for a in since if a.by_stamp is Verdict.ACCEPTED]
    bare = [a for a in since if a.by_number is Verdict.ACCEPTED]
    back = [a.t_ns for a in believed if a.t_ns >= back_ns]
    return Recovery(
        fault=fault,
        lasted_s=(back_ns - fault_ns) * 1e-9,
        back_s=(back[0] - back_ns) * 1e-9 if back else None,
        late=len(late),
        refused=sum(a.by_stamp is not Verdict.ACCEPTED for a in late),
        refused_bare=sum(a.by_number is not Verdict.ACCEPTED for a in late),
        oldest_s=max((a.age_s for a in believed), default=0.0),
        oldest_bare_s=max((a.age_s for a in bare), default=0.0),
    )


def table(found: list[Recovery]) -> str:
    """The figures for a person."""
    lines = [
        f"{BEACONS} beacons at {RATE_HZ:g} Hz; late: more than {RangesSettings().max_age_s:g} s old",
        f"{'':30}{'lasted':>8}{'believed again':>16}{'late':>6}{'refused':>9}{'oldest believed':>17}"
        f"{'without stamps: refused, oldest':>34}",
    ]
    for r in found:
        back = "never" if r.back_s is None else f"{r.back_s:.2f} s"
        lines.append(
            f"{r.fault.value:30}{r.lasted_s:6.1f} s{back:>16}{r.late:6}{r.refused:9}{r.oldest_s:15.2f} s"
            f"{r.refused_bare:24}{r.oldest_bare_s:8.2f} s"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    _loopback("up")
    print(msgspec.json.encode(measure(Fault[sys.argv[1]], float(sys.argv[2]))).decode())
