"""Watching: what is shown of each vehicle, what is said when there is nothing, what strangers can do."""

from __future__ import annotations

import io
import json
import signal
from collections.abc import Iterator
from typing import Any

import msgspec
import pytest
import zenoh
from rich.console import Console

from companion.cli import main
from companion.exits import Exit
from companion.link.zenoh_publish import Heard
from companion.types import Phase, Status
from companion.watch.fleet import MOST_VEHICLES, Fleet, Link
from companion.watch.listen import News
from companion.watch.terminal import PlainScreen, screen, vehicle_line
from companion.wire_status import JSON, StatusMessage, alive_key, encode, status_key
from tests.link.test_fly_process import start
from tests.link.test_zenoh_status import free_endpoint, until
from tests.people.flights import status

S = 1_000_000_000


def message(s: Status, seq: int = 0, session: str = "s1") -> bytes:
    return encode(StatusMessage(session, seq, 10**18, "b1", 0.5, s))


def heard(uav: str, payload: bytes, t_s: float = 0.0, size: int | None = None) -> Heard:
    n = len(payload) if size is None else size
    return Heard(round(t_s * S), 0, status_key(uav), payload, n, JSON, True, False, "DATA")


def fleet_of(*uavs: str) -> Fleet:
    fleet = Fleet()
    for i, uav in enumerate(uavs):
        fleet.take(heard(uav, message(status(1.0 + i))))
    return fleet


def shown(fleet: Fleet, now_s: float = 0.1, missing: str = "") -> str:
    console = Console(record=True, width=150, file=io.StringIO())
    console.print(screen(fleet, missing, round(now_s * S)))
    return console.export_text()


def test_one_vehicle_is_shown_with_its_panel_and_many_in_a_table() -> None:
    text = shown(fleet_of("heron"))
    assert "heron" in text and "live" in text and "17° right ± 6°" in text and "0.50 m/s forward" in text
    both = shown(fleet_of("heron", "crane"))
    assert both.index("crane") < both.index("heron")
    assert "5.30 ± 0.12 m" in both and "0.50 m/s forward" not in both


def test_what_each_vehicle_awaits_is_said() -> None:
    fleet = fleet_of("heron", "crane")
    fleet.take(heard("crane", message(status(phase=Phase.AWAIT, awaited=("ranges of beacon 'b1'",)), seq=1)))
    assert "crane awaits ranges of beacon 'b1'" in shown(fleet)
    assert "awaiting a router" in shown(Fleet(), missing="awaiting a router on tcp/10.0.0.1:7447")


def test_live_silent_and_gone_are_told_apart() -> None:
    fleet = fleet_of("heron")
    vehicle = fleet.vehicles()[0]
    assert vehicle.link(S) is Link.LIVE
    assert vehicle.link(9 * S) is Link.GONE
    fleet.alive([alive_key("heron"), alive_key("crane")])
    assert vehicle.link(9 * S) is Link.SILENT
    assert "silent, 9 s ago" in shown(fleet, 9.0) and "silent, never heard" in shown(fleet, 9.0)
    assert "link=silent age_s=9.0" in vehicle_line(vehicle, 9 * S)
    fleet.alive([])
    assert "gone, 9 s ago" in shown(fleet, 9.0)


def test_changes_of_phase_are_told_and_losses_counted_but_not_over_a_restart() -> None:
    fleet = fleet_of("heron")
    change = fleet.take(heard("heron", message(status(3.0, phase=Phase.HOLD, reason="there"), seq=4)))
    assert change is not None and (change.before, change.after) == (Phase.APPROACH, Phase.HOLD)
    assert fleet.vehicles()[0].lost == 3
    stream, vehicle = io.StringIO(), fleet.vehicles()[0]
    assert vehicle.message is not None
    PlainScreen(stream).show(fleet, [News(vehicle, vehicle.message, change)], "", S)
    told, *rest = stream.getvalue().splitlines()
    assert told == "uav=heron t_s=2.0 change=APPROACH->HOLD severity=INFO reason=there"
    assert [line.split()[:3] for line in rest] == [["uav=heron", "link=live", "age_s=1.0"]]
    assert fleet.take(heard("heron", message(status(1.0, phase=Phase.AWAIT), session="s2"), 5.0)) is None
    assert fleet.vehicles()[0].lost == 0


