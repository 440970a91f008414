"""The faults on the wire: real processes, UDP and Zenoh, in real time, one flight each."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Mapping
from math import inf
from pathlib import Path
from typing import NamedTuple

import zenoh

from companion.link.zenoh_session import zenoh_config
from companion.network_settings import RangesSettings
from companion.types import FlightMode, Phase
from tests.safety.faults.expected import GOES_ON
from tests.safety.faults.flight import SETTINGS, Outcome
from tests.safety.faults.rules import (
    ACQUIRE,
    APPROACH,
    ENDED,
    HAND_OVER,
    INHIBITED,
    RELEASED,
    STALL,
    STANDBY,
    Judgement,
    Rule,
    judge,
)
from tests.safety.faults.scene import LOITER, OFFBOARD, NotReadyError, Scene, limits_of

_KEY = "uwb/v1/lab/b1/drone/range"
_SILENT_S = 0.25
"""What is under way when a process dies, on a machine under load."""

Strike = Callable[[Scene], None]


class WireFault(NamedTuple):
    """A fault on the wire. It strikes in the approach; `strike` lasts as long as the fault does."""

    name: str
    family: str
    what: str
    strike: Strike
    rule: Rule
    watch_s: float = 6.0
    """After the strike has been carried out."""
    mock: tuple[str, ...] = ()
    app: tuple[str, ...] = ()
    routed: bool = False
    falls_back_s: float = inf
    """PX4 must have left OFFBOARD by then."""

    @property
    def rules(self) -> Mapping[Phase, Rule]:
        """By phase, as those of the simulated faults."""
        return {APPROACH: self.rule}


# --------------------------------------------------------------------------------------------- strikes


def _kill(scene: Scene) -> None:
    scene.app.kill()


def _kill_and_start(scene: Scene) -> None:
    scene.app.kill()
    scene.start_app()
    scene.wait(lambda: scene.phase is INHIBITED, "the new app is inhibited")
    time.sleep(3.0)


_STREAMED = 20
"""More setpoints than any autopilot here wants to see before it lets OFFBOARD be selected."""


def _kill_start_engage(scene: Scene) -> None:
    _kill_and_start(scene)
    scene.select(LOITER)
    scene.wait(lambda: scene.phase is STANDBY, "the new app is ready")
    ready_s = time.monotonic()  # PX4 refuses OFFBOARD while no setpoints stream
    scene.wait(lambda: len(scene.sent(ready_s)) > _STREAMED, "setpoints stream")
    scene.select(OFFBOARD)


def _stop_for(seconds: float) -> Strike:
    def strike(scene: Scene) -> None:
        scene.app.send_signal(signal.SIGSTOP)
        time.sleep(seconds)
        scene.app.send_signal(signal.SIGCONT)

    return strike


def _term(scene: Scene) -> None:
    scene.app.terminate()


def _select_loiter(scene: Scene) -> None:
    scene.select(LOITER)


def _mock_killed(scene: Scene) -> None:
    scene.mock.kill()


def _through(make: Callable[[random.Random], Callable[[bytes], Iterable[bytes]]], for_s: float) -> Strike:
    def strike(scene: Scene) -> None:
        relay = scene.relay
        before = relay.up, relay.down
        relay.up, relay.down = make(random.Random(1)), make(random.Random(2))
        time.sleep(for_s)
        relay.up, relay.down = before

    return strike


def _cut(_: random.Random) -> Callable[[bytes], Iterable[bytes]]:
    return lambda packet: ()


def _lossy(draw: random.Random) -> Callable[[bytes], Iterable[bytes]]:
    return lambda packet: () if draw.random() < 0.3 else (packet,)


def _doubled_and_swapped(_: random.Random) -> Callable[[bytes], Iterable[bytes]]:
    held: list[bytes] = []

    def through(packet: bytes) -> Iterable[bytes]:
        if not held:
            held.append(packet)
            return ()
        return (packet, packet, held.pop())

    return through


def _garbled(draw: random.Random) -> Callable[[bytes], Iterable[bytes]]:
    def through(packet: bytes) -> Iterable[bytes]:
        bad = bytearray(packet)
        bad[draw.randrange(len(bad))] ^= 1 << draw.randrange(8)
        return (draw.randbytes(draw.randrange(1, 300)), bytes(bad), packet, packet[: len(packet) // 2])

    return through


def _zenoh_garbage(scene: Scene) -> None:
    draw = random.Random(1)
    with zenoh.open(zenoh_config(RangesSettings(connect=(scene.zenoh,)))) as session:
        for _ in range(500):
            payload = draw.choice((draw.randbytes(60), b"{}", b'{"session": 1}', b"[" * 5000, b""))
            encoding = draw.choice(("application/json", "application/msgpack", "text/plain"))
            session.put(_KEY, payload, encoding=encoding)
            time.sleep(0.01)


def _zenoh_echo(scene: Scene) -> None:
    """Every range comes again, twice, 0.1 s late and in the wrong order."""
    lock, waiting = threading.Lock(), []

    def note(sample: zenoh.Sample) -> None:
        with lock:
            waiting.append((sample.payload.to_bytes(), sample.encoding))

    with zenoh.open(zenoh_config(RangesSettings(connect=(scene.zenoh,)))) as session:
        subscriber = session.declare_subscriber(_KEY, zenoh.handlers.Callback(note, indirect=False))
        for _ in range(60):
            time.sleep(0.1)
            with lock:
                echoed, waiting[:] = list(waiting), []
            for payload, encoding in reversed(echoed * 2):
                session.put(_KEY, payload, encoding=encoding, allowed_destination=zenoh.Locality.REMOTE)
        subscriber.undeclare()  # type: ignore[no-untyped-call]


def _router_gone_for(seconds: float) -> Strike:
    def strike(scene: Scene) -> None:
        assert scene.router is not None
        scene.router.kill()
        scene.router.wait()
        time.sleep(seconds)
        scene.start_router()

    return strike


_REBOOT_AT_S = 32.0


def _nothing(scene: Scene) -> None:
    """The mock does it by itself; the strike is waited for."""


def _load(scene: Scene) -> None:
    core = min(os.sched_getaffinity(0))
    os.sched_setaffinity(scene.app.pid, {core})
    spin = [sys.executable, "-c", f"import os; os.sched_setaffinity(0, {{{core}}})\nwhile True: pass"]
    busy = [subprocess.Popen(spin) for _ in range(3)]
    try:
        time.sleep(6.0)
    finally:
        for process in busy:
            process.kill()
            process.wait()


def _nobody_reads(scene: Scene) -> None:
    scene.reading.clear()
    time.sleep(8.0)
    scene.reading.set()


_STEPPING = """
import signal, sys, time
real, real_ns, back_s = time.time, time.time_ns, 0
def step(*_):
    global back_s
    back_s = 3600 - back_s
