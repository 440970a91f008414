"""Signed links: who is believed, what a forger can do, what survives a restart, where the key shows."""

from __future__ import annotations

import logging
import os
import struct
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymavlink.dialects.v20 import development as mavlink

from companion.link import signing
from companion.link.signing import (
    NOT_SIGNED,
    REPLAYED,
    STEP,
    TICKS_1_S,
    WRONG_SIGNATURE,
    Key,
    SignedMavlink,
    SigningError,
    Timestamps,
    Unsigned,
    read_key,
)

KEY = Key(bytes(range(1, 33)))
OTHER_KEY = Key(bytes(range(2, 34)))
NOW = 350_000_000 * TICKS_1_S
OFFBOARD = 6 << 16
LARGEST = (1 << 48) - 1


class Clock:
    """A wall clock that a test sets."""

    def __init__(self, now: int = NOW) -> None:
        self.now = now

    def __call__(self) -> int:
        return self.now


class Party:
    """Somebody on the link: a SignedMavlink with a state file of its own."""

    def __init__(self, path: Path, key: Key = KEY, clock: Clock | None = None, **more: Any) -> None:
        self.clock = clock or Clock()
        self.timestamps = Timestamps(path, self.clock)
        self.mav = SignedMavlink(key, self.timestamps, **more)

    def say(self, mode: int = OFFBOARD, system: int = 1) -> bytes:
        """A HEARTBEAT, as bytes."""
        self.mav.srcSystem, self.mav.srcComponent = system, 1
        self.clock.now += 1
        return heartbeat(self.mav, mode)

    def hear(self, data: bytes) -> Any:
        """What one packet is taken for."""
        (message,) = self.mav.parse_buffer(data)
        return message


def heartbeat(mav: Any, mode: int = OFFBOARD) -> bytes:
    message = mavlink.MAVLink_heartbeat_message(2, mavlink.MAV_AUTOPILOT_PX4, 129, mode, 4, 3)
    return bytes(message.pack(mav))


def plain_heartbeat() -> bytes:
    return heartbeat(mavlink.MAVLink(None, srcSystem=1, srcComponent=1))


def timestamp_of(packet: bytes) -> int:
    return int.from_bytes(packet[-12:-6], "little")


def forged(packet: bytes, timestamp: int) -> bytes:
    """The packet with another timestamp: a forger can write any, but not the signature to it."""
    return packet[:-12] + struct.pack("<Q", timestamp)[:6] + packet[-6:]


@pytest.fixture
def vehicle(tmp_path: Path) -> Iterator[Party]:
    party = Party(tmp_path / "vehicle")
    yield party
    party.mav.close()


@pytest.fixture
def ours(tmp_path: Path) -> Iterator[Party]:
    party = Party(tmp_path / "ours")
    yield party
    party.mav.close()


# ------------------------------------------------------------------------------------ who is believed


def test_a_holder_of_the_key_is_believed(vehicle: Party, ours: Party) -> None:
    for _ in range(3):
        message = ours.hear(vehicle.say())
        assert message.get_type() == "HEARTBEAT"
        assert message.custom_mode == OFFBOARD
        assert message.get_signed()


def test_pymavlinks_own_signing_understands_ours(vehicle: Party) -> None:
    peer = mavlink.MAVLink(None)
    peer.signing.secret_key = bytes(KEY)
    (message,) = peer.parse_buffer(vehicle.say())
    assert message.get_type() == "HEARTBEAT"
    assert message.get_signed()


def test_a_forged_timestamp_does_not_lock_the_vehicle_out(vehicle: Party, ours: Party) -> None:
    ours.hear(vehicle.say())
    refused = ours.hear(forged(vehicle.say(), LARGEST))
    assert refused.get_type() == "BAD_DATA"
    assert refused.reason == WRONG_SIGNATURE
    assert ours.hear(vehicle.say()).get_type() == "HEARTBEAT"
    assert ours.timestamps.upcoming() < NOW + STEP  # nor does it drive our own timestamps


def test_a_forged_first_packet_does_not_lock_the_vehicle_out(vehicle: Party, ours: Party) -> None:
    assert ours.hear(forged(vehicle.say(), LARGEST)).reason == WRONG_SIGNATURE
    assert ours.hear(vehicle.say()).get_type() == "HEARTBEAT"


def test_nothing_is_believed_twice(vehicle: Party, ours: Party) -> None:
    first, second = vehicle.say(), vehicle.say()
    assert ours.hear(first).get_type() == "HEARTBEAT"
    assert ours.hear(second).get_type() == "HEARTBEAT"
    for packet in (second, first):
        assert ours.hear(packet).reason == REPLAYED


