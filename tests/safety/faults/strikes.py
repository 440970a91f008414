"""What a fault does, from the parts of the mock, the filters and the people around a flight."""

from __future__ import annotations

import math
from random import Random

from msgspec.structs import replace

from companion.types import Attitude, Event, LocalMotion, RangeSample
from sitl_mock.faults import Fault as MockFault
from tests.safety.faults import filters as via
from tests.safety.faults.filters import RANGES, Maker, UplinkMaker
from tests.safety.faults.flight import UNIX_NS, Act, Flight, off, on

Acts = tuple[tuple[float, Act], ...]
"""Seconds after the strike, and what happens then."""


def switched(fault: MockFault, for_s: float = math.inf) -> Acts:
    """A fault of the mock, for so long."""
    acts: Acts = ((0.0, on(fault)),)
    return acts if for_s == math.inf else (*acts, (for_s, off(fault)))


def filtered(maker: Maker | None = None, for_s: float = math.inf, up: UplinkMaker | None = None) -> Acts:
    """Messages to the app, and from it, go through a filter, for so long."""

    def begin(flight: Flight) -> None:
        if maker is not None:
            flight.filters[maker] = maker(flight.random)
        if up is not None:
            flight.uplinks[up] = up(flight.random)

    def end(flight: Flight) -> None:
        flight.filters.pop(maker, None)
        flight.uplinks.pop(up, None)

    return ((0.0, begin),) if for_s == math.inf else ((0.0, begin), (for_s, end))


def clock_set(by_s: float) -> Act:
    """The publisher's clock is set."""

    def act(flight: Flight) -> None:
        flight.wall_step_ns += round(by_s * 1e9)

    return act


def engage(flight: Flight) -> None:
    """A person selects OFFBOARD."""
    flight.world.engage()


def ranges_with(**changes: object) -> Maker:
    """Every range arrives with these fields changed."""

    def how(event: Event, _: Random) -> Event:
        return replace(event, **changes)

    return via.change(RANGES, how)


def ranges_drawn(least_m: float, most_m: float) -> Maker:
    """Every range arrives with a length drawn between these two."""

    def how(event: Event, random: Random) -> Event:
        return replace(event, range_m=random.uniform(least_m, most_m))

    return via.change(RANGES, how)


def absurd(event: Event, random: Random) -> Event:
    """A length that cannot be."""
    return replace(event, range_m=random.choice((math.nan, math.inf, -math.inf, -1.0, 0.0, 1e9)))


def seq_stuck(event: Event, _: Random) -> Event:
    """Sequence numbers 0, 1, 2, 0, …"""
    return replace(event, seq=event.seq % 3) if isinstance(event, RangeSample) else event


def stamped_anew(event: Event, _: Random) -> Event:
    """Every range carries the time at which it is sent, not that of its measurement."""
    return replace(event, sent_t_ns=event.t_ns + UNIX_NS) if isinstance(event, RangeSample) else event


def turned(event: Event, _: Random) -> Event:
    """The heading, turned by a radian."""
    if not isinstance(event, Attitude):
        return event
    return replace(event, heading_rad=math.remainder(event.heading_rad + 1.0, 2.0 * math.pi))


def moved(event: Event, _: Random) -> Event:
    """The position, 6 m off."""
    if not isinstance(event, LocalMotion) or event.x_m is None or event.y_m is None:
        return event
    return replace(event, x_m=event.x_m + 5.0, y_m=event.y_m - 3.0)


def raised(event: Event, _: Random) -> Event:
    """The height, 20 m too large."""
    if not isinstance(event, LocalMotion) or event.height_m is None:
        return event
    return replace(event, height_m=event.height_m + 20.0)


def not_finite(event: Event, random: Random) -> Event:
    """A heading, or a velocity and a height, that are not finite."""
    bad = random.choice((math.nan, math.inf))
    if isinstance(event, Attitude):
        return replace(event, heading_rad=bad)
    return replace(event, vx_m_s=bad, height_m=bad)


def fast(event: Event, _: Random) -> Event:
    """The velocity, 3 m/s too large to the East."""
    return replace(event, vx_m_s=event.vx_m_s + 3.0) if isinstance(event, LocalMotion) else event


def boot_back(event: Event, _: Random) -> Event:
    """The autopilot's clock, which begins anew every second."""
    return (
        replace(event, boot_ms=event.boot_ms % 1000) if isinstance(event, Attitude | LocalMotion) else event
    )


def boot_half_back(event: Event, _: Random) -> Event:
    """The autopilot's clock is half a second behind what it was."""
    return replace(event, boot_ms=event.boot_ms - 500) if isinstance(event, Attitude | LocalMotion) else event
