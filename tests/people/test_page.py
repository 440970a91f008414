"""The report's page in a real browser: it is drawn, follows the mouse, zooms, and asks no network."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from companion.flight_writer import FlightWriter
from companion.picture import Truth
from companion.recording import Recording, read
from companion.report import page as pages
from companion.report.flight import Figures
from companion.types import Phase, RangeSample, RangeVerdict, Setpoint, Status, Tick, Verdict
from tests.people.browser import Browser, Page
from tests.people.flights import status
from tests.record.flights import flown, in_file, start

EVIL = "<img src=x onerror=alert(1)>"
TRUTH = Truth([(1.0, 3.0), (3.5, 5.0)], (3.5, 5.0))


class Seen(NamedTuple):
    """A page that was opened, with what it was made of."""

    page: Page
    recording: Recording
    figures: Figures


@pytest.fixture(scope="module")
def seen(browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Seen]:
    """A capture with a clock, and one range of a beacon whose id is markup."""
    path = tmp_path_factory.mktemp("page") / "flight.mcap"
    items = flown()
    middle = next(i for i, item in enumerate(items) if isinstance(item, RangeSample) and i > 500)
    t_ns = items[middle].t_ns
    items[middle:middle] = [
        RangeSample(t_ns=t_ns, beacon=EVIL, session="s", seq=1, range_m=2.0),
        RangeVerdict(t_ns=t_ns, beacon=EVIL, seq=1, verdict=Verdict.UNKNOWN_BEACON),
    ]
    with path.open("wb") as stream:
        writer = FlightWriter(stream, start())
        for number, item in enumerate(items):
            writer.add(number, item, item.t_ns + 700_000 * isinstance(item, Setpoint))
        writer.finish()
    recording = read(path)
    told = pages.write(path.with_suffix(".html"), recording, TRUTH)
    page = browser.open(path.with_suffix(".html").as_uri(), width=1400, height=1000)
    page.wait_for("document.documentElement.dataset.drawn === 'yes'")
    yield Seen(page, recording, told.figures)
    page.close()


def box(page: Page, of: str) -> tuple[float, float, float, float]:
    """Left, top, width, height in the window."""
    script = (
        f"(() => {{ const r = document.querySelector('{of}').getBoundingClientRect();"
        " return [r.x, r.y, r.width, r.height] })()"
    )
    return page.evaluate(script, tuple[float, float, float, float])


def text(page: Page, of: str) -> str:
    return page.evaluate(f"document.querySelector('{of}').textContent", str)


def time_window(page: Page) -> tuple[float, float]:
    return page.evaluate("plots._fullLayout.xaxis.range", tuple[float, float])


def pixels_per_metre(page: Page) -> tuple[float, float]:
    axes = "[map._fullLayout.xaxis, map._fullLayout.yaxis]"
    script = f"{axes}.map(a => Math.abs(a._length / (a.range[1] - a.range[0])))"
    return page.evaluate(script, tuple[float, float])


def test_it_loads_without_a_complaint_and_asks_nothing_of_the_network(seen: Seen) -> None:
    assert seen.page.errors == []
    assert len(seen.page.asked) == 1, "only itself"
    assert text(seen.page, "h1") == seen.figures.headline


def test_the_map_is_drawn_to_scale_with_all_that_was_flown(seen: Seen) -> None:
    key = text(seen.page, "#key")
    for name in (
        "acquire",
        "approach",
        "hold",
        "shortest path",
        "capture radius",
        "true target",
        "estimate over time",
    ):
        assert name in key
    x, y = pixels_per_metre(seen.page)
    assert x == pytest.approx(y, rel=1e-3) and x > 20.0, "equal axes, and no empty plain"
    drawn = seen.page.evaluate("document.querySelectorAll('#map .scatterlayer path.js-line').length", int)
    assert drawn >= 6
    flown_x = [
        o.x_m
        for s in seen.recording.steps
        for o in s.outputs
        if isinstance(o, Status) and o.phase is Phase.APPROACH
    ]
    on_map = seen.page.evaluate("map.data.find(t => t.name === 'approach').x", list[float])
    assert on_map[1:] == pytest.approx(flown_x, abs=1e-3), "from where the run before ended"


def test_the_plots_share_their_time_and_show_the_phases(seen: Seen) -> None:
    page = seen.page
    titles = page.evaluate(
        "[...document.querySelectorAll('#plots .annotation-text')].map(t => t.textContent)", list[str]
    )
    for row in ("distances", "bearing", "forward speed", "yaw rate", "height", "latency"):
        assert any(title.startswith(row) for title in titles), row
    bands = page.evaluate("document.querySelectorAll('#plots .shapelayer path').length", int)
    assert bands == 1 + sum(p.phase.is_engaged for p in seen.figures.phases)
    names = page.evaluate(
        "[...document.querySelectorAll('#plots .bartext')].map(t => t.textContent)", list[str]
    )
    assert {"acquire", "approach", "hold"} <= set(names)
    assert page.evaluate("new Set(plots.data.map(t => t.xaxis ?? 'x')).size", int) == 1
    marks = page.evaluate("document.querySelectorAll('#plots .scatterlayer path.point').length", int)
    assert marks > sum(b.ranges for b in seen.figures.beacons), "ranges, and their latencies"
    assert text(seen.page, ".tiles").count("range → setpoint, p950.70 ms") == 1


def test_pointing_at_a_plot_moves_the_cursor_and_the_vehicle_on_the_map(seen: Seen) -> None:
    page = seen.page
    left, top, width, height = box(page, "#plots .nsewdrag[data-subplot=xy2]")
    places = []
    for share in (0.3, 0.6):
        page.move(left + share * width - 3.0, top + 0.5 * height)
        page.move(left + share * width, top + 0.5 * height)
        begin, end = time_window(page)
        t_s = begin + share * (end - begin)
        page.wait_for(
            f"Math.abs(cursor - {t_s}) < 0.1 && now.textContent.includes('time' + cursor.toFixed(2))"
        )
        page.wait_for("document.querySelector('#plots .hoverlayer').textContent.includes('distance')")
        page.settle()
        at, *_ = box(page, "#cursor")
        assert at == pytest.approx(left + share * width, abs=3.0)
        places.append(page.evaluate("[map.data.at(-1).x[0], map.data.at(-1).y[0]]", tuple[float, float]))
        statuses = [o for s in seen.recording.steps for o in s.outputs if isinstance(o, Status)]
        engaged_ns = next(o.t_ns for o in statuses if o.phase.is_engaged)
        there = min(statuses, key=lambda o: abs((o.t_ns - engaged_ns) * 1e-9 - t_s))
        assert places[-1] == pytest.approx((there.x_m, there.y_m), abs=0.1)
    assert places[0] != places[1]


def test_dragging_zooms_in_time_and_a_button_brings_the_flight_back(seen: Seen) -> None:
    page = seen.page
    left, top, width, height = box(page, "#plots .nsewdrag[data-subplot=xy2]")
    before = time_window(page)
    page.drag((left + 0.25 * width, top + 0.5 * height), (left + 0.75 * width, top + 0.5 * height))
    page.wait_for(f"plots._fullLayout.xaxis.range[0] > {before[0]} + 0.1")
    begin, end = time_window(page)
    assert end - begin == pytest.approx(0.5 * (before[1] - before[0]), rel=0.05)
    x, y, w, h = box(page, "#zoom-flight")
    page.click(x + w / 2, y + h / 2)
    page.wait_for(f"Math.abs(plots._fullLayout.xaxis.range[0] - {before[0]}) < 1e-6")
    assert time_window(page) == pytest.approx(before)


def test_the_wheel_zooms_the_map_to_scale(seen: Seen) -> None:
    page = seen.page
    left, top, width, height = box(page, "#map .nsewdrag")
    before = pixels_per_metre(page)
    page.wheel(left + 0.5 * width, top + 0.5 * height, -200.0)
    metres = "(map._fullLayout.xaxis.range[1] - map._fullLayout.xaxis.range[0])"
    page.wait_for(f"map._fullLayout.xaxis._length / {metres} > {1.05 * before[0]}")
    x, y = pixels_per_metre(page)
    assert x == pytest.approx(y, rel=1e-3)


def test_what_was_heard_is_text_and_nothing_else(seen: Seen) -> None:
    assert EVIL in text(seen.page, ".tables")
    assert seen.page.evaluate("document.querySelectorAll('img').length", int) == 0


def test_it_fits_a_small_window(seen: Seen) -> None:
    seen.page.resize(420, 800)
    seen.page.settle()
    seen.page.wait_for("document.documentElement.scrollWidth <= 420 && plots._fullLayout.width < 420")
    seen.page.wait_for("map._fullLayout.width < 420")
    x, y = pixels_per_metre(seen.page)
    assert x == pytest.approx(y, rel=1e-3)
    assert seen.page.errors == []


def test_a_flight_without_position_and_ranges_says_so(browser: Browser, tmp_path: Path) -> None:
    blind = status(0.0, phase=Phase.AWAIT, x_m=None, y_m=None, heading_rad=None, estimate=None, range_m=None)
    recording = read(in_file(tmp_path / "f.mcap", [Tick(t_ns=0), blind]))
    pages.write(tmp_path / "f.html", recording)
    page = browser.open((tmp_path / "f.html").as_uri())
    page.wait_for("document.documentElement.dataset.drawn === 'yes'")
    assert "No map: the autopilot told no position." in text(page, ".where")
    assert "no ranges were heard" in text(page, "#plots") and "no estimate" in text(page, "#plots")
    assert page.errors == []
    page.close()