def test_a_recording_of_more_than_a_minute_ago_is_not_believed_after_a_restart(ours: Party) -> None:
    old = signed_at(NOW - 61 * TICKS_1_S)
    assert ours.hear(old).reason == REPLAYED


def signed_at(timestamp: int) -> bytes:
    """A packet of a holder of the key, with this timestamp."""
    mav = mavlink.MAVLink(None, srcSystem=1, srcComponent=1)
    mav.signing.secret_key = bytes(KEY)
    mav.signing.sign_outgoing = True
    mav.signing.timestamp = timestamp
    return heartbeat(mav)


def test_another_key_is_refused_even_where_unsigned_packets_pass(tmp_path: Path) -> None:
    stranger = Party(tmp_path / "stranger", OTHER_KEY)
    lenient = Party(tmp_path / "lenient", unsigned=Unsigned.ACCEPT)
    assert lenient.hear(stranger.say()).reason == WRONG_SIGNATURE
    stranger.mav.close()
    lenient.mav.close()


def test_unsigned_packets_by_policy(tmp_path: Path, ours: Party) -> None:
    assert ours.hear(plain_heartbeat()).reason == NOT_SIGNED
    lenient = Party(tmp_path / "lenient", unsigned=Unsigned.ACCEPT)
    message = lenient.hear(plain_heartbeat())
    assert message.get_type() == "HEARTBEAT"
    assert not message.get_signed()  # the link believes no mode of it
    lenient.mav.close()


@given(st.integers(0, 40), st.integers(1, 255))
@settings(max_examples=60)
def test_a_packet_changed_anywhere_is_not_believed(tmp_path_factory: Any, at: int, change: int) -> None:
    where = tmp_path_factory.mktemp("changed")
    vehicle, ours = Party(where / "vehicle"), Party(where / "ours")
    packet = bytearray(vehicle.say())
    packet[at % len(packet)] ^= change
    messages = ours.mav.parse_buffer(bytes(packet)) or []
    assert not any(m.get_type() == "HEARTBEAT" for m in messages)
    vehicle.mav.close()
    ours.mav.close()


def test_a_vehicle_whose_timestamps_lag_is_believed_once_it_has_heard_us(vehicle: Party, ours: Party) -> None:
    """As PX4: it counts packets from the day its key was set, and catches up with what it hears."""
    vehicle.clock.now = NOW - 400 * 86_400 * TICKS_1_S
    old = signed_at(vehicle.clock.now)
    assert ours.hear(old).reason == REPLAYED
    told = timestamp_of(ours.say())
    assert ours.hear(signed_at(told + 1)).get_type() == "HEARTBEAT"


def test_our_timestamps_catch_up_with_the_vehicles(vehicle: Party, ours: Party) -> None:
    """Our clock is days behind (no battery-backed clock): the vehicle must still take us for new."""
    ours.clock.now = NOW - 30 * 86_400 * TICKS_1_S
    ours.hear(vehicle.say())
    wait_for_writer(ours.timestamps)
    assert timestamp_of(ours.say()) > NOW


def wait_for_writer(timestamps: Timestamps) -> None:
    if timestamps._writer is not None:
        timestamps._writer.join(10.0)


# ---------------------------------------------------------------------------------- our own timestamps


def used(timestamps: Timestamps, count: int) -> list[int]:
    """The next ones, as they are used."""
    result = []
    for _ in range(count):
        result.append(timestamps.upcoming())
        timestamps.use(result[-1])
    return result


def crash(timestamps: Timestamps) -> None:
    """The process is gone without a word; the kernel gives the lock back."""
    wait_for_writer(timestamps)
    os.close(timestamps._file)


def test_a_crash_with_the_clock_set_back_reuses_nothing(tmp_path: Path) -> None:
    clock = Clock()
    before = Timestamps(tmp_path / "state", clock)
    spent = used(before, 5)
    crash(before)
    clock.now = 0
    after = Timestamps(tmp_path / "state", clock)
    assert used(after, 5)[0] > spent[-1]
    after.close()


def test_an_orderly_end_skips_nothing(tmp_path: Path) -> None:
    clock = Clock()
    before = Timestamps(tmp_path / "state", clock)
    last = used(before, 3)[-1]
    before.close()
    clock.now = 0
    after = Timestamps(tmp_path / "state", clock)
    assert after.upcoming() == last + 1
    after.close()


def test_a_clock_that_steps_either_way_never_goes_back(tmp_path: Path) -> None:
    clock = Clock()
    timestamps = Timestamps(tmp_path / "state", clock)
    spent = used(timestamps, 3)
    for step_s in (-3600, 7200, -86_400, 5):
        clock.now += step_s * TICKS_1_S
        spent += used(timestamps, 3)
        wait_for_writer(timestamps)
    assert spent == sorted(set(spent))
    timestamps.close()