def test_two_apps_under_one_id_are_told_and_do_not_alternate() -> None:
    fleet = Fleet()
    for i in range(20):
        fleet.take(heard("heron", message(status(i), i, "s1"), 0.2 * i))
        fleet.take(heard("heron", message(status(phase=Phase.HOLD), i, "s2"), 0.2 * i + 0.1))
    (vehicle,) = fleet.vehicles()
    assert vehicle.message is not None and vehicle.message.session == "s1" and vehicle.lost == 0
    assert "another app publishes under this id" in shown(fleet, 4.0)
    fleet.take(heard("heron", message(status(phase=Phase.HOLD), 50, "s2"), 6.5))  # the first has ended
    assert vehicle.message.session == "s2" and not vehicle.problems(7 * S)


@pytest.mark.parametrize(
    ("payload", "words"),
    [
        (b"\xff", "malformed"),
        (b"{}", "session"),
        (message(status(reason="\x1b[2J")), "control characters"),
        (message(status(warnings=("\x1b[2J",))), "control characters"),
        (message(status(rejected={"\x9b31m": 1})), "control characters"),
        (message(status()).replace(b'"approach"', b'"fly\\u001b"'), "invalid enum value"),
        (message(status()).replace(b"5.3", b"1e999"), "out of range"),
    ],
)
def test_what_cannot_be_read_is_named_and_not_shown(payload: bytes, words: str) -> None:
    fleet = Fleet()
    fleet.take(heard("heron", payload))
    (vehicle,) = fleet.vehicles()
    assert vehicle.message is None and vehicle.unreadable == 1
    assert words in vehicle.problem.lower()
    assert "1 unreadable" in shown(fleet) and "\x1b" not in vehicle_line(vehicle, S)


def test_strangers_neither_fill_the_memory_nor_the_terminal() -> None:
    fleet = Fleet()
    fleet.take(heard("\x1b[2J", message(status())))
    fleet.take(heard("heron", b"", size=10**9))
    for i in range(500):
        fleet.take(heard(f"v{i}", message(status())))
    fleet.alive(alive_key(f"w{i}") for i in range(500))
    assert len(fleet.vehicles()) == MOST_VEHICLES
    assert "other ids are not shown" in shown(fleet)


@pytest.fixture
def vehicle() -> Iterator[tuple[str, zenoh.Session]]:
    """Where a vehicle's session listens, and the session."""
    endpoint = free_endpoint()
    quiet = {"multicast": {"enabled": False}, "gossip": {"enabled": False}}
    config = {"mode": "peer", "listen": {"endpoints": [endpoint]}, "scouting": quiet}
    session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    yield endpoint, session
    session.close()  # type: ignore[no-untyped-call]


def test_it_watches_until_it_is_interrupted(vehicle: tuple[str, zenoh.Session]) -> None:
    endpoint, session = vehicle
    with start("watch", "--zenoh-connect", endpoint, "--view", "json") as process:
        lines: list[str] = []
        assert process.stdout is not None
        publisher: Any = session.declare_publisher(status_key("heron"), encoding=JSON)
        until(lambda: publisher.matching_status.matching)
        publisher.put(message(sent := status(4.0)))
        lines.append(process.stdout.readline())
        process.send_signal(signal.SIGINT)
        assert process.wait(20.0) == Exit.OK
    row = json.loads(lines[0])
    assert (row["uav"], row["link"]) == ("heron", "live")
    assert msgspec.convert(row["message"]["status"], Status) == sent


NOWHERE = ("watch", "--zenoh-connect", "tcp/127.0.0.1:1")


@pytest.mark.parametrize(
    ("arguments", "exit_status", "words"),
    [
        (("watch",), Exit.USAGE, "--zenoh-connect"),
        ((*NOWHERE, "--uav", "a/b"), Exit.USAGE, "a/b"),
        ((*NOWHERE, "--web", "99999"), Exit.USAGE, "between 0 and 65535"),
        ((*NOWHERE, "--web", "0", "--bind", "203.0.113.9"), Exit.LINK, "203.0.113.9"),
        ((*NOWHERE, "--seconds", "0.3"), Exit.NO_VEHICLE, "nobody answers"),
    ],
)
def test_where_there_is_nothing_to_see_it_says_why(
    arguments: tuple[str, ...], exit_status: Exit, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == exit_status
    out, err = capsys.readouterr()
    assert words in out + err
