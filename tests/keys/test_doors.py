"""Closed doors, tried over real sockets: who gets in at the router, and what they may do there."""

from __future__ import annotations

import itertools
import json
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest
import zenoh

from companion.keys import certificates, site
from companion.keys.certificates import Role
from companion.link import credentials
from companion.link.credentials import AUTHORITY, CERTIFICATE, KEY, CredentialsError
from companion.link.zenoh_publish import PublishLink
from companion.link.zenoh_ranges import RangeLink
from companion.link.zenoh_session import zenoh_config
from companion.network_settings import RangesSettings
from companion.range_message import RangeMessage
from companion.types import BeaconTold, Event, RangeSample
from tests.keys.site import BOUND_S, NOW, free_port, make, router


class Door(NamedTuple):
    directory: Path
    port: int

    def settings(self, who: str) -> RangesSettings:
        return RangesSettings(connect=(f"tls/127.0.0.1:{self.port}",), tls=str(self.directory / who))


@pytest.fixture(scope="module")
def door(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Door]:
    directory, port = tmp_path_factory.mktemp("site"), free_port()
    make(directory, port)
    with router(directory):
        yield Door(directory, port)


@pytest.fixture
def opened() -> Iterator[Callable[[RangesSettings], Any]]:
    sessions: list[Any] = []

    def opened(settings: RangesSettings) -> Any:
        sessions.append(zenoh.open(zenoh_config(settings)))
        return sessions[-1]

    yield opened
    for session in sessions:
        session.close()


Open = Callable[[RangesSettings], Any]


def until(condition: Callable[[], object]) -> None:
    end = time.monotonic() + BOUND_S
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


class Ear:
    """Everything that the watcher hears."""

    def __init__(self, session: Any) -> None:
        self.keys: list[str] = []
        for key in ("uwb/v1/lab/**", "uav/v1/**"):
            session.declare_subscriber(key, self._note)

    def _note(self, sample: zenoh.Sample) -> None:
        self.keys.append(str(sample.key_expr))

    def hears(self, put: Callable[[], None], key: str) -> None:
        """Put it again and again until it has arrived."""

        def arrived() -> bool:
            put()
            return key in self.keys

        until(arrived)


def test_a_beacons_ranges_reach_the_vehicle_through_the_router(door: Door) -> None:
    """The links of the app themselves, at both ends."""
    publisher = PublishLink(door.settings("beacon-b1"))
    vehicle = RangeLink(door.settings("vehicle-u1"), lambda: None, ["b1"])
    try:
        publisher.announce("b1", b'{"height_m": 1.5}')
        events: list[Event] = []
        seq = itertools.count()

        def both_came() -> bool:
            publisher.put("b1", "t1", RangeMessage("s", next(seq), 4.25))
            events.extend(vehicle.receive())
            return {type(event) for event in events} >= {RangeSample, BeaconTold}

        until(both_came)
        assert publisher.is_heard()
        assert {e.range_m for e in events if isinstance(e, RangeSample)} == {4.25}
        assert {e.height_m for e in events if isinstance(e, BeaconTold)} == {1.5}
    finally:
        publisher.close()
        vehicle.close()


def test_each_may_write_what_is_its_own_and_nothing_else(door: Door, opened: Open) -> None:
    ear = Ear(opened(door.settings("watcher-desk")))
    attempts = {
        "watcher-desk": ["uwb/v1/lab/b1/t1/range", "uav/v1/u1/status"],
        "beacon-b1": ["uwb/v1/lab/b2/t1/range", "uwb/v1/lab/*/t1/range", "uwb/v1/else/b1/t1/range", "x/y"],
        "tag-t1": ["uwb/v1/lab/b1/t2/range", "uwb/v1/lab/b1/info"],
        "vehicle-u1": ["uwb/v1/lab/b1/t1/range", "uav/v1/u2/status", "uav/v1/u1/other"],
    }
    own = {
        "beacon-b1": "uwb/v1/lab/b1/t9/range",
        "tag-t1": "uwb/v1/lab/b2/t1/range",
        "vehicle-u1": "uav/v1/u1/status",
    }
    for who, keys in attempts.items():
        session = opened(door.settings(who))
        for key in keys:
            session.put(key, b"forged", congestion_control=zenoh.CongestionControl.BLOCK)
        if who in own:  # it comes after the others on the same connection
            ear.hears(partial(session.put, own[who], b"mine"), own[who])
        else:
            list(session.get("uwb/v1/lab/b1/info", timeout=5.0))
    assert set(ear.keys) == set(own.values())


