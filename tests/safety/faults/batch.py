"""Many flights of the matrix, on several cores; processes find `fly` by this file's name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

from tests.safety.faults.flight import Flight, Outcome
from tests.safety.faults.matrix import FAULTS
from tests.safety.faults.rules import EVERY

Flown = tuple[str, int, int]
"""A flight to make: fault, number of the phase, seed. (Phases themselves do not travel between processes.)"""


def fly(flown: Flown) -> Outcome:
    """Make one flight."""
    name, number, seed = flown
    return Flight(FAULTS[name], EVERY[number], seed).fly()


def flights(names: Sequence[str], phases: Sequence[str], seeds: Sequence[int]) -> list[Flown]:
    """Every flight of the matrix, or of a part of it."""
    return [
        (name, number, seed)
        for name in names
        for number, phase in enumerate(EVERY)
        if phase in FAULTS[name].rules and phase.value in phases
        for seed in seeds
    ]


def fly_all(todo: list[Flown], jobs: int) -> Iterator[Outcome]:
    """Make the flights, on several cores; the order and the results do not depend on how many."""
    if jobs <= 1:
        yield from map(fly, todo)
        return
    with ProcessPoolExecutor(jobs, get_context("forkserver")) as pool:
        yield from pool.map(fly, todo, chunksize=8)
