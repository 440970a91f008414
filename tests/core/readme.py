"""The parts of the README that are made from the code: `python -m tests.core.readme` writes them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import msgspec

from companion.bench.system.figures import Report, markdown
from companion.config import schema

README = Path(__file__).parents[2] / "README.md"
BEGIN = "<!-- configuration table: written by `python -m tests.core.readme` -->\n"
END = "<!-- end of configuration table -->\n"
FIGURES = README.parent / "tests" / "data" / "bench-system.json"
"""What `companion bench system --json` printed last."""
FIGURES_BEGIN = (
    "<!-- figures: written by `python -m tests.core.readme` from tests/data/bench-system.json -->\n"
)
FIGURES_END = "<!-- end of figures -->\n"


def configuration_table() -> str:
    """Every key of every table with its default, what is allowed, and what it means."""
    definitions = schema()["$defs"]
    lines = ["| Key | Default | Allowed | |", "|---|---|---|---|"]
    for table, entry in definitions["Config"]["properties"].items():
        if table == "sim":
            continue
        if table == "beacons":
            name, fields = "beacons.ID", definitions["BeaconSettings"]["properties"]
        else:
            name, fields = table, definitions[_reference(entry)]["properties"]
        for key, field in fields.items():
            default = json.dumps(field.get("default"), ensure_ascii=False)
            meaning = field.get("description", "").replace("|", "\\|")
            lines.append(f"| `{name}.{key}` | `{default}` | {_allowed(field)} | {meaning} |")
    return "\n".join(lines) + "\n"


def _reference(entry: dict[str, Any]) -> str:
    reference: str = entry.get("$ref") or entry["anyOf"][0]["$ref"]
    return reference.rsplit("/", 1)[1]


def _allowed(field: dict[str, Any]) -> str:
    if "anyOf" in field:
        return " or ".join(_allowed(option) or "none" for option in field["anyOf"])
    if "enum" in field:
        return ", ".join(f"`{value}`" for value in field["enum"])
    low = field.get("minimum", field.get("exclusiveMinimum"))
    high = field.get("maximum", field.get("exclusiveMaximum"))
    if low is not None or high is not None:
        above = "> " if "exclusiveMinimum" in field else "≥ "
        below = "< " if "exclusiveMaximum" in field else "≤ "
        ends = (
            "" if low is None else f"{above}{low:g}",
            "" if high is None else f"{below}{high:g}",
        )
        return ", ".join(end for end in ends if end)
    return {"string": "text", "boolean": "`true`, `false`", "array": "list"}.get(field.get("type", ""), "")


def with_table(text: str) -> str:
    """The README's text with the configuration's table as it should be."""
    return _with(text, BEGIN, configuration_table(), END)


def with_figures(text: str) -> str:
    """The README's text with the figures of the benchmark as they were measured."""
    report = msgspec.json.decode(FIGURES.read_bytes(), type=Report)
    return _with(text, FIGURES_BEGIN, markdown(report), FIGURES_END)


def _with(text: str, begin: str, part: str, end: str) -> str:
    before, rest = text.split(begin)
    _, after = rest.split(end)
    return before + begin + part + end + after


if __name__ == "__main__":
    README.write_text(with_figures(with_table(README.read_text(encoding="utf-8"))), encoding="utf-8")
