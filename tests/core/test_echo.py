"""Targets that the app did not send: none in the recordings of a real PX4, all of a second commander's."""

from __future__ import annotations

from typing import Any

import pytest

from companion import echo
from companion.echo import Echo
from companion.link.decode import target
from companion.types import FlightMode, ModeReport, Setpoint, Status, TargetEcho
from sitl_mock.faults import Fault
from tests.core.flights import LOITER, MS, OFFBOARD, Script, engaged, fly
from tests.sitl_mock.recordings import received, recording
from tests.sitl_mock.test_protocol import in_air, offboard, setpoint

S = 1_000_000_000


class Message:
    """A recorded message's fields; nulls are NaN."""

    def __init__(self, row: dict[str, Any]) -> None:
        self.vx, self.vy, self.yaw_rate = (
            float("nan") if row[name] is None else row[name] for name in ("vx", "vy", "yaw_rate")
        )


@pytest.mark.parametrize("name", ["offboard_local_ned_steps", "offboard_body_ned_altitude"])
def test_a_real_autopilot_that_obeys_is_not_suspected(name: str) -> None:
    e, mode, told = Echo(), LOITER, 0
    for row in recording(name):
        t_ns = round(row["t"] * 1e9)
        if row["msg"] == "SET_POSITION_TARGET_LOCAL_NED":
            speed = (row["vx"] ** 2 + row["vy"] ** 2) ** 0.5
            e = echo.sent(e, Setpoint(t_ns, speed, -row["yaw_rate"], 0.0, None, 0.0))
        elif row["msg"] == "CURRENT_MODE":
            mode = OFFBOARD if row["custom_mode"] >> 16 & 0xFF == 6 else LOITER
            e = echo.confirmed(e, ModeReport(t_ns, mode, mode))
        elif row["msg"] == "POSITION_TARGET_LOCAL_NED" and mode is OFFBOARD:
            heard = target(Message(row), t_ns)
            if isinstance(heard, TargetEcho):
                told += 1
                e = echo.heard(e, heard)
        assert not echo.is_foreign(e, t_ns)
    assert told > 5


def warned(script: Script, speed_m_s: float, mode: FlightMode) -> bool:
    flown = fly(script.run(2.5), before=engaged(script))
    for _ in range(4):
        t_ns = (script.t_ms + 1) * MS
        events = [TargetEcho(t_ns, speed_m_s, -0.9), ModeReport(t_ns, mode, mode)]
        flown = fly([*events, *script.run(0.2)], before=flown)
    status = next(o for o in reversed(flown.outputs) if isinstance(o, Status))
    return any("did not send" in warning for warning in status.warnings)


def test_targets_of_somebody_else_are_told() -> None:
    assert warned(Script(), 2.0, OFFBOARD)


def test_those_of_another_mode_are_not_ours_to_judge() -> None:
    assert not warned(Script(), 2.0, LOITER)


@pytest.mark.parametrize("hidden", [False, True])
def test_a_commander_on_another_link_of_the_mock_is_seen(hidden: bool) -> None:
    bench = in_air()
    bench.px4.faults.switch(Fault.HIDDEN_COMMANDER, hidden)
    offboard(bench, setpoint(8, 1479, 0, 0, 0, 0.5, 0, 0, 0, 0, 0, 0, 0.2), 6.0)
    e = Echo()
    for k in range(120):
        e = echo.sent(e, Setpoint(k * S // 20, 0.5, -0.2, 0.0, None, 0.0))
    for row in received(bench.rows, "POSITION_TARGET_LOCAL_NED"):
        heard = target(Message(row), 6 * S)
        if row["t"] > 1.0 and isinstance(heard, TargetEcho):
            e = echo.confirmed(echo.heard(e, heard), ModeReport(6 * S, OFFBOARD, OFFBOARD))
    assert echo.is_foreign(e, 6 * S) is hidden
