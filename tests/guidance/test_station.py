"""The default for station keeping, in closed loop: arrives, stays, and says when it cannot."""

from __future__ import annotations

import math
import random
from typing import Any

import msgspec
import numpy as np
import pytest

from companion.bench.station_plant import Air, Field, Moment, Stayed, bound_m, fly, random_field
from companion.guidance import station_pose, station_steer
from companion.guidance.scheme import STAY, TRACK, Scheme
from companion.guidance.settings import GuidanceSettings
from companion.guidance.station import station
from companion.guidance.station_settings import StationSettings
from companion.guidance.station_state import Mode, Problem, Station
from companion.guidance.station_steer import Situation

SHORT = Air(limit_s=150.0, hold_s=30.0)
SQUARE = Field((12.0, 5.0), ((18.0, 4.0), (9.0, 10.0), (10.0, 0.0), (6.0, 3.0)))
TRIANGLE = SQUARE._replace(beacons=SQUARE.beacons[:3])


def scheme_for(field: Field, **keys: object) -> Scheme:
    keeping = msgspec.convert(keys, StationSettings)
    return station(GuidanceSettings(), keeping, field.distances_m, 0.2, 0.3)


def state_of(flight: Stayed) -> Station:
    assert isinstance(flight.state, Station)
    return flight.state


def flights(count: int, seed: int, air: Air) -> tuple[list[Stayed], list[float]]:
    rng = random.Random(seed)
    flown, ratios = [], []
    for k in range(count):
        field = random_field(rng)
        air = air._replace(drift_azimuth_rad=rng.uniform(-math.pi, math.pi))
        flown.append(fly(scheme_for(field), field, seed * 1000 + k, air))
        ratios.append(flown[-1].path_m / bound_m(field, air, 0.5, 1.0))
    return flown, ratios


def test_it_arrives_and_stays_from_anywhere() -> None:
    flown, ratios = flights(10, 1, SHORT)
    assert all(f.worst_m <= 0.3 for f in flown), [f[:4] for f in flown]
    assert np.median(ratios) <= 1.12
    assert max(ratios) <= 2.5
    assert math.sqrt(np.mean([f.rms_m**2 for f in flown])) <= 0.06


def test_it_arrives_and_stays_against_an_unknown_drift() -> None:
    flown, _ = flights(10, 2, SHORT._replace(drift_m_s=0.2))
    assert all(f.worst_m <= 0.3 for f in flown), [f[:4] for f in flown]
    assert math.sqrt(np.mean([f.rms_m**2 for f in flown])) <= 0.11


def test_a_beacon_lost_on_the_way_leaves_enough() -> None:
    flight = fly(scheme_for(SQUARE), SQUARE, 5, SHORT, heard=lambda i, t: i != 1 or t < 8.0)
    assert flight.worst_m <= 0.3


def test_a_beacon_that_comes_late_is_placed() -> None:
    flight = fly(scheme_for(SQUARE), SQUARE, 6, SHORT, heard=lambda i, t: i != 1 or t > 10.0)
    assert flight.worst_m <= 0.3
    assert state_of(flight).beacons[1].located


def test_a_beacon_that_comes_at_the_station_is_placed_once_it_is_needed() -> None:
    """Placed from the way flown since, it may stand on the wrong side, and would lead the vehicle astray."""
    flight = fly(scheme_for(SQUARE), SQUARE, 6, SHORT, heard=lambda i, t: i != 1 or t > 40.0)
    assert flight.worst_m <= 0.3
    assert not state_of(flight).beacons[1].located
    air, later = SHORT._replace(hold_s=60.0), lambda i, t: t > 20.0 if i == 1 else i != 0 or t < 50.0
    flight = fly(scheme_for(SQUARE), SQUARE, 6, air, heard=later)
    assert flight.worst_m <= 0.3
    assert state_of(flight).beacons[1].located


