"""The compiled core does what the plain one does, and is never older than it."""

from __future__ import annotations

import importlib
import io
import math
import os
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterable, Iterator
from importlib.machinery import EXTENSION_SUFFIXES
from itertools import count, repeat
from pathlib import Path
from random import Random
from types import FrameType
from typing import Any

import msgspec
import pytest
from pymavlink.dialects.v20 import development as mavlink

from companion import compiled, pilot
from companion.bench.system.cost import configuration
from companion.compiled import native, source, twin
from companion.config import Config
from companion.flight_writer import FlightWriter
from companion.guidance.settings import GuidanceSettings
from companion.link.mavlink import VehicleLink
from companion.link.range_events import Raw, range_event
from companion.range_message import RangeMessage
from companion.record import Start, start_now
from companion.recorder import Recorder
from companion.run import Flying
from companion.settings import VehicleSettings
from companion.types import Event, Output, RangeSample, Setpoint, Tick
from companion.wire_range import JSON, encode, range_key
from sitl_mock.faults import Fault, FaultAt
from sitl_mock.scenario import Scenario
from sitl_mock.world import World
from tests.safety.test_check import Wire

FAULTS = (
    FaultAt(Fault.RANGE_LOSS, 9.0, 3.0),
    FaultAt(Fault.RANGE_BIAS, 15.0, 2.0),
    FaultAt(Fault.BEACON_RESTART, 19.0, 1.0),
    FaultAt(Fault.TELEMETRY_STOP, 22.0, 2.0),
)
CASES = {
    "capture": Config(sim=Scenario(random_start=True, telemetry="stock", limit_s=30.0)),
    "station": configuration(3, 30.0),
    "paper": Config(
        guidance=GuidanceSettings(observer="luenberger", controller="lq-paper"), sim=Scenario(limit_s=30.0)
    ),
}
"""Kinds of flights that run through different parts of the guidance."""


Flown = list[tuple[Event, tuple[Output, ...]]]
"""Every event of a flight, and what left on it."""


def flight(config: Config, seed: int, core: Any, world: type[World]) -> Flown:
    around = world(config.sim, seed, FAULTS)
    plan = core.plan(config if core is pilot else native(config))
    state = core.initial(plan)
    flown: Flown = []
    for event in around.events():
        state, outputs = core.step(plan, state, event)
        for output in outputs:
            around.send(output)
        flown.append((event, outputs))
    return flown


@pytest.fixture(scope="module")
def built() -> Any:
    """The compiled pilot. Without a C compiler there is none: a failure only where it must be there."""
    why = compiled.why_not()
    if why is not None:
        if os.environ.get("COMPANION_REQUIRE_COMPILED"):
            pytest.fail(f"core {why}")
        pytest.skip(f"core {why}")
    return importlib.import_module(f"{compiled.PACKAGE}.companion.pilot")


@pytest.mark.parametrize("name", CASES)
def test_both_forms_of_the_core_and_of_the_mock_fly_the_same_bit_for_bit(name: str, built: Any) -> None:
    plain = flight(CASES[name], 5, pilot, World)
    assert len(plain) > 3000
    assert flight(CASES[name], 5, built, twin(World)) == plain


STRANGE: dict[type, tuple[float, ...]] = {
    float: (math.nan, math.inf, -math.inf, 0.0, -1.0, 1e300, -1e-300),
    int: (0, -1, 2**63, -(2**70)),
}


def spoilt(events: list[Event], random: Random) -> Iterator[Event]:
    """The same events, some of them lost, doubled or late, and numbers in some replaced by strange ones."""
    late: list[Event] = []
    for event in events:
        if random.random() < 0.03:
            name = random.choice([n for n in event.__struct_fields__ if type(getattr(event, n)) in STRANGE])
            strange = random.choice(STRANGE[type(getattr(event, name))])
            event = msgspec.structs.replace(event, **{name: strange})
        fate = random.random()
        if fate < 0.02:
            late.append(event)
        elif fate > 0.04:
            yield event
        if fate > 0.98:
            yield event
        while late and random.random() < 0.1:
            yield late.pop()


