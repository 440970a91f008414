"""What can happen to messages on their way: each filter takes an event and gives what arrives instead."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from random import Random

from msgspec.structs import replace

from companion.types import (
    Attitude,
    BatteryReport,
    Defect,
    EstimatorReport,
    Event,
    LandedReport,
    LocalMotion,
    Malformed,
    ModeReport,
    Output,
    RangeSample,
    Tick,
    VehicleHeartbeat,
)

Filter = Callable[[Event], Iterable[Event]]
Maker = Callable[[Random], Filter]
"""Makes a filter with its own random numbers."""
Uplink = Callable[[Output], Iterable[Output]]
UplinkMaker = Callable[[Random], Uplink]

RANGES = (RangeSample,)
MAVLINK = (
    Attitude, LocalMotion, VehicleHeartbeat, ModeReport, LandedReport, BatteryReport, EstimatorReport,
)  # fmt: skip
ALL = (*RANGES, *MAVLINK, Tick)
Kinds = tuple[type[Event], ...]


def lose(kinds: Kinds, share: float) -> Maker:
    """This share of them is lost."""
    return lambda random: (
        lambda event: () if isinstance(event, kinds) and random.random() < share else (event,)
    )


def repeat(kinds: Kinds, times: int) -> Maker:
    """Each comes so often."""
    return lambda _: lambda event: (event,) * (times if isinstance(event, kinds) else 1)


def change(kinds: Kinds, how: Callable[[Event, Random], Event]) -> Maker:
    """Each arrives changed."""
    return lambda random: lambda event: (how(event, random) if isinstance(event, kinds) else event,)


def jam(defect: Defect, count: int) -> Maker:
    """Garbage arrives with every tick."""

    def filtered(event: Event) -> Iterator[Event]:
        yield event
        if isinstance(event, Tick):
            for _ in range(count):
                yield Malformed(event.t_ns, defect, "garbage")

    return lambda _: filtered


def swap(kinds: Kinds) -> Maker:
    """Every two of a kind arrive in the wrong order."""

    def make(_: Random) -> Filter:
        held: dict[type[Event], Event] = {}

        def filtered(event: Event) -> Iterator[Event]:
            kind = type(event)
            if kind not in kinds:
                yield event
            elif kind not in held:
                held[kind] = event
            else:
                yield event
                yield replace(held.pop(kind), t_ns=event.t_ns)

        return filtered

    return make


def late(kinds: Kinds, delay_s: float) -> Maker:
    """Each arrives so much later."""

    def make(_: Random) -> Filter:
        waiting: list[Event] = []

        def filtered(event: Event) -> Iterator[Event]:
            if isinstance(event, kinds):
                waiting.append(event)
            while waiting and event.t_ns - waiting[0].t_ns >= delay_s * 1e9:
                yield replace(waiting.pop(0), t_ns=event.t_ns)
            if not isinstance(event, kinds):
                yield event

        return filtered

    return make


def bursts(kinds: Kinds, every_s: float, once: bool = False) -> Maker:
    """They wait for so long, then come all at once: the ranges first, and of the ticks only the last.

    `once`: and flow freely afterwards. With every kind this is a loop that does not run, and wakes.
    """

    def make(_: Random) -> Filter:
        waiting: list[Event] = []
        since_ns: int | None = None
        over = False

        def filtered(event: Event) -> Iterator[Event]:
            nonlocal since_ns, over
            since_ns = event.t_ns if since_ns is None else since_ns
            if over or not isinstance(event, kinds):
                yield event
                return
            waiting.append(event)
            if event.t_ns - since_ns < every_s * 1e9:
                return
            ticks = [e for e in waiting if isinstance(e, Tick)][-1:]
            ranges = [e for e in waiting if isinstance(e, RangeSample)]
            others = [e for e in waiting if not isinstance(e, Tick | RangeSample)]
            for each in (*ranges, *others, *ticks):
                yield replace(each, t_ns=event.t_ns)
            waiting.clear()
            since_ns, over = event.t_ns, once

        return filtered

    return make


def flood(rate_hz: float) -> Maker:
    """Ranges at this rate: between two real ones come copies with sequence numbers of their own."""

    def make(_: Random) -> Filter:
        last: RangeSample | None = None
        seq = 0

        def filtered(event: Event) -> Iterator[Event]:
            nonlocal last, seq
            if isinstance(event, RangeSample):
                last = event
            elif isinstance(event, Tick) and last is not None:
                for _ in range(round(rate_hz / 50.0)):
                    seq += 1
                    yield replace(last, t_ns=event.t_ns, session="flood", seq=seq)
            if not isinstance(event, RangeSample):
                yield event

        return filtered

    return make


def lose_up(share: float) -> UplinkMaker:
    """This share of what the app sends is lost."""
    return lambda random: lambda output: () if random.random() < share else (output,)


def repeat_up(times: int) -> UplinkMaker:
    """Each message of the app arrives so often."""
    return lambda _: lambda output: (output,) * times
