"""Recording while flying: nothing waits for the disk, and whatever happens to it is survived and told."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Callable
from io import FileIO
from pathlib import Path

import pytest

from companion import recorder as recorder_module
from companion.compiled import twin, why_not
from companion.record import Start
from companion.recorder import BACKLOG, Recorder
from companion.recording import Recording, read
from companion.replay import replay
from companion.types import CompanionHeartbeat, Defect, Event, Malformed, Output, SystemStatus, Tick
from tests.record.flights import Item, flown, start

PATIENCE_S = 30.0


def wait_for(what: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE_S
    while not what():
        assert time.monotonic() < end, "waited too long"
        time.sleep(0.01)


@pytest.fixture(scope="module")
def items() -> list[Item]:
    return flown()


@pytest.fixture(params=["plain", "compiled"])
def form(request: pytest.FixtureRequest) -> type[Recorder]:
    """Either form of it, where both are there."""
    if request.param == "plain":
        return Recorder
    if why_not() is not None:
        pytest.skip(f"core {why_not()}")
    return twin(Recorder)


class FakeDisk:
    """Takes what it is given, in pieces; refuses or hangs on demand."""

    def __init__(self) -> None:
        self.data = b""
        self.refusals = 0
        self.refuse: OSError | None = None
        self.free = threading.Event()
        self.free.set()
        self.held = threading.Event()

    def write(self, data: bytes, /) -> int:
        if not self.free.is_set():
            self.held.set()
            self.free.wait()
        if self.refuse is not None:
            self.refusals += 1
            raise self.refuse
        self.data += data[:1000]
        return min(1000, len(data))

    def close(self) -> None:
        pass


def read_back(tmp_path: Path, disk: FakeDisk) -> Recording:
    path = tmp_path / "back.mcap"
    path.write_bytes(disk.data)
    return read(path)


def test_a_flight_is_recorded_and_replays_bit_for_bit(tmp_path: Path, items: list[Item]) -> None:
    path = tmp_path / "new" / "flight.mcap"
    with Recorder.open(path, start()) as recorder:
        for item in items:
            recorder.write(item)
    assert recorder.problem is None and recorder.lost == 0
    result = replay(read(path))
    assert result.equal and result.stopped is None and not result.problems
    assert (result.events, result.compared) == (
        sum(isinstance(item, Event) for item in items),
        sum(isinstance(item, Output) for item in items),
    )


def test_the_record_tells_how_long_each_output_took(tmp_path: Path) -> None:
    t_ns = time.monotonic_ns()
    began = Start(time.time_ns(), t_ns, "{}", "", {}, {})
    with Recorder.open(tmp_path / "f.mcap", began) as recorder:
        recorder.write(Tick(t_ns=t_ns))
        recorder.write(CompanionHeartbeat(t_ns=t_ns, system_status=SystemStatus.ACTIVE))
        told_s = (time.monotonic_ns() - t_ns) * 1e-9
    ((delay_s,),) = [step.delays_s for step in read(tmp_path / "f.mcap").steps]
    assert 0.0 < delay_s <= told_s


def test_an_empty_flight_is_a_sound_file(tmp_path: Path) -> None:
    Recorder.open(tmp_path / "f.mcap", start()).close()
    recording = read(tmp_path / "f.mcap")
    assert recording.steps == () and not recording.problems
    assert replay(recording).equal


def test_a_record_is_never_overwritten(tmp_path: Path, form: type[Recorder]) -> None:
    path = tmp_path / "f.mcap"
    path.write_text("precious")
    with form.open(path, start()) as recorder:
        recorder.write(Tick(t_ns=1))
        assert recorder.problem == f"{path}: File exists"
    assert path.read_text() == "precious" and recorder.lost == 1


def test_an_unwritable_place_is_told_and_the_flight_goes_on(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with Recorder.open(tmp_path / "file" / "f.mcap", start()) as recorder:
        recorder.write(Tick(t_ns=1))
    assert recorder.problem is not None and "Not a directory; the last 1 " in recorder.problem


# ----------------------------------------------------------------------------------------- sick disks


def test_a_full_disk_is_told(items: list[Item], form: type[Recorder]) -> None:
    with form(FileIO("/dev/full", "wb"), start(), "full") as recorder:
        for item in items[:100]:
            recorder.write(item)
        wait_for(lambda: recorder.problem is not None)
        assert recorder.problem == "full: No space left on device"
    assert recorder.problem == "full: No space left on device; the last 100 events and outputs are missing"


def test_a_disk_that_is_full_for_a_while_costs_nothing(
    tmp_path: Path, items: list[Item], form: type[Recorder]
) -> None:
    disk = FakeDisk()
    disk.refuse = OSError(28, "No space left on device")
    with form(disk, start(), "disk") as recorder:
        for item in items[:500]:
            recorder.write(item)
        wait_for(lambda: disk.refusals >= 2)
        disk.refuse = None
        wait_for(lambda: recorder.problem is None)
        for item in items[500:]:
            recorder.write(item)
    assert recorder.problem is None
    assert replay(read_back(tmp_path, disk)).compared == sum(isinstance(item, Output) for item in items)


def test_a_disk_that_hangs_never_holds_the_flight_up(
    tmp_path: Path, items: list[Item], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recorder_module, "BACKLOG", 300)
    monkeypatch.setattr(recorder_module, "_SILENT_S", 0.1)
    disk = FakeDisk()
    with Recorder(disk, start(), "disk") as recorder:
        for item in items[:50]:
            recorder.write(item)
        wait_for(lambda: len(disk.data) > 0)
        disk.free.clear()
        recorder.write(items[50])
        assert disk.held.wait(PATIENCE_S)
        for item in items[51:]:
            recorder.write(item)  # returns, or this test never ends
        waiting = len(recorder._events.waiting) + len(recorder._outputs.waiting)
        assert waiting == 300, "bounded"
        assert not recorder._outputs.waiting, "outputs go first"
        wait_for(lambda: recorder.problem is not None and "has not answered" in recorder.problem)
        disk.free.set()
    assert recorder.problem is not None and "events and" in recorder.problem and "dropped" in recorder.problem
    recording = read_back(tmp_path, disk)
    assert recording.lost == recorder.lost > 0
    assert f"{recorder.lost} records are missing" in recording.problems
    last = [item for item in items if isinstance(item, Event)][-1]
    assert recording.steps[-1].event == last, "the newest are kept"
    result = replay(recording)
    assert result.equal and result.stopped is not None and "lacks events" in result.stopped


def test_what_waits_is_bounded_and_outputs_go_first(form: type[Recorder]) -> None:
    recorder = form(None, start(), "none", "a test")  # without a disk nothing is ever taken
    for n in range(30_000):
        recorder.write(CompanionHeartbeat(t_ns=n, system_status=SystemStatus.ACTIVE))
    for n in range(BACKLOG - 30_000):
        recorder.write(Tick(t_ns=n))
    assert recorder.problem == "none: a test" and recorder.lost == 0
    for n in range(30_007):
        recorder.write(Tick(t_ns=n))
    assert recorder.problem == "none: a test; 7 events and 30000 outputs dropped"
    assert recorder.lost == 30_007


def test_closing_does_not_wait_for_a_disk_that_hangs(items: list[Item], form: type[Recorder]) -> None:
    disk = FakeDisk()
    disk.free.clear()
    recorder = form(disk, start(), "disk")
    try:
        recorder.write(items[0])
        recorder.close(patience_s=0.1)
        problem = "disk: the disk does not answer; the last 1 events and outputs are missing"
        assert recorder.problem == problem
    finally:
        disk.free.set()


def test_a_bug_in_the_recorder_does_not_end_the_flight(form: type[Recorder]) -> None:
    class Unknown(Event, frozen=True, tag="unknown"):
        pass

    with form(FakeDisk(), start(), "disk") as recorder:
        recorder.write(Unknown(t_ns=1))
        wait_for(lambda: recorder.problem is not None)
        recorder.write(Tick(t_ns=2))
    assert recorder.problem is not None and "the recorder failed: KeyError" in recorder.problem


def test_text_that_json_cannot_hold_is_counted(tmp_path: Path, form: type[Recorder]) -> None:
    disk = FakeDisk()
    with form(disk, start(), "disk") as recorder:
        recorder.write(Tick(t_ns=1))
        recorder.write(Malformed(t_ns=2, defect=Defect.RANGE_FIELD, detail="\ud800"))
        recorder.write(Tick(t_ns=3))
    assert recorder.problem == "disk: 1 could not be written as JSON"
    recording = read_back(tmp_path, disk)
    assert [step.event.t_ns for step in recording.steps] == [1, 3] and recording.lost == 1


# ------------------------------------------------------------------------------------------ processes

CHILD = """
import resource, sys, time
from pathlib import Path
from companion.compiled import twin
from companion.recorder import Recorder
from tests.record.flights import flown, start
path, limit = Path(sys.argv[1]), int(sys.argv[2])
items = flown()
if limit:
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
recorder = twin(Recorder).open(path, start())
for n, item in enumerate(items):
    recorder.write(item)
    if n % 20 == 0:
        time.sleep(0.03)
