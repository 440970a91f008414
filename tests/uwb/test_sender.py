"""What a publisher makes of measurements: names, sessions, sequences and sigmas; and what it refuses."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import pytest

from companion import cli_publish
from companion.publish import MOST_PAIRS, Publication, Sender
from companion.range_message import RangeMessage
from companion.types import LineOfSight
from companion.uwb.families import Family, open_parser
from companion.uwb.info import BeaconInfo, decode, decode_many, encode, schema
from companion.uwb.measured import LosRule, Measured
from companion.uwb.sources import Recording, SerialPort, Simulated, Source
from tests.uwb.samples import NTF_FOUR

NOWHERE = ("tcp/127.0.0.1:1",)


class Wire:
    """What a sender gave away."""

    def __init__(self, publication: Publication) -> None:
        self.announced: dict[str, BeaconInfo] = {}
        self.sent: list[tuple[str, str, RangeMessage]] = []
        self.sender = Sender(
            publication,
            lambda beacon, info: self.announced.update({beacon: decode(info)}),
            lambda *sent: self.sent.append(sent),
            clock_ns=lambda: 1_700_000_000_000_000_000,
        )


def module(**options: object) -> Publication:
    return Publication(SerialPort("/dev/null"), Family.QORVO_CLI, connect=NOWHERE, **options)  # type: ignore[arg-type]


def test_each_pair_counts_for_itself() -> None:
    wire = Wire(module())
    for peer in ("0x0001", "0x0002", "0x0001"):
        wire.sender.send(Measured(peer=peer, range_m=2.0, los=LineOfSight.NLOS, rssi_dbm=-80.0))
    assert [(b, t, m.seq) for b, t, m in wire.sent] == [
        ("0x0001", "drone", 0),
        ("0x0002", "drone", 0),
        ("0x0001", "drone", 1),
    ]
    message = wire.sent[0][2]
    assert (message.los, message.rssi_dbm, message.t_ns) == (
        LineOfSight.NLOS,
        -80.0,
        1_700_000_000_000_000_000,
    )
    assert set(wire.announced) == {"0x0001", "0x0002"}


def test_a_new_start_is_a_new_session() -> None:
    wires = [Wire(module()) for _ in range(2)]
    for wire in wires:
        wire.sender.send(Measured(peer="a", range_m=1.0))
    assert wires[0].sent[0][2].session != wires[1].sent[0][2].session


def test_names_given_are_the_only_ones() -> None:
    wire = Wire(module(names={"0x0001": "b1"}))
    assert set(wire.announced) == {"b1"}
    for peer in ("0x0001", "0x0002", "b1"):
        wire.sender.send(Measured(peer=peer, range_m=2.0))
    assert [b for b, _, _ in wire.sent] == ["b1"]
    assert sum(wire.sender.tally.refused.values()) == 2


def test_the_module_may_be_the_beacon() -> None:
    wire = Wire(module(beacon="b7"))
    wire.sender.send(Measured(peer="0x0001", range_m=2.0))
    assert [(b, t) for b, t, _ in wire.sent] == [("b7", "0x0001")]
    assert set(wire.announced) == {"b7"}


def test_sigma_from_the_module_then_the_command_line_then_the_calibration() -> None:
    calibrated = BeaconInfo(sigma_m=0.3)
    told = [
        Wire(module(info=calibrated, sigma_m=0.2)),
        Wire(module(info=calibrated)),
        Wire(module()),
    ]
    sigmas = []
    for wire in told:
        wire.sender.send(Measured(peer="a", range_m=2.0, sigma_m=0.1))
        wire.sender.send(Measured(peer="a", range_m=2.0))
        sigmas.append([m.sigma_m for _, _, m in wire.sent])
    assert sigmas == [[0.1, 0.2], [0.1, 0.3], [0.1, None]]


def test_what_is_no_range_is_told_and_not_sent() -> None:
    wire = Wire(module())
    parser = open_parser(Family.QORVO_CLI)
    for m in parser.feed(NTF_FOUR):
        wire.sender.send(m)
    assert len(wire.sent) == 3
    assert "TX_FAILED 1×" in wire.sender.tally.text(parser)


@pytest.mark.parametrize("peer", ["*", "a/b", "**", "", "a" * 65, "$*", "b 1", "ü", "b1\n"])
def test_a_peer_cannot_write_to_another_key(peer: str) -> None:
    wire = Wire(module())
    wire.sender.send(Measured(peer=peer, range_m=2.0))
    assert wire.sent == [] and wire.announced == {}


def test_invented_peers_are_bounded() -> None:
    wire = Wire(module())
    for i in range(1000):
        wire.sender.send(Measured(peer=f"p{i}", range_m=2.0))
        wire.sender.send(Measured(peer=f"p{i}", status=f"S{i}"))
    assert len(wire.sent) == len(wire.announced) == MOST_PAIRS
    assert len(wire.sender.tally.refused) <= 65


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"tag": "a/b"}, "'a/b'"),
        ({"names": {"1": "*"}}, "'\\*'"),
        ({"sigma_m": 0.0}, "sigma"),
        ({"encoding": "text/plain"}, "text/plain"),
        ({"los": LosRule.POWER}, "power"),
        ({"info": BeaconInfo(height_m=math.nan)}, "height_m"),
        ({"infos": {"b1": BeaconInfo(bias_m=1e9)}}, "bias_m"),
    ],
)
def test_what_cannot_be_meant_is_refused(options: dict[str, object], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        module(**options)


@pytest.mark.parametrize(
    ("source", "family"),
    [
        (SerialPort("/dev/null", baud=0), Family.QORVO_CLI),
        (SerialPort("/dev/null"), None),
        (Recording(None, speed=-1.0), Family.CSV),
        (Simulated(rate_hz=0.0), None),
        (Simulated(dropout=1.5), None),
        (Simulated(), Family.CSV),
    ],
)
def test_a_source_that_cannot_be_meant_is_refused(source: Source, family: Family | None) -> None:
    with pytest.raises(ValueError):
        Publication(source, family, connect=NOWHERE)


def test_nowhere_to_publish_to() -> None:
    with pytest.raises(ValueError, match="endpoint"):
        Publication(Simulated())


def test_each_beacon_may_tell_something_of_its_own(tmp_path: Path) -> None:
    parser = argparse.ArgumentParser()
    cli_publish.options(parser)
    told = tmp_path / "beacons.json"
    asked = f"--simulate --zenoh-listen tcp/127.0.0.1:0 --info {told}".split()
    told.write_text('{"b1": {"height_m": 1.2}, "b2": {"bias_m": 0.3}}')
    infos = cli_publish.publication(parser.parse_args(asked)).infos
    assert infos == {"b1": BeaconInfo(height_m=1.2), "b2": BeaconInfo(bias_m=0.3)}
    told.write_text('{"b1": {"height_m": "high"}}')
    with pytest.raises(ValueError, match=r"beacons.json: Expected `float"):
        cli_publish.publication(parser.parse_args(asked))
    told.unlink()
    with pytest.raises(ValueError, match=r"beacons.json: No such file"):
        cli_publish.publication(parser.parse_args(asked))


def test_info_is_validated() -> None:
    info = BeaconInfo(height_m=1.2, antenna_delay_ticks=16_405, bias_m=-0.12, sigma_m=0.05)
    assert decode(encode(info)) == info
    assert decode(b'{"height_m":1.2,"more":[1]}') == BeaconInfo(height_m=1.2)
    assert decode_many(b'{"b1":{"height_m":1.2}}') == {"b1": BeaconInfo(height_m=1.2)}
    assert "height_m" in str(schema())
    for wrong in (b'{"height_m":"1"}', b'{"sigma_m":0}', b"x", b"\xff", b'{"x":' + b"[" * 3000):
        with pytest.raises(ValueError):
            decode(wrong)
