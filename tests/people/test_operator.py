"""The operator: each way a flight can end, on real UDP, against the mock in its own process."""

from __future__ import annotations

import math
import socket
import sys
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.ground import GroundLink, GroundLinkError, Motion, ground_url
from companion.operator import REST_S, OperatorResult, RestWatch
from tests.people.parties import Ended, Mock, Operator, StandIn

Plan = Callable[[float | None], tuple[float, float] | None]
STANDSTILL = (0.0, 0.0)


def turns_and_stops(since_s: float | None) -> tuple[float, float]:
    """As a companion flies: turning, straight on, at rest."""
    if since_s is None or since_s > 4.0:
        return STANDSTILL
    return (0.5, 1.0) if since_s < 2.0 else (0.5, 0.0)


def spins(since_s: float | None) -> tuple[float, float]:
    return STANDSTILL if since_s is None else (0.0, 0.5)


class Dies:
    """Falls silent 1.5 s after OFFBOARD, for good."""

    def __init__(self) -> None:
        self.dead = False

    def __call__(self, since_s: float | None) -> tuple[float, float] | None:
        self.dead = self.dead or (since_s is not None and since_s > 1.5)
        return None if self.dead else STANDSTILL


class ComesLate:
    """Silent until it is let in."""

    def __init__(self) -> None:
        self.here = False

    def __call__(self, since_s: float | None) -> tuple[float, float] | None:
        return turns_and_stops(since_s) if self.here else None


def fly(
    plan: Plan, *, mock: tuple[str, ...] = (), operator: tuple[str, ...] = (), pilot_after_s: float = math.inf
) -> Ended:
    with Mock(*mock) as vehicle, StandIn(vehicle.onboard_port, plan, pilot_after_s):
        return Operator(f"udpout:127.0.0.1:{vehicle.ground_port}", *operator).ended()


def fly_late() -> Ended:
    plan = ComesLate()
    with Mock() as vehicle, StandIn(vehicle.onboard_port, plan):
        operator = Operator(f"udpout:127.0.0.1:{vehicle.ground_port}")
        operator.wait_for("OFFBOARD refused")
        plan.here = True
        return operator.ended()


def fly_interrupted() -> Ended:
    with Mock() as vehicle, StandIn(vehicle.onboard_port, spins):
        operator = Operator(f"udpout:127.0.0.1:{vehicle.ground_port}")
        operator.wait_for("mode OFFBOARD")
        operator.interrupt()
        return operator.ended()


def fly_with_a_pilot() -> Ended:
    with tempfile.TemporaryDirectory() as folder:
        scenario = Path(folder, "scenario.toml")
        scenario.write_text("[sim]\nremote_control = true\n")  # without one PX4 refuses POSCTL
        return fly(spins, mock=("--scenario", str(scenario)), pilot_after_s=2.0)


FLIGHTS: dict[str, Callable[[], Ended]] = {
    "finished": fly_late,
    "took over": lambda: fly(spins, operator=("--take-over-after", "5")),
    "left offboard": lambda: fly(Dies(), mock=("--param", "COM_OBL_RC_ACT=5")),
    "pilot": fly_with_a_pilot,
    "no companion": lambda: fly(lambda _: None, operator=("--timeout", "25")),
    "not ready": lambda: fly(spins, mock=("--fault", "gps-lost@0"), operator=("--timeout", "5")),
    "interrupted": fly_interrupted,
}


@pytest.fixture(scope="module")
def flights() -> Iterator[dict[str, Future[Ended]]]:
    """All of them at once: each is mostly waiting."""
    with ThreadPoolExecutor(len(FLIGHTS)) as pool:
        yield {name: pool.submit(run) for name, run in FLIGHTS.items()}


def test_it_waits_for_a_companion_and_lands_when_at_rest(flights: dict[str, Future[Ended]]) -> None:
    ended = flights["finished"].result()
    assert ended.status == OperatorResult.FINISHED.exit_status == 0, ended.lines
    steps = (
        "healthy", "armed", "taking off to 1.5 m", "steady at 1.", "OFFBOARD refused", "mode OFFBOARD",
        "at rest", "landing", "landed and disarmed",
    )  # fmt: skip
    found = [next(i for i, line in enumerate(ended.lines) if step in line) for step in steps]
    assert found == sorted(found)


def test_it_takes_over_when_told_and_does_not_take_a_spin_for_rest(flights: dict[str, Future[Ended]]) -> None:
    ended = flights["took over"].result()
    assert ended.status == 0, ended.lines
    assert not ended.said("at rest")
    assert ended.said("mode AUTO.LOITER: the companion is out")
    assert ended.said("landed and disarmed")


def test_it_lands_what_left_offboard(flights: dict[str, Future[Ended]]) -> None:
    ended = flights["left offboard"].result()
    assert ended.status == OperatorResult.LEFT_OFFBOARD.exit_status, ended.lines
    assert ended.said("left OFFBOARD by itself: mode AUTO.LOITER")
    assert ended.said("landed and disarmed")


def test_it_leaves_a_pilot_alone(flights: dict[str, Future[Ended]]) -> None:
    ended = flights["pilot"].result()
    assert ended.status == OperatorResult.PILOT.exit_status, ended.lines
    assert ended.said("mode POSCTL")
    assert not ended.said("landing")