if not limit:
    print("flown", flush=True)
    time.sleep(600)
recorder.close()
print(recorder.problem)
"""


def child(path: Path, limit: int) -> subprocess.Popen[str]:
    arguments = [sys.executable, "-c", CHILD, str(path), str(limit)]
    return subprocess.Popen(arguments, stdout=subprocess.PIPE, text=True, cwd=Path(__file__).parents[2])


def test_a_killed_flight_opens_and_replays(tmp_path: Path) -> None:
    path = tmp_path / "f.mcap"
    with child(path, 0) as process:
        try:
            wait_for(lambda: path.exists() and path.stat().st_size > 40_000)
        finally:
            process.kill()
    recording = read(path)
    assert not recording.finished and recording.lost == 0
    (problem,) = recording.problems
    assert problem.startswith("the end is missing")
    result = replay(recording)
    assert result.equal and result.compared > 50 and result.stopped is None


def test_a_killed_flight_that_had_a_moment_to_write_is_complete(tmp_path: Path, items: list[Item]) -> None:
    path = tmp_path / "f.mcap"
    with child(path, 0) as process:
        try:
            assert process.stdout is not None and process.stdout.readline() == "flown\n"
            last = [item for item in items if isinstance(item, Event)][-1]
            wait_for(lambda: read(path).steps[-1].event == last)  # no later event closes the chunk: time does
        finally:
            process.kill()
    assert replay(read(path)).compared == sum(isinstance(item, Output) for item in items)


def test_a_file_that_may_not_grow_is_told_and_replays_as_far_as_it_goes(tmp_path: Path) -> None:
    path = tmp_path / "f.mcap"
    with child(path, 60_000) as process:
        out, _ = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert out.startswith(f"{path}: File too large; the last ")
    assert path.stat().st_size == 60_000
    result = replay(read(path))
    assert result.equal and result.compared > 50 and result.problems[0].startswith("the end is missing")
