"""Where ranges come from: simulated beacons, recordings at their pace, modules on a serial port."""

from __future__ import annotations

import threading
import time
from itertools import islice
from pathlib import Path

import pytest

from companion.uwb import sources
from companion.uwb.families import Family, open_parser
from companion.uwb.measured import Measured
from companion.uwb.sources import SerialPort, Simulated, Source, SourceError, batches
from tests.uwb.network import until
from tests.uwb.samples import LEC4, LINKTRACK3, NTF_FOUR, TLV_TAG
from tests.uwb.sources import Module, attached, play


def ranges_of(source: Source, count: int) -> list[tuple[float | None, float | None]]:
    read = batches(source, None, open_parser(Family.CSV), threading.Event(), print)
    return [(m.time_s, m.range_m) for m in islice((m for batch in read for m in batch), count)]


def test_a_simulated_beacon_is_seeded() -> None:
    beacons = (Simulated(rate_hz=1000.0, radius_m=3.0, dropout=0.2, seed=seed) for seed in (1, 1, 2))
    a, b, c = (ranges_of(beacon, 50) for beacon in beacons)
    assert a == b != c
    quiet = ranges_of(Simulated(rate_hz=1000.0, radius_m=3.0, period_s=0.1, sigma_m=0.0), 101)
    assert max(r or 0.0 for _, r in quiet) == pytest.approx(13.0)
    assert min(r or 0.0 for _, r in quiet) == pytest.approx(7.0)


def test_a_recording_is_not_played_faster_than_it_was(tmp_path: Path) -> None:
    path = tmp_path / "ranges.csv"
    path.write_text("t_s,beacon,range_m\n100.0,b1,5.0\n100.1,b1,5.1\n100.3,b1,5.2")
    start = time.monotonic()
    assert [m.range_m for m in play(path, Family.CSV)] == [5.0, 5.1, 5.2]
    assert time.monotonic() - start >= 0.3
    start = time.monotonic()
    assert len(play(path, Family.CSV, speed=3.0)) == 3
    assert time.monotonic() - start >= 0.1


def test_a_recording_whose_clock_was_set_back_goes_on(tmp_path: Path) -> None:
    path = tmp_path / "ranges.csv"
    path.write_text("t_s,beacon,range_m\n100.0,b1,5.0\n100.02,b1,5.1\n3.0,b1,5.2\n3.02,b1,5.3\n")
    assert len(play(path, Family.CSV)) == 4


def test_a_recording_without_times_needs_a_rate(tmp_path: Path) -> None:
    path = tmp_path / "module.log"
    path.write_bytes(NTF_FOUR * 3)
    with pytest.raises(SourceError, match="rate"):
        play(path, Family.QORVO_CLI)
    start = time.monotonic()
    assert len(play(path, Family.QORVO_CLI, rate_hz=10.0)) == 12
    assert time.monotonic() - start >= 0.2


# -------------------------------------------------------------------------------------- serial ports


def test_a_module_that_measures_is_left_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sources, "_QUIET_S", 60.0)
    with attached(tmp_path) as (unit, device):
        stop = threading.Event()
        read = batches(
            SerialPort(device), Family.DWM1001_SHELL, open_parser(Family.DWM1001_SHELL), stop, print
        )
        next(read)  # opens the port
        unit.write(LEC4)
        measured: list[Measured] = []

        def more() -> bool:
            measured.extend(next(read))
            return len(measured) >= 4

        until(more, "four ranges")
        monkeypatch.setattr(sources, "_QUIET_S", 0.0)  # now is the time at which a silent one is typed to
        assert next(read) == next(read) == []
        assert len(measured) == 4 and unit.listen() == b""
        stop.set()
        assert list(read) == []


def test_tlv_is_asked_for(tmp_path: Path) -> None:
    with attached(tmp_path) as (unit, device):
        stop = threading.Event()
        source = SerialPort(device, poll_hz=50.0)
        read = batches(source, Family.DWM1001_TLV, open_parser(Family.DWM1001_TLV), stop, print)
        measured: list[Measured] = []
        answered = 0

        def more() -> bool:
            nonlocal answered
            measured.extend(next(read))
            asked = unit.listen().count(b"\x0c\x00")
            unit.write(TLV_TAG * (asked - answered))
            answered = asked
            return len(measured) >= 6

        until(more, "three answers")
        stop.set()


def test_a_port_that_goes_away_is_taken_up_again(tmp_path: Path) -> None:
    link = tmp_path / "uwb"
    unit = Module(link)
    stop = threading.Event()
    said: list[str] = []
    read = batches(SerialPort(str(link)), Family.LINKTRACK, open_parser(Family.LINKTRACK), stop, said.append)
    next(read)  # opens the port, which throws away what had come before
    unit.write(LINKTRACK3)
    until(lambda: bool(next(read)), "a range")
    unit.close()
    until(lambda: next(read) == [] and bool(said), "loss noticed")
    unit = Module(link)
    until(lambda: next(read) == [] and len(said) == 2, "port is back")
    unit.write(LINKTRACK3)
    until(lambda: bool(next(read)), "a range")
    stop.set()
    unit.close()
    assert "lost" in said[0] and "back" in said[1]