def test_a_beacon_that_comes_while_its_place_is_open_ends_no_flight() -> None:
    """Of a single one too little is known at first: no fit of all of them has an optimum."""
    rng = random.Random("31/v 33")  # the layout and the noise that showed it
    field = random_field(rng, 4)
    air = SHORT._replace(drift_azimuth_rad=rng.uniform(-math.pi, math.pi))
    flight = fly(scheme_for(field), field, rng.getrandbits(32), air, heard=lambda i, t: i != 0 or t > 20)
    assert flight.worst_m <= 0.3


def test_a_beacon_far_away_makes_no_line_of_the_others() -> None:
    rng = random.Random("31/v 10")  # the layout and the noise that showed it
    near, azimuth = random_field(rng, 3), rng.uniform(-math.pi, math.pi)
    x, y = near.station
    far = (x + 40.0 * math.cos(azimuth), y + 40.0 * math.sin(azimuth))
    field = near._replace(beacons=(*near.beacons[:2], far))
    rng.uniform(-math.pi, math.pi)
    flight = fly(scheme_for(field), field, rng.getrandbits(32), SHORT)
    assert state_of(flight).problem == Problem.NONE
    assert flight.worst_m <= 0.3


def test_many_beacons() -> None:
    field = random_field(random.Random(7), 12)
    assert fly(scheme_for(field), field, 7, SHORT._replace(drift_m_s=0.1)).worst_m <= 0.3


def test_fewer_than_three_beacons_are_refused() -> None:
    with pytest.raises(ValueError, match="at least 3"):
        station(GuidanceSettings(), StationSettings(), (3.0, 4.0), 0.2, 0.3)


def test_too_few_heard_beacons_are_named_and_nothing_moves() -> None:
    speeds = []
    flight = fly(
        scheme_for(TRIANGLE),
        TRIANGLE,
        8,
        Air(limit_s=10.0),
        heard=lambda i, t: i != 2,
        watch=lambda m: speeds.append(m.v_m_s),
    )
    assert state_of(flight).problem == Problem.TOO_FEW
    assert max(speeds) == 0.0


def test_beacons_in_a_line_are_named_and_refused() -> None:
    field = Field((9.0, 6.0), ((5.0, 2.0), (9.0, 2.0), (14.0, 2.0)))
    stepping: list[float] = []
    steps: list[tuple[float, float]] = []
    circle: list[tuple[float, float]] = []

    def tell(s: Any, truth: Situation) -> Any:
        stepping.append(s.steps_s)
        return s

    def watch(m: Moment) -> None:
        if 0.0 < stepping[-1] < 20.0:
            (steps if stepping[-1] < 8.0 else circle).append((m.x_m, m.y_m))

    flight = fly(scheme_for(field), field, 9, Air(limit_s=60.0), tell=tell, watch=watch)
    assert flight.time_s == math.inf
    assert state_of(flight).problem == Problem.COLLINEAR
    # all has been done to tell: small steps first, then the circle
    assert 0.15 < max(math.dist(steps[0], at) for at in steps) < 0.5
    assert max(math.dist(circle[0], at) for at in circle) > 0.8


def test_beacons_almost_in_a_line_are_looked_at_from_around_the_station_and_not_refused() -> None:
    # 2.1 m along and 0.21 m across their line
    field = Field((8.7, -6.6), ((14.1, -9.2), (9.7, -10.1), (14.1, -9.7)))
    flight = fly(scheme_for(field), field, 9, SHORT)
    assert flight.worst_m <= 0.3
    assert state_of(flight).problem == Problem.NONE


def test_what_the_way_here_has_left_open_is_decided_before_it_is_told_to_stay() -> None:
    field = Field((-23.9, 8.5), ((-27.5, 10.1), (-30.7, 10.5), (-25.0, 4.3)))
    modes: list[Mode] = []
    drifting: list[bool] = []

    def tell(s: Any, truth: Situation) -> Any:
        modes.append(s.mode)
        if s.mode == Mode.FOLLOW:
            drifting.append(s.search.is_drifting)
        return s

    flight = fly(scheme_for(field), field, 14, SHORT._replace(hold_s=0.0), tell=tell)
    assert flight.time_s < math.inf
    assert modes[-1] == Mode.KEEP
    assert state_of(flight).steps_s > 0.0
    assert set(drifting) == {False, True}  # looked for around no drift and around the one found


