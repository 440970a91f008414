"""Is what the autopilot flies what this app sent? Somebody else's targets, in the autopilot's own report.

PX4 tells the target that it flies (POSITION_TARGET_LOCAL_NED). Held against recordings of a real one, speed
and yaw rate of each lie within 0.1 of a setpoint of the second before. One that does not, while OFFBOARD is
in effect, came over another link of the autopilot, or the autopilot limits what it is sent.
"""

from __future__ import annotations

import msgspec
from msgspec.structs import replace

from companion.types import FlightMode, ModeReport, Setpoint, TargetEcho

_WINDOW_NS = 1_000_000_000
_TOLERANCE = 0.15
"""m/s and rad/s."""
_TIMES = 3
_TELL_NS = 5_000_000_000


class Bounds(msgspec.Struct, frozen=True, gc=False):
    """The least and the largest of what was sent."""

    speed_low: float
    speed_high: float
    yaw_rate_low: float
    yaw_rate_high: float

    def has(self, e: TargetEcho) -> bool:
        """The target lies within them."""
        return (
            self.speed_low - _TOLERANCE <= e.speed_m_s <= self.speed_high + _TOLERANCE
            and self.yaw_rate_low - _TOLERANCE <= e.yaw_rate_rad_s <= self.yaw_rate_high + _TOLERANCE
        )


class Echo(msgspec.Struct, frozen=True, gc=False):
    """What was sent in this window of a second and in the one before, and how many targets were not of it."""

    t_window_ns: int = 0
    now: Bounds | None = None
    before: Bounds | None = None
    pending: int = 0
    """Foreign targets that no mode report has confirmed yet: after a mode change they are the new mode's."""
    foreign: int = 0
    t_foreign_ns: int = 0


def sent(echo: Echo, s: Setpoint) -> Echo:
    """A setpoint leaves."""
    b, v, w = echo.now, s.speed_m_s, s.yaw_rate_rad_s
    if b is None or s.t_ns - echo.t_window_ns >= _WINDOW_NS:
        before = b if s.t_ns - echo.t_window_ns < 2 * _WINDOW_NS else None
        return replace(echo, t_window_ns=s.t_ns, before=before, now=Bounds(v, v, w, w))
    if b.speed_low <= v <= b.speed_high and b.yaw_rate_low <= w <= b.yaw_rate_high:
        return echo
    bounds = Bounds(
        min(b.speed_low, v), max(b.speed_high, v), min(b.yaw_rate_low, w), max(b.yaw_rate_high, w)
    )
    return replace(echo, now=bounds)


def heard(echo: Echo, e: TargetEcho) -> Echo:
    """The autopilot tells what it flies. Until a whole window was sent nothing is foreign."""
    if echo.before is None or echo.now is None or echo.before.has(e) or echo.now.has(e):
        return echo
    return replace(echo, pending=echo.pending + 1)


def confirmed(echo: Echo, e: ModeReport) -> Echo:
    """A mode report after it: in OFFBOARD still, then the foreign targets were flown in OFFBOARD."""
    if not echo.pending:
        return echo
    if e.actual is not FlightMode.OFFBOARD:
        return replace(echo, pending=0, foreign=0)
    before = echo.foreign if e.t_ns - echo.t_foreign_ns < _TELL_NS else 0
    return replace(echo, pending=0, foreign=before + echo.pending, t_foreign_ns=e.t_ns)


def is_foreign(echo: Echo, t_ns: int) -> bool:
    """Somebody else's targets were flown lately."""
    return echo.foreign >= _TIMES and t_ns - echo.t_foreign_ns < _TELL_NS
