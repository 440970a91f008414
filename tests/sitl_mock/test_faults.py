"""The schedule of faults."""

from __future__ import annotations

from math import inf

import pytest

from sitl_mock.faults import Fault, FaultAt, Faults, parse_fault


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("range-loss@20:3", FaultAt(Fault.RANGE_LOSS, 20.0, 3.0)),
        ("RC_SWITCH@1.5", FaultAt(Fault.RC_SWITCH, 1.5, inf)),
        ("gps-lost", FaultAt(Fault.GPS_LOST, 0.0, inf)),
    ],
)
def test_parse(text: str, expected: FaultAt) -> None:
    assert parse_fault(text) == expected


@pytest.mark.parametrize(
    "text", ["", "rain@3", "reboot@", "reboot@x", "reboot@-1", "reboot@nan", "reboot@1:0"]
)
def test_parse_refuses_in_words(text: str) -> None:
    with pytest.raises(ValueError, match="fault"):
        parse_fault(text)


def test_schedule_and_switching() -> None:
    faults = Faults([FaultAt(Fault.GPS_LOST, 2.0, 1.0), FaultAt(Fault.REBOOT, 0.5)])
    assert not faults.any
    faults.advance(1.0)
    assert faults.active(Fault.REBOOT)
    assert not faults.active(Fault.GPS_LOST)
    faults.advance(2.0)
    assert faults.active(Fault.GPS_LOST)
    faults.advance(3.0)
    assert not faults.active(Fault.GPS_LOST)
    before = faults.changes
    faults.switch(Fault.REBOOT, False)
    assert not faults.any
    assert faults.changes == before + 1
