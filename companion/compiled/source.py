"""Rewrite the core's source for the compiler: the same statements, on classes that C can lay out.

mypyc compiles typed Python. What it cannot make fast are msgspec's Structs, whose fields it reaches as any
Python would. So each Struct of the modules below becomes a plain class of the same fields, and `replace` of
one a copy with other values; a NamedTuple is made by C alone, not by its own Python function; numbers of a
module become constants, and members of imported enums and modules too, and functions of `math`, since to look
one up takes longer than most calls. Every other statement stays as it is written: the second copy of the core
is one that a build makes and throws away.
"""

from __future__ import annotations

import ast
import math
from pathlib import Path
from typing import TypeGuard

from companion.compiled import MANIFEST, PACKAGE, digest_of, file_of

MODULES = (
    "companion.beacons",
    "companion.echo",
    "companion.flight_writer",
    "companion.foxglove_views",
    "companion.gate",
    "companion.guidance.drift",
    "companion.guidance.kalman",
    "companion.guidance.lq",
    "companion.guidance.luenberger",
    "companion.guidance.model",
    "companion.guidance.readout",
    "companion.guidance.schemes",
    "companion.guidance.seek",
    "companion.guidance.seek_steer",
    "companion.guidance.station",
    "companion.guidance.station_fit",
    "companion.guidance.station_paper",
    "companion.guidance.station_pose",
    "companion.guidance.station_search",
    "companion.guidance.station_state",
    "companion.guidance.station_steer",
    "companion.health",
    "companion.intake",
    "companion.limits",
    "companion.link.decode",
    "companion.link.ground_station",
    "companion.link.mavlink",
    "companion.link.modes",
    "companion.link.packets",
    "companion.link.range_events",
    "companion.link.transport",
    "companion.link.zenoh_ranges",
    "companion.live",
    "companion.mcap_writer",
    "companion.pace",
    "companion.pilot",
    "companion.reach",
    "companion.reasons",
    "companion.recorder",
    "companion.run",
    "companion.state",
    "companion.status",
    "companion.vehicle",
    "companion.wire_range",
    "sitl_mock.ardupilot",
    "sitl_mock.autopilot",
    "sitl_mock.clock",
    "sitl_mock.estimate",
    "sitl_mock.noise",
    "sitl_mock.params",
    "sitl_mock.px4",
    "sitl_mock.uwb",
    "sitl_mock.vehicle",
    "sitl_mock.visitors",
    "sitl_mock.world",
)
"""What a range runs through on its way to a setpoint, every step of a flight, and of a simulated one. Whose
Structs are recorded or sent (`companion.types`) is shared by both forms, and stays as it is."""
SETTINGS = (
    "companion.guidance.settings",
    "companion.guidance.station_settings",
    "companion.network_settings",
    "companion.settings",
)
"""What the core asks for in every step, of classes of its own: `native` makes them of the app's."""
OUTSIDE = ("companion.link.", "companion.live", "companion.run")
"""Whose settings are those of the app."""


def write(into: Path) -> list[Path]:
    """Write the rewritten modules below `into`, and the manifest; their files."""
    trees = {
        module: ast.parse(file_of(module).read_text(encoding="utf-8")) for module in (*MODULES, *SETTINGS)
    }
    structs = [
        frozenset(name for name, _, _ in _fields(node))
        for module, tree in trees.items()
        for node in tree.body
        if module in MODULES and isinstance(node, ast.ClassDef) and _is_struct(node)
    ]
    replaced = frozenset(name for tree in trees.values() for name in _replaced(tree))
    tuples = {
        (module, node.name): [(name, value) for name, _, value in _fields(node)]
        for module, tree in trees.items()
        for node in tree.body
        if isinstance(node, ast.ClassDef) and _is_a(node, "NamedTuple")
    }
    manifest = into.joinpath(*MANIFEST.split(".")).with_suffix(".py")
    manifest.parent.mkdir(parents=True, exist_ok=True)
    manifest.write_text(
        f"COMPILED = {(*MODULES, *SETTINGS)!r}\nMADE_FROM = {made_from()!r}\n", encoding="utf-8"
    )
    files = [manifest]
    for module, tree in trees.items():
        file = into.joinpath(PACKAGE, *module.split(".")).with_suffix(".py")
        file.parent.mkdir(parents=True, exist_ok=True)
        rewritten = ast.fix_missing_locations(_Rewriter(module, structs, replaced, tuples).visit(tree))
        file.write_text(ast.unparse(rewritten) + "\n", encoding="utf-8")
        files.append(file)
    return files


