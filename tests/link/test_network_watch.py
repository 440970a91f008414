"""What a person is told of the network while ranges are awaited: a wrong endpoint is silent in Zenoh."""

from __future__ import annotations

from typing import cast

from companion.fly import NetworkWatch
from companion.link.zenoh_ranges import RangeLink
from tests.people.flights import status

WAITING = status(awaited=("ranges of beacon 'b1'",))


class Link:
    """A range link's outside."""

    def __init__(self) -> None:
        self.neighbours = 0
        self.reason = ""

    def connected(self) -> int:
        return self.neighbours


def watch(is_guarded: bool = False) -> tuple[Link, NetworkWatch, list[str]]:
    link, told = Link(), list[str]()
    return link, NetworkWatch(cast(RangeLink, link), is_guarded, told.append), told


def test_nobody_there_is_told_once_with_the_reason_and_then_that_somebody_is() -> None:
    link, network, told = watch()
    network.look(WAITING)
    assert not told  # it has only just begun
    link.reason = "unable to connect"
    for _ in range(5):
        network.look(WAITING)
    link.neighbours = 1
    for _ in range(5):
        network.look(WAITING)
    assert len(told) == 2
    assert "connected to nobody" in told[0] and "unable to connect" in told[0]
    assert "connected, and no range yet" in told[1]


def test_with_certificates_the_rules_are_named_as_a_cause() -> None:
    link, network, told = watch(is_guarded=True)
    link.neighbours = 1
    network.look(WAITING)
    network.look(WAITING)
    assert "the router's rules" in told[0]


def test_nothing_is_asked_in_flight() -> None:
    _, network, told = watch()
    for _ in range(5):
        network.look(status(awaited=("autopilot HEARTBEAT",)))
        network.look(status())
    assert not told
