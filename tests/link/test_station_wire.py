"""Station keeping over the wires: four beacons on Zenoh, the mock and its operator on MAVLink."""

from __future__ import annotations

import threading
from pathlib import Path

import msgspec

from companion.exits import Exit
from companion.types import Phase, Status
from tests.people.parties import spawn
from tests.sitl_mock.process import running_mock

FILE = Path(__file__).parents[2] / "config/station.toml"
BOUND_S = 80.0


def test_the_station_is_found_from_four_beacons_on_the_wire(tmp_path: Path) -> None:
    scenario = tmp_path / "near.toml"
    near = "[sim]\nrandom_start = false\nstart_x_m = 6.0\nstart_y_m = 4.5\n"
    scenario.write_text(FILE.read_text().replace("[sim]", near, 1).replace("random_start = true", ""))
    ports = ("--mavlink", "udpin:127.0.0.1:0", "--gcs", "udpin:127.0.0.1:0")
    with running_mock(*ports, "--scenario", str(scenario)) as mock:
        onboard, ground = (
            mock.endpoints[kind].replace("udpin", "udpout")
            for kind in ("mavlink onboard", "mavlink ground station")
        )
        app = spawn(
            "companion", "fly", "--config", str(scenario), "--mavlink", onboard, "--zenoh-connect",
            mock.endpoints["zenoh"], "--view", "json", "--record", str(tmp_path / "flight.mcap"),
            "--set", "loss.held_up_after_s=10",  # a loaded machine may hold it up for a second
        )  # fmt: skip
        operator = spawn("companion", "operator", "--mavlink", ground, "--height", "1")
        bound = threading.Timer(BOUND_S, app.kill)
        bound.start()
        statuses: list[Status] = []
        try:
            assert app.stdout is not None
            for line in app.stdout:
                if '"output":"status"' in line:
                    statuses.append(msgspec.json.decode(line, type=Status))
                    if statuses[-1].phase is Phase.APPROACH:
                        break
        finally:
            operator.kill()
            operator.communicate()
            app.terminate()
            rest, _ = app.communicate(timeout=BOUND_S)
            bound.cancel()
    assert statuses[-1].phase is Phase.APPROACH, [s.reason for s in statuses]
    ages = statuses[-1].beacons
    assert ages.keys() == {"b1", "b2", "b3", "b4"}
    assert all(age_s is not None and age_s < 2.0 for age_s in ages.values()), ages
    assert "station NOT reached" in rest
    assert app.returncode == Exit.INTERRUPTED, rest[-4000:]
