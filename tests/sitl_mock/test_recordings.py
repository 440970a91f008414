"""The mock against recordings of a real PX4: the same client, the same answers.

Each recording's commands and setpoints are played to the mock at the recorded times; what it sends is
compared with what PX4 sent: the order of modes, landed states, acknowledgements and health exactly, times and
curves within tolerances that are stated here.
"""

from __future__ import annotations

from bisect import bisect
from functools import cache
from itertools import pairwise
from math import atan2, cos, fsum, hypot, inf, sin
from typing import Any

import pytest
from pymavlink.dialects.v20 import development as mavlink

from sitl_mock.autopilot import Target
from sitl_mock.faults import Faults
from sitl_mock.modes import Mode, Result
from sitl_mock.params import Params
from sitl_mock.px4 import Px4
from sitl_mock.vehicle import Vehicle, wrap
from tests.sitl_mock.recordings import SCENARIO, Bench, Row, changes, received, recording, replay

# A PX4's COM_OBL_RC_ACT in each of the flights.
FLIGHTS = {
    "loss_default_no_rc": 0,
    "loss_hold_then_resume": 5,
    "loss_land": 4,
    "takeover_by_mode": 0,
    "refusals": 0,
    "offboard_body_ned_altitude": 0,
    "offboard_local_ned_steps": 0,
}
AT_ONCE_S = 0.06
"""A commanded mode shows this soon (PX4 tells CURRENT_MODE every 20 ms), a lost stream's fallback as well."""
BY_MOTION_S = 1.2
"""What waits for the vehicle: a height reached, a landing detected. PX4's own flights differ by half."""
SHOWN_EVERY_S = 0.2

Rows = tuple[Row, ...] | list[Row]


@cache
def replayed(name: str) -> Rows:
    """The mock's answers to a recording's client."""
    return replay(name, {"COM_OBL_RC_ACT": FLIGHTS[name]})


@pytest.fixture(params=FLIGHTS)
def flight(request: pytest.FixtureRequest) -> tuple[Rows, Rows]:
    """A recording and the mock's replay of it."""
    return recording(request.param), replayed(request.param)


def assert_same_order(real: list[tuple[float, Any]], mock: list[tuple[float, Any]]) -> None:
    assert [what for _, what in mock] == [what for _, what in real]


def test_modes_follow_one_another_as_recorded(flight: tuple[Rows, Rows]) -> None:
    real, mock = (
        changes(rows, "CURRENT_MODE", "custom_mode", "intended_custom_mode", "standard_mode")
        for rows in flight
    )
    assert_same_order(real, mock)
    takeoff, loiter = 33816576, 50593792
    for i, ((t_real, mode), (t_mock, _)) in enumerate(zip(real[1:], mock[1:], strict=True), start=1):
        by_motion = (mode[0] == loiter and real[i - 1][1][0] == takeoff) or i == len(real) - 1
        assert t_mock == pytest.approx(t_real, abs=BY_MOTION_S if by_motion else AT_ONCE_S), mode


def test_landed_states_follow_one_another_as_recorded(flight: tuple[Rows, Rows]) -> None:
    real, mock = (changes(rows, "EXTENDED_SYS_STATE", "landed_state") for rows in flight)
    assert_same_order(real, mock)
    for (t_real, state), (t_mock, _) in zip(real[1:], mock[1:], strict=True):
        assert t_mock == pytest.approx(t_real, abs=BY_MOTION_S + SHOWN_EVERY_S), state


def test_commands_are_acknowledged_as_recorded(flight: tuple[Rows, Rows]) -> None:
    real, mock = (
        [(row["t"], (row["command"], row["result"])) for row in received(rows, "COMMAND_ACK")]
        for rows in flight
    )
    assert_same_order(real, mock)
    for (t_real, what), (t_mock, _) in zip(real, mock, strict=True):
        assert t_mock == pytest.approx(t_real, abs=0.02), what


def test_heartbeat_tells_flags_and_status_as_recorded(flight: tuple[Rows, Rows]) -> None:
    real, mock = (changes(rows, "HEARTBEAT", "base_mode", "custom_mode", "system_status") for rows in flight)
    # One may end before the heartbeat that tells of the last change: it comes once a second.
    common = min(len(real), len(mock))
    assert common >= len(real) - 1
    assert_same_order(real[:common], mock[:common])


