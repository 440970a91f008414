"""`companion beacons`: what is shown of each beacon, how two under one id show, what strangers can do."""

from __future__ import annotations

import io
import json
import time

import msgspec
import pytest
from rich.console import Console

from companion.cli import main
from companion.exits import Exit
from companion.link.zenoh_publish import Answer, Heard, PublishLink
from companion.network_settings import BeaconSettings, RangesSettings
from companion.range_message import RangeMessage
from companion.settings import Settings
from companion.types import LineOfSight
from companion.uwb import info
from companion.uwb.info import BeaconInfo
from companion.watch.fleet import Link
from companion.watch.sensors import MOST_PAIRS, Sensors, publishers
from companion.watch.sensors_view import beacon_line, table
from companion.wire_range import JSON, alive_key, encode, info_key, range_key
from tests.link.test_fly_process import start
from tests.link.test_zenoh_status import free_endpoint

S = 1_000_000_000


def heard(t_s: float, payload: bytes, beacon: str = "b1", tag: str = "drone") -> Heard:
    key = range_key("lab", beacon, tag)
    return Heard(round(t_s * S), 0, key, payload, len(payload), JSON, True, False, "REAL_TIME")


def measured(seq: int, range_m: float = 5.0, session: str = "s1") -> bytes:
    return encode(RangeMessage(session, seq, range_m, 0.05, LineOfSight.NLOS, -81.0))


def sensors(*known: str) -> Sensors:
    """Three seconds of one beacon at 20 Hz, of which some ranges are lost and some are not to be believed."""
    network = Sensors(Settings(), {beacon: BeaconSettings() for beacon in known} if known else None)
    for seq in range(60):
        if seq % 20 != 7:
            network.take(heard(0.05 * seq, measured(seq)))
    network.take(heard(3.0, measured(60, 900.0)))
    network.take(heard(3.01, measured(60, 900.0)))
    network.take(heard(3.02, b"{}"))
    return network


def shown(network: Sensors, now_s: float, width: int = 200) -> str:
    console = Console(record=True, width=width, file=io.StringIO())
    console.print(table(network.rows(round(now_s * S)), ""))
    return console.export_text()


def test_a_beacon_is_shown_with_all_that_is_known_of_it() -> None:
    network = sensors()
    network.alive([alive_key("lab", "b1")])
    network.told({info_key("lab", "b1"): Answer(info.encode(BeaconInfo(height_m=1.5, bias_m=0.1)), JSON)})
    (row,) = network.rows(round(3.1 * S))
    assert (row.beacon, row.tag, row.link, row.alive) == ("b1", "drone", Link.LIVE, True)
    assert 18.0 < row.rate_hz < 21.0 and row.age_s is not None and 0.05 < row.age_s < 0.15
    assert (row.sigma_m, row.los, row.rssi_dbm, row.lost) == (0.05, LineOfSight.NLOS, -81.0, 3)
    assert row.believed == 57 and row.refused["absurd"] == 2
    assert row.malformed == {"range field missing or out of range": 1}
    text = shown(network, 3.1)
    for words in (
        "b1",
        "drone",
        "live",
        "0.050 m",
        "nlos",
        "absurd 2",
        "lost 3",
        "tells height 1.5 m, bias 0.1 m",
    ):
        assert words in text
    assert "unreadable: Object missing required field" in text


def test_the_table_fits_a_small_terminal() -> None:
    table_lines = shown(sensors(), 3.1, width=80).splitlines()[:2]
    assert not any("…" in line for line in table_lines)


def test_live_silent_and_gone_are_told_apart() -> None:
    network = sensors()
    assert network.rows(round(3.1 * S))[0].link is Link.LIVE
    assert "no liveliness token" in shown(network, 3.1)
    assert network.rows(9 * S)[0].link is Link.GONE
    network.alive([alive_key("lab", "b1"), alive_key("lab", "b9")])
    assert network.rows(9 * S)[0].link is Link.SILENT
    assert "b9: no range heard" in shown(network, 9.0)
    assert network.rows(9 * S)[0].rate_hz == 0.0


