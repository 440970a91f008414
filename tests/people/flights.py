"""A made-up flight, told as the pilot tells one: statuses at 10 Hz and phase changes."""

from __future__ import annotations

import math
import random

from companion.types import AnyOutput, Estimate, FlightMode, Phase, PhaseChange, Severity, Status

TARGET = (3.5, 5.0)
RADIUS_M, SPEED_M_S, YAW_RATE_RAD_S = 0.5, 0.5, 1.0
T0_NS = 7_000_000_000_000


def status(t_s: float = 1.0, **changes: object) -> Status:
    """A status in mid-flight, with some fields changed."""
    fields: dict[str, object] = {
        "t_ns": T0_NS + round(t_s * 1e9),
        "phase": Phase.APPROACH,
        "reason": "bearing known",
        "awaited": (),
        "mode": FlightMode.OFFBOARD,
        "armed": True,
        "range_m": 5.9,
        "range_age_s": 0.03,
        "ranges_accepted": 203,
        "rejected": {"outlier": 4, "stale": 1},
        "malformed": {},
        "telemetry_age_s": 0.02,
        "estimate": Estimate(5.3, 0.12, 0.3, 0.1),
        "speed_m_s": 0.5,
        "yaw_rate_rad_s": -0.2,
        "x_m": 1.0,
        "y_m": 2.0,
        "height_m": 3.01,
        "heading_rad": 1.0,
        "path_m": 4.2,
        "engaged_s": 8.4,
        "captured": False,
    }
    return Status(**(fields | changes))  # type: ignore[arg-type]


def change(
    t_s: float, before: Phase, after: Phase, reason: str, severity: Severity = Severity.INFO
) -> PhaseChange:
    """A phase change at this time."""
    return PhaseChange(T0_NS + round(t_s * 1e9), before, after, reason, severity)


def flight(seed: int = 1, dt_s: float = 0.1) -> list[AnyOutput]:
    """Section VII of the paper flown knowingly, engaged after 2 s, released 3 s after the capture."""
    dice = random.Random(seed)
    x, y, heading, path, t = -2.0, 0.5, math.pi / 2, 0.0, 0.0
    phase, held_s = Phase.STANDBY, 0.0
    out: list[AnyOutput] = []
    out.append(change(0.0, Phase.AWAIT, Phase.STANDBY, "vehicle and ranges are there: waiting for OFFBOARD"))
    while phase is not Phase.RELEASED:
        d = math.hypot(TARGET[0] - x, TARGET[1] - y)
        theta = math.remainder(heading - math.atan2(TARGET[1] - y, TARGET[0] - x), math.tau)
        before = phase
        if t >= 2.0 and phase is Phase.STANDBY:
            phase, reason = Phase.ACQUIRE, "OFFBOARD selected"
        elif phase is Phase.ACQUIRE and t >= 4.0:
            phase, reason = Phase.APPROACH, "bearing known"
        elif phase is Phase.APPROACH and d <= RADIUS_M - 0.05:
            phase, reason = Phase.HOLD, "inside the capture radius"
        elif phase is Phase.HOLD and held_s > 3.0:
            phase, reason = Phase.RELEASED, "the vehicle left OFFBOARD"
        if phase is not before:
            out.append(change(t, before, phase, reason))
        v = SPEED_M_S if phase in (Phase.ACQUIRE, Phase.APPROACH) else 0.0
        omega = 1.0 if phase is Phase.ACQUIRE else max(-1.0, min(1.0, -3.0 * theta)) if v else 0.0
        spread = 2.0 * math.exp(-max(t - 2.0, 0.0) / 1.2) + 0.05
        out.append(
            status(
                t,
                phase=phase,
                reason=out[-1].reason if isinstance(out[-1], PhaseChange) else "",
                range_m=math.hypot(d, 3.0) + dice.gauss(0.0, 0.07),
                estimate=Estimate(
                    max(d + dice.gauss(0.0, 0.04), 0.0),
                    0.1,
                    math.remainder(theta + dice.gauss(0.0, spread / 2), math.tau),
                    spread,
                ),
                speed_m_s=v,
                yaw_rate_rad_s=omega,
                x_m=x,
                y_m=y,
                heading_rad=heading,
                path_m=path,
                engaged_s=max(t - 2.0, 0.0),
                captured=phase in (Phase.HOLD, Phase.RELEASED),
                ranges_accepted=round(t * 17),
                rejected={"outlier": round(t), "stale": 0},
            )
        )
        x += v * dt_s * math.cos(heading)
        y += v * dt_s * math.sin(heading)
        heading = math.remainder(heading + omega * dt_s, math.tau)
        path += v * dt_s
        held_s += dt_s if phase is Phase.HOLD else 0.0
        t += dt_s
    return out