def test_prearm_check_is_told_as_recorded(flight: tuple[Rows, Rows]) -> None:
    real, mock = (changes(rows, "SYS_STATUS", "onboard_control_sensors_health") for rows in flight)
    common = min(len(real), len(mock))
    assert common >= len(real) - 1
    assert_same_order(real[:common], mock[:common])


def test_height_runs_as_recorded(flight: tuple[Rows, Rows]) -> None:
    real, mock = (
        [(row["t"], row["z"]) for row in received(rows, "LOCAL_POSITION_NED") if "vz" in row]
        for rows in flight
    )
    times = [t for t, _ in mock]
    body = [row["t"] for row in flight[0] if row.get("coordinate_frame") == 8 and row["dir"] == "tx"]
    # In BODY_NED with v_z = 0 nobody holds the height: a test of its own below.
    until = body[0] if len(body) > 1 else inf
    for t, z in real:
        if t < until:
            assert mock[min(bisect(times, t), len(mock) - 1)][1] == pytest.approx(z, abs=0.45), t


# ------------------------------------------------------------------------------------------- responses


def steer(row: Row, px4: Px4) -> Row:
    """The recorded client lays its speed along the heading it measures: here, the mock's."""
    if row["msg"] != "SET_POSITION_TARGET_LOCAL_NED" or row["coordinate_frame"] != 1:
        return row
    speed = hypot(row["vx"], row["vy"])
    heading = px4.autopilot.heading_rad
    return {**row, "vx": speed * sin(heading), "vy": speed * cos(heading)}


@pytest.fixture(scope="module")
def steps() -> tuple[Rows, Rows]:
    """The flight of steps in speed and yaw rate."""
    return recording("offboard_local_ned_steps"), replay("offboard_local_ned_steps", steer=steer)


def notes(rows: Rows) -> list[tuple[float, float, float, float]]:
    """Every step: when it began and ended, the speed and the yaw rate."""
    found = [(row["t"], row["msg"].split()) for row in rows if row["dir"] == "note"]
    ends = [t for t, _ in found[1:]] + [found[-1][0] + 5.0]
    return [
        (t, end, float(words[2]), float(words[4]))
        for (t, words), end in zip(found, ends, strict=True)
        if words[0] == "LOCAL_NED"
    ]


class Curve:
    """What happened between two times, seen through the telemetry."""

    def __init__(self, rows: Rows, start: float, end: float) -> None:
        self.yaw_rate = [
            (row["t"] - start, row["yawspeed"])
            for row in received(rows, "ATTITUDE")
            if "yawspeed" in row and start <= row["t"] < end
        ]
        motion = [
            row for row in received(rows, "LOCAL_POSITION_NED") if "vz" in row and start <= row["t"] < end
        ]
        self.speed = [(row["t"] - start, hypot(row["vx"], row["vy"])) for row in motion]
        self.course = [(row["t"] - start, atan2(row["vy"], row["vx"])) for row in motion]
        self.yaw = [
            (row["t"] - start, row["yaw"]) for row in received(rows, "ATTITUDE") if start <= row["t"] < end
        ]

    @staticmethod
    def first(values: list[tuple[float, float]], before: float, after: float, share: float) -> float:
        """When a response reached this share of its step."""
        return next(t for t, v in values if (v - before) / (after - before) >= share)

    @staticmethod
    def mean(values: list[tuple[float, float]], since: float) -> float:
        """The mean after a while."""
        late = [v for t, v in values if t >= since]
        return sum(late) / len(late)

    def crab(self, since: float) -> float:
        """Course minus yaw, NED."""
        times = [t for t, _ in self.yaw]
        late = [
            wrap(course - self.yaw[min(bisect(times, t), len(times) - 1)][1])
            for t, course in self.course
            if t >= since
        ]
        return sum(late) / len(late)

    def coast(self) -> float:
        """How far the vehicle goes before it stands, by its speed: the estimated place wanders meanwhile."""
        moving = [(t, v) for t, v in self.speed if t < 2.5]
        return fsum((t1 - t0) * (v0 + v1) / 2 for (t0, v0), (t1, v1) in pairwise(moving))