def test_all_beacons_gone_at_the_station_stops_the_vehicle() -> None:
    speeds: list[float] = []
    flight = fly(
        scheme_for(TRIANGLE),
        TRIANGLE,
        10,
        Air(limit_s=90.0, hold_s=60.0, drift_m_s=0.1),
        heard=lambda i, t: t < 60.0,
        watch=lambda m: speeds.append(m.v_m_s) if m.t_s > 65.0 else None,
    )
    assert state_of(flight).mode == Mode.KEEP
    assert state_of(flight).problem == Problem.TOO_FEW
    assert max(speeds) == 0.0


def test_a_vehicle_that_cannot_stop_circles_closely() -> None:
    seen: list[tuple[float, float, float]] = []
    fly(
        scheme_for(TRIANGLE, can_stop=False),
        TRIANGLE,
        11,
        Air(limit_s=120.0, hold_s=120.0),
        watch=lambda m: seen.append((m.t_s, m.d_m, m.v_m_s)),
    )
    assert all(v == 0.5 for _, _, v in seen)
    late = [d for t, d, _ in seen if t > 80.0]
    assert max(late) <= 0.9
    assert min(late) >= 0.3


def test_the_mirror_image_is_flown_as_the_mirror_image() -> None:
    quiet = SHORT._replace(sigma_m=1e-6, dropout=0.0, reflected=0.0)
    mirrored = Field((TRIANGLE.station[0], -TRIANGLE.station[1]), tuple((x, -y) for x, y in TRIANGLE.beacons))
    flown = []
    for field, turn in ((TRIANGLE, "left"), (mirrored, "right")):
        guidance = msgspec.convert({"first_turn": turn}, GuidanceSettings)
        scheme = station(guidance, StationSettings(), field.distances_m, 0.2, 0.3)
        flown.append(fly(scheme, field, 12, quiet))
    assert flown[0].time_s == pytest.approx(flown[1].time_s, abs=0.5)
    assert flown[0].path_m == pytest.approx(flown[1].path_m, abs=0.2)


def test_the_same_flight_twice_is_the_same() -> None:
    one, other = (fly(scheme_for(TRIANGLE), TRIANGLE, 13, SHORT._replace(limit_s=30.0)) for _ in range(2))
    assert one == other


def test_a_station_inside_the_tightest_turn_is_turned_to_on_the_spot() -> None:
    law = scheme_for(TRIANGLE).p.law

    def speed(ex: float, ey: float) -> float:
        at = Situation(ex, ey, 0.0, 0.0, 0.0, 0.0, 0.0)
        return station_steer.steer(law, at, station_steer.AWAY, 0.05, 0.0)[1].v_m_s

    assert speed(0.0, 0.6) == 0.0
    assert speed(0.0, 1.2) == law.v
    assert speed(0.6, 0.1) == law.v


def test_a_reflected_range_moves_nothing_in_a_map_just_made() -> None:
    pose = station_pose.start(0.0, 0.0, 0.0, 0.0, 0.0, 0.5, 0.0, 0.05)
    moved, accepted = station_pose.update(pose, 8.0, 0.0, 8.5, 0.07, 0.0, 0.0, 5.0)
    assert not accepted
    assert moved == pose


def test_what_stays_is_not_told_to_have_left_before_it_is_outside() -> None:
    law = scheme_for(TRIANGLE).p.law

    def purposes(*away_m: float) -> list[int]:
        stay, told = station_steer.Stay(True, False, 0.0), []
        for d in away_m:
            for _ in range(60):
                at = Situation(d, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
                stay, wanted = station_steer.steer(law, at, stay, 0.05, 0.0)
            told.append(wanted.purpose)
        return told

    assert purposes(0.01, 0.25, 0.01) == [STAY, STAY, STAY]
    assert purposes(0.25, 0.01) == [TRACK, STAY]
    assert purposes(0.01, 0.35, 0.25) == [STAY, TRACK, TRACK]
