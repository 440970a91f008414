"""The live view: what a person sees while it flies.

A view is fed by the loop and painted by a thread of its own, a few times a second, from a slot that keeps the
newest status only: the loop pays one assignment, however slow the terminal is, and a stalled terminal can
neither delay a setpoint nor keep the program from ending.

Three renderings of the same `Status` and `PhaseChange`:

- `LiveView`, on a terminal: a panel that is painted anew in place, phase changes scrolling above it;
- `PlainView`, elsewhere: one line of `key=value` a second and one for each phase change, made for grep;
- `JsonView`: one JSON object a line (the tagged structs of `companion.types`), made for other programs.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Mapping
from enum import Enum
from typing import IO, ClassVar, NamedTuple, Protocol

import msgspec
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.text import Text

from companion.types import Phase, PhaseChange, Severity, Status

RULER_HALF = 26
"""Characters from straight ahead to straight behind on the bearing ruler: 7° each."""
UNSURE_RAD = 1.0
"""A bearing with a greater standard deviation is not known."""
CLOSE_LIMIT_S = 2.0
"""`close()` waits this long for the last frame: a stalled terminal must not keep the program."""

PHASE_STYLE = {
    Phase.AWAIT: "yellow",
    Phase.STANDBY: "cyan",
    Phase.INHIBITED: "yellow",
    Phase.ACQUIRE: "bold blue",
    Phase.APPROACH: "bold magenta",
    Phase.HOLD: "bold green",
    Phase.KEEP: "bold green",
    Phase.COAST: "bold yellow",
    Phase.STALL: "bold red",
    Phase.HAND_OVER: "bold red",
    Phase.RELEASED: "yellow",
    Phase.ENDED: "bold",
}
"""How each phase looks in a terminal."""


class ViewKind(Enum):
    """How a flight is shown. AUTO: LIVE on a terminal, PLAIN elsewhere."""

    AUTO = "auto"
    LIVE = "live"
    PLAIN = "plain"
    JSON = "json"
    NONE = "none"


class ViewCost(NamedTuple):
    """What painting has cost: frames painted; CPU time of the painting thread a frame, mean and worst, s."""

    frames: int
    mean_s: float
    worst_s: float


class View(Protocol):
    """What the loop sees of any view. No method blocks, none raises into the loop."""

    def show(self, status: Status) -> None:
        """Show this snapshot in the next frame; an unpainted older one is dropped."""

    def note(self, change: PhaseChange) -> None:
        """Tell a phase change; none is dropped."""

    def tell(self, line: str) -> None:
        """Tell a line of text from elsewhere, e.g. the operator's in the demo."""

    def close(self) -> None:
        """Paint what is left and give the stream back."""


def open_view(stream: IO[str], kind: ViewKind = ViewKind.AUTO) -> View:
    """A view on this stream; AUTO asks the stream whether it is a terminal."""
    if kind is ViewKind.AUTO:
        kind = ViewKind.LIVE if stream.isatty() else ViewKind.PLAIN
    match kind:
        case ViewKind.LIVE:
            return LiveView(stream)
        case ViewKind.PLAIN:
            return PlainView(stream)
        case ViewKind.JSON:
            return JsonView(stream)
        case _:
            return NoView()


class NoView:
    """Shows nothing."""

    def show(self, status: Status) -> None:
        """Nothing."""

    def note(self, change: PhaseChange) -> None:
        """Nothing."""

    def tell(self, line: str) -> None:
        """Nothing."""

    def close(self) -> None:
        """Nothing."""