def made_from() -> dict[str, str]:
    """All that a build depends on: those modules, and every other of this project that they import."""
    found: dict[str, str] = {}
    waiting = [*MODULES, *SETTINGS, __name__]
    while waiting:
        module = waiting.pop()
        file = file_of(module)
        if module in found or not file.is_file():
            continue
        found[module] = digest_of(file)
        for node in ast.walk(ast.parse(file.read_bytes())):
            if isinstance(node, ast.ImportFrom) and node.module is not None:
                waiting += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    return dict(sorted(found.items()))


_FUNCTIONS = frozenset({"acos", "asin", "atan", "atan2", "dist", "hypot", "remainder"})
"""Those of `math` that the compiler does not turn into C by itself."""

_Tuples = dict[tuple[str, str], list[tuple[str, ast.expr | None]]]
"""Module and name of every NamedTuple → its fields and their defaults."""


class _Rewriter(ast.NodeTransformer):
    def __init__(
        self, module: str, structs: list[frozenset[str]], replaced: frozenset[str], tuples: _Tuples
    ) -> None:
        self._structs = structs
        self._replaced = replaced
        self._tuples = {name: fields for (of, name), fields in tuples.items() if of == module}
        """As they are called in this module."""
        self._all_tuples = tuples
        self._is_settings = module in SETTINGS
        self._compiled = MODULES if module.startswith(OUTSIDE) else (*MODULES, *SETTINGS)
        self._members: dict[str, ast.Attribute] = {}

    def visit_ImportFrom(self, node: ast.ImportFrom) -> list[ast.stmt]:
        """Compiled modules import one another; all the rest they share with the app."""
        for alias in node.names:
            called = alias.asname or alias.name
            for (module, name), fields in self._all_tuples.items():
                if (node.module, alias.name) == (module, name):
                    self._tuples[called] = fields
                elif f"{node.module}.{alias.name}" == module:
                    self._tuples[f"{called}.{name}"] = fields
        if node.module in self._compiled:
            return [ast.ImportFrom(f"{PACKAGE}.{node.module}", node.names, 0)]
        compiled = [a for a in node.names if f"{node.module}.{a.name}" in self._compiled]
        shared = [a for a in node.names if a not in compiled]
        return [
            ast.ImportFrom(module, names, 0)
            for module, names in ((f"{PACKAGE}.{node.module}", compiled), (node.module, shared))
            if names
        ]

    def visit_Module(self, node: ast.Module) -> ast.Module:
        """The future, what the rewriting needs, the imports, what is looked up but once, and the rest."""
        self._imported = {
            alias.asname or alias.name
            for n in node.body
            if isinstance(n, ast.ImportFrom)
            for alias in n.names
        }
        self.generic_visit(node)
        last = max(i for i, n in enumerate(node.body) if isinstance(n, ast.Import | ast.ImportFrom))
        imports, rest = node.body[: last + 1], node.body[last + 1 :]
        first = next(i for i, n in enumerate(imports) if isinstance(n, ast.ImportFrom))
        typing = ast.ImportFrom("typing", [ast.alias("Final"), ast.alias("final")], 0)
        members = [_constant(name, member) for name, member in self._members.items()]
        body = [*imports[: first + 1], typing, *imports[first + 1 :], *members, *map(_final, rest)]
        return ast.Module(body, [])

    def visit_Attribute(self, node: ast.Attribute) -> ast.expr:
        """`Phase.HOLD` → `_Phase_HOLD`, `phase.STEERED` → `_phase_STEERED`, `math.hypot` → `_math_hypot`."""
        self.generic_visit(node)
        match node:
            case ast.Attribute(value=ast.Name(id="math"), attr=member) if member in _FUNCTIONS:
                return self._member(node, "math", member)
            case ast.Attribute(value=ast.Name(id=name), attr=member) if (
                name in self._imported and not name.isupper() and member.isupper()
            ):
                return self._member(node, name, member)
        return node

    def _member(self, node: ast.Attribute, of: str, name: str) -> ast.expr:
        self._members[f"_{of}_{name}"] = node
        return ast.Name(f"_{of}_{name}")

    def visit_ClassDef(self, node: ast.ClassDef) -> ast.ClassDef:
        self.generic_visit(node)
        if self._is_settings:  # made by `native` alone, which gives every value, and never replaced
            for field in (n for n in node.body if isinstance(n, ast.AnnAssign)):
                field.value = None
            return _native(node, frozenset())
        return _native(node, self._replaced) if _is_struct(node) else node

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        """`Annotated[float, Meta(gt=0.0)]` → `float`."""
        self.generic_visit(node)
        match node:
            case ast.Subscript(value=ast.Name(id="Annotated"), slice=ast.Tuple(elts=[kind, *_])):
                return kind
        return node

    def visit_Call(self, node: ast.Call) -> ast.expr:
        """`replace(s, phase=x)` → `s.but().but_phase(x)`, which mypyc calls directly; `Gains(1.0, k2=x)` →
        `tuple.__new__(Gains, (1.0, x))`; `math.isfinite(x)` → `abs(x) < inf`, which is C."""
        self.generic_visit(node)
        fields = self._tuples.get(ast.unparse(node.func))
        if fields is not None and not any(isinstance(a, ast.Starred) for a in node.args):
            named = {k.arg: k.value for k in node.keywords}
            rest = [named.get(name, value) for name, value in fields[len(node.args) :]]
            values = [*node.args, *(value for value in rest if value is not None)]
            new = self._member(ast.Attribute(ast.Name("tuple"), "__new__"), "tuple", "new")
            return ast.Call(new, [node.func, ast.Tuple(values)], [])
        if ast.unparse(node.func) == "math.isfinite":
            return ast.Compare(ast.Call(ast.Name("abs"), node.args, []), [ast.Lt()], [ast.Constant(math.inf)])
        names = {k.arg for k in node.keywords}
        if not _is_replace(node) or not any(names <= fields for fields in self._structs):
            return node
        result: ast.expr = ast.Call(ast.Attribute(node.args[0], "but"), [], [])
        for keyword in node.keywords:
            result = ast.Call(ast.Attribute(result, f"but_{keyword.arg}"), [keyword.value], [])
        return result


