"""What the true range can be by now: what the vehicle can have flown since, and nothing further.

A distance changes no faster than the vehicle moves. The span widens at that rate, and every believed range
narrows it to its own margin; a range outside has jumped, whether at once or by creeping faster than that.
Beside the believed span there is a doubt, the span of ranges that do not fit into it: it takes the other's
place when more ranges speak for it, so that one lie that was believed does not shut out the truth.
"""

from __future__ import annotations

import msgspec


class Span(msgspec.Struct, frozen=True, gc=False):
    """All that the true range can be."""

    low_m: float
    high_m: float
    t_ns: int
    rate_m_s: float


class Reach(msgspec.Struct, frozen=True, gc=False):
    """The believed span, and the doubt."""

    span: Span
    doubt: Span | None = None
    since_ns: int = 0
    """When the doubt began; 0 where it is what was believed before."""
    hits: int = 0
    doubt_hits: int = 0
    """Ranges that fitted into the believed span, and into the doubt alone, since the doubt began."""


_NOISE_SIGMAS = 5.0
"""A range is not further from the truth than this."""
_CONVINCED_NS = 1_000_000_000
"""A doubt that did not grow out of what was believed must last for so long."""
_DOUBT_LASTS_NS = 300_000_000
"""A doubt that has not been confirmed for so long gives way to the next one."""


def judged(
    reach: Reach | None, t_ns: int, range_m: float, sigma_m: float, rate_m_s: float
) -> tuple[Reach, bool]:
    """The reach with one more range, and whether that range is within it. `rate_m_s`: the vehicle's, now."""
    margin_m = _NOISE_SIGMAS * sigma_m
    low_m, high_m = range_m - margin_m, range_m + margin_m
    if reach is None:
        return Reach(Span(low_m, high_m, t_ns, rate_m_s)), True
    span, doubt = reach.span, reach.doubt
    wider_m = max(span.rate_m_s, rate_m_s) * (t_ns - span.t_ns) * 1e-9
    least_m, most_m = span.low_m - wider_m, span.high_m + wider_m
    if low_m <= most_m and least_m <= high_m:
        fits = Span(
            low_m if low_m > least_m else least_m, high_m if high_m < most_m else most_m, t_ns, rate_m_s
        )
        if low_m > span.high_m or span.low_m > high_m:
            # Only a flight explains it: if the next range says that there was none, it was a lie.
            return Reach(fits, Span(least_m, most_m, t_ns, rate_m_s)), True
        if doubt is None or t_ns - doubt.t_ns > _DOUBT_LASTS_NS:
            return Reach(fits), True
        return Reach(fits, doubt, reach.since_ns, reach.hits + 1, reach.doubt_hits), True
    if doubt is not None:
        wider_m = max(doubt.rate_m_s, rate_m_s) * (t_ns - doubt.t_ns) * 1e-9
        least_m, most_m = doubt.low_m - wider_m, doubt.high_m + wider_m
        if low_m <= most_m and least_m <= high_m:
            other, hits = Span(max(low_m, least_m), min(high_m, most_m), t_ns, rate_m_s), reach.doubt_hits + 1
            # critical: without this a lie would shut the truth out for long
            if hits > reach.hits and t_ns - reach.since_ns >= _CONVINCED_NS:
                return Reach(other), True
            return Reach(span, other, reach.since_ns, reach.hits, hits), False
        if t_ns - doubt.t_ns <= _DOUBT_LASTS_NS:
            return reach, False
    return Reach(span, Span(low_m, high_m, t_ns, rate_m_s), t_ns, 0, 1), False