class _PaintedView:
    """The slot, the thread and their ends; a subclass says how to paint."""

    period_s: ClassVar[float] = 0.25

    def __init__(self) -> None:
        self._latest: Status | None = None
        self._told: deque[PhaseChange | str] = deque(maxlen=1000)
        self._wake = threading.Event()
        self._closing = False
        self._frames = 0
        self._busy_s = 0.0
        self._worst_s = 0.0
        self._thread = threading.Thread(target=self._run, name="view", daemon=True)

    def show(self, status: Status) -> None:
        """Show this snapshot in the next frame; an unpainted older one is dropped."""
        self._latest = status

    def note(self, change: PhaseChange) -> None:
        """Tell a phase change; none is dropped."""
        if (pending := self._latest) is not None and pending.t_ns < change.t_ns:
            self._latest = None  # it would be shown after the change, and show the phase before
        self._told.append(change)
        self._wake.set()

    def tell(self, line: str) -> None:
        """Tell a line of text from elsewhere."""
        self._told.append(line)
        self._wake.set()

    def close(self) -> None:
        """Paint what is left, within `CLOSE_LIMIT_S`. Closing twice is no error."""
        self._closing = True
        self._wake.set()
        self._thread.join(CLOSE_LIMIT_S)

    @property
    def cost(self) -> ViewCost:
        """What painting has cost so far."""
        return ViewCost(self._frames, self._busy_s / max(self._frames, 1), self._worst_s)

    def _run(self) -> None:
        """The thread: told lines at once, the newest status once a period, until closed."""
        due = time.monotonic()
        try:
            while not self._closing:
                self._wake.wait(max(due - time.monotonic(), 0.0))
                self._wake.clear()
                if time.monotonic() >= due:
                    due = time.monotonic() + self.period_s
                    self._frame(self._take())
                else:
                    self._frame(None)
            self._frame(self._take())
            self._end()
        except OSError:
            # The stream is gone (a closed pipe, a lost terminal): the flight goes on without a view.
            return

    def _take(self) -> Status | None:
        status, self._latest = self._latest, None
        return status

    def _frame(self, status: Status | None) -> None:
        start = time.thread_time()
        told = [self._told.popleft() for _ in range(len(self._told))]
        if status is None and not told:
            return
        self._paint(status, told)
        took = time.thread_time() - start
        self._frames += 1
        self._busy_s += took
        self._worst_s = max(self._worst_s, took)

    def _paint(self, status: Status | None, told: list[PhaseChange | str]) -> None:
        raise NotImplementedError

    def _end(self) -> None:
        """Give the stream back."""


class LiveView(_PaintedView):
    """The panel on a terminal, four times a second; it stays when the view is closed."""

    def __init__(self, stream: IO[str], console: Console | None = None) -> None:
        super().__init__()
        self._console = console or Console(file=stream, highlight=False)
        self._live = Live(
            console=self._console, auto_refresh=False, redirect_stdout=False, redirect_stderr=False
        )
        self._live.start()
        self._t0_ns: int | None = None
        self._thread.start()

    def _paint(self, status: Status | None, told: list[PhaseChange | str]) -> None:
        for item in told:
            if self._t0_ns is None and isinstance(item, PhaseChange):
                self._t0_ns = item.t_ns
            self._console.print(told_text(item, self._t0_ns or 0), soft_wrap=True)
        if status is not None:
            if self._t0_ns is None:
                self._t0_ns = status.t_ns
            self._live.update(panel(status, self._t0_ns), refresh=True)

    def _end(self) -> None:
        self._live.stop()


class PlainView(_PaintedView):
    """A line a second and a line for each phase change, as `plain_line` and `change_line` write them."""

    period_s: ClassVar[float] = 1.0

    def __init__(self, stream: IO[str]) -> None:
        super().__init__()
        self._stream = stream
        self._t0_ns: int | None = None
        self._thread.start()

    def _paint(self, status: Status | None, told: list[PhaseChange | str]) -> None:
        lines: list[str] = []
        for item in told:
            if isinstance(item, str):
                lines.append(item)
                continue
            if self._t0_ns is None:
                self._t0_ns = item.t_ns
            lines.append(change_line(item, self._t0_ns))
        if status is not None:
            if self._t0_ns is None:
                self._t0_ns = status.t_ns
            lines.append(plain_line(status, self._t0_ns))
        self._stream.write("".join(f"{line}\n" for line in lines))
        self._stream.flush()


class JsonView(_PaintedView):
    """One JSON object a line: a `Status`, a `PhaseChange`, or `{"output": "text", "line": …}`."""

    def __init__(self, stream: IO[str]) -> None:
        super().__init__()
        self._stream = stream
        self._encoder = msgspec.json.Encoder()
        self._thread.start()

    def _paint(self, status: Status | None, told: list[PhaseChange | str]) -> None:
        lines: list[str] = []
        for item in (*told, *((status,) if status is not None else ())):
            value = {"output": "text", "line": item} if isinstance(item, str) else item
            lines.append(self._encoder.encode(value).decode())
        self._stream.write("".join(f"{line}\n" for line in lines))
        self._stream.flush()


