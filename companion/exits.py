"""Exit statuses: stable, so that scripts and supervisors can tell the endings apart."""

from __future__ import annotations

from enum import IntEnum


class Exit(IntEnum):
    """What a command's exit status means. 1 is a bug: Python's own, with its traceback."""

    OK = 0
    USAGE = 2
    NO_VEHICLE = 3
    NO_RANGES = 4
    NOT_CAPTURED = 5
    LINK = 6
    NOT_READY = 7
    DIFFERENT = 8
    FAULTY = 9
    TOO_SLOW = 10
    INTERRUPTED = 130


MEANING = {
    Exit.OK: "done; for fly and demo: the target was captured; for check: ready to fly",
    Exit.USAGE: "wrong command line or configuration",
    Exit.NO_VEHICLE: "no vehicle fit to fly (telemetry, battery) within loss.wait_s; for watch: none heard",
    Exit.NO_RANGES: "no usable ranges within loss.wait_s; for beacons: no range heard",
    Exit.NOT_CAPTURED: "the flight ended without a capture",
    Exit.LINK: "a port or endpoint could not be opened",
    Exit.NOT_READY: "check: not ready to fly",
    Exit.DIFFERENT: "replay: other outputs than recorded",
    Exit.FAULTY: "publish --check, keys: something is wrong with the publisher, certificates or rules",
    Exit.TOO_SLOW: "bench system: a ratio is twice its goal",
    Exit.INTERRUPTED: "interrupted before a capture",
}
"""One line each, for `--help`."""
