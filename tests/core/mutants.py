"""Mutation testing of the limits and of the phases: `make mutants`.

mutmut changes `companion/limits.py` and `companion/phase.py` in some 240 ways, one at a time, in a copy below
`mutants/`, and runs the tests named in `[tool.mutmut]` of pyproject.toml against each. A change that no test
notices has to stand in `EXPLAINED`. mutmut changes functions only; the table of phases is data, and
held entry by entry by `test_phase_table.py`.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

MUTMUT = Path(sys.executable).with_name("mutmut")

EXPLAINED = {
    "if before * wanted <= 0.0:": "one of the two is zero: from zero it is slewed from zero anyway, "
    "and towards zero it goes at once",
    "if abs(wanted) < abs(before):": "of equal size and sign they are the same number: within any step",
    "return low if value <= low else high if value > high else value": "at the bound the value is the bound",
    "return low if value < low else high if value >= high else value": "at the bound the value is the bound",
}
"""A changed line that no test can notice → why."""


def survivors() -> list[tuple[str, str]]:
    """Name and changed line of every mutant that no test noticed."""
    results = _mutmut("results").splitlines()
    names = [line.strip().partition(":")[0] for line in results if "mutmut_" in line]
    return [(name, _changed(_mutmut("show", name))) for name in names]


def _changed(diff: str) -> str:
    added = [line[1:].strip() for line in diff.splitlines() if line.startswith("+") and line[1:2] != "+"]
    return " ".join(added)


def _mutmut(*arguments: str) -> str:
    return subprocess.run([MUTMUT, *arguments], capture_output=True, text=True, check=True).stdout


def main() -> int:
    """Run mutmut; 0 where every survivor is explained."""
    if subprocess.run([MUTMUT, "run"], check=False).returncode:
        return 1
    unexplained = 0
    for name, line in survivors():
        why = EXPLAINED.get(line)
        unexplained += why is None
        print(f"{name}: {line}\n    {why or 'NOT EXPLAINED: write a test that notices it'}")
    print(f"{unexplained} surviving mutants that are not explained")
    return 1 if unexplained else 0


if __name__ == "__main__":
    sys.exit(main())
