"""What the pilot makes of what is known of a beacon: bias, height, and what people are told."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from companion.network_settings import BeaconSettings
from companion.settings import Settings
from companion.types import BeaconTold, RangeSample, Status, Verdict
from tests.core.flights import MS, Flown, Script, fly


def warnings(flown: Flown) -> tuple[str, ...]:
    status = flown.of(Status)[-1]
    assert isinstance(status, Status)
    return status.warnings


def test_the_bias_reaches_the_estimate() -> None:
    settings = Settings(beacons={"b1": BeaconSettings(bias_m=0.4)})
    assert fly(Script().run(1.0), settings).state.ranging.range_m == pytest.approx(9.6)


def test_what_a_beacon_tells_counts_where_the_configuration_is_silent() -> None:
    flown = fly([BeaconTold(0, "b1", height_m=1.5, bias_m=0.25), *Script().run(1.0)])
    assert flown.state.ranging.range_m == pytest.approx(9.75)
    assert flown.state.ranging.beacons["b1"].height_m == 1.5
    assert warnings(flown) == ()


def test_a_beacon_that_contradicts_the_configuration_is_named() -> None:
    settings = Settings(beacons={"b1": BeaconSettings(height_m=1.5)})
    flown = fly([BeaconTold(0, "b1", height_m=0.0), *Script().run(1.0)], settings)
    assert flown.state.ranging.beacons["b1"].height_m == 1.5
    assert warnings(flown) == ("b1 tells height 0 m, the configuration 1.5 m, which counts",)


@pytest.mark.parametrize(("tells_motion", "jumps"), [(True, True), (False, False)])
def test_a_distance_must_fit_the_vehicles_own_motion(tells_motion: bool, jumps: bool) -> None:
    """It hovers, and the distance shrinks by 5 m/s: possible only where it does not tell how it moves."""
    script = Script()
    script.tells_attitude = tells_motion  # and with it the velocity
    flown = fly(script.run(1.0))
    for _ in range(10):
        assert script.range_m is not None
        script.range_m -= 0.5
        flown = fly(script.run(0.1), before=flown)
    assert (Verdict.JUMP in flown.state.ranging.rejected) is jumps


def test_what_a_stranger_tells_is_of_no_interest() -> None:
    before = fly(Script().run(1.0))
    after = fly([BeaconTold(10**9, "b7", height_m=5.0)], before=before)
    assert after.state.ranging == before.state.ranging


def test_a_second_publisher_is_named_counted_and_not_believed() -> None:
    script = Script()
    flown = fly(script.run(1.0))
    both = []
    for event in script.run(1.0):
        both.append(event)
        if isinstance(event, RangeSample):
            both.append(replace(event, t_ns=event.t_ns + 5 * MS, session="intruder", range_m=4.0))
    flown = fly(both, before=flown)
    assert warnings(flown) == ("two publishers of b1: session 's' is believed, 'intruder' is not",)
    assert flown.state.ranging.rejected == {Verdict.SECOND_PUBLISHER: 20}
    assert flown.state.ranging.range_m == 10.0
    assert warnings(fly(script.run(6.0), before=flown)) == ()