def test_yaw_rate_steps(steps: tuple[Rows, Rows]) -> None:
    """t63 and the rate after 1 s and at the end; PX4: 0.47 s, 90 %, 97 %."""
    seen = 0
    before = 0.0
    for start, end, _, rate in notes(steps[0]):
        if rate == before:
            continue
        real, mock = (Curve(rows, start, end).yaw_rate for rows in steps)
        assert Curve.first(mock, before, rate, 0.63) == pytest.approx(
            Curve.first(real, before, rate, 0.63), abs=0.05
        )
        assert Curve.first(mock, before, rate, 0.1) == pytest.approx(
            Curve.first(real, before, rate, 0.1), abs=0.05
        )
        assert Curve.mean(mock, 4.0) == pytest.approx(Curve.mean(real, 4.0), abs=0.012)
        before = rate
        seen += 1
    assert seen >= 8


def test_speed_steps_and_coasting(steps: tuple[Rows, Rows]) -> None:
    """t63 within 0.05 s, t90 within 0.15 s; a stop coasts as far within 0.04 m."""
    before = 0.0
    seen = 0
    for start, end, speed, _ in notes(steps[0]):
        if speed == before:
            continue
        real, mock = (Curve(rows, start, end) for rows in steps)
        for share, within in ((0.63, 0.05), (0.9, 0.15)):
            t_real = Curve.first(real.speed, before, speed, share)
            if speed > 0.0 or share < 0.9:
                assert Curve.first(mock.speed, before, speed, share) == pytest.approx(t_real, abs=within)
        if speed == 0.0:
            assert mock.coast() == pytest.approx(real.coast(), abs=0.04)
        before = speed
        seen += 1
    assert seen >= 6


def test_turning_flight_crabs(steps: tuple[Rows, Rows]) -> None:
    """In a turn the ground velocity lags the nose: 0.33 rad at 0.5 rad/s, 0.13 rad at −0.2 rad/s."""
    turns = [note for note in notes(steps[0]) if note[2] > 0.0 and note[3] != 0.0]
    assert len(turns) == 2
    for start, end, _, _ in turns:
        real, mock = (Curve(rows, start, end) for rows in steps)
        assert mock.crab(4.0) == pytest.approx(real.crab(4.0), abs=0.04)
        assert Curve.mean(mock.speed, 4.0) == pytest.approx(Curve.mean(real.speed, 4.0), abs=0.02)


def test_held_height_stays_within_centimetres(steps: tuple[Rows, Rows]) -> None:
    """LOCAL_NED with z: the estimate stays within 0.05 m of the setpoint through 100 s of turns and steps."""
    start, end = notes(steps[0])[0][0], notes(steps[0])[-1][1]
    for rows in steps:
        heights = [row["z"] for row in received(rows, "LOCAL_POSITION_NED") if start + 2.0 < row["t"] < end]
        assert max(heights) - min(heights) < 0.1


def test_bare_zero_climb_drifts() -> None:
    """BODY_NED with v_z = 0: PX4's height is off by 0.1 to 1.3 m in 60 s. So in nine flights of ten."""
    ends = []
    for seed in range(12):
        vehicle = Vehicle(SCENARIO, 0.0, 0.0, 5.0, 0.0)
        px4 = Px4(SCENARIO, seed, vehicle, Params(), Faults())
        px4.start_in_air()
        while px4.t_s < 63.0:
            px4.setpoint(Target(vx_m_s=0.0, vy_m_s=0.0, climb_m_s=0.0, yaw_rate_rad_s=0.0))
            if px4.mode is not Mode.OFFBOARD:
                px4.set_mode(Mode.OFFBOARD)
            px4.step()
        ends.append(abs(vehicle.height_m - 5.0))
    ends.sort()
    assert 0.1 < ends[len(ends) // 2] < 1.3
    assert ends[-2] < 1.3


def test_height_step() -> None:
    """A step of 1 m: PX4 takes 1.1 s to 63 % and 2 s to 90 %."""
    bench = Bench(scenario=SCENARIO)
    bench.vehicle.height_m = 5.0
    bench.px4.start_in_air()

    def stream(height_m: float, until_s: float) -> None:
        while bench.t < until_s:
            fields = (0, 0, -height_m, 0, 0, 0, 0, 0, 0, 0, 0)
            bench.send(mavlink.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 1507, *fields))
            bench.run(bench.t + 0.05)

    stream(5.0, 1.0)
    bench.command(176, 1, 6)
    stream(5.0, 4.0)
    stream(6.0, 9.0)
    z = [(row["t"] - 4.0, -row["z"]) for row in received(bench.rows, "LOCAL_POSITION_NED") if row["t"] > 4.0]
    assert Curve.first(z, 5.0, 6.0, 0.63) == pytest.approx(1.1, abs=0.15)
    assert Curve.first(z, 5.0, 6.0, 0.9) == pytest.approx(2.0, abs=0.3)


