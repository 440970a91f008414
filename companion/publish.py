"""`companion publish`: a UWB module, a recording or a simulated beacon becomes ranges on Zenoh.

And `--check`: what is wrong with somebody else's ranges.
"""

from __future__ import annotations

import secrets
import signal
import sys
import time
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, field
from enum import Enum
from io import FileIO
from pathlib import Path
from threading import Event
from typing import NamedTuple

import msgspec
import zenoh

from companion import wire_range
from companion.exits import Exit
from companion.link.zenoh_publish import Ear, Heard, PublishLink
from companion.link.zenoh_session import words
from companion.network_settings import NAME_RULE, RangesSettings, is_name
from companion.range_message import RangeMessage
from companion.uwb import info as beacon_info
from companion.uwb.check import Finding, KeyReport, Level, judge, judge_beacon
from companion.uwb.families import Family, open_parser
from companion.uwb.info import BeaconInfo
from companion.uwb.measured import LosRule, Measured, Parser
from companion.uwb.sources import Recording, SerialPort, Simulated, Source, SourceError, batches
from companion.wire_range import alive_key, info_key

MOST_PAIRS = 64
"""Beacons times tags that one publisher serves. A module without checksums can invent ids without end."""
_REPORT_S = 10.0
_LOOK_S = 1.0
_Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Publication:
    """What is published, and where. Raises ValueError for what cannot be meant."""

    source: Source
    family: Family | None = None
    """Format of the source; None for a simulated beacon."""
    los: LosRule = LosRule.UNKNOWN
    site: str = "lab"
    tag: str = "drone"
    """The module is this tag; its peers are beacons. The module may well be on the vehicle."""
    beacon: str | None = None
    """Given: the module is this beacon instead, and its peers are tags."""
    names: Mapping[str, str] = field(default_factory=dict)
    """Peer as the module names it → id in the key. Empty: the module's names as they are; else only these."""
    sigma_m: float | None = None
    """For ranges that tell none themselves; without it the beacon's calibrated one, if there is one."""
    info: BeaconInfo = field(default_factory=BeaconInfo)
    """What every beacon tells of itself, unless `infos` has more of it."""
    infos: Mapping[str, BeaconInfo] = field(default_factory=dict)
    stamped: bool = True
    """Put `t_ns` in: the computer's clock when the measurement came. Off where that clock is not set."""
    encoding: str = wire_range.JSON
    connect: tuple[str, ...] = ()
    listen: tuple[str, ...] = ()
    tls: str = ""
    """Directory of `companion keys`; empty: in the clear."""
    save: Path | None = None
    """Keep what the module measured, as JSON lines that can be published again at their pace."""

    def __post_init__(self) -> None:
        if isinstance(self.source, Simulated):
            if self.family is not None or self.los is not LosRule.UNKNOWN:
                raise ValueError("a simulated beacon has no module: no family, no line-of-sight rule")
        elif self.family is None:
            raise ValueError("the format of the source must be named: " + ", ".join(f.value for f in Family))
        else:
            open_parser(self.family, self.los)
        for name in (self.site, self.tag, *self.names.values(), *((self.beacon,) if self.beacon else ())):
            _name(name)
        if self.encoding not in (wire_range.JSON, wire_range.MSGPACK):
            raise ValueError(f"{self.encoding}: {wire_range.JSON} or {wire_range.MSGPACK}")
        if self.sigma_m is not None and not 0.0 < self.sigma_m <= 1_000.0:
            raise ValueError(f"sigma {self.sigma_m} m: must be above 0 and at most 1000")
        for info in (self.info, *self.infos.values()):
            try:
                msgspec.convert(msgspec.to_builtins(info), BeaconInfo)
            except msgspec.ValidationError as error:  # a vehicle would refuse it unseen
                raise ValueError(f"what the beacon tells of itself: {error}") from error
        _check_source(self.source)
        if not self.connect and not self.listen:
            raise ValueError("nowhere to publish to: name an endpoint to connect to or to listen on")