def test_nobody_answers_or_stands_in_for_a_beacon_but_itself(door: Door, opened: Open) -> None:
    watcher, b1, b2 = (opened(door.settings(who)) for who in ("watcher-desk", "beacon-b1", "beacon-b2"))
    key = "uwb/v1/lab/b1/info"
    kept = [
        b2.declare_queryable(key, lambda query: query.reply(key, b"forged"), complete=True),
        b2.liveliness().declare_token("uwb/v1/lab/b3/alive"),
        b1.declare_queryable(key, lambda query: query.reply(key, b"mine"), complete=True),
        b1.liveliness().declare_token("uwb/v1/lab/b1/alive"),
        b2.liveliness().declare_token("uwb/v1/lab/b2/alive"),  # after the forged ones
    ]

    def answers() -> set[bytes]:
        return {r.ok.payload.to_bytes() for r in watcher.get("uwb/v1/lab/*/info", timeout=5.0) if r.ok}

    def alive() -> set[str]:
        return {str(r.ok.key_expr) for r in watcher.liveliness().get("uwb/v1/lab/*/alive") if r.ok}

    found: set[str] = set()
    heard: set[bytes] = set()

    def all_came() -> bool:
        found.update(alive())
        heard.update(answers())
        return found >= {"uwb/v1/lab/b1/alive", "uwb/v1/lab/b2/alive"} and bool(heard)

    until(all_came)
    assert found == {"uwb/v1/lab/b1/alive", "uwb/v1/lab/b2/alive"}
    assert heard == {b"mine"}
    assert len(kept) == 5


def test_a_beacon_may_not_listen_to_the_others(door: Door, opened: Open) -> None:
    heard: list[str] = []
    listener, b1 = opened(door.settings("beacon-b2")), opened(door.settings("beacon-b1"))
    listener.declare_subscriber("uwb/v1/lab/**", lambda sample: heard.append(str(sample.key_expr)))
    ear = Ear(opened(door.settings("watcher-desk")))
    ear.hears(partial(b1.put, "uwb/v1/lab/b1/t1/range", b""), "uwb/v1/lab/b1/t1/range")
    assert not heard


def write(place: Path, identity: certificates.Identity, authority: bytes) -> Path:
    place.mkdir()
    (place / AUTHORITY).write_bytes(authority)
    (place / CERTIFICATE).write_bytes(identity.certificate_pem())
    (place / KEY).write_bytes(identity.key_pem())
    (place / KEY).chmod(0o600)
    return place


def of_another_site(door: Door, place: Path) -> Path:
    """It calls itself b1 and trusts our router, but another authority made it."""
    other = certificates.issue(certificates.authority("lab", NOW, 10), Role.BEACON, "b1", NOW, 5)
    return write(place, other, (door.directory / "router" / AUTHORITY).read_bytes())


def expired(door: Door, place: Path) -> Path:
    ca = site.authority_of(door.directory)
    gone = certificates.issue(ca, Role.BEACON, "b1", NOW - timedelta(days=20), 10)
    return write(place, gone, ca.certificate_pem())


def another_key(door: Door, place: Path) -> Path:
    """A certificate that was overheard, and no key to it."""
    shutil.copytree(door.directory / "beacon-b1", place)
    shutil.copy(door.directory / "beacon-b2" / KEY, place / KEY)
    return place


REFUSED = [of_another_site, expired, another_key]


@pytest.mark.parametrize("made", REFUSED, ids=lambda made: made.__name__)
def test_the_router_lets_nobody_in_whose_certificate_is_not_good(
    made: Callable[[Door, Path], Path], door: Door, tmp_path: Path
) -> None:
    """Zenoh itself is asked, past our own look at the files."""
    place = made(door, tmp_path / "who")
    files = credentials.Credentials(place / AUTHORITY, place / CERTIFICATE, place / KEY, "", NOW)
    refused(door, credentials.tls_config(files))


