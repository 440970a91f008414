"""Where measurements come from: a serial port, standard input, a file, or nowhere (a simulated beacon).

Every source is a generator of batches. It never blocks for long: where nothing has come, the batch is empty.
"""

from __future__ import annotations

import math
import os
import select
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from random import Random
from threading import Event
from typing import assert_never

import serial

from companion.uwb.dwm1001_tlv import LOC_GET
from companion.uwb.families import Family
from companion.uwb.measured import Measured, Parser

_READ_S = 0.02
_QUIET_S = 1.5
"""A module that has measured nothing for this long after the port was opened is told to begin."""
_CHARACTER_S = 0.1
"""DWM1001's shell loses characters that come faster."""
_COMMAND_S = 1.0
_REOPEN_S = 1.0
_CHUNK_BYTES = 4096
_NOISE_FLOOR_M = 0.01


class SourceError(Exception):
    """The source cannot be used as it was asked for, in one line."""


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A module on a serial port, 8N1. `baud` and `commands` default to the family's."""

    device: str
    baud: int | None = None
    commands: tuple[str, ...] | None = None
    """Lines typed when the module measures nothing by itself, such as `INITF -ADDR=0 -PADDR=1`."""
    poll_hz: float = 10.0
    """DWM1001 in TLV mode measures at its own pace, but tells it only when asked."""


@dataclass(frozen=True, slots=True)
class Recording:
    """A file at its recorded pace; or standard input (`path` None) as it comes, unless `speed` is given."""

    path: Path | None
    speed: float | None = None
    rate_hz: float | None = None
    """The pace of messages that tell no time."""


@dataclass(frozen=True, slots=True)
class Simulated:
    """A fixed beacon and a tag that flies a circle around a place `distance_m` away; radius 0: it stands."""

    beacon: str = "b1"
    distance_m: float = 10.0
    radius_m: float = 0.0
    period_s: float = 30.0
    rate_hz: float = 20.0
    sigma_m: float = 0.07
    dropout: float = 0.0
    """Share of measurements that are lost."""
    seed: int = 1

    def range_m(self, t_s: float) -> float:
        """The true distance."""
        angle = 2.0 * math.pi * t_s / self.period_s
        return math.hypot(self.distance_m + self.radius_m * math.cos(angle), self.radius_m * math.sin(angle))


Source = SerialPort | Recording | Simulated
Batches = Iterator[list[Measured]]
_BAUD = {Family.LINKTRACK: 921_600}
_COMMANDS = {Family.DWM1001_SHELL: ("\r", "lec")}
"""Two CR open the shell; `lec` starts the stream, and would stop it where it runs already."""


def batches(
    source: Source, family: Family | None, parser: Parser, stop: Event, say: Callable[[str], None]
) -> Batches:
    """The source's measurements until it ends or `stop` is set. Opens nothing before the first `next`.

    Raises SourceError, or OSError where a port or file cannot be opened.
    """
    if isinstance(source, Simulated):
        return _at_its_pace(_simulated(source), 1.0, None, stop)
    if isinstance(source, SerialPort):
        if family is None:
            raise SourceError("a serial port needs the module's family")
        return _from_port(source, family, parser, stop, say)
    if isinstance(source, Recording):
        read = _from_stream(source.path, parser, stop)
        if source.path is None and source.speed is None:
            return read
        return _at_its_pace(read, source.speed or 1.0, source.rate_hz, stop)
    assert_never(source)


def _simulated(beacon: Simulated) -> Batches:
    random = Random(beacon.seed)
    sigma_m = beacon.sigma_m if beacon.sigma_m > 0.0 else None
    number = 0
    while True:
        t_s = number / beacon.rate_hz
        number += 1
        # Each measurement draws the same numbers, lost or not, so that a loss does not shift the noise.
        noise, luck = random.gauss(0.0, beacon.sigma_m), random.random()
        if luck < beacon.dropout:
            yield [Measured(peer=beacon.beacon, status="RX_TIMEOUT", time_s=t_s)]
        else:
            range_m = max(beacon.range_m(t_s) + noise, _NOISE_FLOOR_M)
            yield [Measured(peer=beacon.beacon, range_m=range_m, sigma_m=sigma_m, time_s=t_s)]