# ------------------------------------------------------------------------------------------- plain lines


def plain_line(status: Status, t0_ns: int) -> str:
    """One line of `key=value`: the keys, their order and their units do not change; `-` where not known.

    Angles are degrees here: bearings positive to the right, yaw rates positive to the left.
    """
    e = status.estimate
    fields = (
        ("t_s", _number(_since(status.t_ns, t0_ns), 1)),
        ("phase", status.phase.name),
        ("mode", status.mode.value if status.mode is not None else "-"),
        ("armed", "-" if status.armed is None else "yes" if status.armed else "no"),
        ("range_m", _number(status.range_m, 2)),
        ("range_age_s", _number(status.range_age_s, 2)),
        ("distance_m", _number(e.distance_m if e else None, 2)),
        ("distance_sigma_m", _number(e.distance_sigma_m if e else None, 2)),
        ("bearing_deg", _number(_degrees(e.bearing_rad if e else None), 1)),
        ("bearing_sigma_deg", _number(_degrees(e.bearing_sigma_rad if e else None), 1)),
        ("speed_m_s", _number(status.speed_m_s, 2)),
        ("yaw_rate_deg_s", _number(_degrees(status.yaw_rate_rad_s), 1)),
        ("height_m", _number(status.height_m, 2)),
        ("path_m", _number(status.path_m, 2)),
        ("engaged_s", _number(status.engaged_s, 1)),
        ("captured", "yes" if status.captured else "no"),
        ("accepted", str(status.ranges_accepted)),
        ("rejected", _counts(status.rejected)),
        ("malformed", _counts(status.malformed)),
        ("telemetry_age_s", _number(status.telemetry_age_s, 2)),
        ("awaiting", ";".join(status.awaited).replace(" ", "_") or "-"),
        ("warnings", ";".join(status.warnings).replace(" ", "_") or "-"),
    )
    return " ".join(f"{key}={value}" for key, value in fields)


def change_line(change: PhaseChange, t0_ns: int) -> str:
    """A phase change: `t_s=12.3 change=ACQUIRE->APPROACH severity=INFO reason=the bearing is known`."""
    return (
        f"t_s={_since(change.t_ns, t0_ns):.1f} change={change.before.name}->{change.after.name} "
        f"severity={change.severity.name} reason={change.reason}"
    )


def _since(t_ns: int, t0_ns: int) -> float:
    return (t_ns - t0_ns) * 1e-9


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _degrees(value: float | None) -> float | None:
    return None if value is None else math.degrees(value)


def _counts(counts: Mapping[str, int]) -> str:
    return ",".join(f"{k.replace(' ', '_')}:{n}" for k, n in sorted(counts.items()) if n) or "-"


# --------------------------------------------------------------------------------------------- the panel


def told_text(item: PhaseChange | str, t0_ns: int) -> Text:
    """A phase change or a told line, as it scrolls above the panel."""
    if isinstance(item, str):
        return Text(item, style="dim")
    style = "bold red" if item.severity <= Severity.WARNING else PHASE_STYLE[item.after]
    return Text.assemble(
        (f"{_since(item.t_ns, t0_ns):6.1f} s  ", "dim"),
        (item.before.value, "dim"),
        (" → ", "dim"),
        (item.after.value.upper(), style),
        f"  {item.reason}",
    )


def panel(status: Status, t0_ns: int) -> RenderableType:
    """The panel: phase, target, bearing ruler, setpoint, vehicle, links."""
    style = PHASE_STYLE[status.phase]
    rows = [_row("phase", (status.phase.value.upper(), style), (f"  {status.reason}", ""))]
    rows += [_row("awaiting", (awaited, "yellow")) for awaited in status.awaited]
    rows += [_target(status), bearing_ruler(status), _setpoint(status), _vehicle(status), _ranges(status)]
    if status.beacons:
        rows.append(_beacons(status))
    if (rejected := _counts(status.rejected)) != "-":
        rows.append(_row("rejected", (rejected, "yellow")))
    if (malformed := _counts(status.malformed)) != "-":
        rows.append(_row("malformed", (malformed, "red")))
    rows += [_row("warning", (warning, "bold yellow")) for warning in status.warnings]
    rows.append(
        _row(
            "flown",
            (f"{status.path_m:.2f} m in {status.engaged_s:.1f} s engaged", ""),
            (("   reached" if status.beacons else "   captured") if status.captured else "", "bold green"),
        )
    )
    title = f"companion  {_since(status.t_ns, t0_ns):.1f} s"
    return Panel(Group(*rows), title=title, border_style=style, width=80)