def test_it_follows_the_clock_and_writes_ahead(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(signing, "_RETRY_NS", 0)
    clock, path = Clock(), tmp_path / "state"
    timestamps = Timestamps(path, clock)
    for _ in range(30):
        clock.now += TICKS_1_S
        used(timestamps, 1)
        wait_for_writer(timestamps)
        assert int(path.read_text()) > timestamps._last
    assert timestamps.upcoming() >= clock.now
    timestamps.close()


def test_on_a_full_disk_it_goes_on_within_what_is_reserved_then_refuses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    timestamps = Timestamps(tmp_path / "state", clock)
    reserved = timestamps._reserved

    def full(*_: object) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    clock.now += 3600 * TICKS_1_S
    spent = used(timestamps, 100)
    assert spent == sorted(set(spent))
    assert spent[-1] < reserved
    timestamps._last = reserved - 1
    with pytest.raises(SigningError, match="no timestamps left"):
        used(timestamps, 1)
    monkeypatch.undo()
    timestamps.close()


def test_two_processes_cannot_share_a_state(tmp_path: Path) -> None:
    first = Timestamps(tmp_path / "state", Clock())
    with pytest.raises(SigningError, match="in use by another process"):
        Timestamps(tmp_path / "state", Clock())
    first.close()
    Timestamps(tmp_path / "state", Clock()).close()


@pytest.mark.parametrize("content", ["nonsense", "12", "-00000000000001\n", "9" * 15 + "\n"])
def test_a_damaged_state_is_refused_in_words(tmp_path: Path, content: str) -> None:
    path = tmp_path / "state"
    path.write_text(content)
    with pytest.raises(SigningError, match=r"state: not a timestamp; delete it only if"):
        Timestamps(path, Clock())
    assert path.read_text() == content


def test_a_state_that_cannot_be_written_is_refused_in_words(tmp_path: Path) -> None:
    with pytest.raises(SigningError, match="No such file"):
        Timestamps(tmp_path / "nowhere" / "state", Clock())


# ------------------------------------------------------------------------------------------- the key


def key_file(tmp_path: Path, content: bytes, mode: int = 0o600) -> Path:
    path = tmp_path / "mavlink.key"
    path.write_bytes(content)
    path.chmod(mode)
    return path


@pytest.mark.parametrize("content", [bytes(KEY), KEY.hex().encode(), KEY.hex().upper().encode() + b"\n"])
def test_a_key_is_read_raw_or_as_hexadecimal(tmp_path: Path, content: bytes) -> None:
    assert read_key(key_file(tmp_path, content)) == KEY


@pytest.mark.parametrize("mode", [0o644, 0o604, 0o602, 0o601])
def test_a_key_that_others_can_get_at_is_refused(tmp_path: Path, mode: int) -> None:
    with pytest.raises(SigningError, match="chmod 600"):
        read_key(key_file(tmp_path, bytes(KEY), mode))


@pytest.mark.parametrize(
    "content", [b"", b"short", KEY.hex()[:-1].encode(), KEY.hex().encode() + b"00", b"g" * 64, bytes(33)]
)
def test_what_is_no_key_is_refused_without_showing_it(tmp_path: Path, content: bytes) -> None:
    with pytest.raises(SigningError, match="64 hexadecimal digits") as error:
        read_key(key_file(tmp_path, content))
    assert not content or content.decode("latin-1") not in "".join(traceback.format_exception(error.value))


def test_an_all_zero_key_and_a_missing_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(SigningError, match="all zeros"):
        read_key(key_file(tmp_path, bytes(32)))
    with pytest.raises(SigningError, match="No such file"):
        read_key(tmp_path / "nowhere.key")


def test_the_key_is_never_shown(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.DEBUG)
    path = key_file(tmp_path, KEY.hex().encode())
    mav = SignedMavlink.open(path, tmp_path / "state")
    stranger = Party(tmp_path / "stranger", OTHER_KEY)
    shown = [repr(mav), str(mav), repr(vars(mav)), repr(vars(mav.signing)), f"{mav.signing.secret_key}"]
    for data in (stranger.say(), plain_heartbeat(), b"garbage"):
        shown += [f"{m.get_type()} {m.reason} {m}" for m in mav.parse_buffer(data)]
    shown.append(caplog.text)
    text = "\n".join(shown)
    for secret in (KEY, OTHER_KEY):
        for form in (
            secret.hex(),
            secret.hex().upper(),
            bytes.__repr__(secret)[2:-1],
            str(list(secret))[1:-1],
        ):
            assert form not in text
    assert "Key(hidden)" in text
    mav.close()
    stranger.mav.close()
