"""The benches of the network, small: real processes, and figures that add up."""

from __future__ import annotations

import math

import pytest

from companion.bench import recovery
from companion.bench.network import BenchError, Figures, Load, Process, bench_network, table
from companion.bench.network_ends import VehicleEnd
from companion.bench.recovery import Fault
from companion.network_settings import RangesSettings


def quiet(_: str) -> None:
    pass


def test_every_vehicle_hears_its_own_beacons_and_the_costs_are_told() -> None:
    load = Load(vehicles=2, beacons=4, rate_hz=20.0, each=3, seconds=0.5, tls=True)
    f = bench_network(load, quiet)
    assert isinstance(f, Figures)
    assert f.wanted == 2 * 3 * 10
    assert 0 < f.received <= f.wanted
    assert f.delivered == f.received / f.wanted
    assert all(math.isfinite(ms) and ms > 0.0 for ms in f.latency_ms.values())
    assert f.wire_bytes > 60.0  # more than bare headers
    assert "delivered" in table(f)


def test_vehicles_share_the_beacons_evenly() -> None:
    load = Load(vehicles=10, beacons=200, each=20)
    assert sorted(b for k in range(10) for b in load.named(k)) == sorted(f"b{k}" for k in range(200))


def test_an_end_that_dies_is_told_with_its_last_words() -> None:
    end = VehicleEnd(RangesSettings(connect=("tls/127.0.0.1:1",)), ["b1"])
    process = Process("vehicle", end)
    try:
        with pytest.raises(BenchError, match=r"vehicle died: .*needs ranges.tls"):
            process.answer(int)
    finally:
        process.end()


def test_the_backlog_of_a_frozen_router_is_refused_and_ranges_are_believed_again() -> None:
    """What waited a second arrives at once: with stamps and without, none older than told is believed.

    Frozen for longer, a loaded machine may give the connection up (2 s without a word), and nothing waits.
    """
    r = recovery.measure(Fault.ROUTER_FROZEN, 1.0, before_s=1.0, after_s=2.0)
    assert r.back_s is not None
    assert r.late > 0
    assert r.oldest_s < 1.0
    assert r.oldest_bare_s < 1.0


def test_a_router_that_was_killed_is_found_again() -> None:
    r = recovery.measure(Fault.ROUTER_KILLED, 0.2, before_s=0.5, after_s=4.0)
    assert r.back_s is not None
    assert recovery.table([r]).count("\n") == 2
