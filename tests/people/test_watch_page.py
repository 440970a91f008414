"""The page of `companion watch --web`: what a person sees of a flight, live, and what a stranger gets."""

from __future__ import annotations

import http.client
import signal
import socket
import time
from collections.abc import Iterator
from urllib.parse import urlsplit

import msgspec
import pytest

from companion.exits import Exit
from companion.types import Phase, Status
from companion.watch import server
from companion.watch.fleet import Fleet
from companion.watch.listen import News
from companion.watch.page import Page
from companion.watch.server import is_ours
from tests.link.test_fly_process import start
from tests.link.test_zenoh_status import until
from tests.people.browser import BOUND_S, Browser
from tests.people.browser import Page as Tab
from tests.people.flights import flight, status
from tests.people.test_watch import S, heard, message

FLIGHT = [s for s in flight() if isinstance(s, Status)]
HOSTILE = '<img src=x onerror="alert(1)"><script>alert(2)</script>'


class Told:
    """A page that is fed by the test instead of by Zenoh."""

    def __init__(self) -> None:
        self.fleet = Fleet()
        self.page = Page("127.0.0.1", 0)
        self.seq = 0
        self.now_s = 0.0

    def hear(self, uav: str, *statuses: Status, session: str = "s1", missing: str = "") -> None:
        news = []
        for s in statuses:
            self.seq += 1
            change = self.fleet.take(heard(uav, message(s, self.seq, session), self.now_s))
            vehicle = self.fleet.get(uav)
            assert vehicle is not None and vehicle.message is not None
            news.append(News(vehicle, vehicle.message, change))
        self.page.show(self.fleet, news, missing, round(self.now_s * S))

    def until(self, tab: Tab, script: str) -> None:
        """Tell again what is told five times a second, until the page shows it."""
        end = time.monotonic() + BOUND_S
        while time.monotonic() < end:
            self.page.show(self.fleet, [], "", round(self.now_s * S))
            if tab.evaluate(f"!!({script})", bool):
                return
            tab.settle()
        raise AssertionError(f"{script} in vain: {tab.evaluate('JSON.stringify(watching())', str)}")


@pytest.fixture
def told() -> Iterator[Told]:
    feeder = Told()
    yield feeder
    feeder.page.close()


INKED = """(id => {
  const canvas = document.getElementById(id);
  const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
  return data.filter((value, i) => i % 4 == 3 && value > 0).length;
})"""
"""How many pixels of a canvas are drawn on."""
PLACE = "(b => [b.x + 90, b.y + 90])(document.getElementById('{}').getBoundingClientRect())"


def test_a_flight_is_seen_live(browser: Browser, told: Told) -> None:
    tab = browser.open(told.page.url)
    told.hear("heron", *FLIGHT[:80:2])
    told.hear(
        "crane", status(2.0, phase=Phase.AWAIT, awaited=(HOSTILE,), reason=HOSTILE, estimate=None, x_m=None)
    )
    told.until(tab, "watching().vehicles.length == 2")
    tab.evaluate("document.querySelector('[data-uav=heron] button').click()", type(None))
    told.until(tab, "watching().chosen == 'heron' && watching().rows == 40 && watching().view")
    assert "approach" in tab.evaluate("document.getElementById('reason').textContent", str)
    tab.settle()
    before = tab.evaluate(f"[{INKED}('plots'), {INKED}('map')]", list[int])
    assert min(before) > 1000
    told.hear("heron", *FLIGHT[80::2])
    told.until(tab, f"watching().rows == {len(FLIGHT[::2])}")
    assert "released" in tab.evaluate("document.getElementById('vehicles').textContent", str)
    tab.settle()
    assert tab.evaluate(f"{INKED}('plots')", int) > before[0]
    x, y = tab.evaluate(PLACE.format("plots"), list[float])
    tab.move(x, y)
    told.until(tab, "watching().hover > 0")
    x, y = tab.evaluate(PLACE.format("map"), list[float])
    scale = tab.evaluate("watching().view.scale", float)
    tab.wheel(x, y, -240.0)
    told.until(tab, f"watching().view.scale > {scale} * 1.2")
    tab.evaluate("document.querySelector('[data-uav=crane] button').click()", type(None))
    told.until(tab, "watching().chosen == 'crane'")
    assert HOSTILE in tab.evaluate("document.getElementById('awaited').textContent", str)
    assert tab.evaluate("document.querySelectorAll('img, main script').length", int) == 0
    told.now_s = 9.0
    told.hear("heron", status(0.5), session="s2")  # started anew: its past is another flight's
    tab.evaluate("document.querySelector('[data-uav=heron] button').click()", type(None))
    told.until(tab, "watching().rows == 1")
    assert tab.errors == []
    assert all(url.startswith(told.page.url) for url in tab.asked)
    tab.close()


