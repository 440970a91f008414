"""The report of a recorded flight: right figures, bounded size, and no file too odd to be told."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.cli import main
from companion.exits import Exit
from companion.flight_writer import FlightWriter
from companion.recording import Step, read
from companion.report import flight, page, series
from companion.report.flight import Figures
from companion.report.thin import LINE_POINTS, MARKS, line, peaks
from companion.summary import FlightReport
from companion.types import (
    Attitude,
    Defect,
    Event,
    FlightMode,
    LocalMotion,
    Malformed,
    Output,
    Phase,
    PhaseChange,
    RangeSample,
    RangeVerdict,
    Setpoint,
    Severity,
    Tick,
    Verdict,
)
from tests.people.flights import status
from tests.record.flights import Item, as_bytes, flown, in_file, start


@cache
def items() -> tuple[Item, ...]:
    return tuple(flown())


def figures(path: Path, of: Sequence[Item]) -> Figures:
    return flight.of(read(in_file(path / "f.mcap", of))).figures


# -------------------------------------------------------------------------------------------- figures


def test_a_capture_is_told_in_figures(tmp_path: Path) -> None:
    f = figures(tmp_path, items())
    assert f.summary.captured and f.headline.startswith("Target captured after ")
    assert f.headline.endswith(f"{f.summary.path_ratio:.2f} × the shortest path")
    verdicts = [o.verdict.value for o in items() if isinstance(o, RangeVerdict)]
    (beacon,) = f.beacons
    assert beacon.beacon == "b1" and beacon.ranges == len(verdicts)
    assert beacon.verdicts == {v: verdicts.count(v) for v in set(verdicts)}
    assert beacon.rate_hz == pytest.approx(18.0, abs=2.0)  # 20 Hz less a tenth
    assert [p.phase for p in f.phases][:3] == [Phase.STANDBY, Phase.ACQUIRE, Phase.APPROACH]
    assert f.settings == {"guidance.speed_m_s": ("0.5", "a test")}
    assert not f.problems


def test_the_story_tells_what_happened_in_order(tmp_path: Path) -> None:
    spoilt = [Malformed(t_ns=items()[-1].t_ns, defect=Defect.RANGE_PAYLOAD)] * 3
    warned = status(1e6, warnings=("two publishers of b1",))
    f = figures(tmp_path, [*items(), *spoilt, warned])
    changes = [o for o in items() if isinstance(o, PhaseChange)]
    told = [h.text for h in f.story]
    assert [t for t in told if " → " in t] == [
        f"{c.before.value} → {c.after.value}: {c.reason}" for c in changes
    ]
    assert "mode OFFBOARD" in told and "armed" in told
    assert "unreadable range × 3, for the first time" in told and "two publishers of b1" in told
    assert [h.t_s for h in f.story] == sorted(h.t_s for h in f.story)
    engaged = next(h for h in f.story if h.text.startswith("standby → acquire"))
    assert engaged.t_s == pytest.approx(0.0, abs=1e-6)


def test_the_latency_is_from_the_ranges_arrival_to_the_setpoint_handed_over(tmp_path: Path) -> None:
    """Ranges 50 ms apart, answered after 1, 2, … ms; each tenth is refused and has no answer. Nor has the
    first: when it came no setpoints were streamed, so that the next one is no answer to it.
    """
    path, numbered = tmp_path / "f.mcap", []
    for i in range(100):
        t_ns = i * 50_000_000
        verdict = Verdict.OUTLIER if i % 10 == 5 else Verdict.ACCEPTED
        told: list[Item] = [
            RangeSample(
                t_ns=t_ns, beacon="b1", session="s", seq=i, range_m=5.0, sent_t_ns=t_ns - i % 3 * 1_000_000
            ),
            RangeVerdict(t_ns=t_ns, beacon="b1", seq=i, verdict=verdict),
            Setpoint(t_ns, 0.5, 0.0, 0.0, 3.0, 0.0),
        ]
        numbered += [(item, t_ns + (i + 1) * 1_000_000) for item in told]
    with path.open("wb") as stream:
        writer = FlightWriter(stream, start())
        for number, (item, noted_ns) in enumerate(numbered):
            writer.add(number, item, noted_ns)
        writer.finish()
    f = flight.of(read(path)).figures
    assert f.setpoint_latency is not None and f.setpoint_latency.count == 89
    assert f.setpoint_latency.longest_s == pytest.approx(0.100)
    assert f.setpoint_latency.median_s == pytest.approx(0.050, abs=0.002)
    assert f.transport is not None and f.transport.longest_s == pytest.approx(2e-3, abs=1e-6)


def test_a_simulation_has_no_latency(tmp_path: Path) -> None:
    assert figures(tmp_path, items()).setpoint_latency is None


@pytest.mark.parametrize(
    ("outputs", "headline"),
    [
        ([], "The record ends before anything was decided"),
        ([status(0.0, phase=Phase.AWAIT, estimate=None, engaged_s=0.0, reason="waited long enough")],
         "Never engaged: waited long enough"),
        ([PhaseChange(0, Phase.STANDBY, Phase.ACQUIRE, "OFFBOARD selected", Severity.NOTICE),
          status(-7000.0), status(-6990.0, path_m=9.2)],
         "The record ends in mid-flight (approach) after 10.0 s and 5.00 m, 5.3 m from the target"),
        ([PhaseChange(0, Phase.STANDBY, Phase.ACQUIRE, "OFFBOARD selected", Severity.NOTICE),
          status(-7000.0),
          PhaseChange(8_000_000_000, Phase.STALL, Phase.HAND_OVER, "no ranges for too long",
                      Severity.CRITICAL),
          PhaseChange(9_000_000_000, Phase.HAND_OVER, Phase.RELEASED, "the vehicle left OFFBOARD",
                      Severity.WARNING),
          status(-6991.0, phase=Phase.RELEASED, path_m=9.2)],
         "Target not captured: no ranges for too long after 9.0 s and 5.00 m, 5.3 m from the target"),
    ],
)  # fmt: skip
def test_the_headline_says_what_happened(tmp_path: Path, outputs: list[Item], headline: str) -> None:
    assert figures(tmp_path, [Tick(t_ns=0), *outputs]).headline == headline


def test_an_empty_record_is_told_too(tmp_path: Path) -> None:
    told = page.write(tmp_path / "f.html", read(in_file(tmp_path / "f.mcap", [])))
    assert told.figures.headline == "The record is empty"
    assert "The record is empty" in (tmp_path / "f.html").read_text(encoding="utf-8")


# ----------------------------------------------------------------------------------------------- size

POINTS = st.lists(st.tuples(st.floats(0.0, 0.2), st.floats(-10.0, 10.0)), max_size=400)


@given(POINTS, st.integers(20, 100))
def test_a_thinned_line_keeps_its_extremes_and_its_gaps(steps: list[tuple[float, float]], limit: int) -> None:
    points, t_s = [], 0.0
    for dt_s, value in steps:
        t_s += dt_s
        points.append((t_s, value))
    times, values = line(points, gap_s=1.0, limit=limit)
    assert times == sorted(times) and None not in values
    assert len(times) <= max(limit + 4, min(len(points), limit))
    if points:
        known = [v for v in values if v is not None]
        assert max(known) == pytest.approx(max(v for _, v in points), abs=1e-4)
        assert min(known) == pytest.approx(min(v for _, v in points), abs=1e-4)
    assert max((v for _, v in peaks(points, 10)), default=0.0) == max((v for _, v in points), default=0.0)
    assert len(peaks(points, 10)) <= 10


def test_a_line_is_broken_where_nothing_came() -> None:
    assert line([(0.0, 1.0), (0.1, 2.0), (5.0, 3.0)], gap_s=0.5) == (
        [0.0, 0.1, 0.1, 5.0], [1.0, 2.0, None, 3.0]
    )  # fmt: skip


def test_the_page_of_a_long_flight_stays_small(tmp_path: Path) -> None:
    """Twenty minutes: statuses and telemetry at 10 Hz, ranges and setpoints at 20 Hz."""
    steps: list[Step] = []

    def add(event: Event, *outputs: Output) -> None:
        slots = tuple(range(len(outputs)))
        steps.append(Step(len(steps), event, outputs, slots, 0, (0.0,) * len(outputs)))

    for i in range(24_000):
        t_ns = i * 50_000_000
        fate = Verdict.OUTLIER if i % 20 == 0 else Verdict.ACCEPTED
        add(
            RangeSample(t_ns=t_ns, beacon="b1", session="s", seq=i, range_m=300.0 - 0.01 * i),
            RangeVerdict(t_ns=t_ns, beacon="b1", seq=i, verdict=fate),
            Setpoint(t_ns, 0.5, math.sin(0.01 * i), 0.0, 3.0, 0.0),
        )
        if i % 2:
            add(Attitude(t_ns=t_ns, heading_rad=0.0, yaw_rate_rad_s=0.001 * i))
            add(LocalMotion(t_ns, 0.0, 0.0, 3.0, 0.5, 0.0, 0.0))
            add(Tick(t_ns=t_ns), msgspec.structs.replace(status(), t_ns=t_ns, x_m=0.01 * i))
    recording = read(in_file(tmp_path / "f.mcap", []))._replace(steps=tuple(steps))
    told = flight.of(recording)
    drawn = series.of(recording, told)
    assert len(drawn.rows.t) <= LINE_POINTS + 1 and len(drawn.yaw_asked[0]) <= LINE_POINTS + 4
    assert sum(len(m.t) for m in drawn.ranges) <= 2 * MARKS
    assert drawn.thinned and told.figures.beacons[0].ranges == 24_000
    assert len(page.html(told, drawn, "")) < 1_200_000  # without Plotly


# -------------------------------------------------------------------------------------------- command


def report(*words: object) -> int:
    return main(["report", *map(str, words)])


def test_the_command_writes_page_and_picture_and_says_where(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[tuple[Path, FlightReport, str]] = []

    def draw(path: Path, told: FlightReport, *, title: str) -> None:
        drawn.append((path, told, title))

    monkeypatch.setattr("companion.picture.draw_flight", draw)
    path = in_file(tmp_path / "f.mcap", items())
    assert report(path, "--png", tmp_path / "f.png") == Exit.OK
    out = capsys.readouterr().out
    assert "Target captured after" in out
    assert f"page: {tmp_path / 'f.html'}" in out and f"picture: {tmp_path / 'f.png'}" in out
    text = (tmp_path / "f.html").read_text(encoding="utf-8")
    assert 'http-equiv="Content-Security-Policy" content="default-src \'none\';' in text
    ((where, told, title),) = drawn
    assert where == tmp_path / "f.png" and told.summary.captured and title.startswith("Target captured")


def test_the_figures_as_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert report(in_file(tmp_path / "f.mcap", items()), "-o", tmp_path, "--json") == Exit.OK
    told = json.loads(capsys.readouterr().out)
    assert told["summary"]["captured"] is True and told["beacons"][0]["beacon"] == "b1"
    assert (tmp_path / "f.html").exists()


def test_a_cut_record_is_told_in_a_line_and_the_rest_is_shown(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = as_bytes(enumerate(items()[:800]), start(), finish=False)
    (tmp_path / "f.mcap").write_bytes(data[:-100] + as_bytes([], start()))
    path = tmp_path / "cut.mcap"
    path.write_bytes(data + b"\x06 and no more")
    assert report(path) == Exit.OK
    out = capsys.readouterr().out
    assert "record: the end is missing: it stops at byte" in out and "The record ends in mid-flight" in out
    assert "this is what could be read" in path.with_suffix(".html").read_text(encoding="utf-8")


@pytest.mark.parametrize(
    ("data", "problem"),
    [(None, "No such file"), (b"", "the file is empty"), (b"PK\x03\x04 a zip", "not an MCAP file")],
)
def test_no_flight_is_told_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], data: bytes | None, problem: str
) -> None:
    path = tmp_path / "f.mcap"
    if data is not None:
        path.write_bytes(data)
    assert report(path) == Exit.USAGE
    err = capsys.readouterr().err
    assert problem in err and err.count("\n") == 1
    assert not path.with_suffix(".html").exists()


def test_a_folder_is_no_flight(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert report(tmp_path) == Exit.USAGE and report(".") == Exit.USAGE
    assert capsys.readouterr().err.count("Is a directory") == 2


def test_a_record_that_lacks_its_beginning_claims_nothing_of_it(tmp_path: Path) -> None:
    numbered = list(enumerate(items()))
    (tmp_path / "f.mcap").write_bytes(as_bytes(numbered[len(numbered) // 2 :], start()))
    recording = read(tmp_path / "f.mcap")
    assert recording.lost_at_first
    told = flight.of(recording).figures
    assert told.headline == "Target captured; how it was engaged is missing in the record"
    assert main(["replay", str(tmp_path / "f.mcap")]) == Exit.USAGE  # nothing can be compared


def test_the_flight_is_never_overwritten(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = in_file(tmp_path / "f.mcap", items()[:100])
    before = path.read_bytes()
    assert report(path, "-o", path) == Exit.USAGE
    assert path.read_bytes() == before and "would overwrite the flight" in capsys.readouterr().err
    assert report(path, "-o", tmp_path / "no" / "f.html") == Exit.USAGE
    assert "No such file or directory" in capsys.readouterr().err


def test_without_plotly_it_says_what_to_install(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(package: str) -> Path:
        raise ModuleNotFoundError(f"No module named {package!r}")

    monkeypatch.setattr("companion.report.page.resources.files", gone)
    assert report(in_file(tmp_path / "f.mcap", items()[:100])) == Exit.USAGE
    assert "pip install 'companion[report]'" in capsys.readouterr().err


def test_a_flight_without_ranges_and_positions_is_told(tmp_path: Path) -> None:
    blind: list[Item] = [
        Tick(t_ns=0),
        status(0.0, phase=Phase.AWAIT, x_m=None, y_m=None, heading_rad=None, estimate=None, range_m=None,
               mode=FlightMode.POSCTL, awaited=("ranges of beacon 'b1'",)),
    ]  # fmt: skip
    told = page.write(tmp_path / "f.html", read(in_file(tmp_path / "f.mcap", blind)))
    assert told.figures.beacons == () and told.ranges == ()


def test_what_was_heard_cannot_become_markup(tmp_path: Path) -> None:
    evil = "</script><script>alert(1)</script><!--"
    heard: list[Item] = [
        Tick(t_ns=0),
        RangeSample(t_ns=1, beacon=evil, session="s", seq=1, range_m=1.0),
        RangeVerdict(t_ns=1, beacon=evil, seq=1, verdict=Verdict.UNKNOWN_BEACON),
        status(0.0, reason=evil),
    ]
    recording = read(in_file(tmp_path / "f.mcap", heard))
    told = flight.of(recording)
    text = page.html(told, series.of(recording, told), "/* plotly */")
    assert "alert(1)" in text and "<script>alert" not in text and "</script><script>alert" not in text
    assert "<!--" not in text
