"""UWB beacons: seeded slant ranges in three dimensions, as a module on the vehicle would measure them."""

from __future__ import annotations

from math import sqrt
from random import Random

import msgspec

from sitl_mock.faults import Fault, Faults
from sitl_mock.noise import Noise
from sitl_mock.scenario import BeaconAt, Scenario

NLOS_BIAS_M = 1.5
"""What the fault RANGE_BIAS adds to every range."""


class Range(msgspec.Struct, frozen=True, gc=False):
    """One measured slant range. `los` is "los", "nlos" or "unknown"; `t_ns`: when, by the beacon's clock."""

    beacon: str
    session: str
    seq: int
    range_m: float
    sigma_m: float | None
    los: str
    t_ns: int = 0


class Beacon:
    """One beacon and its module: noise, bias, dropout, outliers, each from its own seeded stream."""

    def __init__(
        self, at: BeaconAt, scenario: Scenario, seed: int, faults: Faults, sessions: Random | None = None
    ) -> None:
        """`sessions` draws the session ids; by default they follow from the seed, as everything else does."""
        self.at = at
        self._scenario = scenario
        self._faults = faults
        self._random = Noise(f"{seed}/uwb/{at.id}")
        self._sessions = sessions or Random(f"{seed}/session/{at.id}")
        self._last: Range | None = None
        self._restarted = False
        self._start()

    def measure(self, x_m: float, y_m: float, height_m: float, t_ns: int = 0) -> Range | None:
        """Measure from here; None where the measurement is lost. The sequence number counts lost ones too."""
        s, random = self._scenario, self._random
        restart = self._faults.active(Fault.BEACON_RESTART)
        if restart and not self._restarted:
            self._start()
        self._restarted = restart
        self._seq += 1
        # Every measurement draws the same numbers, whatever becomes of it: faults do not shift the noise.
        lost, outlier = random.random(), random.random()
        excess = random.uniform(*s.range_outlier_m)
        noise = random.gauss(s.range_sigma_m) if s.range_sigma_m else 0.0
        if lost < s.range_dropout or self._faults.active(Fault.RANGE_LOSS):
            return None
        if self._faults.active(Fault.RANGE_FROZEN) and self._last is not None:
            return self._last
        at = self.at
        dx, dy, dz = x_m - at.x_m, y_m - at.y_m, height_m - at.height_m
        range_m = sqrt(dx * dx + dy * dy + dz * dz) + at.bias_m + noise
        nlos = outlier < s.range_outliers or self._faults.active(Fault.RANGE_BIAS)
        if outlier < s.range_outliers:
            range_m += excess
        elif nlos:
            range_m += NLOS_BIAS_M
        los = ("nlos" if nlos else "los") if s.range_outliers_told else "unknown"
        self._last = Range(
            at.id,
            self._session,
            self._seq,
            max(range_m, 0.0),
            s.range_sigma_m if s.range_sigma_m else None,
            los,
            t_ns,
        )
        return self._last

    def _start(self) -> None:
        self._session = f"{self._sessions.getrandbits(32):08x}"
        self._seq = -1