def test_the_router_lets_nobody_in_who_shows_no_certificate(door: Door) -> None:
    authority = str(door.directory / "router" / AUTHORITY)
    refused(door, {"root_ca_certificate": authority, "enable_mtls": False})


def test_the_router_does_not_speak_in_the_clear(door: Door) -> None:
    with pytest.raises(zenoh.ZError):
        zenoh.open(zenoh_config(RangesSettings(connect=(f"tcp/127.0.0.1:{door.port}",))))


def refused(door: Door, tls: dict[str, object]) -> None:
    """As a client, which fails to open; and as a peer, which opens without a word and is not connected."""
    config = zenoh_config(RangesSettings(connect=(f"tcp/127.0.0.1:{door.port}",)))
    config.insert_json5("connect/endpoints", json.dumps([f"tls/127.0.0.1:{door.port}"]))
    config.insert_json5("transport/link/tls", json.dumps(tls))
    with pytest.raises(zenoh.ZError):
        zenoh.open(config)
    config.insert_json5("mode", '"peer"')
    session = zenoh.open(config)
    assert not session.info.routers_zid()
    session.close()  # type: ignore[no-untyped-call]


def test_a_router_that_is_not_the_sites_is_not_believed(door: Door, tmp_path: Path) -> None:
    """Somebody listens at the router's address with a certificate of another authority."""
    port = free_port()
    make(tmp_path / "other", port)
    with router(tmp_path / "other"):
        link = RangeLink(door._replace(port=port).settings("vehicle-u1"), lambda: None)
        until(lambda: link.reason)
        assert not link.connected()
        assert "accept" in link.reason
        link.close()


def test_a_router_at_another_address_than_its_certificate_names_is_not_believed(door: Door) -> None:
    settings = RangesSettings(connect=(f"tls/127.0.0.2:{door.port}",), tls=str(door.directory / "vehicle-u1"))
    with pytest.raises(zenoh.ZError):
        zenoh.open(zenoh_config(settings))


def test_a_certificate_without_a_rule_connects_and_can_do_nothing(
    door: Door, opened: Open, tmp_path: Path
) -> None:
    """The router was not started again after somebody was added: this is silent in Zenoh."""
    ca = site.authority_of(door.directory)
    place = write(tmp_path / "who", certificates.issue(ca, Role.BEACON, "b9", NOW, 5), ca.certificate_pem())
    stranger = opened(door.settings(str(place)))
    ear, b1 = Ear(opened(door.settings("watcher-desk"))), opened(door.settings("beacon-b1"))
    stranger.put("uwb/v1/lab/b9/t1/range", b"", congestion_control=zenoh.CongestionControl.BLOCK)
    list(stranger.get("uwb/v1/lab/b1/info", timeout=5.0))
    link = PublishLink(door.settings(str(place)))
    until(link.connected)
    link.put("b9", "t1", RangeMessage("s", 0, 4.25))
    ear.hears(partial(b1.put, "uwb/v1/lab/b1/t1/range", b""), "uwb/v1/lab/b1/t1/range")
    assert not link.is_heard()
    link.close()
    assert stranger.info.routers_zid()
    assert set(ear.keys) == {"uwb/v1/lab/b1/t1/range"}


def test_a_certificate_that_expires_ends_the_connection_that_it_opened(
    door: Door, opened: Open, tmp_path: Path
) -> None:
    ca = site.authority_of(door.directory)
    for lasts_s in (3, 15):  # a loaded machine may not open a session within three seconds
        made = datetime.now(UTC) - timedelta(days=1) + timedelta(seconds=lasts_s)
        soon = certificates.issue(ca, Role.BEACON, "b1", made, 1)
        place = write(tmp_path / f"{lasts_s} s", soon, ca.certificate_pem())
        with suppress(zenoh.ZError, CredentialsError):
            session = opened(door.settings(str(place)))
            if session.info.routers_zid():
                break
    else:
        pytest.fail("no session within fifteen seconds")
    until(lambda: not session.info.routers_zid())
    with pytest.raises(CredentialsError, match="expired"):
        zenoh_config(door.settings(str(place)))


