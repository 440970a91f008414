"""The live view: what it shows, where, and that it can neither block nor break the loop."""

from __future__ import annotations

import io
import math
import threading

import msgspec
import pytest
from rich.console import Console

from companion.lines import TextLine, change_line, plain_line
from companion.panel import LivePanel, bearing_ruler, panel
from companion.types import Estimate, Phase, PhaseChange, Severity, Status
from companion.view import NoView, PaintedView, ViewKind, open_view
from tests.people.flights import T0_NS, change, flight, status


def shown(s: Status, width: int = 80) -> str:
    console = Console(record=True, width=width, file=io.StringIO())
    console.print(panel(s, T0_NS))
    return console.export_text()


def test_the_panel_tells_what_a_pilot_needs() -> None:
    text = shown(status(12.3, malformed={"not finite": 2}))
    for wanted in (
        "12.3 s",
        "APPROACH",
        "bearing known",
        "5.30 m ± 0.12",
        "17° right ± 6°",
        "0.50 m/s forward",
        "11°/s right",
        "OFFBOARD",
        "armed",
        "height 3.01 m",
        "telemetry 0.02 s ago",
        "5.90 m  0.03 s ago",
        "accepted 203",
        "outlier:4,stale:1",
        "not_finite:2",
        "4.20 m in 8.4 s",
    ):
        assert wanted in text


def test_the_panel_shows_a_station_and_its_beacons() -> None:
    text = shown(status(phase=Phase.KEEP, captured=True, beacons={"b1": 0.04, "b2": 12.0, "b3": None}))
    for wanted in ("KEEP", "station  5.30 m", "b1 0.0 s", "b2 12.0 s", "b3 never", "reached"):
        assert wanted in text
    assert "target" not in text


def test_the_panel_says_when_the_bearing_is_not_known() -> None:
    unsure = Estimate(5.3, 0.1, 0.3, 1.2)
    assert "± 69°  bearing not known" in shown(status(estimate=unsure))
    assert "not known" not in shown(status())


def test_the_panel_says_what_is_awaited_and_from_where() -> None:
    text = shown(
        status(
            phase=Phase.AWAIT,
            reason="waiting",
            awaited=("a heartbeat on udpin:0.0.0.0:14540", "ranges of b1 on uwb/v1/lab/b1/*/range"),
            mode=None,
            armed=None,
            range_m=None,
            range_age_s=None,
            telemetry_age_s=None,
            estimate=None,
            speed_m_s=None,
            yaw_rate_rad_s=None,
            x_m=None,
            y_m=None,
            height_m=None,
            heading_rad=None,
        )
    )
    assert "a heartbeat on udpin:0.0.0.0:14540" in text
    assert "ranges of b1 on uwb/v1/lab/b1/*/range" in text
    assert "never heard" in text
    assert "no estimate yet" in text
    assert "none sent" in text


def test_a_target_on_the_left_is_shown_on_the_left() -> None:
    left = status(estimate=Estimate(4.0, 0.1, -math.pi / 2, 0.01))
    assert "90° left" in shown(left)
    ruler = bearing_ruler(left).plain
    assert ruler.index("●") < ruler.index("┼")


@pytest.mark.parametrize("bearing", [-math.pi + 1e-9, -3.0, -0.01, 0.0, 0.01, 3.0, math.pi])
@pytest.mark.parametrize("sigma", [0.0, 0.3, 3.0, 50.0])
def test_the_ruler_holds_any_bearing(bearing: float, sigma: float) -> None:
    ruler = bearing_ruler(status(estimate=Estimate(4.0, 0.1, bearing, sigma))).plain
    assert ruler.count("●") == 1
    assert len(ruler) == len(bearing_ruler(status(estimate=None)).plain)


@pytest.mark.parametrize("width", [20, 40, 80, 200])
def test_the_panel_fits_any_terminal(width: int) -> None:
    assert max(len(line) for line in shown(status(), width).splitlines()) <= width


def test_the_plain_line_is_stable() -> None:
    assert plain_line(status(12.3), T0_NS) == (
        "t_s=12.3 phase=APPROACH mode=OFFBOARD armed=yes range_m=5.90 range_age_s=0.03 distance_m=5.30 "
        "distance_sigma_m=0.12 bearing_deg=17.2 bearing_sigma_deg=5.7 speed_m_s=0.50 yaw_rate_deg_s=-11.5 "
        "height_m=3.01 path_m=4.20 engaged_s=8.4 captured=no accepted=203 rejected=outlier:4,stale:1 "
        "malformed=- telemetry_age_s=0.02 awaiting=- warnings=-"
    )
    assert (
        change_line(change(4.0, Phase.ACQUIRE, Phase.APPROACH, "bearing known"), T0_NS)
        == "t_s=4.0 change=ACQUIRE->APPROACH severity=INFO reason=bearing known"
    )