def _is_replace(node: ast.AST) -> TypeGuard[ast.Call]:
    return isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "replace"


def _replaced(tree: ast.Module) -> set[str]:
    """The fields that are ever replaced."""
    return {k.arg for node in ast.walk(tree) if _is_replace(node) for k in node.keywords if k.arg is not None}


def _is_a(node: ast.ClassDef, base: str) -> bool:
    return base in map(ast.unparse, node.bases)


def _is_struct(node: ast.ClassDef) -> bool:
    return _is_a(node, "msgspec.Struct") or _is_a(node, "Table")


def _fields(node: ast.ClassDef) -> list[tuple[str, str, ast.expr | None]]:
    """Name, type and default."""
    return [
        (n.target.id, ast.unparse(n.annotation), n.value)
        for n in node.body
        if isinstance(n, ast.AnnAssign) and isinstance(n.target, ast.Name)
    ]


def _native(node: ast.ClassDef, replaced: frozenset[str]) -> ast.ClassDef:
    """A plain class of the same fields, with what the places of `replace` need: a copy, and setters that
    return the object."""
    fields = _fields(node)
    others = [n for n in node.body if isinstance(n, ast.FunctionDef) and n.name != "__post_init__"]
    parameters = "".join(f", {n}: {t}" + ("" if v is None else f" = {ast.unparse(v)}") for n, t, v in fields)
    lines = [f"@final\nclass {node.name}:"]
    lines += [f"    {n}: {t}" for n, t, _ in fields]
    lines += [f"    def __init__(self{parameters}) -> None:"]
    lines += [f"        self.{n} = {n}" for n, _, _ in fields] or ["        pass"]
    lines += [f"    def but(self) -> {node.name}:"]
    lines += [f"        return {node.name}({', '.join(f'self.{n}' for n, _, _ in fields)})"]
    for n, t in ((n, t) for n, t, _ in fields if n in replaced):
        lines += [f"    def but_{n}(self, {n}: {t}) -> {node.name}:"]
        lines += [f"        self.{n} = {n}", "        return self"]
    (made,) = ast.parse("\n".join(lines)).body
    assert isinstance(made, ast.ClassDef)
    made.body += others
    return made


def _final(node: ast.stmt) -> ast.stmt:
    """A module's number that is never assigned again: the compiler puts it where it is used."""
    match node:
        case ast.Assign(targets=[ast.Name(id=name)], value=value) if name.isupper() and _is_number(value):
            return _constant(name, value)
    return node


def _constant(name: str, value: ast.expr) -> ast.stmt:
    return ast.AnnAssign(ast.Name(name), ast.Name("Final"), value, 1)


def _is_number(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, int | float)
