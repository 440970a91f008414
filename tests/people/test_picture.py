"""The picture: a PNG with something on it, whatever the flight; and the dashed line is the shortest path."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance.model import shortest_path_m
from companion.picture import PictureError, Truth, draw_flight, headline, shortest_path
from companion.summary import FlightLog, Pose, Problem, report
from companion.types import AnyOutput, Phase
from tests.people.flights import RADIUS_M, SPEED_M_S, TARGET, YAW_RATE_RAD_S, change, flight, status

PROBLEM = Problem(RADIUS_M, SPEED_M_S, YAW_RATE_RAD_S)


def draw(path: Path, outputs: list[AnyOutput], truth: Truth | None = None) -> None:
    log = FlightLog()
    for output in outputs:
        log.add(output)
    draw_flight(path, report(log, PROBLEM), truth)


def colours(path: Path) -> set[tuple[int, int, int]]:
    from matplotlib.image import imread

    pixels = np.asarray(imread(path))[..., :3]
    assert pixels.shape[0] > 500 and pixels.shape[1] > 900
    return {tuple(c) for c in np.unique((pixels.reshape(-1, 3) * 255).round().astype(int), axis=0).tolist()}


def test_a_flight_is_drawn(tmp_path: Path) -> None:
    path = tmp_path / "flight.png"
    truth = Truth([(-2.0, 0.5), (0.0, 2.0), TARGET], TARGET)
    draw(path, flight(), truth)
    assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    seen = colours(path)
    # the path in the colours of its phases: acquire, approach, hold; and the true target's star
    for wanted in ((0x7F, 0xB2, 0xE5), (0x1D, 0x5F, 0xA8), (0x2F, 0x8F, 0x5B), (0xF2, 0xB7, 0x05)):
        assert wanted in seen


def test_the_headline_says_how_it_went() -> None:
    assert (
        headline(True, 14.24, 7.1, 1.032)
        == "Target captured  ·  14.2 s, 7.10 m flown  ·  1.03 × the shortest path"
    )
    assert headline(False, None, None, None) == "Target not captured"
    assert headline(True, None, None, None, "station") == "Station reached"


def test_a_station_is_drawn_with_its_beacons(tmp_path: Path) -> None:
    log = FlightLog()
    for output in flight():
        log.add(output)
    problem = Problem(0.3, SPEED_M_S, YAW_RATE_RAD_S, "station")
    drawn = []
    for beacons in ((), ((0.0, 5.0), (6.0, 6.0), (3.0, 1.0))):
        path = tmp_path / "station.png"
        draw_flight(path, report(log, problem), Truth([(-2.0, 0.5), TARGET], TARGET, beacons))
        drawn.append(path.read_bytes())
    assert drawn[0] != drawn[1]


@pytest.mark.parametrize(
    "outputs",
    [
        [status(0.0, phase=Phase.STANDBY, estimate=None)],
        [
            change(0.0, Phase.STANDBY, Phase.ACQUIRE, "go"),
            status(0.0, estimate=None),
            status(0.5, range_m=None),
        ],
    ],
)
def test_odd_flights_are_drawn_too(tmp_path: Path, outputs: list[AnyOutput]) -> None:
    draw(tmp_path / "odd.png", outputs)
    assert (tmp_path / "odd.png").stat().st_size > 5000


def test_without_positions_it_says_so(tmp_path: Path) -> None:
    with pytest.raises(PictureError, match="no position"):
        draw(tmp_path / "none.png", [status(0.0, x_m=None, y_m=None)])


@given(d=st.floats(0.6, 30.0), theta=st.floats(-math.pi, math.pi), heading=st.floats(-math.pi, math.pi))
def test_the_dashed_line_is_the_shortest_path(d: float, theta: float, heading: float) -> None:
    azimuth = heading - theta
    target = (1.0 + d * math.cos(azimuth), -2.0 + d * math.sin(azimuth))
    points = shortest_path(Pose(1.0, -2.0, heading), target, PROBLEM)
    bound = shortest_path_m(d, theta, RADIUS_M, SPEED_M_S, YAW_RATE_RAD_S)
    if not points:
        return  # two arcs: not drawn
    length = sum(math.dist(a, b) for a, b in itertools.pairwise(points))
    assert math.dist(points[-1], target) <= RADIUS_M + 1e-6
    assert length >= bound - 0.01
    if d > 3.0:  # out of reach of the turning circles nothing else is as short
        assert length == pytest.approx(bound, abs=0.03)
