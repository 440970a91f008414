"""The command limits hold whatever is asked for."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from companion import limits
from companion.settings import LimitSettings
from companion.types import Setpoint

CFG = LimitSettings()
S = 1_000_000_000
anything = st.floats(allow_nan=True, allow_infinity=True)


def setpoint(t_ns: int, speed: float, yaw_rate: float = 0.0, heading: float = 0.0) -> Setpoint:
    return Setpoint(t_ns, speed, yaw_rate, heading, 3.0, 0.0)


@given(
    st.lists(
        st.tuples(st.integers(0, 2 * S), anything, anything, anything, st.none() | anything, anything),
        max_size=30,
    ),
    st.none() | anything,
)
def test_whatever_is_asked_for_what_leaves_is_finite_and_bounded(
    asked: list[tuple[int, float, float, float, float | None, float]], height: float | None
) -> None:
    t_ns = S
    state = limits.start(t_ns)
    before = 0.0
    for gap_ns, speed, yaw_rate, heading, wanted_height, climb in asked:
        t_ns += gap_ns
        wanted = Setpoint(t_ns, speed, yaw_rate, heading, wanted_height, climb)
        state, out = limits.apply(CFG, state, wanted, height)
        assert 0.0 <= out.speed_m_s <= CFG.speed_m_s
        assert out.speed_m_s <= before + CFG.acceleration_m_s2 * 0.1 + 1e-9
        assert abs(out.yaw_rate_rad_s) <= CFG.yaw_rate_rad_s
        assert abs(out.climb_m_s) <= CFG.climb_m_s
        assert math.isfinite(out.heading_rad)
        assert out.height_m is None or math.isfinite(out.height_m)
        before = out.speed_m_s


def fly(cfg: LimitSettings, seconds: float, speed: float, yaw_rate: float = 0.0) -> list[Setpoint]:
    state, t_ns, sent, heading = limits.start(0), 0, [], 0.0
    while t_ns < seconds * S:
        t_ns += S // 20
        heading += yaw_rate * 0.05
        state, out = limits.apply(cfg, state, setpoint(t_ns, speed, yaw_rate, heading), 3.0)
        sent.append(out)
    return sent


def test_the_flight_time_ends_the_forward_speed() -> None:
    sent = fly(LimitSettings(flight_time_s=2.0), 4.0, 0.5)
    assert all(out.speed_m_s == 0.5 for out in sent if 0.5 * S < out.t_ns <= 2 * S)
    assert all(out.speed_m_s == 0.0 for out in sent if out.t_ns > 2 * S)


def test_the_distance_flown_ends_the_forward_speed_also_in_circles() -> None:
    sent = fly(LimitSettings(distance_m=2.0), 10.0, 0.5, yaw_rate=1.0)
    assert sum(out.speed_m_s * 0.05 for out in sent) <= 2.0 + 0.05


def test_the_distance_from_the_start_ends_the_forward_speed() -> None:
    sent = fly(LimitSettings(from_start_m=3.0), 20.0, 0.5)
    assert sum(out.speed_m_s * 0.05 for out in sent) <= 3.0 + 0.05
    assert sent[-1].speed_m_s == 0.0


@pytest.mark.parametrize(
    ("lie", "sent"), [(math.nan, 0.0), (math.inf, 0.0), (-math.inf, 0.0), (-3.0, 0.0), (1e300, 0.5)]
)
def test_a_bad_speed_means_standstill_or_the_limit(lie: float, sent: float) -> None:
    _, out = limits.apply(CFG, limits.start(0), setpoint(S, lie), 3.0)
    assert out.speed_m_s == pytest.approx(sent)


@pytest.mark.parametrize("lie", [math.nan, math.inf])
def test_without_a_heading_there_is_no_speed(lie: float) -> None:
    state, out = limits.apply(CFG, limits.start(0), setpoint(S, 0.5, heading=lie), 3.0)
    assert (out.speed_m_s, out.heading_rad) == (0.0, 0.0)
    assert (state.speed_m_s, state.heading_rad) == (0.0, 0.0)


@pytest.mark.parametrize(
    ("asked", "sent"), [(0.3, 0.3), (-0.3, -0.3), (9.0, 0.5), (-9.0, -0.5), (math.nan, 0.0)]
)
def test_the_climb_is_bounded_either_way(asked: float, sent: float) -> None:
    _, out = limits.apply(CFG, limits.start(0), Setpoint(S, 0.0, 0.0, 0.0, None, asked), 3.0)
    assert out.climb_m_s == sent


@pytest.mark.parametrize("heading", [0.4, 2.0, -2.5])
def test_the_dead_reckoning_follows_the_heading(heading: float) -> None:
    state = limits.start(7 * S)
    for k in range(81):  # a speed counts from the moment it is sent to the next one
        state, _ = limits.apply(
            LimitSettings(), state, setpoint(7 * S + k * S // 20, 0.25, 0.0, heading), 3.0
        )
    flown_m = 0.25 * 79 / 20  # the first has no time in which to gain speed, the last has not been flown
    assert state.path_m == pytest.approx(flown_m)
    assert (state.x_m, state.y_m) == pytest.approx((flown_m * math.cos(heading), flown_m * math.sin(heading)))


def test_a_budget_is_spent_beyond_it_not_at_it() -> None:
    cfg = LimitSettings(flight_time_s=10.0, distance_m=50.0, from_start_m=20.0)
    fresh = limits.start(100 * S)
    assert limits.spent(cfg, fresh, 100 * S) is None
    assert limits.spent(cfg, fresh, 110 * S) is None
    assert "flight time over 10 s" in str(limits.spent(cfg, fresh, 110 * S + S // 10))
    for spent, state in (
        (False, replace(fresh, path_m=50.0)),
        (True, replace(fresh, path_m=50.01)),
        (False, replace(fresh, x_m=-20.0)),
        (False, replace(fresh, y_m=20.0)),
        (True, replace(fresh, x_m=-20.01)),
        (True, replace(fresh, y_m=-20.01)),
        (True, replace(fresh, x_m=15.0, y_m=15.0)),
    ):
        assert (limits.spent(cfg, state, 100 * S) is not None) is spent


def test_a_new_engagement_counts_from_its_own_start() -> None:
    """A clock that has run for long is no gap: no slew is owed, no way was flown."""
    state, out = limits.apply(CFG, limits.start(500 * S), setpoint(500 * S, 0.5, 1.0), 3.0)
    assert (out.speed_m_s, out.yaw_rate_rad_s) == (0.0, 0.0)
    assert limits.spent(CFG, state, 500 * S) is None


def test_slowing_down_and_stopping_to_turn_are_never_delayed() -> None:
    state = limits.start(0)
    for k in range(1, 20):
        state, _ = limits.apply(CFG, state, setpoint(k * S // 20, 0.5, 1.0), 3.0)
    _, out = limits.apply(CFG, state, setpoint(S, 0.0, 0.0), 3.0)
    assert (out.speed_m_s, out.yaw_rate_rad_s) == (0.0, 0.0)


def test_the_yaw_rate_is_slewed_away_from_zero() -> None:
    cfg = LimitSettings(yaw_acceleration_rad_s2=2.0)
    state = limits.start(0)
    state, first = limits.apply(cfg, state, setpoint(S // 20, 0.0, 1.0), 3.0)
    state, second = limits.apply(cfg, state, setpoint(S // 10, 0.0, 1.0), 3.0)
    assert first.yaw_rate_rad_s == pytest.approx(0.1)
    assert second.yaw_rate_rad_s == pytest.approx(0.2)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_turn_that_is_reversed_is_slewed_from_zero(sign: float) -> None:
    cfg = LimitSettings(yaw_acceleration_rad_s2=2.0)
    state = replace(limits.start(0), yaw_rate_rad_s=0.8 * sign)
    _, out = limits.apply(cfg, state, setpoint(S // 20, 0.0, -1.0 * sign), 3.0)
    assert out.yaw_rate_rad_s == pytest.approx(-0.1 * sign)


@pytest.mark.parametrize(
    ("wanted", "measured", "sent"),
    [
        (3.0, 3.0, 3.0),
        (0.1, 3.0, 0.5),  # never below the band ...
        (0.1, 0.1, 0.1),  # ... but what stands on the ground may stay there
        (80.0, 3.0, 50.0),
        (math.nan, 2.0, 2.0),
        (math.nan, None, None),
        (None, 2.0, None),
    ],
)
def test_the_height_stays_in_its_band(
    wanted: float | None, measured: float | None, sent: float | None
) -> None:
    _, out = limits.apply(CFG, limits.start(0), Setpoint(S, 0.0, 0.0, 0.0, wanted, 0.0), measured)
    assert out.height_m == sent