# --------------------------------------------------------------------------------- lost streams, refusals


@pytest.mark.parametrize("name", ["loss_default_no_rc", "loss_hold_then_resume", "loss_land"])
def test_lost_stream_is_flown_on_for_a_second(name: str) -> None:
    """The last velocity is flown on; the failsafe comes 0.96 to 1.16 s after the stream's end."""
    rows = replayed(name)
    stopped = next(row["t"] for row in recording(name) if row["msg"] == "stream stops")
    modes = changes(rows, "CURRENT_MODE", "custom_mode", "intended_custom_mode")
    failsafe = next(t for t, (mode, intended) in modes if mode != intended)
    assert 0.96 <= failsafe - stopped <= 1.16
    moving = [row for row in received(rows, "LOCAL_POSITION_NED") if stopped < row["t"] < failsafe]
    assert all(hypot(row["vx"], row["vy"]) > 0.4 for row in moving)


def test_resumed_stream_returns_to_offboard_by_itself() -> None:
    rows = replayed("loss_hold_then_resume")
    resumed = next(row["t"] for row in recording("loss_hold_then_resume") if row["msg"] == "stream resumes")
    modes = changes(rows, "CURRENT_MODE", "custom_mode", "intended_custom_mode")
    back = next(t for t, (mode, _) in modes if t > resumed and mode == 6 << 16)
    assert back - resumed <= 0.04


def test_blind_descent_keeps_drifting_and_sinks_at_the_landing_speed() -> None:
    """Recorded: level, so the speed dies by drag alone, and 0.7 m/s down."""
    real, mock = recording("loss_default_no_rc"), replayed("loss_default_no_rc")
    for t in (26.0, 28.0, 30.0):
        near = [
            next(row for row in received(rows, "LOCAL_POSITION_NED") if "vz" in row and row["t"] > t)
            for rows in (real, mock)
        ]
        assert near[1]["vx"] == pytest.approx(near[0]["vx"], abs=0.08)
        assert near[1]["vz"] == pytest.approx(near[0]["vz"], abs=0.08)


def test_refused_setpoints_are_not_a_stream() -> None:
    """Frames 9, 12 and 20 and the all-ignore mask: no proof of life, so OFFBOARD stays refused."""
    for frame, mask in ((9, 1479), (12, 1479), (20, 1479), (1, 4095), (8, 0b1000)):
        bench = Bench()
        bench.vehicle.height_m = 3.0
        bench.px4.start_in_air()
        bench.run(0.5)
        fields = (0, 0, 0, 0.2, 0, 0, 0, 0, 0, 0, 0)
        bench.send(mavlink.MAVLink_set_position_target_local_ned_message(0, 1, 1, frame, mask, *fields))
        bench.command(176, 1, 6)
        bench.run(0.6)
        refused = frame != 8
        assert (bench.last("COMMAND_ACK")["result"] == Result.TEMPORARILY_REJECTED) is refused, (frame, mask)


def test_default_rates_on_the_onboard_link() -> None:
    """Within a tenth of the recorded default rates; some 400 messages a second in all."""
    bench = Bench()
    bench.run(20.0)
    rows = [row for row in bench.rows if row["link"].value == "onboard"]
    expected = {
        "ATTITUDE": 99, "ATTITUDE_QUATERNION": 50, "GLOBAL_POSITION_INT": 50, "HIGHRES_IMU": 50,
        "LOCAL_POSITION_NED": 30, "ODOMETRY": 30, "ALTITUDE": 10, "VFR_HUD": 10, "TIMESYNC": 10,
        "GPS_RAW_INT": 8, "EXTENDED_SYS_STATE": 5, "SYS_STATUS": 5, "HEARTBEAT": 1, "CURRENT_MODE": 0.5,
    }  # fmt: skip
    for name, rate in expected.items():
        assert sum(row["msg"] == name for row in rows) / 20.0 == pytest.approx(rate, rel=0.1), name
    assert 350 < len(rows) / 20.0 < 430