def ask(
    page: Page, path: str = "/", host: str | None = None, method: str = "GET"
) -> http.client.HTTPResponse:
    at = urlsplit(page.url)
    connection = http.client.HTTPConnection(at.hostname or "", at.port, timeout=10.0)
    connection.request(method, path, headers={} if host is None else {"Host": host})
    return connection.getresponse()


def test_it_answers_its_own_paths_only_and_gives_no_directory(told: Told) -> None:
    for path in ("/", "/page.js", "/map.js", "/plots.js", "/page.css", "/theme.css", "/?x=1"):
        answer = ask(told.page, path)
        assert answer.status == 200 and answer.read()
        assert "default-src 'none'" in (answer.getheader("Content-Security-Policy") or "")
        assert answer.getheader("Access-Control-Allow-Origin") is None
    for path in ("/page.py", "/../pyproject.toml", "/%2e%2e/fleet.py", "//etc/passwd", "/./", "/favicon.ico"):
        assert ask(told.page, path).status == 404
    for method in ("POST", "PUT", "DELETE", "OPTIONS", "HEAD"):
        assert ask(told.page, method=method).status == 501


OURS = (
    ("127.0.0.1:8080", "127.0.0.1"), ("localhost:8080", "127.0.0.1"), ("LOCALHOST", "127.0.0.1"),
    ("[::1]:8080", "::1"), ("192.168.1.7:8080", "0.0.0.0"), ("ground:80", "ground"),
)  # fmt: skip
NOT_OURS = (
    ("evil.example", "127.0.0.1"), ("evil.example:8080", "0.0.0.0"), ("", "127.0.0.1"), ("[::1", "127.0.0.1"),
    ("127.0.0.1.evil.example", "127.0.0.1"), ("@127.0.0.1:1", "ground"),
)  # fmt: skip


def test_no_other_sites_name_can_be_made_to_point_here() -> None:
    assert all(is_ours(host, bound) for host, bound in OURS)
    assert not any(is_ours(host, bound) for host, bound in NOT_OURS)


def test_a_rebound_name_is_refused(told: Told) -> None:
    for path in ("/", "/events"):
        assert ask(told.page, path, host="evil.example").status == 421


def test_surplus_connections_are_turned_away_and_those_that_end_make_room(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(server, "MOST_CLIENTS", 3)
    told = Told()
    at = urlsplit(told.page.url)
    where = (at.hostname or "", at.port or 0)
    crowd = [socket.create_connection(where, timeout=10.0) for _ in range(server.MOST_CLIENTS)]
    with socket.create_connection(where, timeout=10.0) as late:
        assert late.recv(1) == b""
    for one in crowd:
        one.close()
    until(lambda: is_answered(told.page))
    told.page.close()


def is_answered(page: Page) -> bool:
    try:
        return ask(page).status == 200
    except (http.client.RemoteDisconnected, ConnectionError):
        return False


def test_who_does_not_keep_up_is_cut_off_and_a_new_page_gets_the_past() -> None:
    feeder = Told()
    slow = feeder.page._server.join()
    for s in FLIGHT[:150]:
        feeder.hear("heron", s)
    new = feeder.page._server.join()
    feeder.hear("heron", FLIGHT[150])
    stories = msgspec.json.decode(new.get() or b"")["stories"]
    assert [(story["uav"], story["afresh"], len(story["rows"])) for story in stories] == [
        ("heron", True, 151)
    ]
    held = [slow.get() for _ in range(slow.qsize())]
    assert held.index(None) == server.BACKLOG
    feeder.page.close()


def test_the_command_serves_on_loopback_until_it_is_interrupted() -> None:
    with start("watch", "--zenoh-connect", "tcp/127.0.0.1:1", "--web", "0") as process:
        assert process.stdout is not None
        url = process.stdout.readline().split()[2]
        at = urlsplit(url)
        assert at.hostname == "127.0.0.1"
        connection = http.client.HTTPConnection("127.0.0.1", at.port, timeout=20.0)
        connection.request("GET", "/events")
        first = connection.getresponse().readline()
        assert b"nobody answers" in first
        process.send_signal(signal.SIGINT)
        assert process.wait(20.0) == Exit.OK
