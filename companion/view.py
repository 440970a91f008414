"""The live view: what a person sees while it flies.

A view is fed by the loop and painted by a thread of its own, a few times a second, from a slot that keeps the
newest status only: the loop pays one assignment, however slow the terminal is, and a stalled terminal can
neither delay a setpoint nor keep the program from ending.

Three paintings of the same `Status` and `PhaseChange`, on a terminal `companion.panel`, elsewhere the lines
of `companion.lines`: one of `key=value` a second and one for each phase change, or JSON.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from enum import Enum
from typing import IO, NamedTuple, Protocol

from companion.lines import Told, json_lines, plain_lines, write_lines
from companion.types import PhaseChange, Status

CLOSE_LIMIT_S = 2.0
"""`close()` waits this long for the last frame: a stalled terminal must not keep the program."""


class ViewKind(Enum):
    """How a flight is shown. AUTO: LIVE on a terminal, PLAIN elsewhere."""

    AUTO = "auto"
    LIVE = "live"
    PLAIN = "plain"
    JSON = "json"
    NONE = "none"


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
            from companion.panel import LivePanel  # the only one that needs rich

            live = LivePanel(stream)
            return PaintedView(0.25, live.paint, live.close)
        case ViewKind.PLAIN:
            return PaintedView(1.0, lambda *frame: write_lines(stream, plain_lines(*frame)))
        case ViewKind.JSON:
            return PaintedView(0.25, lambda told, status, _: write_lines(stream, json_lines(told, status)))
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


Paint = Callable[[Sequence[Told], Status | None, int], None]
"""Paints one frame: what was told since the last one, the newest status if there is one, and the time from
which seconds are counted (t0_ns). May block; raises OSError where the stream is gone."""


class ViewCost(NamedTuple):
    """What painting has cost: frames painted; CPU time of the painting thread a frame, mean and worst, s."""

    frames: int
    mean_s: float
    worst_s: float


class PaintedView:
    """A slot, and a thread that paints what is in it."""

    def __init__(self, period_s: float, paint: Paint, end: Callable[[], None] = lambda: None) -> None:
        """Paint every `period_s`, and at once what is told; `end` gives the stream back."""
        self._period_s, self._paint, self._end = period_s, paint, end
        self._latest: Status | None = None
        self._told: deque[Told] = deque(maxlen=1000)
        self._t0_ns: int | None = None
        self._wake = threading.Event()
        self._closing = False
        self._frames = 0
        self._busy_s = 0.0
        self._worst_s = 0.0
        self._thread = threading.Thread(target=self._run, name="view", daemon=True)
        self._thread.start()

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
                    due = time.monotonic() + self._period_s
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
        if self._t0_ns is None:
            timed = (item.t_ns for item in (*told, status) if isinstance(item, PhaseChange | Status))
            self._t0_ns = next(timed, None)
        self._paint(told, status, self._t0_ns or 0)
        took = time.thread_time() - start
        self._frames += 1
        self._busy_s += took
        self._worst_s = max(self._worst_s, took)