def told_by(core: Any, config: Config, events: Iterable[Event]) -> list[str]:
    """What leaves, and the error that ends it, in words: where NaN is NaN."""
    plan = core.plan(config if core is pilot else native(config))
    state = core.initial(plan)
    told: list[str] = []
    try:
        for event in events:
            state, outputs = core.step(plan, state, event)
            told += map(repr, outputs)
    except (ArithmeticError, ValueError) as error:
        told.append(repr(error))
    return told


@pytest.mark.parametrize("name", CASES)
def test_both_forms_make_the_same_of_strange_events(name: str, built: Any) -> None:
    events = [event for event, _ in flight(CASES[name], 6, pilot, World)]
    for seed in range(6):
        plain = told_by(pilot, CASES[name], spoilt(events, Random(seed)))
        assert told_by(built, CASES[name], spoilt(events, Random(seed))) == plain
        assert len(plain) > 100


@pytest.mark.usefixtures("built")
def test_telemetry_setpoints_and_record_run_without_a_frame_of_python() -> None:
    """A frame costs more than all that it does: the first one of a thread that wakes maps its stack anew."""
    autopilot, wire = mavlink.MAVLink(None, 1, 1), Wire()
    link = twin(VehicleLink)(VehicleSettings(), wire)
    recorder = twin(Recorder)(None, start_now(VehicleSettings(), "", {}), "none")
    heard = (
        mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 128, 393216, 4, 3),
        mavlink.MAVLink_attitude_message(1, 0.0, 0.0, 0.5, 0.0, 0.0, 0.1),
        mavlink.MAVLink_local_position_ned_message(1, 1.0, 2.0, -3.0, 0.1, 0.2, 0.3),
        mavlink.MAVLink_current_mode_message(0, 393216, 393216),
        mavlink.MAVLink_extended_sys_state_message(0, 2),
        mavlink.MAVLink_attitude_quaternion_message(1, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),  # not heard
    )
    wire.incoming = [bytes(message.pack(autopilot)) for message in heard]
    clock = repeat(0).__next__
    frames: list[str] = []

    def see(frame: FrameType, what: str, _: object) -> None:
        if what == "call" and frame.f_code.co_qualname not in ("Wire.receive", "Wire.send"):
            frames.append(frame.f_code.co_qualname)

    sys.setprofile(see)
    try:
        events = list(link.receive(clock))
        link.send(Setpoint(1, 0.5, 0.1, 0.0, 3.0, 0.0))
        recorder.write(Tick(1))
    finally:
        sys.setprofile(None)
    assert len(events) == 5 and len(wire.sent) == 1
    assert frames == []


class HeldDisk:
    """Takes nothing until it is released: all of a flight waits then, and its chunks depend on no clock."""

    def __init__(self) -> None:
        self.data = b""
        self.released = threading.Event()

    def write(self, data: bytes, /) -> int:
        self.released.wait()
        self.data += data
        return len(data)

    def close(self) -> None:
        pass


def recorded(form: type[Recorder], start: Start, items: list[Event | Output]) -> bytes:
    disk = HeldDisk()
    recorder = form(disk, start, "disk")
    for item in items:
        recorder.write(item)
    recorder.close(patience_s=0.0)
    disk.released.set()
    recorder.close()
    assert recorder.problem is None
    return disk.data


def laid_out(form: type[FlightWriter], start: Start, items: list[Event | Output]) -> bytes:
    stream = io.BytesIO()
    writer = form(stream, start)
    for number, item in enumerate(items):
        if number == 500:
            writer.say_lost(item.t_ns, 7)
            writer.flush()
        writer.add(number if number < 500 else number + 7, item, item.t_ns + number)
    writer.finish()
    return stream.getvalue()


@pytest.mark.usefixtures("built")
def test_both_forms_record_the_same_byte_for_byte(monkeypatch: pytest.MonkeyPatch) -> None:
    start = start_now(CASES["station"], "digest", {})
    flown = flight(CASES["station"], 5, pilot, twin(World))
    items: list[Event | Output] = []
    for event, outputs in flown:
        items.append(event)
        items.extend(outputs)
    t_ns = flown[0][0].t_ns
    items[1:1] = [RangeSample(t_ns, f"made up {n}", "", n, 1.0, sent_t_ns=n) for n in range(70)]
    items.append(Tick(t_ns=-(2**62)))  # before 1970
    assert twin(FlightWriter) is not FlightWriter and twin(Recorder) is not Recorder
    assert laid_out(twin(FlightWriter), start, items) == laid_out(FlightWriter, start, items)
    files = []
    for form in (Recorder, twin(Recorder)):
        monkeypatch.setattr(time, "monotonic_ns", count(t_ns).__next__)
        files.append(recorded(form, start, items))
    assert files[0] == files[1] and len(files[0]) > 100_000


