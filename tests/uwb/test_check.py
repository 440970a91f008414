"""Somebody else's ranges, judged: each mistake is named, and a publisher without one is fine."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from typing import Any

import pytest
import zenoh
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.link.zenoh_publish import Answer, Heard
from companion.publish import Publication, Verdict, check
from companion.range_message import RangeMessage
from companion.uwb.check import Level, judge, judge_beacon
from companion.uwb.info import BeaconInfo
from companion.uwb.sources import Simulated
from companion.wire_range import JSON, MSGPACK, encode
from tests.uwb.network import publishing, router, until
from tests.uwb.samples import JAZZY

KEY = "uwb/v1/lab/b1/drone/range"
NOW_NS = 1_800_000_000_000_000_000
PERIOD_NS = 50_000_000


def heard(i: int, payload: bytes, **changes: Any) -> Heard:
    """The i-th sample of a 20 Hz publisher."""
    t_ns = i * PERIOD_NS
    plain = Heard(t_ns, NOW_NS + t_ns, KEY, payload, len(payload), JSON, True, False, "REAL_TIME")
    return plain._replace(**changes)


def fields(i: int, **changes: Any) -> dict[str, Any]:
    plain = {
        "session": "5eed",
        "seq": i,
        "range_m": 10.0 + 0.013 * i,
        "sigma_m": 0.07,
        "t_ns": NOW_NS + i * PERIOD_NS - 2_000_000,
    }
    return {name: value for name, value in (plain | changes).items() if value is not None}


def run(
    change: Callable[[int], dict[str, Any]] = lambda i: {}, count: int = 60, **sample: Any
) -> list[Heard]:
    return [heard(i, json.dumps(fields(i, **change(i))).encode(), **sample) for i in range(count)]


def said(samples: list[Heard], level: Level) -> list[str]:
    return [f.text for f in judge(KEY, samples).findings if f.level is level]


def test_nothing_is_wrong_with_what_is_right() -> None:
    report = judge(KEY, run())
    assert report.findings == []
    assert report.summary == "60 ranges of 1 session, 20.0 Hz, 10.00 to 10.77 m"


def bytes_of(payload: bytes, **sample: Any) -> list[Heard]:
    return [heard(i, payload, **sample) for i in range(60)]


WRONG: list[tuple[list[Heard], str]] = [
    (run(encoding="zenoh/bytes"), "reads as application/json, which must be declared"),
    (run(encoding="text/plain"), "'text/plain'"),
    (bytes_of(JAZZY, encoding="zenoh/bytes"), "ROS 2 sensor_msgs/Range"),
    (bytes_of(b"10.5"), "Expected `object`"),
    (bytes_of(b"range=10.5"), "unreadable"),
    (bytes_of(b"\xff\xfe"), "unreadable"),
    (bytes_of(b'{"x":' + b"[" * 3000), "unreadable"),
    (bytes_of(b"", size=1 << 20), "above 4096 bytes"),
    (run(is_put=False), "a delete"),
    (run(lambda i: {"range_m": None, "range": 10.0}), "`range`: `range_m` is meant?"),
    (run(lambda i: {"seq": None, "sequence": i}), "`sequence`: `seq` is meant?"),
    (run(lambda i: {"range_m": -1.0}), "range_m"),
    (run(lambda i: {"range_m": "10"}), "Expected `float`, got `str`"),
    (run(lambda i: {"los": True}), "los"),
    (run(lambda i: {"session": f"s{i}"}), "session changes with every message"),
    (run(lambda i: {"session": "ab"[i % 2], "seq": i // 2}), "two publishers share this key"),
    (run(lambda i: {"seq": 0}), "seq repeated 59 times"),
    (run(lambda i: {"seq": 59 - i}), "seq went backwards 59 times"),
    (run(lambda i: {"seq": 5 * i}), "seq rises by 5"),
    (run(lambda i: {"seq": i + i // 5}), "% of the ranges never arrived"),
    (run(lambda i: {"status": "RX_TIMEOUT"}), "none is a measurement"),
    (run(lambda i: {"t_ns": 1_800_000_000 + i}), "seconds"),
    (run(lambda i: {"t_ns": 1_800_000_000_000 + i}), "milliseconds"),
    (run(lambda i: {"t_ns": 1_800_000_000_000_000 + i}), "microseconds"),
    (run(lambda i: {"t_ns": NOW_NS}), "does not rise"),
    (run(lambda i: {"t_ns": NOW_NS + i * PERIOD_NS - 60 * 10**9}), "60 s behind"),
    (run(lambda i: {"t_ns": NOW_NS + i * PERIOD_NS + 60 * 10**9}), "60 s ahead of"),
    (run(lambda i: {"t_ns": NOW_NS + i * PERIOD_NS - (500_000_000 if i == 30 else 0)}), "later than others"),
    ([h._replace(t_ns=i * 10**9) for i, h in enumerate(run())], "1 Hz"),
    ([h._replace(t_ns=i * 500_000) for i, h in enumerate(run())], "2000 Hz"),
    (run(count=1), "a single range"),
    (run(blocks=True), "BLOCK"),
]
ADVICE: list[tuple[list[Heard], str]] = [
    (run(lambda i: {"sigma_m": None}), "no sigma_m"),
    (run(lambda i: {"t_ns": None}), "no t_ns"),
    (run(lambda i: {"quality": 98}), "fields that nobody reads: quality"),
    (run(lambda i: {"status": "RX_TIMEOUT" if i % 10 == 0 else "ok"}), "6 of 60 are no measurements"),
    (run(lambda i: {"session": "a" if i < 30 else "b", "seq": i % 30}), "the publisher restarts"),
    (run(lambda i: {"seq": i + (i > 30)}), "1 ranges never arrived"),
    (run(lambda i: {"range_m": 1000.0 + i}), "whole number"),
    (run(lambda i: {"range_m": 10.5}), "never changes"),
    (run(priority="DATA"), "priority DATA"),
    ([h._replace(t_ns=i * 5_000_000) for i, h in enumerate(run())], "200 Hz"),
    ([h._replace(t_ns=h.t_ns + 10**9 * (i > 30)) for i, h in enumerate(run())], "a pause of 1.1 s"),
]


@pytest.mark.parametrize(("samples", "words"), WRONG, ids=[words for _, words in WRONG])
def test_what_is_wrong_is_named(samples: list[Heard], words: str) -> None:
    assert any(words in text for text in said(samples, Level.WRONG))


@pytest.mark.parametrize(("samples", "words"), ADVICE, ids=[words for _, words in ADVICE])
def test_what_could_be_better_is_named(samples: list[Heard], words: str) -> None:
    assert any(words in text for text in said(samples, Level.ADVICE))
    assert said(samples, Level.WRONG) == []


@pytest.mark.parametrize(
    "key", ["uwb/lab/b1/drone/range", "uwb/v2/lab/b1/drone/range", "uwb/v1/lab/b1/range"]
)
def test_the_form_of_the_key(key: str) -> None:
    assert "not of the form" in judge(key, run()).findings[0].text


def test_names_in_the_key() -> None:
    assert "'b 1'" in judge("uwb/v1/lab/b 1/drone/range", run()).findings[0].text


def test_more_than_was_kept() -> None:
    assert any("17 samples" in f.text for f in judge(KEY, run(), lost=17).findings)


@given(st.lists(st.tuples(st.binary(max_size=60), st.sampled_from([JSON, MSGPACK, "x", ""])), max_size=8))
@settings(max_examples=200)
def test_no_payload_is_too_odd_to_be_judged(samples: list[tuple[bytes, str]]) -> None:
    judge(KEY, [heard(i, payload, encoding=encoding) for i, (payload, encoding) in enumerate(samples)])


@pytest.mark.parametrize(
    ("about", "alive", "words"),
    [
        (None, True, ["/info"]),
        (Answer(b'{"height_m":1.0}', JSON), False, ["/alive"]),
        (Answer(b"{}", JSON), True, ["height_m"]),
        (Answer(b'{"height_m":1.0}', "zenoh/bytes"), True, ["encoding"]),
        (Answer(b"height 1", JSON), True, ["unreadable"]),
        (Answer(b'{"height_m":1.0}', JSON), True, []),
    ],
)
def test_what_the_beacon_tells_of_itself(about: Answer | None, alive: bool, words: list[str]) -> None:
    found = judge_beacon(about, alive)
    assert len(found) == len(words)
    assert all(word in f.text for word, f in zip(words, found, strict=True))


# ----------------------------------------------------------------------------------------- on the wire


def test_our_own_publisher_is_fine() -> None:
    lines: list[str] = []
    with router() as network:
        publication = Publication(
            Simulated(rate_hz=50.0), info=BeaconInfo(height_m=1.0), connect=(network.endpoint,)
        )
        with publishing(publication) as running:
            until(lambda: any("connected to 1" in line for line in running.said), "connection")
            report = check(
                "uwb/v1/lab/*/*/range", lines.append, seconds=1.0, connect=(network.endpoint,), strict=True
            )
    # A busy machine may pause for longer than a vehicle likes; everything else must be right.
    rest = [f for k in report.keys for f in k.findings if "pause" not in f.text and "later" not in f.text]
    assert [k.key for k in report.keys] == ["uwb/v1/lab/b1/drone/range"]
    assert rest == [] and report.beacons == {"lab/b1": []}


def foreign(session: zenoh.Session, stop: threading.Event, key: str) -> None:
    """A publisher by somebody who has not read the schema."""
    i = 0
    while not stop.wait(0.02):
        payload = json.dumps({"id": "b1", "range": 5.0, "session": "x", "seq": i})
        session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
        i += 1


def checked(key: str, of_publisher: str, seconds: float = 1.5) -> tuple[Verdict, str]:
    lines: list[str] = []
    stop = threading.Event()
    with router() as network:
        thread = threading.Thread(target=foreign, args=(network.session, stop, of_publisher))
        thread.start()
        try:
            report = check(key, lines.append, seconds=seconds, connect=(network.endpoint,))
        finally:
            stop.set()
            thread.join(10.0)
    return report.verdict, "\n".join(lines)


def test_a_foreign_publisher_is_told() -> None:
    verdict, text = checked(KEY, KEY)
    assert verdict is Verdict.WRONG
    for words in ("must be declared", "`range`: `range_m` is meant?", "BLOCK", "/alive", "/info"):
        assert words in text


def test_the_key_that_is_published_on_is_named() -> None:
    verdict, text = checked(KEY, "uwb/lab/b1")
    assert verdict is Verdict.NOTHING_HEARD
    assert "uwb/lab/b1" in text


def test_keys_that_are_none_and_endpoints_where_nobody_is() -> None:
    lines: list[str] = []
    for key in ("/uwb/v1/x", "uwb/v1/lab/", "uwb//b1", "a#b"):
        with pytest.raises(ValueError, match="is no Zenoh key"):
            check(key, lines.append, connect=("tcp/127.0.0.1:1",))
    with pytest.raises(ValueError, match="endpoint"):
        check(KEY, lines.append)
    assert check(KEY, lines.append, connect=("tcp/127.0.0.1:1",)).verdict is Verdict.NOT_CONNECTED
    assert "not connected" in lines[-1]
    report = check(KEY, lines.append, seconds=0.1, listen=("tcp/127.0.0.1:0",), patience_s=0.2)
    assert report.verdict is Verdict.NOT_CONNECTED
    assert "nobody" in lines[-1]


def test_messagepack_is_as_good() -> None:
    samples = [
        heard(
            i, encode(RangeMessage("5eed", i, 10.0 + 0.013 * i, 0.07, t_ns=NOW_NS + i * PERIOD_NS), MSGPACK)
        )
        for i in range(60)
    ]
    assert judge(KEY, [h._replace(encoding=MSGPACK) for h in samples]).findings == []
