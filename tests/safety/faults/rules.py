"""What must come of a fault, as data: by the phase in which it strikes, with times in seconds after it."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import NamedTuple

from companion.types import Phase

ACQUIRE, APPROACH, COAST = Phase.ACQUIRE, Phase.APPROACH, Phase.COAST
STALL, HOLD, KEEP, HAND_OVER = Phase.STALL, Phase.HOLD, Phase.KEEP, Phase.HAND_OVER
AWAIT, STANDBY, INHIBITED = Phase.AWAIT, Phase.STANDBY, Phase.INHIBITED
RELEASED, ENDED = Phase.RELEASED, Phase.ENDED

MOVING = (ACQUIRE, APPROACH, COAST, KEEP)
ENGAGED = (*MOVING, STALL, HOLD)
SILENT = (INHIBITED, RELEASED)
EVERY = (AWAIT, STANDBY, *ENGAGED, HAND_OVER, *SILENT)
"""Every phase in which a fault may strike."""
GROUPS: Mapping[str, tuple[Phase, ...]] = {
    "every": EVERY,
    "engaged": ENGAGED,
    "moving": MOVING,
    "stall": (STALL,),
    "hold": (HOLD,),
    "waiting": (AWAIT,),
    "standby": (STANDBY,),
    "hand_over": (HAND_OVER,),
    "silent": SILENT,
}
"""From the general to the special."""

Window = tuple[float, float]
"""From and until, seconds after the strike."""
NEVER: Window = (inf, inf)


class Rule(NamedTuple):
    """What must hold after the strike."""

    says: str
    """In words for the table."""
    reach: tuple[tuple[Phase, float], ...] = ()
    """Phases that must be entered (or be the present one), and by when."""
    still: Window = NEVER
    """No forward speed is commanded in this window."""
    silent: Window = NEVER
    """No setpoint leaves in this window."""
    ends_in: frozenset[Phase] | None = None
    """Where the flight stands at the end of the watch; None: anywhere."""
    never: frozenset[Phase] = frozenset()
    """Phases that must not be entered."""


class Step(NamedTuple):
    """A transition of the app, `t_s` after the strike."""

    t_s: float
    phase: Phase
    reason: str


class Sent(NamedTuple):
    """A setpoint that left, `t_s` after the strike."""

    t_s: float
    speed_m_s: float


class Judgement(NamedTuple):
    """Whether a rule held, and within which time it came true (None: the rule names no time)."""

    broken: tuple[str, ...]
    took_s: float | None


_GRAIN_S = 0.021
"""Two ticks of the simulation: the strike is seen up to one of them before the app can see it."""


def judge(rule: Rule, struck_in: Phase, steps: list[Step], sent: list[Sent]) -> Judgement:
    """Hold what the app did against a rule."""
    broken: list[str] = []
    took: float | None = None
    for phase, by_s in rule.reach:
        at = 0.0 if phase is struck_in else next((s.t_s for s in steps if s.phase is phase), None)
        if at is None or at > by_s + _GRAIN_S:
            when = "never" if at is None else f"after {at:.2f} s"
            broken.append(f"{phase.value} {when}, not within {by_s:g} s")
        else:
            took = at if took is None else max(took, at)
    moving = [s.t_s for s in sent if s.speed_m_s > 0.0]
    for what, window, times in (
        ("a forward speed", rule.still, moving),
        ("a setpoint", rule.silent, [s.t_s for s in sent]),
    ):
        since, until = window
        bad = [t for t in times if since + _GRAIN_S < t < until]
        if bad:
            broken.append(f"{what} {bad[0]:.2f} s after the strike")
        if since < inf:
            before = [t for t in times if t <= since + _GRAIN_S]
            took = max(took or 0.0, before[-1] if before else 0.0)
    last = steps[-1].phase if steps else struck_in
    if rule.ends_in is not None and last not in rule.ends_in:
        broken.append(f"ends in {last.value}")
    broken += [f"entered {s.phase.value}: {s.reason}" for s in steps if s.phase in rule.never]
    return Judgement(tuple(broken), took)