@pytest.mark.parametrize("name", CASES)
def test_no_python_function_runs_between_a_range_and_its_setpoint(name: str, built: Any) -> None:
    """Zenoh's threads pay for the first one of every call with memory mapped, and unmapped again. Now and
    then there is one: a range is refused, or a phase left."""
    config, called, clean, ranges = CASES[name], Counter[str](), 0, 0
    link = twin(VehicleLink)(config.vehicle, Wire())
    recorder = twin(Recorder)(None, start_now(config, "", {}), "nowhere")
    flying = twin(Flying)(config, link.send, recorder.write)
    read = twin(range_event)

    def seen(frame: FrameType, what: str, _: object) -> None:
        if what == "call" and frame.f_code.co_qualname != "Wire.send":
            called[frame.f_code.co_qualname] += 1

    for event, _ in flight(config, 7, pilot, World):
        if not isinstance(event, RangeSample):
            flying.take(event)
            continue
        message = RangeMessage("s", event.seq, event.range_m, event.sigma_m, event.los)
        key, payload = range_key("lab", event.beacon, "tag"), encode(message)
        raw = twin(Raw)(event.t_ns, key, payload, len(payload), JSON)
        before = called.total()
        sys.setprofile(seen)
        try:
            flying.take(read(raw))
        finally:
            sys.setprofile(None)
        ranges += 1
        clean += called.total() == before
    assert ranges > 300
    assert clean > 0.9 * ranges, called.most_common(5)


def test_the_rewritten_source_says_what_the_source_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without a compiler: the same statements, run as the plain Python that they are."""
    monkeypatch.setattr(source, "PACKAGE", "companion_rewritten")
    monkeypatch.setattr(source, "MANIFEST", "companion_rewritten.manifest")
    source.write(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    core = importlib.import_module("companion_rewritten.companion.pilot")
    world = importlib.import_module("companion_rewritten.sitl_mock.world")
    assert flight(CASES["capture"], 5, core, world.World) == flight(CASES["capture"], 5, pilot, World)


@pytest.fixture
def fresh() -> Iterator[None]:
    compiled.why_not.cache_clear()
    yield
    compiled.why_not.cache_clear()


@pytest.mark.usefixtures("fresh", "built")
def test_an_edited_source_runs_as_edited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiled.why_not.cache_clear()
    assert compiled.why_not() is None and twin(pilot.step) is not pilot.step
    edited = tmp_path / "limits.py"
    edited.write_bytes(compiled.file_of("companion.limits").read_bytes() + b"\n")
    where = compiled.file_of
    monkeypatch.setattr(
        compiled, "file_of", lambda module: edited if module == "companion.limits" else where(module)
    )
    compiled.why_not.cache_clear()
    why = compiled.why_not()
    assert why is not None and "companion.limits has changed" in why and "make compiled" in why
    assert twin(pilot.step) is pilot.step


@pytest.mark.usefixtures("built")
def test_a_library_carries_its_own_digests() -> None:
    """Beside it, a build that failed would leave an old library with the digests of a new one."""
    assert str(importlib.import_module(compiled.MANIFEST).__file__).endswith(tuple(EXTENSION_SUFFIXES))


@pytest.mark.usefixtures("fresh")
def test_without_a_compiled_core_the_plain_one_flies(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, compiled.MANIFEST, None)
    compiled.why_not.cache_clear()
    why = compiled.why_not()
    assert why is not None and "C compiler" in why
    assert twin(pilot.step) is pilot.step and twin(World) is World


def test_everything_that_a_build_depends_on_is_watched() -> None:
    watched = set(source.made_from())
    assert watched > set(source.MODULES)
    assert {"companion.types", "companion.settings", "companion.phase", "sitl_mock.scenario"} <= watched


def test_the_version_tells_of_the_core() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "companion", "--version"], capture_output=True, text=True, check=True
    )
    assert ", core " in done.stdout
