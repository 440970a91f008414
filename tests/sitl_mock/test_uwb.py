"""The beacons."""

from __future__ import annotations

import itertools
from math import sqrt
from statistics import fmean, pstdev

import pytest

from sitl_mock.faults import Fault, Faults
from sitl_mock.scenario import BeaconAt, Scenario
from sitl_mock.uwb import Beacon, Range

CLEAN = Scenario(range_dropout=0.0, range_outliers=0.0, range_sigma_m=0.0)


def measure(scenario: Scenario, at: BeaconAt, count: int, faults: Faults | None = None) -> list[Range | None]:
    """So many measurements from (3, 4, 0)."""
    beacon = Beacon(at, scenario, 1, faults or Faults())
    return [beacon.measure(3.0, 4.0, 0.0) for _ in range(count)]


def told(ranges: list[Range | None]) -> list[Range]:
    """Those that arrived."""
    return [r for r in ranges if r is not None]


def test_range_is_slant_and_biased() -> None:
    at = BeaconAt(x_m=0.0, y_m=0.0, height_m=-12.0, bias_m=0.25)
    (r,) = told(measure(CLEAN, at, 1))
    assert r.range_m == pytest.approx(sqrt(9 + 16 + 144) + 0.25)
    assert (r.beacon, r.seq, r.sigma_m, r.los) == ("b1", 0, None, "unknown")


def test_noise_dropout_and_outliers_are_as_frequent_and_as_large_as_told() -> None:
    scenario = Scenario(range_outliers_told=True)
    ranges = measure(scenario, BeaconAt(x_m=0.0, y_m=0.0), 20_000)
    arrived = told(ranges)
    assert len(arrived) / len(ranges) == pytest.approx(1.0 - scenario.range_dropout, abs=0.01)
    good = [r.range_m - 5.0 for r in arrived if r.los == "los"]
    bad = [r.range_m - 5.0 for r in arrived if r.los == "nlos"]
    assert fmean(good) == pytest.approx(0.0, abs=0.005)
    assert pstdev(good) == pytest.approx(scenario.range_sigma_m, rel=0.05)
    assert len(bad) / len(arrived) == pytest.approx(scenario.range_outliers, abs=0.01)
    assert min(bad) > 0.1 and max(bad) < 3.5
    assert fmean(bad) == pytest.approx(1.75, abs=0.1)
    assert all(r.sigma_m == scenario.range_sigma_m for r in arrived)


def test_lost_measurements_leave_gaps_in_the_sequence() -> None:
    ranges = measure(Scenario(range_dropout=0.5), BeaconAt(), 100)
    assert [r.seq for r in told(ranges)] == [i for i, r in enumerate(ranges) if r is not None]


def test_beacons_are_independent_and_follow_from_the_seed() -> None:
    def draw(beacon: str, seed: int) -> list[float]:
        source = Beacon(BeaconAt(id=beacon), Scenario(range_dropout=0.0), seed, Faults())
        return [r.range_m for r in told([source.measure(0.0, 0.0, 0.0) for _ in range(5)])]

    assert draw("a", 1) == draw("a", 1)
    assert draw("a", 1) != draw("b", 1)
    assert draw("a", 1) != draw("a", 2)


def test_faults() -> None:
    faults = Faults()
    beacon = Beacon(BeaconAt(x_m=0.0, y_m=0.0), CLEAN, 1, faults)

    clock = itertools.count()

    def one() -> Range | None:
        return beacon.measure(3.0, 4.0, 0.0, next(clock))

    first = one()
    assert first is not None
    faults.switch(Fault.RANGE_FROZEN, True)
    assert one() == first
    faults.switch(Fault.RANGE_FROZEN, False)
    faults.switch(Fault.RANGE_BIAS, True)
    biased = one()
    assert biased is not None and biased.range_m == pytest.approx(6.5)
    faults.switch(Fault.RANGE_BIAS, False)
    faults.switch(Fault.RANGE_LOSS, True)
    assert one() is None
    faults.switch(Fault.RANGE_LOSS, False)
    faults.switch(Fault.BEACON_RESTART, True)
    restarted, after = one(), one()
    assert restarted is not None and after is not None
    assert restarted.session != first.session
    assert (restarted.seq, after.seq, after.session) == (0, 1, restarted.session)


def test_a_fault_does_not_shift_the_noise() -> None:
    """The flight after a fault is the flight that would have been: seeds stay comparable."""
    faults = Faults()
    at = BeaconAt()
    plain, faulty = Beacon(at, Scenario(), 3, Faults()), Beacon(at, Scenario(), 3, faults)
    for i in range(60):
        faults.switch(Fault.RANGE_LOSS, 10 <= i < 30)
        a, b = plain.measure(0.0, 0.0, 1.0), faulty.measure(0.0, 0.0, 1.0)
        if not 10 <= i < 30:
            assert a == b
