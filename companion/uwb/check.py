"""Somebody's ranges, judged: what is wrong with them, in words for the author of the publisher.

`WRONG` makes a vehicle refuse ranges or believe the wrong ones; `ADVICE` leaves it less to work with.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from difflib import get_close_matches
from enum import Enum
from itertools import pairwise
from statistics import median
from typing import NamedTuple

import msgspec

from companion import wire_range
from companion.link.zenoh_publish import Answer, Heard
from companion.network_settings import NAME_RULE, is_name
from companion.range_message import RangeMessage
from companion.uwb import info, ros2
from companion.wire_range import JSON, MAX_PAYLOAD_BYTES, MSGPACK

KEY_FORM = f"{wire_range.KEY_VERSION}/{{site}}/{{beacon}}/{{tag}}/range"
PAUSE_S = 0.5
"""After this long without a range a vehicle flies on its prediction (`loss.coast_after_s`)."""
LEAST_RATE_HZ = 1.0 / PAUSE_S
MOST_RATE_HZ = 100.0
FLOOD_HZ = 1_000.0
CLOCK_S = 1.0
LATE_S = 0.3
"""Older ranges are stale (`ranges.max_age_s`)."""
MOST_LOST = 0.05
_FIELDS = {field.name for field in msgspec.structs.fields(RangeMessage)}


class Level(Enum):
    """How bad it is."""

    WRONG = "wrong"
    ADVICE = "advice"


class Finding(NamedTuple):
    """One thing to mend."""

    level: Level
    text: str


class KeyReport(NamedTuple):
    """What was heard on one key."""

    key: str
    summary: str
    findings: list[Finding]


class _Read(NamedTuple):
    heard: Heard
    message: RangeMessage


def judge(key: str, heard: Sequence[Heard], lost: int = 0) -> KeyReport:
    """Judge everything heard on one key, in order. `lost`: samples beyond what was kept."""
    found: list[Finding] = _of_key(key)
    read, problems = _decode_all(heard)
    found += problems
    good = [r for r in read if is_measurement(r.message)]
    if read and not good:
        found.append(_wrong(f"none is a measurement: status {read[0].message.status!r}"))
    elif len(good) < len(read):
        words = Counter(r.message.status for r in read if not is_measurement(r.message))
        told = ", ".join(f"{word} {count}×" for word, count in words.most_common(3))
        found.append(_advice(f"{len(read) - len(good)} of {len(read)} are no measurements: {told}"))
    if read:
        found += (
            _of_counting([r.message for r in read]) + _of_time(read) + _of_values([r.message for r in good])
        )
    if heard:
        found += _of_service(heard)
    if lost:
        found.append(_wrong(f"too many to keep: {lost} samples more were not looked at"))
    return KeyReport(key, _summary(heard, read), found)


def is_measurement(message: RangeMessage) -> bool:
    """True where the status does not say that there is no measurement."""
    return message.status is None or message.status.lower() in ("ok", "success")


def judge_beacon(about: Answer | None, alive: bool) -> list[Finding]:
    """Judge what a beacon tells of itself."""
    found = []
    if not alive:
        found.append(
            _advice("no liveliness token on .../{beacon}/alive: its end shows only when ranges stop coming")
        )
    if about is None:
        found.append(
            _advice("no answer to a query for .../{beacon}/info: the vehicle must be told the height")
        )
        return found
    if not about.encoding.startswith(JSON):
        found.append(_wrong(f"info has the encoding {about.encoding!r}, expected {JSON}"))
    try:
        told = info.decode(about.payload)
    except ValueError as error:
        found.append(_wrong(f"info is unreadable: {error}"))
        return found
    if told.height_m is None:
        found.append(_advice("info has no height_m: slant ranges cannot be corrected with it"))
    return found


def _wrong(text: str) -> Finding:
    return Finding(Level.WRONG, text)


def _advice(text: str) -> Finding:
    return Finding(Level.ADVICE, text)


def _summary(heard: Sequence[Heard], read: Sequence[_Read]) -> str:
    if not read:
        return f"{len(heard)} samples, none readable"
    ranges = [r.message.range_m for r in read]
    sessions = len({r.message.session for r in read})
    rate = _rate_hz([r.heard.t_ns for r in read])
    return (
        f"{len(read)} ranges of {sessions} session{'s' if sessions > 1 else ''}, {rate:.1f} Hz, "
        f"{min(ranges):.2f} to {max(ranges):.2f} m"
    )


def _rate_hz(t_ns: Sequence[int]) -> float:
    span_ns = t_ns[-1] - t_ns[0]
    return (len(t_ns) - 1) / (span_ns / 1e9) if span_ns > 0 else 0.0


def _of_key(key: str) -> list[Finding]:
    parts = key.split("/")
    if len(parts) != 6 or "/".join(parts[:2]) != wire_range.KEY_VERSION or parts[5] != "range":
        return [_wrong(f"the key is not of the form {KEY_FORM}: no vehicle listens there")]
    odd = [part for part in parts[2:5] if not is_name(part)]
    if odd:
        return [_wrong(f"{odd[0]!r} in the key: {NAME_RULE}")]
    return []


# -------------------------------------------------------------------------------------------- payloads


def _decode_all(heard: Sequence[Heard]) -> tuple[list[_Read], list[Finding]]:
    """Every readable message, and each kind of trouble once, with how often it came."""
    read: list[_Read] = []
    trouble: Counter[Finding] = Counter()
    for h in heard:
        message, findings = _decode(h)
        if message is not None:
            read.append(_Read(h, message))
        trouble.update(findings)
    found = [
        Finding(f.level, f"{f.text} ({count} of {len(heard)} samples)") for f, count in trouble.most_common(5)
    ]
    return read, found


def _decode(h: Heard) -> tuple[RangeMessage | None, list[Finding]]:
    if not h.is_put:
        return None, [_wrong("a delete instead of a put")]
    if h.size > MAX_PAYLOAD_BYTES:
        return None, [_wrong(f"a payload above {MAX_PAYLOAD_BYTES} bytes is refused unread")]
    findings: list[Finding] = []
    encoding = h.encoding
    if not encoding.startswith((JSON, MSGPACK)):
        sniffed = next((e for e in (JSON, MSGPACK) if _fields(h.payload, e)), None)
        if sniffed is None:
            return None, [
                _wrong(f"encoding {encoding[:40]!r}, expected {JSON} or {MSGPACK}{_guess(h.payload)}")
            ]
        findings.append(
            _wrong(f"encoding {encoding[:40]!r}: the payload reads as {sniffed}, which must be declared")
        )
        encoding = sniffed
    fields = _fields(h.payload, encoding)
    try:
        message = wire_range.decode(h.payload, encoding)
    except msgspec.ValidationError as error:
        return None, [*findings, _wrong(f"{error}{_misnamed(fields)}")]
    except (ValueError, RecursionError) as error:
        return None, [*findings, _wrong(f"unreadable: {str(error)[:100]}{_guess(h.payload)}")]
    unknown = fields - _FIELDS
    if unknown:
        names = ", ".join(sorted(unknown)[:5])
        findings.append(_advice(f"fields that nobody reads: {names[:200]}{_misnamed(fields)}"))
    return message, findings


def _fields(payload: bytes, encoding: str) -> set[str]:
    """The names in the payload; empty where it is no object."""
    decode = msgspec.json.decode if encoding.startswith(JSON) else msgspec.msgpack.decode
    try:
        value = decode(payload)
    except (ValueError, RecursionError):
        return set()
    return {str(name)[:64] for name in value} if isinstance(value, dict) else set()


def _misnamed(fields: set[str]) -> str:
    meant = []
    for name in sorted(fields - _FIELDS)[:5]:
        close = get_close_matches(name, sorted(_FIELDS - fields), n=1, cutoff=0.5)
        if close:
            meant.append(f"; `{name}`: `{close[0]}` is meant?")
    return "".join(meant)


def _guess(payload: bytes) -> str:
    try:
        ros2.decode_range(payload)
    except ValueError:
        return ""
    return "; this is a ROS 2 sensor_msgs/Range, which a vehicle takes from a ROS 2 subscription only"


# ------------------------------------------------------------------------------- what they add up to


def _of_counting(messages: Sequence[RangeMessage]) -> list[Finding]:
    found = []
    last: dict[str, int] = {}
    repeated = backwards = lost = 0
    steps: Counter[int] = Counter()
    changes = [b.session for a, b in pairwise(messages) if a.session != b.session]
    for m in messages:
        before = last.get(m.session)
        if before is not None:
            step = m.seq - before
            steps[step] += 1
            repeated += step == 0
            backwards += step < 0
            lost += max(step - 1, 0)
        last[m.session] = m.seq
    if len(last) > 1 and len(last) > len(messages) // 2:
        found.append(
            _wrong("session changes with every message: it is drawn once, when the publisher starts")
        )
    elif len(changes) >= len(last) > 1:
        found.append(_wrong(f"{len(last)} sessions take turns: two publishers share this key"))
    elif len(last) > 1:
        found.append(_advice(f"session changed {len(last) - 1} times: the publisher restarts"))
    if repeated:
        found.append(_wrong(f"seq repeated {repeated} times: such ranges are dropped as replayed"))
    if backwards:
        found.append(_wrong(f"seq went backwards {backwards} times in a session: such ranges are dropped"))
    usual, times = steps.most_common(1)[0] if steps else (1, 0)
    if usual > 1 and times > sum(steps.values()) // 2:
        found.append(_wrong(f"seq rises by {usual}: it counts ranges, one by one, for each beacon and tag"))
    elif lost > MOST_LOST * (lost + len(messages)):
        share = 100.0 * lost / (lost + len(messages))
        found.append(_wrong(f"{share:.0f} % of the ranges never arrived (gaps in seq)"))
    elif lost:
        found.append(_advice(f"{lost} ranges never arrived (gaps in seq)"))
    return found


def _of_time(read: Sequence[_Read]) -> list[Finding]:
    found = []
    arrivals = [r.heard.t_ns for r in read]
    if len(arrivals) < 2:
        return [_wrong("a single range in all this time")]
    rate_hz = _rate_hz(arrivals)
    if rate_hz < LEAST_RATE_HZ:
        found.append(_wrong(f"{rate_hz:.2g} Hz: a vehicle takes ranges as lost after {PAUSE_S} s"))
    elif rate_hz > FLOOD_HZ:
        found.append(_wrong(f"{rate_hz:.0f} Hz: no module measures so often"))
    elif rate_hz > MOST_RATE_HZ:
        found.append(_advice(f"{rate_hz:.0f} Hz: more than a vehicle makes setpoints of (50 a second)"))
    pause_s = max(b - a for a, b in pairwise(arrivals)) / 1e9
    if pause_s > PAUSE_S and rate_hz >= LEAST_RATE_HZ:
        found.append(
            _advice(f"a pause of {pause_s:.1f} s: after {PAUSE_S} s a vehicle flies on its prediction")
        )
    return found + _of_clock([(r.heard.unix_ns, r.message.t_ns) for r in read if r.message.t_ns is not None])


_UNITS = ((1e11, "seconds"), (1e14, "milliseconds"), (1e17, "microseconds"))


def _of_clock(stamps: Sequence[tuple[int, int]]) -> list[Finding]:
    """`stamps`: time of reception and `t_ns`, both Unix nanoseconds."""
    if not stamps:
        return [_advice("no t_ns: fine for flying, but delays and a hung link cannot be told from it")]
    newest = stamps[-1][1]
    for limit, unit in _UNITS:
        if 0 < newest < limit:
            return [_wrong(f"t_ns {newest} looks like {unit}: nanoseconds since 1970 are expected")]
    found = []
    if any(b[1] <= a[1] for a, b in pairwise(stamps)):
        found.append(_wrong("t_ns does not rise from range to range"))
    ages_s = sorted((here - there) / 1e9 for here, there in stamps)
    middle_s = median(ages_s)
    if abs(middle_s) > CLOCK_S:
        way = "behind" if middle_s > 0.0 else "ahead of"
        found.append(
            _wrong(f"t_ns is {abs(middle_s):.3g} s {way} this computer's clock: set both, or leave it out")
        )
    late_s = ages_s[-1] - ages_s[0]
    if late_s > LATE_S:
        found.append(_wrong(f"some arrive {late_s:.2g} s later than others; {LATE_S} s is stale"))
    return found


def _of_values(messages: Sequence[RangeMessage]) -> list[Finding]:
    found = []
    if messages and all(m.sigma_m is None for m in messages):
        found.append(_advice("no sigma_m: the vehicle uses its own setting for this beacon"))
    ranges = {m.range_m for m in messages}
    if len(messages) >= 5 and all(r == int(r) for r in ranges) and max(ranges) >= 10.0:
        found.append(_advice("range_m is always a whole number: metres are expected, not cm or mm"))
    elif len(messages) >= 20 and len(ranges) == 1:
        found.append(_advice(f"range_m never changes from {ranges.pop()}: is the module frozen?"))
    return found


def _of_service(heard: Sequence[Heard]) -> list[Finding]:
    found = []
    if any(h.blocks for h in heard):
        found.append(
            _wrong(
                "congestion control is BLOCK: a stalled link stops the publisher, then delivers old ranges"
            )
        )
    low = sorted({h.priority for h in heard} & {"DATA", "DATA_LOW", "BACKGROUND"})
    if low:
        found.append(_advice(f"priority {low[0]}: on a full link ranges are lost that REAL_TIME would save"))
    return found