def test_routers_of_a_site_hand_on_to_each_other_what_they_let_in(door: Door, opened: Open) -> None:
    """A second router with a copy of the first one's directory, connected to it."""
    place, port = door.directory / "router", free_port()
    text = (place / "zenoh.json5").read_text().replace(str(door.port), str(port))
    there = f'connect: {{ endpoints: ["tls/127.0.0.1:{door.port}"] }},'
    (place / "second.json5").write_text(text.replace('mode: "router",', f'mode: "router", {there}'))
    with router(door.directory, "second.json5"):
        ear = Ear(opened(door._replace(port=port).settings("watcher-desk")))
        b1 = opened(door.settings("beacon-b1"))

        def put() -> None:
            b1.put("uwb/v1/lab/b2/t1/range", b"forged")
            b1.put("uwb/v1/lab/b1/t1/range", b"mine")

        ear.hears(put, "uwb/v1/lab/b1/t1/range")
        assert set(ear.keys) == {"uwb/v1/lab/b1/t1/range"}


def test_a_vehicle_that_names_two_routers_flies_with_one_of_them_dead(door: Door) -> None:
    first = door.settings("vehicle-u1")
    both = msgspec.structs.replace(first, connect=(f"tls/127.0.0.1:{free_port()}", *first.connect))
    vehicle, publisher = RangeLink(both, lambda: None, ["b1"]), PublishLink(door.settings("beacon-b1"))

    def heard() -> bool:
        publisher.put("b1", "t1", RangeMessage("s", 0, 4.25))
        return any(isinstance(event, RangeSample) for event in vehicle.receive())

    until(heard)
    vehicle.close()
    publisher.close()


# ------------------------------------------------------------------------- our own look at the files


def test_good_files_say_who_we_are(door: Door) -> None:
    found = credentials.read(door.directory / "vehicle-u1")
    assert found.name == "vehicle/u1"
    assert timedelta(days=363) < found.until - NOW < timedelta(days=366)


@pytest.mark.parametrize(
    ("made", "words"), list(zip(REFUSED, ["authority", "expired", "do not belong together"], strict=True))
)
def test_bad_files_stop_the_start_in_words(
    made: Callable[[Door, Path], Path], words: str, door: Door, tmp_path: Path
) -> None:
    place = made(door, tmp_path / "who")
    with pytest.raises(CredentialsError, match=words):
        RangeLink(door.settings(str(place)), lambda: None)


@pytest.mark.parametrize("file", [AUTHORITY, CERTIFICATE, KEY])
@pytest.mark.parametrize("content", [None, b"", b"nonsense"])
def test_a_file_that_is_missing_or_nonsense_is_named(
    file: str, content: bytes | None, door: Door, tmp_path: Path
) -> None:
    place = Path(shutil.copytree(door.directory / "beacon-b1", tmp_path / "who"))
    (place / file).unlink()
    if content is not None:
        (place / file).write_bytes(content)
        (place / file).chmod(0o600)
    with pytest.raises(CredentialsError, match=file):
        credentials.read(place)


def test_a_private_key_that_others_can_read_is_refused(door: Door, tmp_path: Path) -> None:
    place = Path(shutil.copytree(door.directory / "beacon-b1", tmp_path / "who"))
    (place / KEY).chmod(0o640)
    with pytest.raises(CredentialsError, match="chmod 600"):
        credentials.read(place)


@pytest.mark.parametrize(
    ("ranges", "words"),
    [
        (RangesSettings(connect=("tls/h:1",)), "needs ranges.tls"),
        (RangesSettings(connect=("tcp/h:1",), tls="d"), "write tls/h:1"),
        (RangesSettings(connect=("tls/h:1", "udp/h:1"), tls="d"), "udp/h:1"),
        (RangesSettings(listen=("tls/h:1",), tls="d"), "only a router"),
        (RangesSettings(connect=("tls/h:1",), tls="d", multicast_scouting=True), "no router guards"),
    ],
)
def test_endpoints_that_leave_a_door_open_are_refused(ranges: RangesSettings, words: str) -> None:
    with pytest.raises(CredentialsError, match=words):
        zenoh_config(ranges)
