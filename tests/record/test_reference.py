"""The pilot does what it did in the reference flights; `python -m tests.record.accept` accepts a change."""

from __future__ import annotations

import pytest

from companion.recording import read
from companion.replay import replay
from tests.record.reference import DATA, FLIGHTS, SAME_BEHAVIOUR, path_of, record


@pytest.mark.parametrize("name", FLIGHTS)
def test_the_pilot_does_what_it_did(name: str) -> None:
    if not DATA.exists():
        pytest.skip("no reference flights yet: python -m tests.record.accept")
    result = replay(read(path_of(name)))
    told = f"\n{result.text()}\naccept it with: python -m tests.record.accept"
    assert result.stopped is None and not result.problems, told
    assert result.deviation <= SAME_BEHAVIOUR, told


def test_nothing_else_lies_among_them() -> None:
    assert {path.stem for path in DATA.glob("*")} <= FLIGHTS.keys()


def test_the_same_simulation_gives_the_same_file() -> None:
    assert record("capture") == record("capture")
