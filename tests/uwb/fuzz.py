"""Damaged streams by the million: `python -m tests.uwb.fuzz --inputs 1000000`.

Each input is one to three samples of a family, joined, damaged (bits flipped, bytes lost, put in, repeated or
taken from another family) and cut into pieces at random; parsers live on from input to input, as on a port.
The same seed gives the same inputs. Nothing may raise, nothing may be kept beyond a parser's limit, every
range must be one that the wire format takes; and after the damage, whole samples must be read again.
"""

from __future__ import annotations

import argparse
import resource
import sys
import time
from collections import Counter
from collections.abc import Iterator
from random import Random

from companion.uwb import ros2
from companion.uwb.families import Family, open_parser
from companion.uwb.measured import OK, LosRule, Measured, Parser
from tests.uwb.samples import ATTACHMENT, JAZZY, SAMPLES

_RULES = {Family.FIRA_UCI: LosRule.ZERO_IS_LOS, Family.LINKTRACK: LosRule.POWER}
_RECOVERY_EVERY = 1_000


def damaged(random: Random, family: Family) -> bytes:
    """One input."""
    own = [s.data for s in SAMPLES if s.family is family]
    return damage(random, b"".join(random.choice(own) for _ in range(random.randint(1, 3))))


def damage(random: Random, whole: bytes) -> bytes:
    """The same bytes with up to 30 faults."""
    data = bytearray(whole)
    for _ in range(random.choice((0, 1, 1, 2, 3, 8, 30))):
        at = random.randrange(len(data) + 1)
        kind = random.randrange(6)
        if kind == 0 and at < len(data):
            data[at] ^= 1 << random.randrange(8)
        elif kind == 1:
            del data[at : at + random.randint(1, 12)]
        elif kind == 2:
            data[at:at] = random.randbytes(random.randint(1, 12))
        elif kind == 3:
            data[at:at] = data[at : at + random.randint(1, 60)]
        elif kind == 4:
            other = random.choice(SAMPLES).data
            begin = random.randrange(len(other))
            data[at:at] = other[begin : begin + random.randint(1, 60)]
        elif at < len(data):
            data[at] = random.choice(b'\x00\xff\r\n,;[]{}"0.-nN\x55\x62\x72\x40')
    return bytes(data)


def pieces(random: Random, data: bytes) -> Iterator[bytes]:
    """The same bytes, in pieces."""
    at = 0
    while at < len(data):
        size = random.choice((1, 3, 16, 64, 500, 500))
        yield data[at : at + size]
        at += size


def check(parser: Parser, measured: list[Measured]) -> None:
    """Hold what a parser promises. Raises AssertionError."""
    assert parser.held_bytes <= parser.limit_bytes
    for m in measured:
        assert 1 <= len(m.peer) <= 64 and 1 <= len(m.status) <= 64
        assert (m.range_m is None) == (m.status != OK)
        assert m.range_m is None or 0.0 < m.range_m <= 10_000.0
        assert m.rssi_dbm is None or -300.0 <= m.rssi_dbm <= 100.0


def recovers(parser: Parser, family: Family) -> None:
    """After any damage, undamaged samples are read again. Raises AssertionError."""
    for sample in SAMPLES:
        if sample.family is family and sample.measured:
            # Enough to complete whatever a damaged beginning is still waiting for.
            parser.feed(b"\n" + sample.data * (parser.limit_bytes // len(sample.data) + 2))
            assert parser.feed(sample.data) == _fresh(family).feed(sample.data), sample.name


def _fresh(family: Family) -> Parser:
    return open_parser(family, _RULES.get(family, LosRule.UNKNOWN))


def ros2_range(random: Random) -> str:
    """A damaged ROS 2 message. Raises AssertionError, or anything but ValueError."""
    payload = damage(random, random.choice((JAZZY, JAZZY[:40])))
    attachment = damage(random, ATTACHMENT) if random.random() < 0.5 else None
    try:
        message = ros2.to_message(payload, attachment)
    except ValueError:
        return "refused"
    assert 0.0 < message.range_m <= 10_000.0
    return "read"


def run(inputs: int, seed: int) -> Counter[str]:
    """Feed this many inputs; what came out of them. Raises whatever a parser raises."""
    random = Random(seed)
    parsers = {family: _fresh(family) for family in Family}
    families = list(Family)
    true = {f: [m for s in SAMPLES if s.family is f for m in _fresh(f).feed(s.data)] for f in families}
    figures: Counter[str] = Counter()
    for number in range(1, inputs + 1):
        family = random.choice(families)
        parser = parsers[family]
        data = damaged(random, family)
        for piece in pieces(random, data):
            measured = parser.feed(piece)
            check(parser, measured)
            figures[f"{family.value}: measurements"] += len(measured)
            figures[f"{family.value}: measurements altered unnoticed"] += sum(
                m not in true[family] for m in measured
            )
        figures[f"{family.value}: inputs"] += 1
        figures["bytes"] += len(data)
        figures[f"ros2: {ros2_range(random)}"] += 1
        if number % _RECOVERY_EVERY == 0:
            for each in families:
                recovers(parsers[each], each)
    for family, parser in parsers.items():
        for defect, count in parser.defects.items():
            figures[f"{family.value}: {defect.value}"] = count
    return figures


def _main() -> int:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    options.add_argument("--inputs", type=int, default=1_000_000)
    options.add_argument("--seed", type=int, default=1)
    args = options.parse_args()
    run(1_000, args.seed)  # tables and caches are filled before memory is measured
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.perf_counter()
    figures = run(args.inputs, args.seed)
    spent = time.perf_counter() - start
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    for name, count in sorted(figures.items()):
        print(f"{name}: {count}")
    print(f"{args.inputs} inputs in {spent:.0f} s, no exception; the process grew by {grown} KiB")
    return 0


if __name__ == "__main__":
    sys.exit(_main())
