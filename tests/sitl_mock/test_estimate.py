"""The mock's estimation errors against PX4's, recorded beside the truth over 130 s of turning flight."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, pi, sin, sqrt
from statistics import fmean, median, pstdev

import pytest

from sitl_mock.autopilot import Target
from sitl_mock.faults import Faults
from sitl_mock.modes import Mode
from sitl_mock.params import Params
from sitl_mock.px4 import Px4
from sitl_mock.scenario import Scenario, TelemetryKind
from sitl_mock.vehicle import Vehicle, wrap
from tests.sitl_mock.recordings import estimate_and_truth

SEEDS = range(10)
RATE_HZ = 30
Columns = dict[str, list[float]]
QUANTITIES = ("n_m", "e_m", "d_m", "vn_m_s", "ve_m_s", "vd_m_s", "yaw_rad")


def fly(kind: TelemetryKind, seed: int) -> Columns:
    """The recorded commands, flown by the mock with this quality of estimate."""
    wanted = estimate_and_truth(kind)
    scenario = Scenario(start_x_m=0.0, start_y_m=0.0, telemetry=kind)
    vehicle = Vehicle(scenario, 0.0, 0.0, 5.0, pi / 2)
    px4 = Px4(scenario, seed, vehicle, Params(), Faults())
    px4.start_in_air()
    columns: Columns = {f"{side}_{name}": [] for side in ("est", "true") for name in QUANTITIES}
    while px4.t_s < 3.0:
        px4.step()
    begin = wanted["t_s"][0] - px4.t_s
    for t, speed, yaw_rate in zip(
        wanted["t_s"], wanted["cmd_forward_m_s"], wanted["cmd_yaw_rate_rad_s"], strict=True
    ):
        heading = px4.autopilot.heading_rad
        px4.setpoint(
            Target(
                height_m=5.0,
                vx_m_s=speed * cos(heading),
                vy_m_s=speed * sin(heading),
                yaw_rate_rad_s=-yaw_rate,
            )
        )
        if px4.mode is not Mode.OFFBOARD:
            px4.set_mode(Mode.OFFBOARD)
        while px4.t_s < t - begin:
            px4.step()
        v, e = vehicle, px4.errors
        truth = (v.y_m, v.x_m, -v.height_m, v.vy_m_s, v.vx_m_s, -v.climb_m_s, pi / 2 - v.heading_rad)
        error = (e.y_m, e.x_m, -e.height_m, e.vy_m_s, e.vx_m_s, -e.climb_m_s, -e.heading_rad)
        for name, true_value, wrong in zip(QUANTITIES, truth, error, strict=True):
            columns[f"true_{name}"].append(true_value)
            columns[f"est_{name}"].append(true_value + wrong)
    return columns


def errors(columns: Columns, name: str) -> list[float]:
    """Estimate minus truth."""
    pairs = zip(columns[f"est_{name}"], columns[f"true_{name}"], strict=True)
    return [wrap(e - t) if name == "yaw_rad" else e - t for e, t in pairs]


def rms(values: Sequence[float]) -> float:
    """Root mean square."""
    return sqrt(fmean(v * v for v in values))


def correlation(values: Sequence[float], lag_s: float) -> float:
    """Autocorrelation at a lag, mean removed."""
    mean, lag = fmean(values), round(lag_s * RATE_HZ)
    centred = [v - mean for v in values]
    return fmean(a * b for a, b in zip(centred, centred[lag:], strict=False)) / fmean(v * v for v in centred)


@pytest.fixture(scope="module", params=["quiet", "stock"])
def kinds(request: pytest.FixtureRequest) -> tuple[Columns, list[Columns]]:
    """PX4's flight and some of the mock's."""
    kind: TelemetryKind = request.param
    return estimate_and_truth(kind), [fly(kind, seed) for seed in SEEDS]


@pytest.mark.parametrize("name", QUANTITIES)
def test_errors_are_as_large_as_recorded(kinds: tuple[Columns, list[Columns]], name: str) -> None:
    """PX4's rms lies among the mock's flights, give or take a third: of slow errors, 130 s are one draw."""
    real = rms(errors(kinds[0], name))
    mock = sorted(rms(errors(flight, name)) for flight in kinds[1])
    assert mock[0] / 1.33 < real < mock[-1] * 1.33
    assert 0.5 < median(mock) / real < 2.0


@pytest.mark.parametrize("names", [("vn_m_s", "ve_m_s"), ("vd_m_s",), ("d_m",)])
@pytest.mark.parametrize("lag_s", [1.0, 2.0, 4.0])
def test_errors_last_as_long_as_recorded(
    kinds: tuple[Columns, list[Columns]], names: tuple[str, ...], lag_s: float
) -> None:
    """What a filter cannot average away: the correlation at 1, 2 and 4 s, within 0.2."""
    real = fmean(correlation(errors(kinds[0], name), lag_s) for name in names)
    mock = median(correlation(errors(flight, name), lag_s) for flight in kinds[1] for name in names)
    assert mock == pytest.approx(real, abs=0.2)


def test_truth_moves_where_the_estimate_is_wrong(kinds: tuple[Columns, list[Columns]]) -> None:
    """The autopilot regulates its estimate: estimated speed and height are steadier than the true ones."""

    def spreads(columns: Columns) -> tuple[float, float, float, float]:
        speeds = [
            [hypot(n, e) for n, e in zip(columns[f"{side}_vn_m_s"], columns[f"{side}_ve_m_s"], strict=True)]
            for side in ("est", "true")
        ]
        return (
            pstdev(speeds[0]),
            pstdev(speeds[1]),
            pstdev(columns["est_d_m"]),
            pstdev(columns["true_d_m"]),
        )

    real = spreads(kinds[0])
    mock = [median(values) for values in zip(*(spreads(flight) for flight in kinds[1]), strict=True)]
    assert mock[0] == pytest.approx(real[0], rel=0.15)
    assert mock[1] == pytest.approx(real[1], rel=0.25)
    assert mock[2] == pytest.approx(real[2], rel=0.4)
    assert mock[3] == pytest.approx(real[3], rel=0.5)
    assert mock[3] > 1.5 * mock[2]


def test_drift_is_motion_that_the_autopilot_does_not_know_of() -> None:
    scenario = Scenario(telemetry="perfect", drift_x_m_s=0.1, drift_y_m_s=-0.05)
    vehicle = Vehicle(scenario, 0.0, 0.0, 3.0, 0.0)
    px4 = Px4(scenario, 1, vehicle, Params(), Faults())
    px4.start_in_air()
    while px4.t_s < 20.0:
        px4.step()
    assert (vehicle.vx_m_s, vehicle.vy_m_s) == pytest.approx((0.1, -0.05), abs=1e-3)
    assert vehicle.vx_m_s + px4.errors.vx_m_s == pytest.approx(0.0, abs=1e-3)
    assert hypot(vehicle.x_m + px4.errors.x_m, vehicle.y_m + px4.errors.y_m) < 0.1
    assert vehicle.x_m > 1.5
