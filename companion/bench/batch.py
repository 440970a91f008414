"""Many flights in little time: numba compiles the guidance that flies, and the plant, exactly as they stand.

No second copy of the mathematics exists: `_compiled` takes a plain function and, one by one, every function
of this project that it calls. Where the guidance makes Structs, which cost a flight least, numba is given a
NamedTuple of the same name and fields. Compiling costs some seconds per scheme and process; a flight then
costs about a millisecond. Results depend on the seed alone, not on the number of threads.
"""

from __future__ import annotations

import math
import os
from collections import namedtuple
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from types import FunctionType, ModuleType
from typing import Any, NamedTuple

import msgspec
import numba
import numpy as np

from companion.bench import plant as plants
from companion.bench.plant import Flight, Plant, Sample, Start
from companion.guidance.scheme import Scheme

Floats = np.ndarray[Any, np.dtype[np.float64]]
Progress = Callable[[int], None]
"""Told how many flights are done."""

_CHUNK = 50
"""Flights between two words of progress."""
_INNER: dict[str, Any] = {"no_cpython_wrapper": True, "no_cfunc_wrapper": True}
_done: dict[object, Any] = {}


class Flyer(NamedTuple):
    """What flies: a scheme, and the function that tells it the truth (`plant.untold` for all but the
    limits)."""

    scheme: Scheme
    tell: Callable[..., Any] = plants.untold


def _compiled(thing: Any) -> Any:
    """A numba version of a function or Struct of this project (or of a module of such); anything else as it
    is.

    Such a function can be called by compiled ones alone (Python would crash): without the ways in from
    elsewhere the compiler takes two thirds of the time.
    """
    if isinstance(thing, type) and issubclass(thing, msgspec.Struct):
        return _done.setdefault(thing, namedtuple(thing.__name__, thing.__struct_fields__))
    if not isinstance(thing, FunctionType | ModuleType) or not _is_ours(thing):
        return thing
    if thing not in _done:
        if isinstance(thing, ModuleType):
            clone = ModuleType(thing.__name__)
            _done[thing] = clone
            for name, value in vars(thing).items():
                if not name.startswith("__"):
                    setattr(clone, name, _compiled(value))
        else:
            names = {n: thing.__globals__[n] for n in thing.__code__.co_names if n in thing.__globals__}
            namespace: dict[str, Any] = {"__name__": thing.__module__}
            twin = FunctionType(thing.__code__, namespace, thing.__name__, thing.__defaults__)
            _done[thing] = numba.njit(twin, **_INNER)
            namespace.update({n: _compiled(value) for n, value in names.items()})
    return _done[thing]


def _compiled_scheme(scheme: Scheme) -> Scheme:
    """The same scheme with compiled functions."""
    return Scheme(_as_tuples(scheme.p), *(_compiled(f) for f in scheme[1:]))


def _as_tuples(p: Any) -> Any:
    """A Struct, and the Structs in it, as the NamedTuples that numba knows."""
    if not isinstance(p, msgspec.Struct):
        return p
    return _compiled(type(p))(*(_as_tuples(value) for value in msgspec.structs.astuple(p)))


def _is_ours(thing: FunctionType | ModuleType) -> bool:
    module = thing.__name__ if isinstance(thing, ModuleType) else thing.__module__
    return module.partition(".")[0] == "companion"


def random_starts(
    count: int, seed: int, d_min_m: float = 3.0, d_max_m: float = 30.0, theta_rad: float | None = None
) -> list[Start]:
    """Distances drawn evenly, and bearings too unless one is given; each start with a seed of its own.

    Fewer starts of the same seed are the first of more.
    """
    draws = np.random.default_rng(seed).random((count, 3))
    d = d_min_m + (d_max_m - d_min_m) * draws[:, 0]
    theta = math.pi * (2.0 * draws[:, 1] - 1.0) if theta_rad is None else np.full(count, theta_rad)
    seeds = (draws[:, 2] * 2**31).astype(int)
    return [Start(float(a), float(b), int(c)) for a, b, c in zip(d, theta, seeds, strict=True)]


def prepare(flyer: Flyer) -> None:
    """Compile, if this process has not done so yet; `fly_many` would do it as well."""
    _fly_range(flyer, Plant(), _table([]), _unflown(0), _UNTRACED, 0, 0)


def fly_many(
    flyer: Flyer, plant: Plant, starts: Sequence[Start], progress: Progress = lambda done: None
) -> Floats:
    """Fly from every start, on all cores; one `Flight` a line, in the order of the starts."""
    prepare(flyer)
    table, flights, count = _table(starts), _unflown(len(starts)), len(starts)
    done = 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        jobs = [
            pool.submit(
                _fly_range, flyer, plant, table, flights, _UNTRACED, first, min(first + _CHUNK, count)
            )
            for first in range(0, count, _CHUNK)
        ]
        for job in as_completed(jobs):
            done += job.result()
            progress(done)
    return flights


def fly_traced(flyer: Flyer, plant: Plant, start: Start) -> tuple[Flight, Floats]:
    """Fly once; the flight, and one `Sample` a line for every command."""
    trace, flights = _room(plant), _unflown(1)
    _fly_range(flyer, plant, _table([start]), flights, trace, 0, 1)
    return Flight(*flights[0]), trace[np.isfinite(trace[:, 0])]


def fly_plain(flyer: Flyer, plant: Plant, start: Start) -> tuple[Flight, Floats]:
    """As `fly_traced`, in plain Python: what the compiled form is held to."""
    trace = _room(plant)
    flight = plants.fly(*flyer.scheme[1:5], flyer.tell, flyer.scheme.p, plant, start, trace)
    return flight, trace[np.isfinite(trace[:, 0])]


_UNTRACED = np.empty((0, len(Sample._fields)))
"""A trace with room for nothing."""


def _room(plant: Plant) -> Floats:
    """Room for the trace of one flight."""
    lines = int(plant.limit_s / (plants.STEP_S * plants.RANGE_STEPS)) + 1
    return np.full((lines, len(Sample._fields)), math.nan)


def _table(starts: Sequence[Start]) -> Floats:
    return np.array(starts, dtype=np.float64).reshape(len(starts), len(Start._fields))


def _unflown(count: int) -> Floats:
    return np.full((count, len(Flight._fields)), math.nan)


def _fly_range(
    flyer: Flyer, plant: Plant, starts: Floats, flights: Floats, trace: Floats, first: int, last: int
) -> int:
    scheme = _compiled_scheme(flyer.scheme)
    _range()(*scheme[1:5], _compiled(flyer.tell), scheme.p, plant, starts, flights, trace, first, last)
    return last - first


def _range() -> Any:
    """The compiled loop over flights, which lets other threads run: the only way in from Python."""
    if _range not in _done:
        fly = _compiled(plants.fly)

        @numba.njit(nogil=True)
        def fly_range(
            initial: Any,
            predict: Any,
            update: Any,
            command: Any,
            tell: Any,
            p: Any,
            plant: Plant,
            starts: Floats,
            flights: Floats,
            trace: Floats,
            first: int,
            last: int,
        ) -> None:
            for n in range(first, last):
                start = Start(starts[n, 0], starts[n, 1], int(starts[n, 2]))
                flight = fly(initial, predict, update, command, tell, p, plant, start, trace)
                for i, value in enumerate(flight):
                    flights[n, i] = value

        _done[_range] = fly_range
    return _done[_range]