def test_without_a_companion_it_says_so_and_lands(flights: dict[str, Future[Ended]]) -> None:
    ended = flights["no companion"].result()
    assert ended.status == OperatorResult.NO_COMPANION.exit_status, ended.lines
    assert ended.said("no companion streams setpoints yet")
    assert ended.said("landed and disarmed")


def test_it_names_what_keeps_the_vehicle_from_arming(flights: dict[str, Future[Ended]]) -> None:
    ended = flights["not ready"].result()
    assert ended.status == OperatorResult.NOT_READY.exit_status, ended.lines
    assert ended.said("not ready yet: ")
    assert ended.said("pre-arm checks")
    assert not ended.said(" armed")


def test_ctrl_c_holds_and_does_not_land(flights: dict[str, Future[Ended]]) -> None:
    ended = flights["interrupted"].result()
    assert ended.status == OperatorResult.INTERRUPTED.exit_status == 130, ended.lines
    assert ended.said("mode AUTO.LOITER: still in the air, over to the pilot")
    assert not ended.said("landing")


def test_it_gives_up_where_there_is_no_vehicle() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        url = f"udpout:127.0.0.1:{silent.getsockname()[1]}"
        ended = Operator(url, "--timeout", "2").ended(30.0)
    assert ended.status == OperatorResult.NO_VEHICLE.exit_status, ended.lines
    assert ended.said(f"no autopilot heard on {url}")


def test_every_ending_has_its_own_status() -> None:
    bad = [result.exit_status for result in OperatorResult if result.exit_status != 0]
    assert len(bad) == len(set(bad)) == len(OperatorResult) - 2


def test_without_mavsdk_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mavsdk", None)
    with pytest.raises(GroundLinkError, match=r"pip install 'companion\[operator\]'"):
        GroundLink("udpin://127.0.0.1:0", print)


def test_urls() -> None:
    assert ground_url("udpin:0.0.0.0:14550") == "udpin://0.0.0.0:14550"
    assert ground_url("udpout:10.0.0.2:14550") == "udpout://10.0.0.2:14550"
    assert ground_url("tcp:127.0.0.1:5760") == "tcpout://127.0.0.1:5760"
    assert ground_url("serial:/dev/ttyUSB0:57600") == "serial:///dev/ttyUSB0:57600"


@pytest.mark.parametrize(
    "url", ["", "14550", "udp:127.0.0.1:14550", "udpin:14550", "serial:/dev/ttyUSB0", "tcp:h:p"]
)
def test_what_is_no_url_is_refused_with_what_is(url: str) -> None:
    with pytest.raises(ValueError, match="expected udpin:HOST:PORT"):
        ground_url(url)


# --------------------------------------------------------------------------------------------------- rest


def rested(
    track: Callable[[float], tuple[float, float, float]], until_s: float = 30.0, rest_s: float = REST_S
) -> float | None:
    """When RestWatch says so on a track of x, y, heading, looked at ten times a second."""
    watch = RestWatch(rest_s)
    for i in range(round(until_s * 10)):
        x, y, heading = track(i * 0.1)
        if watch.add(i * 0.1, Motion(x, y, 3.0, math.remainder(heading, math.tau), 0.0, 0.0)):
            return i * 0.1
    return None


@given(phase=st.floats(-math.pi, math.pi))
def test_rest_is_neither_moving_nor_turning(phase: float) -> None:
    assert rested(lambda t: (0.0, 0.0, phase)) is None  # has not set out
    assert rested(lambda t: (0.0, 0.0, phase + 0.5 * t)) is None  # turns on the spot
    assert rested(lambda t: (0.3 * t, 0.0, phase)) is None  # flies
    assert rested(lambda t: (math.cos(t), math.sin(t), phase + t)) is None  # circles
    stopped = rested(lambda t: (0.5 * min(t, 6.0), 0.0, phase))
    assert stopped is not None and REST_S <= stopped - 6.0 + 0.5 < REST_S + 0.6
    longer = rested(lambda t: (0.5 * min(t, 6.0), 0.0, phase), rest_s=8.0)
    assert longer is not None and 8.0 <= longer - 6.0 + 0.5 < 8.6
    turned = rested(lambda t: (0.0, 0.0, phase + min(t, 3.0)))
    assert turned is not None and REST_S <= turned - 3.0 + 0.2 < REST_S + 0.4


def test_a_wobble_does_not_add_up_to_having_set_out() -> None:
    assert rested(lambda t: (0.05 * math.sin(40 * t), 0.0, 0.05 * math.cos(40 * t)), 60.0) is None


def test_what_was_not_seen_is_not_taken_for_rest() -> None:
    watch = RestWatch()
    for i in range(60):
        assert not watch.add(i * 0.1, Motion(0.3 * i * 0.1, 0.0, 3.0, 0.0, 0.3, 0.0))
    still = Motion(1.8, 0.0, 3.0, 0.0, 0.0, 0.0)
    assert not watch.add(20.0, still)
    assert not watch.add(23.0, still)
    assert not any(watch.add(23.0 + 0.1 * i, still) for i in range(1, 24))
    assert any(watch.add(25.4 + 0.1 * i, still) for i in range(4))
