"""What happens to the vehicle in flight, made to happen by the mock's faults: the app answers by its name."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from companion.config import Config, load
from companion.run import run
from companion.types import FlightMode, ModeRequest, Output, Phase, PhaseChange, Setpoint
from sitl_mock.faults import Fault, FaultAt
from sitl_mock.scenario import BeaconAt, Scenario
from sitl_mock.world import World

STRIKE_S = 6.0
FAR = Scenario(beacons=(BeaconAt(x_m=0.0, y_m=20.0, height_m=1.5),), telemetry="quiet", limit_s=14.0)


class Flown(NamedTuple):
    changes: list[PhaseChange]
    outputs: list[Output]
    world: World

    def after(self, t_s: float) -> list[Output]:
        return [output for output in self.outputs if output.t_ns >= self.world.time_ns(t_s)]


def flown(fault: Fault | None, at_s: float = STRIKE_S, **params: int) -> Flown:
    """A flight towards a beacon that is far away; the fault strikes on the way."""
    config: Config = load(None, {}, ["beacons.b1.height_m=1.5"]).config
    world = World(FAR, 2, () if fault is None else (FaultAt(fault, at_s),), dict(params))
    outputs: list[Output] = []

    def send(output: Output) -> None:
        outputs.append(output)
        world.send(output)

    run(world.events(), config, send, lambda _: None)
    return Flown([o for o in outputs if isinstance(o, PhaseChange)], outputs, world)


def test_without_a_fault_it_approaches() -> None:
    assert flown(None).changes[-1].after is Phase.APPROACH


@pytest.mark.parametrize(
    ("fault", "phase", "words", "within_s"),
    [
        (Fault.BATTERY_WARNING, Phase.HAND_OVER, "battery low, 14 % left", 1.2),
        (Fault.BATTERY_LOW, Phase.HAND_OVER, "battery critical, 5 % left", 1.2),
        (Fault.TWIN, Phase.HAND_OVER, "another companion with our own ids", 1.2),
        (Fault.SECOND_COMMANDER, Phase.HAND_OVER, "somebody else's setpoints", 0.2),
        (Fault.ID_CHANGE, Phase.RELEASED, "another one is on its link: system 42", 4.2),
        (Fault.DISARM, Phase.ENDED, "disarmed in the air", 1.2),
        (Fault.REBOOT, Phase.ENDED, "disarmed in the air (a kill switch, or the autopilot restarted)", 3.2),
        (Fault.VELOCITY_INVALID, Phase.RELEASED, "own failsafe", 0.2),
    ],
    ids=lambda value: value.value if isinstance(value, Fault) else "",
)
def test_it_has_its_own_transition(fault: Fault, phase: Phase, words: str, within_s: float) -> None:
    flight = flown(fault)
    struck_ns = flight.world.time_ns(STRIKE_S)
    change = next(c for c in flight.changes if c.t_ns >= struck_ns and c.after is phase)
    assert words in change.reason, [c.reason for c in flight.changes]
    assert (change.t_ns - struck_ns) * 1e-9 <= within_s
    moved = [o for o in flight.after(STRIKE_S + within_s) if isinstance(o, Setpoint) and o.speed_m_s > 0.0]
    assert not moved


def test_a_second_vehicle_on_the_link_does_not_stop_a_flight_but_keeps_one_from_beginning() -> None:
    assert flown(Fault.SECOND_VEHICLE).changes[-1].after is Phase.APPROACH
    waiting = flown(Fault.SECOND_VEHICLE, at_s=0.0)
    assert not any(c.after.is_engaged for c in waiting.changes)


def test_a_low_battery_lands() -> None:
    asked = [o.mode for o in flown(Fault.BATTERY_WARNING).outputs if isinstance(o, ModeRequest)]
    assert set(asked) == {FlightMode.AUTO_LAND}
