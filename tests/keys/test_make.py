"""`companion keys`: what it makes, what it leaves alone, and what it says to nonsense."""

from __future__ import annotations

import stat
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from companion.check.credentials import judge
from companion.check.report import State
from companion.config import load
from companion.exits import Exit
from companion.keys import site
from companion.keys.certificates import Role
from companion.keys.router import Site, router_config
from companion.link import credentials
from companion.network_settings import RangesSettings
from companion.settings import Settings, StatusSettings
from tests.keys.site import NOW, keys, make

Say = pytest.CaptureFixture[str]


@pytest.fixture
def place(tmp_path: Path) -> Path:
    return make(tmp_path / "keys")


def contents(directory: Path) -> dict[str, bytes]:
    return {str(p.relative_to(directory)): p.read_bytes() for p in directory.rglob("*") if p.is_file()}


def test_everybody_gets_a_directory_that_is_whole(place: Path) -> None:
    for folder, name in {
        "router": "router/lab",
        "beacon-b1": "beacon/b1",
        "tag-t1": "tag/t1",
        "vehicle-u1": "vehicle/u1",
        "watcher-desk": "watcher/desk",
    }.items():
        found = credentials.read(place / folder)
        assert found.name == name
        assert timedelta(days=364) < found.until - NOW < timedelta(days=366)


def test_private_keys_are_the_owners_alone_and_only_the_router_may_be_a_server(place: Path) -> None:
    secret = [p for p in place.rglob("*") if p.name in ("key.pem", "ca.key")]
    assert len(secret) == 7
    assert {stat.S_IMODE(p.stat().st_mode) for p in secret} == {0o600}
    for path in place.glob("*/certificate.pem"):
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
        usage = certificate.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        assert (ExtendedKeyUsageOID.SERVER_AUTH in usage) == (path.parent.name == "router")
        assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca


def test_one_more_beacon_leaves_the_others_as_they_are(place: Path, capsys: Say) -> None:
    before = contents(place)
    assert keys(place, "--beacon", "b3", "--beacon", "b1") == Exit.OK
    after = contents(place)
    new = {"beacon-b3/ca.pem", "beacon-b3/certificate.pem", "beacon-b3/key.pem", "router/zenoh.json5.before"}
    assert set(after) - set(before) == new
    assert {name for name in before if after[name] != before[name]} == {"router/zenoh.json5"}
    assert after["router/zenoh.json5.before"] == before["router/zenoh.json5"]
    assert b"uwb/v1/lab/b3/**" in after["router/zenoh.json5"]
    said = capsys.readouterr().out
    assert "beacon/b1: is there already" in said
    assert "start the router again" in said


def test_asked_for_nothing_it_shows_who_there_is_and_changes_nothing(place: Path, capsys: Say) -> None:
    before = contents(place)
    capsys.readouterr()
    assert keys(place) == Exit.OK
    assert contents(place) == before
    said = capsys.readouterr().out
    for words in ("authority until", "beacon/b1", "vehicle/u1", "days", "127.0.0.1"):
        assert words in said


def test_what_a_person_wrote_into_the_routers_file_stays(place: Path) -> None:
    path = place / "router/zenoh.json5"
    path.write_text(path.read_text().replace("tls/0.0.0.0:7447", "tls/10.0.0.1:7000"))
    assert keys(place, "--beacon", "b3") == Exit.OK
    assert "tls/10.0.0.1:7000" in path.read_text()
    path.write_text(path.read_text().replace("// end of access control", ""))
    assert keys(place, "--beacon", "b4") == Exit.USAGE


def test_renewing_makes_a_new_key_for_the_same_name(place: Path) -> None:
    path = place / "router/zenoh.json5"
    rules = path.read_text()
    old = contents(place)
    assert keys(place, "--renew", "beacon/b1", "--renew", "router", "--days", "40") == Exit.OK
    now = contents(place)
    changed = {name for name in old if now[name] != old[name]}
    assert changed == {
        f"{who}/{f}" for who in ("beacon-b1", "router") for f in ("certificate.pem", "key.pem")
    }
    assert set(now) == set(old)
    assert path.read_text() == rules
    assert credentials.read(place / "beacon-b1").until - NOW < timedelta(days=41)


def test_who_is_deleted_loses_the_rules_at_the_next_run(place: Path) -> None:
    for path in (place / "beacon-b2").iterdir():
        path.unlink()
    (place / "beacon-b2").rmdir()
    assert keys(place) == Exit.OK
    assert "b2" not in (place / "router/zenoh.json5").read_text()


