"""Configuration: what wins, what is refused, and in which words."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest

from companion.config import Config, ConfigError, contradictions, flat, load, schema

ROOT = Path(__file__).parents[2]


def test_the_command_line_beats_the_environment_beats_the_file(tmp_path: Path) -> None:
    file = tmp_path / "c.toml"
    file.write_text("[guidance]\nspeed_m_s = 0.3\ncapture_radius_m = 0.4\nlq_r = 2.0\n")
    environment = {
        "COMPANION_GUIDANCE__SPEED_M_S": "0.35",
        "COMPANION_GUIDANCE__CAPTURE_RADIUS_M": "0.45",
        "HOME": "/",
    }
    loaded = load(file, environment, ["guidance.speed_m_s=0.38"])
    g = loaded.config.guidance
    assert (g.speed_m_s, g.capture_radius_m, g.lq_r) == (0.38, 0.45, 2.0)
    assert loaded.sources == {
        "guidance.speed_m_s": "--set guidance.speed_m_s=0.38",
        "guidance.capture_radius_m": "environment COMPANION_GUIDANCE__CAPTURE_RADIUS_M",
        "guidance.lq_r": str(file),
    }


def test_text_lists_and_tables_can_be_set() -> None:
    loaded = load(
        None,
        {"COMPANION_BEACONS__B1__HEIGHT_M": "1.5"},
        ["vehicle.mavlink=udpin:127.0.0.1:14540", 'ranges.connect=["tcp/127.0.0.1:7447"]'],
    )
    assert loaded.config.vehicle.mavlink == "udpin:127.0.0.1:14540"
    assert loaded.config.ranges.connect == ("tcp/127.0.0.1:7447",)
    assert loaded.config.beacons["b1"].height_m == 1.5


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("guidance.speed_m_s=7", ["guidance.speed_m_s = 7", "<= 5.0"]),
        ("guidance.speed=1", ["guidance.speed", "unknown key", "did you mean speed_m_s?"]),
        ("guidance.observer=guess", ["guidance.observer = 'guess'", "'kalman'", "'luenberger'"]),
        ("beacons.b1.hight=1", ["beacons.b1.hight", "unknown key", "height_m"]),
        ("beacons.b1.height_m=nan", ["beacons.b1.height_m = nan"]),
        ('ranges.connect=["tcp/10.0.0.1"]', ["ranges.connect.0 = 'tcp/10.0.0.1'", "tcp/192.168.1.10:7447"]),
        ('ranges.listen=["here"]', ["ranges.listen.0 = 'here'", "PROTOCOL/ADDRESS:PORT"]),
        ("ranges.site=a/b", ["ranges.site = 'a/b'", "letters, digits"]),
        ("loss.telemetry_after_s=0.03", ["loss.telemetry_after_s = 0.03", "every 0.02 s", "0.04 s at least"]),
        ("vehicle.component_id=1", ["vehicle.component_id = 1", "autopilot's own"]),
        ("ranges.max_range_m=0.3", ["guidance.capture_radius_m = 0.5", "ranges.max_range_m = 0.3"]),
        ("nope.x=1", ["nope", "unknown key", "guidance"]),
        ("vehicle.mavlink=com1", ["vehicle.mavlink", "com1", "udpin:HOST:PORT"]),
        ("vehicle.mavlink=udpin:0.0.0.0:99999", ["99999", "65535"]),
        ("limits.speed_m_s=0.1", ["guidance.speed_m_s = 0.5", "limits.speed_m_s = 0.1"]),
        ("mission.target=b9", ["mission.target = 'b9'", "b1"]),
        ("loss.stall_after_s=0.1", ["loss.coast_after_s = 0.5", "loss.stall_after_s = 0.1"]),
        ("guidance.capture_radius_m=0.06", ["capture_radius_m = 0.06", "b1.sigma_m = 0.07"]),
        ("beacons.b1.sigma_m=0.6", ["capture_radius_m = 0.5", "beacons.b1.sigma_m = 0.6"]),
        ("vehicle.velocity_lag_s=4.0", ["speed_m_s = 0.5", "coasts 2.08 m", "capture_radius_m = 0.5"]),
        ("guidance.stop_margin_m=0.6", ["stop_margin_m = 0.6", "capture_radius_m = 0.5"]),
        ("sim.beacons=[{id='a',x=3}]", ["sim.beacons.0.x", "unknown key", "x_m"]),
        ("guidance=3", ["table.key=value"]),
        ("ranges.site=a/b", ["ranges.site = 'a/b'"]),
    ],
)
def test_a_bad_value_is_refused_with_its_name_and_what_is_allowed(override: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as refused:
        load(None, {}, [override])
    text = str(refused.value)
    assert "\n" not in text
    assert all(word in text for word in words), text


@pytest.mark.parametrize("observer", ["kalman", "luenberger"])
def test_high_above_the_beacon_only_the_default_tells_the_disc(observer: str) -> None:
    high = ("vehicle.height_m=5", "beacons.b1.height_m=0")
    load(None, {}, high)
    with pytest.raises(ConfigError, match=r"5 m above b1 .*known to 1\.22 m only"):
        load(None, {}, (*high, f"guidance.observer={observer}"))


STATION = (
    "mission.kind='station'",
    *(f"beacons.b{i}={{station_distance_m={d}}}" for i, d in ((1, 5), (2, 6.5), (3, 5))),
)


def test_a_station_is_given_by_its_distances() -> None:
    config = load(None, {}, STATION).config
    assert [b.station_distance_m for b in config.beacons.values()] == [5, 6.5, 5]


@pytest.mark.parametrize(
    ("overrides", "words"),
    [
        (STATION[:3], ["beacons = b1, b2", "'station'", "at least 3"]),
        ((*STATION, "beacons.b4.height_m=1"), ["beacons.b4.station_distance_m = none", "above 0"]),
        ((*STATION, "beacons.b2.station_distance_m=0"), ["beacons.b2.station_distance_m = 0", "> 0"]),
        ((*STATION, "beacons.b2.station_bearing_rad=1"), ["b2.station_bearing_rad = 1", "'station-paper'"]),
        (
            (*STATION, "station.scheme='station-paper'", "beacons.b2.station_bearing_rad=1"),
            ["all beacons or none", "b1, b3"],
        ),
        ((*STATION, "station.scheme='station-paper'", "station.can_stop=false"), ["can_stop = False"]),
        ((*STATION, "station.scheme='spiral'"), ["'spiral'", "'station', 'station-paper'"]),
    ],
)
def test_a_station_that_cannot_be_kept_is_refused(overrides: tuple[str, ...], words: list[str]) -> None:
    with pytest.raises(ConfigError) as refused:
        load(None, {}, overrides)
    text = str(refused.value)
    assert "\n" not in text
    assert all(word in text for word in words), text


@pytest.mark.parametrize(
    ("content", "words"), [("[guidance", "not TOML"), ("[guidance]\nspeed_m_s = 'fast'\n", "'fast'")]
)
def test_a_bad_file_is_named(tmp_path: Path, content: str, words: str) -> None:
    file = tmp_path / "bad.toml"
    file.write_text(content)
    with pytest.raises(ConfigError) as refused:
        load(file, {})
    assert words in str(refused.value)
    assert str(file) in str(refused.value)


def test_a_missing_file_is_named() -> None:
    with pytest.raises(ConfigError, match=r"nowhere\.toml: No such file"):
        load(Path("nowhere.toml"), {})


@pytest.mark.parametrize("file", sorted((ROOT / "config").glob("*.toml")), ids=lambda p: p.name)
def test_the_shipped_files_are_valid(file: Path) -> None:
    load(file, {})


def test_the_defaults_do_not_contradict_one_another() -> None:
    assert contradictions(Config()) == []


def test_every_value_is_shown_and_described() -> None:
    assert flat(Config())["guidance.speed_m_s"] == 0.5
    tables = schema()["$defs"]
    undescribed = [
        f"{table}.{key}"
        for table, definition in tables.items()
        for key, entry in definition["properties"].items()
        if "description" not in entry and not table.startswith(("Scenario", "BeaconAt", "Config"))
    ]
    assert not undescribed
    json.dumps(schema())


def test_the_digest_tells_configurations_apart() -> None:
    one, same = load(None, {}), load(None, {}, ["guidance.speed_m_s=0.5"])
    other = load(None, {}, ["guidance.speed_m_s=0.4"])
    assert one.digest == same.digest != other.digest
    assert msgspec.json.decode(msgspec.json.encode(one.config), type=Config) == one.config


def test_a_wildcard_topic_cannot_be_one_beacons() -> None:
    topic = "ranges.ros2=[{topic = '/uwb/*/range', beacon = 'b1'}]"
    with pytest.raises(ConfigError, match=r"/uwb/\*/range.*'b1'"):
        load(None, {}, [topic])
    with pytest.raises(ConfigError, match="bridge = 'dds': allowed: 'rmw_zenoh', 'ros2dds'"):
        load(None, {}, ["ranges.ros2=[{topic = '/a', bridge = 'dds'}]"])
