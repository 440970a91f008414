"""The core in machine code, where it was built: the same source, run through mypyc when this was installed.

`twin` gives the compiled form of a function or class, and the thing itself where there is none. Compiled code
counts only as long as every file that it was made from is the one that is here: whoever edits a source runs
what was edited, not what was built before. Both forms do the same, bit for bit; only their speed differs.

A compiled class is another class: who gives one to compiled code gives its twin, and to the core the settings
as it reads them (`native`).
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

PACKAGE = "companion_compiled"
"""`companion.pilot` is compiled as `companion_compiled.companion.pilot`."""
MANIFEST = f"{PACKAGE}.manifest"
"""What is compiled and what it was made from. Compiled itself, into the same library: a build that fails
leaves an old library with its old digests, and none that is taken for a new one."""
ROOT = Path(__file__).parents[2]

_Thing = TypeVar("_Thing", bound=Callable[..., Any])


def twin(thing: _Thing) -> _Thing:
    """The compiled form of a function or class; the thing itself where there is none."""
    if why_not() is not None or thing.__module__ not in import_module(MANIFEST).COMPILED:
        return thing
    compiled: _Thing = getattr(import_module(f"{PACKAGE}.{thing.__module__}"), thing.__name__)
    return compiled


def native(settings: Any) -> Any:
    """Settings as the compiled core reads them, in classes of its own; themselves where there is none."""
    if isinstance(settings, dict):
        return {name: native(value) for name, value in settings.items()}
    kinds: tuple[Any, ...] = type(settings).__mro__
    for kind in kinds:
        compiled = twin(kind)
        if compiled is not kind:
            return compiled(*(native(getattr(settings, name)) for name in kind.__struct_fields__))
    return settings


@cache
def why_not() -> str | None:
    """Why the core runs as plain Python, for a person; None where it is compiled."""
    try:
        made_from: dict[str, str] = import_module(MANIFEST).MADE_FROM
    except ImportError:
        return "not compiled when it was installed (that takes a C compiler and Python's headers)"
    for module, digest in made_from.items():
        if digest_of(file_of(module)) != digest:
            return f"{module} has changed since it was compiled (to compile it anew: make compiled)"
    return None


def form() -> str:
    """Of the core that runs here: "compiled" or "not compiled"."""
    return "compiled" if why_not() is None else "not compiled"


def file_of(module: str) -> Path:
    """The source of a module of this project."""
    return ROOT.joinpath(*module.split(".")).with_suffix(".py")


def digest_of(file: Path) -> str:
    """What tells one state of a source from another."""
    return hashlib.sha256(file.read_bytes()).hexdigest()