def test_an_expired_certificate_is_shown_and_is_a_failure(place: Path, capsys: Say) -> None:
    site.add(place, Role.BEACON, "b7", NOW - timedelta(days=20), 10)
    assert keys(place) == Exit.FAULTY
    assert "EXPIRED" in capsys.readouterr().out


def test_nobody_outlives_the_authority(tmp_path: Path) -> None:
    site.create(tmp_path, "lab", NOW - timedelta(days=site.AUTHORITY_DAYS - 5))
    member = site.add(tmp_path, Role.BEACON, "b1", NOW, 365)
    assert member.until - NOW < timedelta(days=6)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--site", "other"), "is the site lab"),
        (("--router", "10.0.0.1"), "--renew router"),
        (("--router", "10.0.0.1:7447"), "a host name or an IP address alone"),
        (("--beacon", "b/1"), "letters, digits"),
        (("--beacon", "*"), "letters, digits"),
        (("--beacon", "b" * 60), "at most 57 characters"),
        (("--renew", "beacon/b9"), "there are router, beacon/b1"),
        (("--days", "0"), "1 to 3650"),
        (("--port", "70000"), "1 to 65535"),
    ],
)
def test_nonsense_is_refused_in_words_and_changes_nothing(
    arguments: tuple[str, ...], words: str, place: Path, capsys: Say
) -> None:
    before = contents(place)
    assert keys(place, *arguments) == Exit.USAGE
    assert words in capsys.readouterr().err
    assert contents(place) == before


def no_key(place: Path) -> None:
    (place / "authority/ca.key").unlink()


def foreign_key(place: Path) -> None:
    (place / "authority/ca.key").write_bytes((place / "beacon-b1/key.pem").read_bytes())


def swapped(place: Path) -> None:
    (place / "beacon-b1").rename(place / "beacon-b8")


def broken(place: Path) -> None:
    (place / "beacon-b1/certificate.pem").write_text("nonsense")


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        (no_key, "authority's key is needed"),
        (foreign_key, "is not the key of"),
        (swapped, "does not belong in this directory"),
        (broken, "no certificate in PEM form"),
    ],
)
def test_a_directory_that_was_tampered_with_is_told(
    harm: Callable[[Path], None], words: str, place: Path, capsys: Say
) -> None:
    harm(place)
    before = contents(place)
    for wish in (("--beacon", "b3"), ("--renew", "beacon/b2")):
        assert keys(place, *wish) == Exit.USAGE
        assert words in capsys.readouterr().err
        assert contents(place) == before


def test_a_new_site_must_be_named_and_a_stranger_directory_is_left_alone(tmp_path: Path, capsys: Say) -> None:
    assert keys(tmp_path, "--beacon", "b1") == Exit.USAGE
    assert "--site NAME --router HOST" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


SPECIMEN = Path(__file__).parents[2] / "config/secure/router.json5"


def specimen() -> str:
    members = ((Role.ROUTER, "lab"), (Role.BEACON, "b1"), (Role.VEHICLE, "uav1"), (Role.WATCHER, "desk"))
    return router_config(Site("lab", members), 7447)


def test_the_specimen_is_what_is_made() -> None:
    assert SPECIMEN.read_text(encoding="utf-8") == specimen()


def test_the_secure_configuration_goes_together() -> None:
    loaded = load(SPECIMEN.parent / "capture.toml", {})
    assert loaded.config.ranges.tls


# ------------------------------------------------------------------------------- in `companion check`


def rows(tls: Path, uav: str = "u1") -> list[tuple[State, str]]:
    ranges = RangesSettings(connect=("tls/127.0.0.1:7447",), tls=str(tls))
    settings = Settings(ranges=ranges, status=StatusSettings(uav=uav))
    return [(row.state, row.found) for row in judge(settings)]


def test_check_shows_the_certificate_and_warns_of_its_end(place: Path) -> None:
    ((state, found),) = rows(place / "vehicle-u1")
    assert state is State.OK
    assert found.startswith("vehicle/u1, until ")
    assert keys(place, "--renew", "vehicle/u1", "--days", "10") == Exit.OK
    ((state, found),) = rows(place / "vehicle-u1")
    assert state is State.WARN


@pytest.mark.parametrize(
    ("who", "uav", "state", "words"),
    [
        ("vehicle-u1", "uav1", State.WARN, "status.uav = 'uav1'"),
        ("beacon-b1", "u1", State.WARN, "is no vehicle's but beacon/b1"),
        ("gone", "u1", State.FAIL, "ca.pem"),
    ],
)
def test_check_tells_a_certificate_that_is_not_this_vehicles(
    place: Path, who: str, uav: str, state: State, words: str
) -> None:
    assert any(s is state and words in found for s, found in rows(place / who, uav))