def _check_source(source: Source) -> None:
    positive: dict[str, float | None] = {}
    if isinstance(source, SerialPort):
        positive = {"baud": source.baud, "poll": source.poll_hz}
    elif isinstance(source, Recording):
        positive = {"speed": source.speed, "rate": source.rate_hz}
    else:
        positive = {"distance": source.distance_m, "period": source.period_s, "rate": source.rate_hz}
        _name(source.beacon)
        if not (
            0.0 <= source.radius_m <= 1e4 and 0.0 <= source.sigma_m <= 1e3 and 0.0 <= source.dropout <= 1.0
        ):
            raise ValueError("radius and sigma must not be negative, dropout is a share of 1")
    for what, value in positive.items():
        if value is not None and not 0.0 < value <= 1e7:
            raise ValueError(f"{what} {value}: must be above 0")


def _name(text: str) -> str:
    """The same text. Raises ValueError where it cannot be part of a key."""
    if not is_name(text):
        raise ValueError(f"{text[:80]!r}: {NAME_RULE}")
    return text


class Tally:
    """What became of the measurements. Bounded: beyond 64 different reasons they are counted together."""

    def __init__(self) -> None:
        self.published: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()

    def refuse(self, reason: str) -> None:
        """Count one that was not published."""
        known = reason in self.refused or len(self.refused) < 64
        self.refused[reason if known else "other reasons"] += 1

    def text(self, parser: Parser) -> str:
        """One line for a person."""
        parts = [", ".join(f"{key} {count}" for key, count in sorted(self.published.items())) or "no range"]
        parts += [f"{reason} {count}×" for reason, count in self.refused.most_common(6)]
        parts += [f"{defect.value} {count}×" for defect, count in parser.defects.most_common(4)]
        if parser.skipped_bytes and not self.published:
            parts.append(
                f"{parser.skipped_bytes} bytes that are no ranges: is it this format, at this speed?"
            )
        return "; ".join(parts)


class Sender:
    """Turns measurements into messages: names, session, sequence, stamp. Pure but for what it is given."""

    def __init__(
        self,
        publication: Publication,
        announce: Callable[[str, bytes], None],
        put: Callable[[str, str, RangeMessage], None],
        clock_ns: Callable[[], int] = time.time_ns,
        session: str | None = None,
    ) -> None:
        """`session` is drawn anew by default, so that a reader sees the restart."""
        self.tally = Tally()
        self._p = publication
        self._announce, self._put, self._clock_ns = announce, put, clock_ns
        self._session = session if session is not None else secrets.token_hex(8)
        self._seq: dict[tuple[str, str], int] = {}
        self._announced: set[str] = set()
        for beacon in self._known_beacons():
            self._present(beacon)

    def _known_beacons(self) -> list[str]:
        if self._p.beacon is not None:
            return [self._p.beacon]
        if isinstance(self._p.source, Simulated):
            return [self._p.source.beacon]
        return list(dict.fromkeys(self._p.names.values()))

    def send(self, m: Measured) -> str | None:
        """Publish a measurement. The result names a beacon and tag heard for the first time, for a person."""
        if m.range_m is None:
            self.tally.refuse(m.status)
            return None
        pair = self._pair(m.peer)
        if pair is None:
            return None
        first = pair not in self._seq
        seq = self._seq.get(pair, 0)
        self._seq[pair] = seq + 1
        beacon, tag = pair
        self._present(beacon)
        sigma_m = m.sigma_m if m.sigma_m is not None else self._p.sigma_m
        message = RangeMessage(
            session=self._session,
            seq=seq,
            range_m=m.range_m,
            sigma_m=sigma_m if sigma_m is not None else self._info(beacon).sigma_m,
            los=m.los,
            rssi_dbm=m.rssi_dbm,
            t_ns=self._clock_ns() if self._p.stamped else None,
        )
        self._put(beacon, tag, message)
        self.tally.published[beacon if self._p.beacon is None else tag] += 1
        return f"{beacon} to {tag}: first range {m.range_m:.2f} m (module: {m.peer})" if first else None

    def _pair(self, peer: str) -> tuple[str, str] | None:
        name = self._p.names.get(peer, None if self._p.names else peer)
        if name is None:
            self.tally.refuse(f"{peer[:64]} has no name given")
            return None
        if name is peer:
            try:
                _name(peer)
            except ValueError:
                self.tally.refuse("a peer's name that cannot be in a key")
                return None
        pair = (name, self._p.tag) if self._p.beacon is None else (self._p.beacon, name)
        if pair not in self._seq and len(self._seq) >= MOST_PAIRS:
            self.tally.refuse(f"more than {MOST_PAIRS} peers")
            return None
        return pair

    def _info(self, beacon: str) -> BeaconInfo:
        return self._p.infos.get(beacon, self._p.info)

    def _present(self, beacon: str) -> None:
        if beacon not in self._announced:
            self._announced.add(beacon)
            self._announce(beacon, beacon_info.encode(self._info(beacon)))