def test_the_plain_line_has_the_same_keys_when_nothing_is_known() -> None:
    bare = status(
        mode=None, armed=None, range_m=None, range_age_s=None, telemetry_age_s=None, estimate=None,
        speed_m_s=None, yaw_rate_rad_s=None, x_m=None, y_m=None, height_m=None, heading_rad=None, rejected={},
        awaited=("ranges of b1", "a heartbeat"),
    )  # fmt: skip
    keys = [field.split("=")[0] for field in plain_line(status(), T0_NS).split()]
    assert [field.split("=")[0] for field in plain_line(bare, T0_NS).split()] == keys
    assert plain_line(bare, T0_NS).endswith("awaiting=ranges_of_b1;a_heartbeat warnings=-")


def test_plain_view_tells_every_change_and_the_last_status() -> None:
    stream = io.StringIO()
    view = open_view(stream)
    assert isinstance(view, PaintedView)
    for output in flight():
        if isinstance(output, Status):
            view.show(output)
        elif isinstance(output, PhaseChange):
            view.note(output)
    view.tell("operator: landed")
    view.close()
    lines = stream.getvalue().splitlines()
    assert [line.split()[1] for line in lines if "change=" in line] == [
        "change=AWAIT->STANDBY",
        "change=STANDBY->ACQUIRE",
        "change=ACQUIRE->APPROACH",
        "change=APPROACH->HOLD",
        "change=HOLD->RELEASED",
    ]
    assert lines[-1].startswith("t_s=") and "captured=yes" in lines[-1]
    assert "operator: landed" in lines
    assert view.cost.frames <= len(lines)


def test_live_view_ends_with_the_newest_panel() -> None:
    stream = io.StringIO()
    live = LivePanel(stream, Console(file=stream, force_terminal=True, width=100))
    view = PaintedView(0.25, live.paint, live.close)
    for i in range(1000):
        view.show(status(i * 0.01, path_m=float(i)))
    view.note(change(3.0, Phase.HOLD, Phase.HAND_OVER, "a limit is spent", Severity.WARNING))
    view.close()
    text = stream.getvalue()
    assert "999.00 m" in text
    assert "a limit is spent" in text
    assert view.cost.frames < 20  # a thousand statuses were not a thousand frames


def test_json_view_round_trips() -> None:
    stream = io.StringIO()
    view = open_view(stream, ViewKind.JSON)
    sent = status(5.0, awaited=("ranges",))
    changed = change(5.0, Phase.AWAIT, Phase.STANDBY, "ready")
    view.note(changed)
    view.show(sent)
    view.tell("hello")
    view.close()
    lines = stream.getvalue().splitlines()
    decoded = [msgspec.json.decode(x, type=Status | PhaseChange | TextLine) for x in lines]
    assert sent in decoded and changed in decoded
    assert msgspec.json.decode(lines[decoded.index(TextLine("hello"))]) == {"output": "text", "line": "hello"}


def test_nothing_is_shown_where_nothing_is_wanted() -> None:
    assert isinstance(open_view(io.StringIO(), ViewKind.NONE), NoView)


class Gone(io.StringIO):
    """A pipe whose reader has gone."""

    def write(self, s: str, /) -> int:
        raise BrokenPipeError


class Stalled(io.StringIO):
    """A terminal that nobody reads."""

    def __init__(self) -> None:
        super().__init__()
        self.release = threading.Event()

    def write(self, s: str, /) -> int:
        self.release.wait(60.0)
        return len(s)


def test_a_closed_pipe_does_not_reach_the_loop() -> None:
    view = open_view(Gone())
    for i in range(10):
        view.note(change(i, Phase.AWAIT, Phase.STANDBY, "again"))
        view.show(status(i))
    view.close()


def test_a_stalled_terminal_neither_blocks_nor_fills_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("companion.view.CLOSE_LIMIT_S", 0.05)
    stream = Stalled()
    view = open_view(stream)
    assert isinstance(view, PaintedView)
    for i in range(5000):  # would never return if a write were waited for
        view.show(status(i))
        view.note(change(i, Phase.AWAIT, Phase.STANDBY, "again"))
    view.close()
    assert len(view._told) <= 1000
    stream.release.set()