def bearing_ruler(status: Status) -> Text:
    """Left … ahead … right: the estimated bearing as ●, its ±1σ as ━, straight behind at both ends."""
    cells = ["─"] * (2 * RULER_HALF + 1)
    cells[RULER_HALF] = "┼"
    cells[RULER_HALF // 2] = cells[RULER_HALF + RULER_HALF // 2] = "┴"
    span = range(0)
    if (e := status.estimate) is not None:
        at = RULER_HALF + round(e.bearing_rad / math.pi * RULER_HALF)
        half = min(round(e.bearing_sigma_rad / math.pi * RULER_HALF), RULER_HALF)
        span = range(at - half, at + half + 1)
        for i in span:
            cells[i % (2 * RULER_HALF)] = "━"  # beyond straight behind the ruler goes on at its other end
        cells[at] = "●"
    line_style = PHASE_STYLE[status.phase] if span else "dim"
    return _row("", ("left ", "dim"), ("".join(cells), line_style), (" right", "dim"))


def _row(name: str, *parts: tuple[str, str]) -> Text:
    return Text.assemble((f"{name:<8} ", "dim"), *parts, no_wrap=True, overflow="ellipsis")


def _target(status: Status) -> Text:
    e = status.estimate
    name = "station" if status.beacons else "target"
    if e is None:
        return _row(name, ("no estimate yet", "dim"))
    side = "right" if e.bearing_rad >= 0 else "left"
    unsure = e.bearing_sigma_rad > UNSURE_RAD
    return _row(
        name,
        (f"{e.distance_m:.2f} m", "bold"),
        (f" ± {e.distance_sigma_m:.2f}   ", ""),
        (f"{abs(math.degrees(e.bearing_rad)):.0f}° {side}", "bold"),
        (f" ± {math.degrees(e.bearing_sigma_rad):.0f}°", "yellow" if unsure else ""),
        ("  bearing not known" if unsure else "", "yellow"),
    )


def _setpoint(status: Status) -> Text:
    if status.speed_m_s is None or status.yaw_rate_rad_s is None:
        return _row("setpoint", ("none sent", "dim"))
    side = "left" if status.yaw_rate_rad_s >= 0 else "right"
    turn = abs(math.degrees(status.yaw_rate_rad_s))
    return _row("setpoint", (f"{status.speed_m_s:.2f} m/s forward   turn {turn:.0f}°/s {side}", ""))


def _vehicle(status: Status) -> Text:
    armed = {None: "", True: "armed  ", False: "disarmed  "}[status.armed]
    return _row(
        "vehicle",
        (status.mode.value if status.mode else "mode not known", "bold" if status.phase.is_engaged else ""),
        (f"  {armed}height {_metres(status.height_m)}", ""),
        (f"  telemetry {_age(status.telemetry_age_s)}", _age_style(status.telemetry_age_s)),
    )


def _ranges(status: Status) -> Text:
    return _row(
        "ranges",
        (f"{_metres(status.range_m)}  {_age(status.range_age_s)}", _age_style(status.range_age_s)),
        (f"  accepted {status.ranges_accepted}", ""),
    )


def _beacons(status: Status) -> Text:
    """Station keeping: each beacon with the age of its last range."""
    parts = []
    for name, age_s in status.beacons.items():
        told = "never" if age_s is None else f"{age_s:.1f} s"
        parts.append((f"{name} {told}  ", _age_style(age_s)))
    return _row("beacons", *parts)


def _metres(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f} m"


def _age(age_s: float | None) -> str:
    return "never heard" if age_s is None else f"{age_s:.2f} s ago"


def _age_style(age_s: float | None) -> str:
    return "green" if age_s is not None and age_s < 0.5 else "red"
