"""What the true range can be by now: what the vehicle can have flown since, and nothing further.

A distance changes no faster than the vehicle moves. The span widens at that rate, and every believed range
narrows it to its own margin; a range outside has jumped, whether at once or by creeping faster than that.
"""

from __future__ import annotations

import msgspec


class Span(msgspec.Struct, frozen=True, gc=False):
    """All that the true range can be."""

    low_m: float
    high_m: float
    t_ns: int
    rate_m_s: float
    since_ns: int
    """When it began."""


class Reach(msgspec.Struct, frozen=True, gc=False):
    """The span of the believed ranges; `doubt` is that of ranges outside it, as far as they agree."""

    span: Span
    doubt: Span | None = None


_NOISE_SIGMAS = 5.0
"""A range is not further from the truth than this."""
_CONVINCED_NS = 1_000_000_000
"""Ranges that contradict the former ones, but not each other, are believed after this time."""
_DOUBT_LASTS_NS = 300_000_000
"""A doubt that has not been confirmed for so long gives way to the next one."""


def judged(
    reach: Reach | None, t_ns: int, range_m: float, sigma_m: float, rate_m_s: float
) -> tuple[Reach, bool]:
    """The reach with one more range, and whether that range is within it. `rate_m_s`: the vehicle's, now."""
    margin_m = _NOISE_SIGMAS * sigma_m
    if reach is None:
        return Reach(Span(range_m - margin_m, range_m + margin_m, t_ns, rate_m_s, t_ns)), True
    span = _narrowed(reach.span, t_ns, range_m, margin_m, rate_m_s)
    if span is not None:
        return Reach(span), True
    doubt = reach.doubt
    if doubt is not None:
        confirmed = _narrowed(doubt, t_ns, range_m, margin_m, rate_m_s)
        if confirmed is not None:
            # critical: without this a lie would shut the truth out for long
            if t_ns - confirmed.since_ns >= _CONVINCED_NS:
                return Reach(confirmed), True
            return Reach(reach.span, confirmed), False
        if t_ns - doubt.t_ns < _DOUBT_LASTS_NS:
            return reach, False
    return Reach(reach.span, Span(range_m - margin_m, range_m + margin_m, t_ns, rate_m_s, t_ns)), False


def _narrowed(span: Span, t_ns: int, range_m: float, margin_m: float, rate_m_s: float) -> Span | None:
    """What is left of the span by now, within the range's margin; None where that is nothing."""
    wider_m = max(span.rate_m_s, rate_m_s) * (t_ns - span.t_ns) * 1e-9
    low_m = max(span.low_m - wider_m, range_m - margin_m)
    high_m = min(span.high_m + wider_m, range_m + margin_m)
    return Span(low_m, high_m, t_ns, rate_m_s, span.since_ns) if low_m <= high_m else None