def publish(publication: Publication, say: _Say, stop: Event | None = None) -> Exit:
    """Publish until the source ends, Ctrl-C or SIGTERM (or `stop`, which then replaces the signals).

    OK where something was published, NO_RANGES where the source ended without a range, LINK where a port or
    endpoint cannot be opened, USAGE where the source cannot be read as asked.
    """
    p = publication
    parser = open_parser(p.family if p.family is not None else Family.JSON_LINES, p.los)
    try:
        with ExitStack() as stack:
            if stop is None:
                stop = _until_signal(stack)
            link = PublishLink(RangesSettings(p.site, p.tag, p.connect, p.listen, tls=p.tls), p.encoding)
            stack.callback(link.close)
            save = None if p.save is None else stack.enter_context(p.save.open("wb", buffering=0))
            sender = Sender(p, link.announce, link.put)
            say(f"publishing {wire_range.range_key(p.site, p.beacon or '*', '*' if p.beacon else p.tag)}")
            if isinstance(p.source, Recording) and p.source.path is not None:
                _await_somebody(link, stop, say)
            report_at = time.monotonic() + _REPORT_S
            look_at, told = 0.0, ""
            for batch in batches(p.source, p.family, parser, stop, say):
                for m in batch:
                    if (news := sender.send(m)) is not None:
                        say(news)
                    if save is not None and (trouble := _kept(save, m)):
                        say(f"--save {p.save}: {trouble}: not kept any more")
                        save = None
                now = time.monotonic()
                if now >= look_at:
                    look_at = now + _LOOK_S
                    if (words_now := _connection(link, bool(p.tls))) != told:
                        told = words_now
                        say(told)
                if now >= report_at:
                    report_at = now + _REPORT_S
                    say(sender.tally.text(parser))
            say(f"done: {sender.tally.text(parser)}")
            return Exit.OK if sender.tally.published or stop.is_set() else Exit.NO_RANGES
    except SourceError as error:
        print(f"companion: {error}", file=sys.stderr)
        return Exit.USAGE
    except OSError as error:  # a port or a file
        print(f"companion: {error}", file=sys.stderr)
        return Exit.LINK
    except zenoh.ZError as error:
        print(f"companion: {words(error)}", file=sys.stderr)
        return Exit.LINK


def _await_somebody(link: PublishLink, stop: Event, say: _Say) -> None:
    """A recording played to nobody is lost, so it waits."""
    if not link.connected():
        say("waiting for a router or a vehicle")
        while not link.connected() and not stop.wait(0.05):
            pass


def _until_signal(stack: ExitStack) -> Event:
    stop = Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        stack.callback(signal.signal, number, signal.signal(number, lambda *_: stop.set()))
    return stop


def _kept(save: FileIO, m: Measured) -> str:
    """Keep a measurement; the result says why that cannot be: vehicles fly by the ranges, not by the file."""
    try:
        save.write(msgspec.json.encode(_timed(m)) + b"\n")
    except OSError as error:
        return error.strerror or str(error)
    return ""


def _timed(m: Measured) -> Measured:
    return m if m.time_s is not None else msgspec.structs.replace(m, time_s=time.monotonic())


