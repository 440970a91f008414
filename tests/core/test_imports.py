"""Imports point one way: held by walking the syntax trees."""

from __future__ import annotations

import ast
import functools
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]

ORDER = [
    "types", "guidance", "network_settings", "settings",
    "beacons", "pace", "reach", "gate", "vehicle", "echo", "health", "phase",
    "limits", "state", "intake", "status", "reasons", "pilot", "run",
]  # fmt: skip
"""The core, each built on those before it."""
CORE = set(ORDER)
"""The pure core, which may import only itself."""
EDGES = {
    "link", "live", "view", "lines", "panel", "summary", "range_message", "wire_range", "wire_status",
    "record", "flight_writer", "recorder", "recording", "replay", "mcap_writer", "foxglove", "foxglove_views",
    "uwb",
}  # fmt: skip
COMPILED = {"compiled"}
"""Which form of the core runs: the loop asks for it, the record tells it, and it needs nothing of ours."""
DESK = {
    "operator", "ground", "picture", "demo", "goal", "bench", "simulate", "publish", "check", "watch", "keys",
    "report", "calibrate",
}  # fmt: skip
TOP = {
    "cli", "cli_publish", "cli_watch", "cli_keys", "cli_calibrate", "commands", "fly", "config", "exits",
    "__main__",
} | DESK  # fmt: skip


@functools.cache
def imported(path: Path) -> frozenset[str]:
    """Every module that a file imports when it is loaded or run, dotted."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module} | {f"{node.module}.{alias.name}" for alias in node.names}
    return frozenset(names)


def room(module: str) -> str:
    """`companion.link.mavlink` → `link`."""
    return module.split(".")[1] if module.startswith("companion.") else ""


def files(package: str) -> list[Path]:
    return sorted((ROOT / package).rglob("*.py"))


def name_of(path: Path) -> str:
    return path.relative_to(ROOT / "companion").parts[0].removesuffix(".py")


@pytest.mark.parametrize("path", files("companion"), ids=lambda p: str(p.relative_to(ROOT)))
def test_nothing_below_the_command_line_imports_what_is_above_it(path: Path) -> None:
    here = name_of(path)
    rooms = {room(module) for module in imported(path)} - {""}
    if here in CORE:
        assert rooms <= (CORE | COMPILED if here == "run" else CORE)
    elif here in EDGES:
        assert rooms <= CORE | EDGES | COMPILED
    elif here in COMPILED:
        assert rooms <= COMPILED
    if here not in TOP:
        assert not any(module.startswith("sitl_mock") for module in imported(path))


@pytest.mark.parametrize("path", files("companion"), ids=lambda p: str(p.relative_to(ROOT)))
def test_the_core_has_one_direction(path: Path) -> None:
    here = name_of(path)
    if here in ORDER:
        above = set(ORDER[ORDER.index(here) + 1 :])
        assert not {room(module) for module in imported(path)} & above


FORBIDDEN_IN_CORE = {
    "time", "datetime", "socket", "select", "random", "os", "pathlib", "threading", "asyncio", "io",
    "logging", "numpy", "scipy", "control", "zenoh", "pymavlink", "mavsdk", "serial", "rich", "matplotlib",
}  # fmt: skip


@pytest.mark.parametrize(
    "path", [p for p in files("companion") if name_of(p) in CORE], ids=lambda p: str(p.relative_to(ROOT))
)
def test_the_core_touches_no_clock_no_file_no_socket(path: Path) -> None:
    assert not {module.split(".")[0] for module in imported(path)} & FORBIDDEN_IN_CORE


def test_the_mock_is_independent_of_the_app() -> None:
    allowed = ("companion.types", "companion.range_message", "companion.wire_range")
    for path in files("sitl_mock"):
        ours = {m for m in imported(path) if m == "companion" or m.startswith("companion.")}
        assert all(m.startswith(allowed) for m in ours), path


def test_only_the_links_speak_mavlink_and_zenoh() -> None:
    desk = {"operator", "ground", "demo", "bench", "publish", "uwb", "fly", "keys"}
    for path in files("companion"):
        roots = {module.split(".")[0] for module in imported(path)}
        if name_of(path) not in {"link"} | desk:
            assert not roots & {"pymavlink", "zenoh"}, path


def loaded(code: str, libraries: str) -> str:
    """Which of the libraries a process has loaded after the code."""
    told = f"\nimport sys; print(*(m for m in {libraries.split()!r} if m in sys.modules))"
    done = subprocess.run([sys.executable, "-c", code + told], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def test_the_flying_process_loads_none_of_the_desks_tools() -> None:
    code = (
        "import sys, companion.cli, companion.fly, companion.config, companion.view as view\n"
        "view.open_view(sys.stdout, view.ViewKind.PLAIN).close()"
    )
    # rich: with --view live alone
    assert loaded(code, "control scipy matplotlib numba mavsdk numpy pandas plotly rich") == ""


def test_the_help_loads_no_library() -> None:
    code = "import companion.cli; companion.cli._parser().format_help()"
    assert loaded(code, "msgspec zenoh pymavlink rich mcap serial") == ""
    assert loaded(code, "argparse") == "argparse"
