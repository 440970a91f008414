"""The last thing before the wire. It trusts nothing: whatever was computed, what leaves is finite, bounded.

Speed, yaw rate, their slew, climb rate and height band are enforced on every setpoint; flight time, distance
flown and distance from the start by dead reckoning of what was commanded are budgets: once one is spent, the
forward speed is zero here, whatever the rest of the app believes.
"""

from __future__ import annotations

import math

import msgspec
from msgspec.structs import replace

from companion.settings import LimitSettings
from companion.types import Setpoint

_LONGEST_STEP_S = 0.1
"""A pause in the stream gives no more slew than this."""


class LimitState(msgspec.Struct, frozen=True, gc=False):
    """What was let through last, and how far that has led since the engagement."""

    t_start_ns: int = 0
    t_ns: int = 0
    speed_m_s: float = 0.0
    yaw_rate_rad_s: float = 0.0
    heading_rad: float = 0.0
    x_m: float = 0.0
    y_m: float = 0.0
    path_m: float = 0.0


def start(t_ns: int) -> LimitState:
    """Full budgets, from now on."""
    return LimitState(t_start_ns=t_ns, t_ns=t_ns)


def spent(cfg: LimitSettings, s: LimitState, t_ns: int) -> str | None:
    """Which budget is used up, in words, or None."""
    if (t_ns - s.t_start_ns) * 1e-9 > cfg.flight_time_s:
        return f"flight time over {cfg.flight_time_s:g} s"
    if s.path_m > cfg.distance_m:
        return f"distance flown over {cfg.distance_m:g} m"
    if math.hypot(s.x_m, s.y_m) > cfg.from_start_m:
        return f"more than {cfg.from_start_m:g} m from the start"
    return None


def apply(
    cfg: LimitSettings, s: LimitState, wanted: Setpoint, measured_height_m: float | None
) -> tuple[LimitState, Setpoint]:
    """Bound a setpoint. The height asked for stays in its band, but the present height may always be held."""
    since_s = max(0.0, (wanted.t_ns - s.t_ns) * 1e-9)
    step_s = min(since_s, _LONGEST_STEP_S)
    turned = s.heading_rad
    s = replace(
        s,
        t_ns=wanted.t_ns,
        x_m=s.x_m + s.speed_m_s * since_s * math.cos(turned),
        y_m=s.y_m + s.speed_m_s * since_s * math.sin(turned),
        path_m=s.path_m + s.speed_m_s * since_s,
    )
    heading = wanted.heading_rad
    speed = _finite(wanted.speed_m_s)
    if not math.isfinite(heading):
        heading, speed = 0.0, 0.0
    if spent(cfg, s, wanted.t_ns) is not None:
        speed = 0.0
    speed = _clamp(speed, 0.0, min(cfg.speed_m_s, s.speed_m_s + cfg.acceleration_m_s2 * step_s))
    yaw_rate = _slew(
        s.yaw_rate_rad_s,
        _clamp(_finite(wanted.yaw_rate_rad_s), -cfg.yaw_rate_rad_s, cfg.yaw_rate_rad_s),
        cfg.yaw_acceleration_rad_s2 * step_s,
    )
    let_through = Setpoint(
        t_ns=wanted.t_ns,
        speed_m_s=speed,
        yaw_rate_rad_s=yaw_rate,
        heading_rad=heading,
        height_m=_height(cfg, wanted.height_m, measured_height_m),
        climb_m_s=_clamp(_finite(wanted.climb_m_s), -cfg.climb_m_s, cfg.climb_m_s),
    )
    return replace(s, speed_m_s=speed, yaw_rate_rad_s=yaw_rate, heading_rad=heading), let_through


def _height(cfg: LimitSettings, wanted_m: float | None, measured_m: float | None) -> float | None:
    if wanted_m is None:
        return None
    floor, ceiling = cfg.height_min_m, cfg.height_max_m
    if measured_m is not None and math.isfinite(measured_m):
        floor, ceiling = min(floor, measured_m), max(ceiling, measured_m)
        if not math.isfinite(wanted_m):
            return measured_m
    elif not math.isfinite(wanted_m):
        return None
    return _clamp(wanted_m, floor, ceiling)


def _slew(before: float, wanted: float, step: float) -> float:
    """Away from zero no faster than `step`; towards zero at once."""
    if before * wanted < 0.0:
        before = 0.0
    if abs(wanted) <= abs(before):
        return wanted
    return _clamp(wanted, before - step, before + step)


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 0.0


def _clamp(value: float, low: float, high: float) -> float:
    return low if value < low else high if value > high else value