time.time = lambda: real() - back_s
time.time_ns = lambda: real_ns() - back_s * 1_000_000_000
signal.signal(signal.SIGUSR1, step)
from companion.__main__ import main
sys.exit(main())
"""
"""The app with a wall clock that a signal sets back an hour, and forth again."""


def _clock_back(scene: Scene) -> None:
    scene.app.send_signal(signal.SIGUSR1)
    time.sleep(3.0)
    scene.app.send_signal(signal.SIGUSR1)


# ---------------------------------------------------------------------------------------------- matrix

_DEAD = Rule("silent at once, PX4 acts", silent=(_SILENT_S, inf))
_WATCHES = Rule(
    "silent and inhibited until a person acts", reach=((INHIBITED, 20.0),), silent=(_SILENT_S, inf)
)
_ENGAGES = Rule("inhibited, ready, engaged anew", reach=((INHIBITED, 20.0), (STANDBY, 25.0), (ACQUIRE, 26.0)))
_WAKES = Rule("silent, also when it wakes", reach=((RELEASED, 3.5),), silent=(_SILENT_S, inf))
_ENDS = Rule(
    "stands still, asks for Hold, ends",
    reach=((HAND_OVER, 0.3), (ENDED, 2.0)),
    still=(0.3, inf),
    silent=(2.0, inf),
)
_TAKEN = Rule("silent at once, then standstill only", reach=((RELEASED, 0.3),), still=(0.3, inf))
_REBOOTED = Rule("stands still, then silent", still=(1.2, inf), silent=(4.0, inf))
_GONE = Rule(
    "stands still, then silent: the vehicle is gone",
    reach=((STALL, 0.9), (RELEASED, 3.4)),
    still=(0.9, inf),
    silent=(3.4, inf),
)
_BACK = Rule(
    "stands still in time, then acquires anew",
    reach=((STALL, 4.3), (ACQUIRE, 14.0)),
    still=(4.3, 6.0),
    never=frozenset({HAND_OVER, RELEASED, ENDED}),
)

# fmt: off
_ALL = (
    WireFault("wire/kill-9", "process", "the app is killed (SIGKILL)", _kill, _DEAD, 3.0, falls_back_s=2.0),
    WireFault("wire/restart", "process", "killed, and started anew at once", _kill_and_start, _WATCHES, 1.0),
    WireFault("wire/restart-engage", "process", "the same, and LOITER, then OFFBOARD are selected",
        _kill_start_engage, _ENGAGES, 3.0),
    WireFault("wire/sigstop", "process", "the app is stopped for 3 s (SIGSTOP)",
        _stop_for(3.0), _WAKES, 4.0, falls_back_s=2.0),
    WireFault("wire/sigterm", "process", "the app is asked to end (SIGTERM)",
        _term, _ENDS, 4.0, falls_back_s=2.0),
    WireFault("wire/output-blocked", "process", "nobody reads what the app prints",
        _nobody_reads, GOES_ON, 2.0),
    WireFault("wire/takeover", "person", "a person selects LOITER", _select_loiter, _TAKEN, 3.0),
    WireFault("wire/reboot", "vehicle", "the autopilot restarts in flight",
        _nothing, _REBOOTED, 6.0, mock=("--fault", f"reboot@{_REBOOT_AT_S:g}")),
    WireFault("wire/autopilot-killed", "vehicle", "the autopilot is gone, its port closed",
        _mock_killed, _GONE, 5.0),
    WireFault("wire/link-cut", "link", "no packet passes for 5 s", _through(_cut, 5.0), _GONE, 3.0),
    WireFault("wire/packet-loss", "link", "30 % of the packets are lost, either way",
        _through(_lossy, 8.0), GOES_ON, 1.0),
    WireFault("wire/packets-doubled", "link", "packets are doubled and swapped, either way",
        _through(_doubled_and_swapped, 8.0), GOES_ON, 1.0),
    WireFault("wire/mavlink-garbage", "link", "noise, flipped bits and torn packets, either way",
        _through(_garbled, 6.0), GOES_ON, 1.0),
    WireFault("wire/zenoh-garbage", "range", "unreadable messages on the ranges' key",
        _zenoh_garbage, GOES_ON, 1.0),
    WireFault("wire/ranges-echoed", "range", "ranges come again, late, doubled, in the wrong order",
        _zenoh_echo, GOES_ON, 1.0),
    WireFault("wire/router-gone", "range", "the Zenoh router is killed, and back after 6 s",
        _router_gone_for(6.0), _BACK, 8.0, routed=True),
    WireFault("wire/clock-step", "clock", "the wall clock jumps back an hour, and forth again",
        _clock_back, GOES_ON, 3.0, app=("-c", _STEPPING)),
    WireFault("wire/cpu-load", "load", "three busy processes on the app's core", _load, GOES_ON, 1.0),
)
# fmt: on

WIRE: Mapping[str, WireFault] = {fault.name: fault for fault in _ALL}
"""By name, in the order of the table."""


# ---------------------------------------------------------------------------------------------- flights


def fly(fault: WireFault) -> Outcome:
    """One flight with one fault."""
    with tempfile.TemporaryDirectory() as directory:
        try:
            with Scene(Path(directory), fault.mock, fault.app, fault.routed) as scene:
                return _fly(fault, scene)
        except (NotReadyError, AssertionError) as error:
            nothing = Judgement((), None)
            return Outcome(fault.name, APPROACH, 1, (), nothing, limits_of(()), (), str(error))


def _fly(fault: WireFault, scene: Scene) -> Outcome:
    scene.take_off_and_engage()
    if any("reboot" in option for option in fault.mock):
        scene.wait(lambda: scene.truth()[-1].t_s >= _REBOOT_AT_S, "the autopilot restarts")
    else:
        time.sleep(1.0)
    began_s, rows_before = time.monotonic(), len(scene.truth())
    struck_in = scene.phase
    fault.strike(scene)
    time.sleep(fault.watch_s)
    judgement = judge(fault.rule, struck_in, scene.steps(began_s), scene.sent(began_s))
    rows = scene.truth()[rows_before:]
    worst = limits_of(rows)
    broken = worst.exceeded(SETTINGS)
    if fault.falls_back_s < inf:
        held = [row.t_s - rows[0].t_s for row in rows if row.mode is FlightMode.OFFBOARD]
        if held and held[-1] > fault.falls_back_s:
            broken.append(f"the vehicle is in OFFBOARD {held[-1]:.1f} s after the strike")
    if struck_in is not APPROACH:
        broken.append(f"struck in {struck_in.value}")
    dead = scene.app.poll() is not None and scene.phase is not ENDED
    steps = tuple(scene.steps(began_s))
    return Outcome(fault.name, APPROACH, 1, steps, judgement, worst, tuple(broken), dead=dead)