def test_beacons_are_held_against_the_configuration() -> None:
    text = shown(sensors("b2"), 3.1)
    assert "b1 to drone: not in [beacons]" in text
    assert "b2: no range heard, and no publisher is there" in text
    assert "not in [beacons]" not in shown(sensors(), 3.1)


def test_two_publishers_on_one_id_are_seen_and_a_restart_is_none() -> None:
    network = Sensors(Settings(), None)
    for seq in range(40):
        network.take(heard(0.05 * seq, measured(seq, 5.0, "s1")))
        network.take(heard(0.05 * seq + 0.02, measured(1000 + seq, 9.0, "s2")))
    (row,) = network.rows(2 * S)
    assert row.sessions == ("s1", "s2") and row.refused["second publisher"] == 40
    assert "2 publishers use this id" in shown(network, 2.0)
    assert "sessions=2" in beacon_line(row)
    assert publishers(["a"] * 5 + ["b"] * 5) == 1
    assert publishers(["a", "b", "c", "a", "b"]) == 3
    assert publishers([]) == 1


def test_strangers_neither_fill_the_memory_nor_the_terminal() -> None:
    network = Sensors(Settings(), None)
    network.take(heard(0.0, measured(1), beacon="\x1b[2J"))
    network.take(heard(0.0, b'{"session": "\\u001b[2J", "seq": 1, "range_m": 1}'))
    network.take(heard(0.0, b'{"session": "s", "seq": 1, "range_m": 1, "los": "\\u001b[2J"}'))
    network.told({info_key("lab", "b1"): Answer(b'{"height_m": "\\u001b[2J"}', JSON), "x": Answer(b"", JSON)})
    assert "\x1b" not in "".join(beacon_line(row) for row in network.rows(S))
    assert "\x1b" not in shown(network, 1.0)
    for i in range(2 * MOST_PAIRS):
        network.take(heard(0.0, measured(1), beacon=f"b{i}"))
    assert len(network.rows(S)) == MOST_PAIRS
    for i in range(5000):  # a publisher that is another one every time
        network.take(heard(0.001 * i, measured(1, session=f"s{i}")))
    assert len(network.rows(5 * S)) == MOST_PAIRS


def test_the_command_listens_asks_and_tells_in_json() -> None:
    endpoint = free_endpoint()
    link = PublishLink(RangesSettings(listen=(endpoint,)))
    link.announce("b7", info.encode(BeaconInfo(height_m=1.25)))
    with start("beacons", "--zenoh-connect", endpoint, "--json") as process:
        assert process.stdout is not None
        rows: list[dict[str, object]] = []
        end = time.monotonic() + 60.0
        seq = 0
        while not rows or rows[0]["info"] is None or rows[0]["range_m"] is None:
            assert time.monotonic() < end, rows
            for _ in range(10):
                link.put("b7", "drone", RangeMessage("s", seq, 4.5))
                seq += 1
                time.sleep(0.02)
            rows = msgspec.json.decode(process.stdout.readline())["beacons"]
        process.terminate()
        assert process.wait(20.0) == Exit.OK
    link.close()
    assert (rows[0]["beacon"], rows[0]["tag"], rows[0]["range_m"]) == ("b7", "drone", 4.5)
    assert rows[0]["alive"] is True and rows[0]["info"] == {"height_m": 1.25}


def test_where_there_is_nothing_it_says_so(capsys: pytest.CaptureFixture[str]) -> None:
    nowhere = ("beacons", "--zenoh-connect", "tcp/127.0.0.1:1")
    assert main([*nowhere, "--once", "--json", "--seconds", "0.3"]) == Exit.NO_RANGES
    told = json.loads(capsys.readouterr().out)
    assert told["beacons"] == [] and "nobody answers" in told["missing"]
    assert main(["beacons"]) == Exit.USAGE
    assert "--zenoh-connect" in capsys.readouterr().err