# -------------------------------------------------------------------------------------------- streams


def _from_stream(path: Path | None, parser: Parser, stop: Event) -> Batches:
    descriptor = 0 if path is None else os.open(path, os.O_RDONLY)
    try:
        while not stop.is_set():
            if not select.select([descriptor], [], [], 0.2)[0]:
                yield []
                continue
            data = os.read(descriptor, _CHUNK_BYTES)
            if not data:
                yield parser.feed(b"\n")  # a last line without its end
                return
            yield parser.feed(data)
    finally:
        if path is not None:
            os.close(descriptor)


def _at_its_pace(read: Batches, speed: float, rate_hz: float | None, stop: Event) -> Batches:
    """Each measurement when its time has come; those of one message together."""
    origin: tuple[float, float] | None = None
    last_s = 0.0
    messages = 0
    peers: set[str] = set()
    for batch in read:
        for m in batch:
            if m.time_s is not None:
                t_s = m.time_s
            elif rate_hz is not None:
                if m.peer in peers:  # a peer again: the next message
                    messages += 1
                    peers.clear()
                peers.add(m.peer)
                t_s = messages / rate_hz
            else:
                raise SourceError("the recording tells no times: its rate must be given")
            if origin is None or t_s < last_s:  # a clock that was set back begins anew
                origin = (t_s, time.monotonic())
            last_s = t_s
            due = origin[1] + (t_s - origin[0]) / speed
            while (wait_s := due - time.monotonic()) > 0.0:
                if stop.wait(min(wait_s, 1.0)):
                    return
                if wait_s > 1.0:
                    yield []
            if stop.is_set():
                return
            yield [m]


# ---------------------------------------------------------------------------------------- serial port


def _from_port(
    port: SerialPort, family: Family, parser: Parser, stop: Event, say: Callable[[str], None]
) -> Batches:
    opened = _open(port, family)
    while True:
        try:
            yield from _while_open(port, family, opened, parser, stop)
            return
        except OSError as error:  # serial.SerialException is one: unplugged, or taken away
            say(f"{port.device} lost ({error}); trying again every {_REOPEN_S:g} s")
        finally:
            opened.close()
        while True:
            yield []
            if stop.wait(_REOPEN_S):
                return
            try:
                opened = _open(port, family)
            except OSError:
                continue
            say(f"{port.device} is back")
            break


def _open(port: SerialPort, family: Family) -> serial.Serial:
    baud = port.baud if port.baud is not None else _BAUD.get(family, 115_200)
    try:
        return serial.Serial(port.device, baud, timeout=_READ_S, write_timeout=1.0, exclusive=True)
    except serial.SerialException as error:
        raise OSError(
            f"{port.device}: {error.strerror or error}; is it there, is no other program using it, and may "
            "you open it (group dialout)?"
        ) from error


def _while_open(
    port: SerialPort, family: Family, opened: serial.Serial, parser: Parser, stop: Event
) -> Batches:
    began = time.monotonic()
    typed: deque[tuple[float, bytes]] | None = None
    poll_at = began if family is Family.DWM1001_TLV else math.inf
    measures = False
    while not stop.is_set():
        now = time.monotonic()
        if now >= poll_at:
            opened.write(LOC_GET)
            poll_at = now + 1.0 / port.poll_hz
        if typed is None and not measures and now - began >= _QUIET_S:
            typed = _typing(port, family, now)
        while typed and typed[0][0] <= now:
            opened.write(typed.popleft()[1])
        # One byte awaited, then all that have come with it: no waiting for a full buffer.
        batch = parser.feed(opened.read(max(1, opened.in_waiting)))
        measures = measures or bool(batch)
        yield batch


def _typing(port: SerialPort, family: Family, now: float) -> deque[tuple[float, bytes]]:
    """What is to be typed and when, character by character."""
    commands = port.commands if port.commands is not None else _COMMANDS.get(family, ())
    typed: deque[tuple[float, bytes]] = deque()
    at = now
    for command in commands:
        for character in f"{command}\r":
            typed.append((at, character.encode()))
            at += _CHARACTER_S
        at += _COMMAND_S
    return typed
