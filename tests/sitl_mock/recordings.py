"""Recorded flights of a real PX4, and the same client played against the mock in virtual time."""

from __future__ import annotations

import csv
import gzip
import json
from collections.abc import Callable, Iterator
from functools import cache
from math import nan, pi
from pathlib import Path
from typing import Any

from pymavlink.dialects.v20 import development as mavlink

from sitl_mock.faults import FaultAt, Faults
from sitl_mock.params import Params
from sitl_mock.protocol import Link, Protocol
from sitl_mock.px4 import Px4
from sitl_mock.scenario import Scenario
from sitl_mock.vehicle import STEP_S, Vehicle

DATA = Path(__file__).parent.parent / "data"
Row = dict[str, Any]
"""One message: `t` seconds, `dir` "rx" (from the autopilot), "tx" or "note", `msg` its name, its fields."""
SCENARIO = Scenario(start_x_m=0.0, start_y_m=0.0, start_heading_rad=pi / 2)
"""The recordings begin at the origin, the nose to the North."""

_REPLAYED = frozenset(
    {
        "ATTITUDE", "COMMAND_ACK", "CURRENT_MODE", "EXTENDED_SYS_STATE", "HEARTBEAT", "LOCAL_POSITION_NED",
        "SYS_STATUS",
    }
)  # fmt: skip


@cache
def recording(name: str) -> tuple[Row, ...]:
    """The rows of a recording. Some of its lines are cut or run into one another: those are left out."""
    rows: list[Row] = []
    with gzip.open(DATA / f"{name}.jsonl.gz", "rt", errors="replace") as file:
        for line in file:
            try:
                row = json.loads(line)
            except json.JSONDecodeError:
                continue
            if isinstance(row, dict) and {"t", "dir", "msg"} <= row.keys():
                rows.append(row)
    return tuple(rows)


@cache
def estimate_and_truth(kind: str) -> dict[str, list[float]]:
    """PX4's estimate beside the simulator's truth, by column."""
    with gzip.open(DATA / f"estimate_vs_truth_{kind}.csv.gz", "rt") as file:
        rows = list(csv.DictReader(file))
    return {name: [float(row[name]) for row in rows] for name in rows[0]}


class Bench:
    """The mock on its two links, in virtual time: messages go in by `send`, `run` collects what comes out.

    With `keep` only messages of these names on the onboard link are collected.
    """

    def __init__(
        self,
        scenario: Scenario = SCENARIO,
        seed: int = 1,
        params: dict[str, int | float] | None = None,
        faults: tuple[FaultAt, ...] = (),
        keep: frozenset[str] | None = None,
    ) -> None:
        self._keep = keep
        self.faults = Faults(faults)
        self.vehicle = Vehicle(
            scenario, scenario.start_x_m, scenario.start_y_m, 0.0, scenario.start_heading_rad
        )
        self.px4 = Px4(scenario, seed, self.vehicle, Params(params), self.faults)
        self.protocol = Protocol(self.px4)
        self.rows: list[Row] = []
        self._steps = 0

    @property
    def t(self) -> float:
        """Seconds since the mock was started."""
        return self._steps * STEP_S

    def send(self, message: Any, link: Link = Link.ONBOARD) -> None:
        """A peer's message reaches the mock now."""
        message._header.srcSystem, message._header.srcComponent = 1, 191
        self.protocol.receive(link, message)

    def command(self, command: int, *params: float, link: Link = Link.ONBOARD) -> None:
        """COMMAND_LONG."""
        fields = [*params, *[0.0] * (7 - len(params))]
        self.send(mavlink.MAVLink_command_long_message(1, 1, command, 0, *fields), link)

    def run(self, until_s: float) -> None:
        """Let time pass."""
        while self._steps < round(until_s / STEP_S):
            self._steps += 1
            for link, message in self.protocol.step():
                name = message.get_type()
                if self._keep is not None and (name not in self._keep or link is not Link.ONBOARD):
                    continue
                fields = {name: getattr(message, name) for name in message.fieldnames}
                self.rows.append({"t": self.t, "dir": "rx", "link": link, "msg": name, **fields})

    def last(self, name: str) -> Row:
        """The newest message with this name."""
        return next(row for row in reversed(self.rows) if row["msg"] == name)


def replay(
    name: str,
    params: dict[str, int | float] | None = None,
    steer: Callable[[Row, Px4], Row] = lambda row, px4: row,
    seed: int = 1,
) -> list[Row]:
    """What the mock answers to a recording's client. `steer` may change a message before it is sent."""
    bench = Bench(seed=seed, params=params, keep=_REPLAYED)
    rows = recording(name)
    for row in rows:
        if row["dir"] != "tx":
            continue
        bench.run(row["t"])
        row = steer(row, bench.px4)
        message = getattr(mavlink, f"MAVLink_{row['msg'].lower()}_message")
        fields = {k: nan if v is None else v for k, v in row.items() if k in message.fieldnames}
        bench.send(message(**fields))
    bench.run(rows[-1]["t"])
    return bench.rows


def received(rows: tuple[Row, ...] | list[Row], name: str) -> Iterator[Row]:
    """The autopilot's messages of one name."""
    return (row for row in rows if row["dir"] == "rx" and row["msg"] == name)


def changes(
    rows: tuple[Row, ...] | list[Row], name: str, *fields: str
) -> list[tuple[float, tuple[Any, ...]]]:
    """When these fields of a message took which values: one entry for every change."""
    found: list[tuple[float, tuple[Any, ...]]] = []
    for row in received(rows, name):
        values = tuple(row[field] for field in fields)
        if not found or found[-1][1] != values:
            found.append((row["t"], values))
    return found