def _connection(link: PublishLink, is_guarded: bool) -> str:
    count = link.connected()
    if count == 0:
        nobody = "connected to nobody: ranges go nowhere until a router or a vehicle is there."
        return f"{nobody} {link.reason}".strip()
    number = f"connected to {count} router or peer" + ("s" if count > 1 else "")
    if link.is_heard():
        return f"{number}, and heard"
    rules = ", or the router's rules do not let this certificate in" if is_guarded else ""
    return f"{number}, and nobody listens: no vehicle is there{rules}"


# ------------------------------------------------------------------------------------------------ check


class Verdict(Enum):
    """What a check came to."""

    FINE = "fine"
    WRONG = "wrong"
    NOTHING_HEARD = "nothing heard"
    NOT_CONNECTED = "not connected"


class CheckReport(NamedTuple):
    """The verdict, what was found on each key, and what was found on each beacon (`site/beacon`)."""

    verdict: Verdict
    keys: list[KeyReport]
    beacons: dict[str, list[Finding]]


def check(
    key: str,
    say: _Say,
    *,
    seconds: float = 5.0,
    connect: tuple[str, ...] = (),
    listen: tuple[str, ...] = (),
    tls: str = "",
    strict: bool = False,
    patience_s: float = 10.0,
) -> CheckReport:
    """Listen to `key` (wildcards allowed) and say what is wrong with what comes; `strict`: advice counts too.

    `seconds` counts from when somebody is connected, who is waited for no longer than `patience_s`.
    Where nothing comes on it, everything on the network is listened to for two seconds, to name other keys.
    Raises ValueError where `key` is no key expression, or no endpoint is named.
    """
    try:
        zenoh.KeyExpr(key)
    except zenoh.ZError as error:
        raise ValueError(f"{key!r} is no Zenoh key, such as uwb/v1/lab/b1/*/range: {words(error)}") from error
    if not connect and not listen:
        raise ValueError("nowhere to listen: name an endpoint to connect to or to listen on")
    try:
        ear = Ear(RangesSettings(connect=connect, listen=listen, tls=tls), key)
    except zenoh.ZError as error:
        say(f"wrong: not connected: {words(error)}")
        return CheckReport(Verdict.NOT_CONNECTED, [], {})
    try:
        deadline = time.monotonic() + patience_s
        while not ear.connected():
            if time.monotonic() > deadline:
                say("wrong: connected to nobody: no router or publisher answers at these endpoints")
                return CheckReport(Verdict.NOT_CONNECTED, [], {})
            time.sleep(0.05)
        return _check(ear, key, say, seconds, strict)
    finally:
        ear.close()


def _check(ear: Ear, key: str, say: _Say, seconds: float, strict: bool) -> CheckReport:
    time.sleep(seconds)
    by_key: dict[str, list[Heard]] = {}
    for heard in ear.drain():
        by_key.setdefault(heard.key, []).append(heard)
    if not by_key:
        say(f"wrong: nothing on {key} in {seconds:g} s")
        others = ear.other_keys(2.0)
        say(f"other keys that are published on: {', '.join(others)}" if others else "nothing else either")
        return CheckReport(Verdict.NOTHING_HEARD, [], {})
    keys = [judge(name, heard, ear.lost) for name, heard in sorted(by_key.items())[:MOST_PAIRS]]
    beacons = {}
    for report in keys:
        parts = report.key.split("/")
        if len(parts) == 6:
            site, beacon = parts[2:4]
            about, alive = ear.ask(info_key(site, beacon)), ear.is_alive(alive_key(site, beacon))
            beacons[f"{site}/{beacon}"] = judge_beacon(about, alive)
    findings = [f for report in keys for f in report.findings] + [f for b in beacons.values() for f in b]
    bad = any(f.level is Level.WRONG or strict for f in findings)
    for report in keys:
        say(f"{report.key}: {report.summary}")
        for finding in report.findings:
            say(f"  {finding.level.value}: {finding.text}")
    for name, found in beacons.items():
        for finding in found:
            say(f"{name}: {finding.level.value}: {finding.text}")
    verdict = Verdict.WRONG if bad else Verdict.FINE
    say(verdict.value)
    return CheckReport(verdict, keys, beacons)
