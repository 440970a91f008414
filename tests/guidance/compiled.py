"""Compile plain-float functions with numba exactly as they stand, with everything of ours that they call."""

from __future__ import annotations

from types import FunctionType, ModuleType
from typing import Any

import numba

from companion.guidance.scheme import Scheme

_done: dict[object, Any] = {}


def compiled(thing: Any) -> Any:
    """A numba version of a function of this project (or of a module of such); anything else as it is."""
    if not isinstance(thing, FunctionType | ModuleType) or not _is_ours(thing):
        return thing
    if thing not in _done:
        if isinstance(thing, ModuleType):
            clone = ModuleType(thing.__name__)
            _done[thing] = clone
            for name, value in vars(thing).items():
                if not name.startswith("__"):
                    setattr(clone, name, compiled(value))
        else:
            names = {n: thing.__globals__[n] for n in thing.__code__.co_names if n in thing.__globals__}
            namespace: dict[str, Any] = {"__name__": thing.__module__}
            twin = FunctionType(thing.__code__, namespace, thing.__name__, thing.__defaults__)
            _done[thing] = numba.njit(twin)
            namespace.update({n: compiled(value) for n, value in names.items()})
    return _done[thing]


def compiled_scheme(scheme: Scheme) -> Scheme:
    """The same scheme with compiled functions."""
    return Scheme(scheme.p, *(compiled(f) for f in scheme[1:]))


def _is_ours(thing: FunctionType | ModuleType) -> bool:
    module = thing.__name__ if isinstance(thing, ModuleType) else thing.__module__
    return module.partition(".")[0] == "companion"
