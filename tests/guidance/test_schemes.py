"""The schemes as the pilot uses them: every observer with every steering law, and any order of events."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from companion.guidance.model import NEAR_M
from companion.guidance.scheme import PROBE, REST, TRACK, UNKNOWN_M, Command, Knowledge, Scheme
from companion.guidance.schemes import capture
from companion.guidance.settings import GuidanceSettings

MIRRORS_EXACTLY: list[dict[str, Any]] = [
    {"observer": "kalman", "controller": "lq"},
    {"observer": "kalman", "controller": "lq-paper"},
    {"observer": "luenberger", "controller": "lq"},
    {"observer": "luenberger", "controller": "lq-paper"},
    {"observer": "luenberger", "controller": "lq-paper", "initial_bearing_rad": 0.885, "stop_margin_m": 0.0},
]
COMBINATIONS: list[dict[str, Any]] = [
    *MIRRORS_EXACTLY,
    {"observer": "drift", "controller": "lq"},
    {"observer": "drift", "controller": "lq-paper"},
]
every_combination = pytest.mark.parametrize(
    "keys", COMBINATIONS, ids=lambda k: "-".join(map(str, k.values()))
)

every_filter = pytest.mark.parametrize("observer", ["kalman", "drift"])

MOVED = st.tuples(
    st.just("moved"), st.floats(0.0, 1.0), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0), st.floats(-2.0, 2.0)
)
RANGE = st.tuples(
    st.just("range"),
    st.floats(0.0, 200.0),
    st.floats(0.005, 5.0),
    st.floats(-20.0, 20.0),
    st.floats(0.0, 2.0),
)
CLOSE_RANGE = st.tuples(
    st.just("range"), st.floats(0.0, 1.0), st.just(0.07), st.floats(-1.0, 1.0), st.just(0.1)
)
ASK = st.tuples(st.just("ask"), st.floats(0.0, 1.0), st.floats(-2.0, 2.0))
EVENTS = st.lists(MOVED | RANGE | CLOSE_RANGE | ASK, min_size=10, max_size=80)


def _run(scheme: Scheme, events: list[Any]) -> list[tuple[Command, Knowledge]]:
    """Feed the events; after every one, what the scheme knows and what it would command."""
    p, s, out = scheme.p, scheme.initial(scheme.p), []
    dt, omega = 0.05, 0.0
    for event in events:
        if event[0] == "moved":
            s = scheme.predict(p, s, *event[1:])
        elif event[0] == "range":
            s = scheme.update(p, s, 0, *event[1:])
        else:
            dt, omega = event[1:]
        s, command = scheme.command(p, s, dt, omega)
        out.append((command, scheme.knowledge(p, s)))
    return out


def _mirrored(events: list[Any]) -> list[Any]:
    """The same as seen in a mirror: left is right."""
    turned: list[Any] = []
    for e in events:
        if e[0] == "moved":
            turned.append((e[0], e[1], e[2], -e[3], -e[4]))
        elif e[0] == "ask":
            turned.append((e[0], e[1], -e[2]))
        else:
            turned.append(e)
    return turned


@every_combination
@given(events=EVENTS)
def test_outputs_are_finite_and_within_bounds(keys: dict[str, Any], events: list[Any]) -> None:
    for command, known in _run(capture(GuidanceSettings(**keys), 0.2), events):
        assert command.v_m_s in (0.0, 0.5)
        assert abs(command.omega_rad_s) <= 1.0
        assert command.purpose in (PROBE, TRACK, REST)
        assert 0.0 <= known.d_m < 1e6
        assert -math.pi < known.theta_rad <= math.pi
        assert 0.0 <= known.sigma_d_m <= UNKNOWN_M
        assert 0.0 <= known.sigma_theta_rad <= math.pi


@pytest.mark.parametrize("keys", MIRRORS_EXACTLY, ids=lambda k: "-".join(map(str, k.values())))
@given(events=EVENTS)
def test_the_mirrored_world_gets_the_mirrored_answer(keys: dict[str, Any], events: list[Any]) -> None:
    bearing = keys.get("initial_bearing_rad")
    mirrored = keys if bearing is None else {**keys, "initial_bearing_rad": -bearing}
    one = _run(capture(GuidanceSettings(**keys, first_turn="left"), 0.2), events)
    other = _run(capture(GuidanceSettings(**mirrored, first_turn="right"), 0.2), _mirrored(events))
    for (command, known), (command_2, known_2) in zip(one, other, strict=True):
        if known.sigma_d_m < UNKNOWN_M and abs(math.sin(known.theta_rad)) < 1e-9:
            return  # dead ahead or astern there is no side to mirror, and either is right
        assert known_2 == replace(known, theta_rad=-known.theta_rad)
        assert command_2 == replace(command, omega_rad_s=-command.omega_rad_s)


def test_stands_still_until_it_knows_a_distance_then_turns_to_find_the_bearing() -> None:
    scheme = capture(GuidanceSettings(observer="kalman", first_turn="right"), 0.2)
    out = _run(scheme, [("range", 10.0, 0.07, 0.0, 0.0)] * 6)
    for command, known in out[:4]:
        assert command == Command(0.0, 0.0, PROBE)
        assert known.sigma_d_m == UNKNOWN_M
    command, known = out[4]
    assert command == Command(0.5, -1.0, PROBE)
    assert known.d_m == pytest.approx(10.0, abs=0.01)
    assert known.sigma_theta_rad > 1.5


def test_the_drift_observer_claims_nothing_until_it_knows_and_little_until_it_has_turned() -> None:
    scheme = capture(GuidanceSettings(observer="drift", first_turn="right"), 0.2)
    out = _run(scheme, [("range", 10.0, 0.07, 0.0, 0.0)] * 6)
    for command, known in out[:4]:
        assert command.purpose == PROBE
        assert known.sigma_d_m == UNKNOWN_M
    command, known = out[5]
    assert command == Command(0.5, -1.0, PROBE)
    assert known.d_m == pytest.approx(10.0, abs=0.01)
    assert known.sigma_theta_rad > 1.5


@every_filter
def test_one_reflection_among_the_first_ranges_does_not_matter(observer: Any) -> None:
    scheme = capture(GuidanceSettings(observer=observer), 0.2)
    ranges = [("range", r, 0.07, 0.0, 0.0) for r in (10.0, 13.0, 10.05, 9.95, 10.0)]
    assert _run(scheme, ranges)[-1][1].d_m == pytest.approx(10.0, abs=0.01)


@every_filter
def test_an_outlier_is_refused_and_a_locked_out_filter_starts_afresh(observer: Any) -> None:
    scheme = capture(GuidanceSettings(observer=observer), 0.2)
    p, s = scheme.p, scheme.initial(scheme.p)
    for _ in range(40):
        s = scheme.update(p, s, 0, 10.0, 0.07, 0.0, 0.0)
        s, _ = scheme.command(p, s, 0.05, 0.0)
        assert s.accepted == 1.0
    s = scheme.update(p, s, 0, 14.0, 0.07, 0.0, 0.0)
    assert s.accepted == 0.0
    assert scheme.knowledge(p, s).d_m == pytest.approx(10.0, abs=0.05)
    commands = []
    for _ in range(30):  # and what if the target really is there?
        s = scheme.update(p, s, 0, 14.0, 0.07, 0.0, 0.0)
        s, command = scheme.command(p, s, 0.05, 0.0)
        commands.append(command)
    assert scheme.knowledge(p, s).d_m == pytest.approx(14.0, abs=0.05)
    assert PROBE in {command.purpose for command in commands}
    assert commands[-1].purpose == PROBE
    assert commands[-1].v_m_s == 0.5


def test_overhead_negative_measurements_are_used() -> None:
    scheme = capture(GuidanceSettings(observer="kalman"), 0.2)
    out = _run(scheme, [("range", 4.9, 0.07, 5.0, 0.1)] * 20)
    assert out[-1][1].d_m == 0.0
    assert out[-1][0] == Command(0.0, 0.0, REST)


def test_a_turn_begun_is_finished_where_the_target_is_astern() -> None:
    """Just past astern on the other side, turning on is as near as turning back."""
    keys: dict[str, Any] = {"observer": "luenberger", "initial_bearing_rad": 2.9, "probe_turn_s": 0.0}
    scheme = capture(GuidanceSettings(**keys), 0.2)
    s = scheme.update(scheme.p, scheme.initial(scheme.p), 0, 10.0, 0.07, 0.0, 0.0)
    _, onwards = scheme.command(scheme.p, s, 0.05, 0.9)
    _, from_rest = scheme.command(scheme.p, s, 0.05, 0.0)
    assert (onwards.omega_rad_s, from_rest.omega_rad_s) == (1.0, -1.0)


def test_the_papers_observer_claims_no_sigma_and_takes_the_distance_as_measured() -> None:
    scheme = capture(GuidanceSettings(observer="luenberger", initial_bearing_rad=0.5), 0.2)
    s = scheme.initial(scheme.p)
    for r in (10.0, 10.3):
        s = scheme.update(scheme.p, s, 0, r, 0.07, 3.0, 0.0)
    known = scheme.knowledge(scheme.p, s)
    assert known.d_m == pytest.approx(math.sqrt(10.3**2 - 9.0))
    assert known.sigma_theta_rad == math.pi
    s = scheme.update(scheme.p, s, 0, 2.9, 0.07, 3.0, 0.0)
    assert scheme.knowledge(scheme.p, s).d_m == 0.0
    assert scheme.knowledge(scheme.p, s).sigma_d_m == pytest.approx(2.9 * 0.07 / NEAR_M)


def _after_a_walk(target: tuple[float, float], **keys: Any) -> tuple[Command, Knowledge]:
    """Half a circle to the right, and two seconds straight on."""
    x = y = heading = 0.0
    events: list[Any] = []
    for step in range(103):
        omega = -1.0 if step < 63 else 0.0
        middle = heading + 0.025 * omega
        x, y, heading = x + 0.025 * math.cos(middle), y + 0.025 * math.sin(middle), heading + 0.05 * omega
        events += [
            ("moved", 0.05, 0.5, 0.0, omega),
            ("range", math.hypot(target[0] - x, target[1] - y), 0.07, 0.0, 0.0),
        ]
    return _run(capture(GuidanceSettings(observer="drift", **keys), 0.2), events)[-1]


@pytest.mark.parametrize("controller", ["lq", "lq-paper"])
def test_a_target_behind_is_turned_to_on_the_spot_without_dawdling(controller: Any) -> None:
    command, known = _after_a_walk((9.0, -1.0), controller=controller)
    assert abs(known.theta_rad) > 2.8
    assert command.v_m_s == 0.0
    assert abs(command.omega_rad_s) > 0.9


def test_the_bearing_is_told_no_surer_than_a_drift_allows_that_is_left_out() -> None:
    """The filter trusts the dead reckoning until the ranges contradict it; who reads the sigma must not."""
    _, trusting = _after_a_walk((-9.0, 2.0), drift_m_s=0.1, trust=0.05)
    _, doubting = _after_a_walk((-9.0, 2.0), drift_m_s=0.1, trust=1.0)
    assert trusting.sigma_theta_rad > 0.1 / 0.5
    assert doubting.sigma_theta_rad < trusting.sigma_theta_rad
