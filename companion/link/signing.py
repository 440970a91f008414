"""MAVLink 2 message signing: who holds the key is believed, everybody else is refused.

A signature is the first 48 bits of SHA-256 over the key and the packet, with a timestamp (10 µs since 2015)
that must rise in each stream, so that nothing is believed twice. Three things differ from pymavlink's own
signing: the signature is verified *before* the stream's timestamp is stored (else one forged packet with the
largest timestamp locks the legitimate sender out), a wrong signature is never passed off as merely unsigned,
and our own timestamps survive a restart, also where the clock was set back.

PX4's timestamps do not follow a clock: they rise by one a packet and to what it hears from us. So after a
pause its packets look old until our first heartbeat has reached it, and are refused for that long.
"""

from __future__ import annotations

import fcntl
import hashlib
import hmac
import os
import stat
import threading
import time
from collections.abc import Callable
from enum import Enum
from pathlib import Path

from pymavlink.dialects.v20 import development as mavlink

from companion.settings import VehicleSettings

KEY_BYTES = 32
TICKS_1_S = 100_000
"""Timestamps count 10 µs."""
_EPOCH_S = 1_420_070_400
"""2015-01-01 00:00 UTC."""
_LAST_TIMESTAMP = (1 << 48) - 1
STEP = 10 * TICKS_1_S
"""So far ahead timestamps are reserved on disk; a crash skips at most these."""
_NEW_STREAM_LAG = 60 * TICKS_1_S
"""A stream not heard before may be this far behind us (MAVLink's rule)."""
_STATE_BYTES = 16
_RETRY_NS = 1_000_000_000


class SigningError(ValueError):
    """Signing cannot be used; the text says which file and what to do, and nothing of the key."""


class Key(bytes):
    """The shared secret. It is never shown: not by repr, not by str, so not in a log or a traceback."""

    __slots__ = ()

    def __repr__(self) -> str:
        return "Key(hidden)"

    __str__ = __repr__


def read_key(path: Path) -> Key:
    """Read a key file: 32 bytes, raw or as 64 hexadecimal digits.

    Raises SigningError where it cannot be read, is not such a file, or others may read it.
    """
    try:
        with path.open("rb") as file:
            mode = os.fstat(file.fileno()).st_mode
            data = file.read(4 * KEY_BYTES)
    except OSError as error:
        raise SigningError(f"signing key {path}: {error.strerror or 'cannot be read'}") from None
    if mode & stat.S_IRWXO:
        raise SigningError(
            f"signing key {path}: everybody on this machine can get at it (mode {stat.S_IMODE(mode):04o}); "
            f"make it your own: chmod 600 {path}"
        )
    key = _parse_key(data)
    if key is None:
        raise SigningError(
            f"signing key {path}: must hold {KEY_BYTES} bytes, raw or as {2 * KEY_BYTES} hexadecimal digits"
        )
    if not any(key):
        raise SigningError(f"signing key {path}: all zeros, which MAVLink takes for no key")
    return key


def _parse_key(data: bytes) -> Key | None:
    if len(data) == KEY_BYTES:
        return Key(data)
    try:
        key = bytes.fromhex(data.decode("ascii").strip())
    except ValueError:
        return None
    return Key(key) if len(key) == KEY_BYTES else None


def _wall_clock() -> int:
    return time.time_ns() // 10_000 - _EPOCH_S * TICKS_1_S


class Timestamps:
    """Our own timestamps: strictly rising, also over crashes, restarts and a clock that is set back.

    The state file holds a number that no timestamp has reached yet. It is written ahead in steps, by a thread
    of its own because a disk may take long, and the timestamps never overtake what is on the disk.
    """

    def __init__(self, path: Path, clock: Callable[[], int] = _wall_clock) -> None:
        """Open and lock the state file. Raises SigningError where that fails or it cannot be understood."""
        self._path, self._clock = path, clock
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
        except OSError as error:
            raise SigningError(f"signing state {path}: {error.strerror}") from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            self._last = _parse_state(path, os.pread(self._file, 64, 0)) - 1
            self._heard = 0
            self._reserved = 0
            self._write(max(self._last, clock()) + STEP)
        except BlockingIOError:
            os.close(self._file)
            raise SigningError(f"signing state {path}: in use by another process with this key") from None
        except OSError as error:
            os.close(self._file)
            raise SigningError(f"signing state {path}: {error.strerror}") from None
        except SigningError:
            os.close(self._file)
            raise
        self._writer: threading.Thread | None = None
        self._t_written_ns = 0

    def upcoming(self) -> int:
        """The timestamp of the next packet: the clock's, as far as it is reserved; never one used before."""
        wanted = min(max(self._clock(), self._heard + 1), self._reserved - STEP // 2)
        return max(self._last + 1, wanted)

    def use(self, timestamp: int) -> None:
        """Never hand out this one, or an earlier one, again. Raises SigningError where none are left."""
        if timestamp >= min(self._reserved, _LAST_TIMESTAMP):
            raise SigningError(f"signing state {self._path}: no timestamps left; is the disk full or broken?")
        self._last = max(self._last, timestamp)
        self._reserve()

    def hear(self, timestamp: int) -> None:
        """A holder of the key is at this timestamp: ours catch up, as MAVLink asks."""
        self._heard = max(self._heard, timestamp)
        self._reserve()

    def close(self) -> None:
        """Note where we stand, so that the next start skips nothing, and release the file."""
        if self._writer is not None:
            self._writer.join()
        try:
            self._write(max(self._last, self._heard) + 1)
        except OSError:  # what is on the disk is further ahead, and good
            pass
        finally:
            os.close(self._file)

    def _reserve(self) -> None:
        """Reserve the next step in good time; at most one write at a time, one a second."""
        ahead = max(self._last, self._heard, self._clock())
        now_ns = time.monotonic_ns()
        if ahead < self._reserved - STEP // 2 or now_ns - self._t_written_ns < _RETRY_NS:
            return
        if self._writer is None or not self._writer.is_alive():
            self._t_written_ns = now_ns
            self._writer = threading.Thread(target=self._try_write, args=(ahead + STEP,), daemon=True)
            self._writer.start()

    def _try_write(self, reserved: int) -> None:
        try:
            self._write(reserved)
        except OSError:  # tried again in a second; `use` refuses once the reserve is spent
            return

    def _write(self, reserved: int) -> None:
        reserved = min(reserved, _LAST_TIMESTAMP)
        os.pwrite(self._file, b"%0*d\n" % (_STATE_BYTES - 1, reserved), 0)
        os.fdatasync(self._file)
        self._reserved = reserved


def _parse_state(path: Path, data: bytes) -> int:
    """The number in a state file; 0 for a new one."""
    if not data:
        return 0
    text = data.decode("ascii", "replace").rstrip("\n")
    if len(data) != _STATE_BYTES or not text.isdecimal() or int(text) > _LAST_TIMESTAMP:
        raise SigningError(
            f"signing state {path}: not a timestamp; delete it only if this machine's clock is right"
        )
    return int(text)


class Unsigned(Enum):
    """What becomes of packets without a signature. Those with a wrong one are refused in any case."""

    REFUSE = "refuse"
    ACCEPT = "accept"


NOT_SIGNED = "not signed"
WRONG_SIGNATURE = "signed with another key, or tampered with"
REPLAYED = "signed, but sent before or too old"
REFUSALS = frozenset({NOT_SIGNED, WRONG_SIGNATURE, REPLAYED})
"""The reasons of BAD_DATA that signing gives."""


class _Signing(mavlink.MAVLinkSigning):  # type: ignore[misc]
    """pymavlink reads `timestamp` for each packet that it signs, then sets it to one more."""

    def __init__(self, timestamps: Timestamps) -> None:
        self._timestamps = timestamps
        super().__init__()
        self.sign_outgoing = True

    @property
    def timestamp(self) -> int:
        return self._timestamps.upcoming()

    @timestamp.setter
    def timestamp(self, following: int) -> None:
        if following:  # the base class begins by setting 0
            self._timestamps.use(following - 1)


class SignedMavlink(mavlink.MAVLink):  # type: ignore[misc]
    """A MAVLink encoder and parser that signs all it packs and verifies all it parses.

    What is refused arrives as BAD_DATA, its `reason` one of `REFUSALS`. One thread at a time, as its base.
    """

    def __init__(
        self,
        key: Key,
        timestamps: Timestamps,
        link_id: int = 0,
        unsigned: Unsigned = Unsigned.REFUSE,
        source_component: int = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER,
    ) -> None:
        super().__init__(None, srcSystem=1, srcComponent=source_component)
        self.robust_parsing = True
        self._timestamps = timestamps
        self._unsigned = unsigned
        self.signing = _Signing(timestamps)
        self.signing.secret_key = key
        self.signing.link_id = link_id
        self.signing.allow_unsigned_callback = self._judge_unsigned

    @classmethod
    def open(
        cls,
        key_file: Path,
        state_file: Path,
        link_id: int = 0,
        unsigned: Unsigned = Unsigned.REFUSE,
        source_component: int = mavlink.MAV_COMP_ID_ONBOARD_COMPUTER,
    ) -> SignedMavlink:
        """Read the key and take up the timestamps. Raises SigningError, in words for a person."""
        return cls(read_key(key_file), Timestamps(state_file), link_id, unsigned, source_component)

    @classmethod
    def of(cls, settings: VehicleSettings) -> SignedMavlink | None:
        """For the configured link; None where it is not signed. Raises SigningError."""
        if not settings.signing_key_file:
            return None
        return cls.open(
            Path(settings.signing_key_file),
            Path(settings.signing_state_file),
            settings.signing_link_id,
            Unsigned.ACCEPT if settings.accept_unsigned else Unsigned.REFUSE,
            settings.component_id,
        )

    def close(self) -> None:
        """Release the state file."""
        self._timestamps.close()

    def _judge_unsigned(self, _: object, __: int) -> bool:
        if self._unsigned is Unsigned.ACCEPT:
            return True
        raise mavlink.MAVError(NOT_SIGNED)

    def check_signature(self, msgbuf: bytearray, srcSystem: int, srcComponent: int) -> bool:
        """Verify a signed packet: True, or MAVError with the reason. Nothing is stored before it is true."""
        digest = hashlib.sha256(self.signing.secret_key)
        digest.update(msgbuf[:-6])
        if not hmac.compare_digest(digest.digest()[:6], bytes(msgbuf[-6:])):
            raise mavlink.MAVError(WRONG_SIGNATURE)
        timestamp = int.from_bytes(msgbuf[-12:-6], "little")
        stream = (msgbuf[-13], srcSystem, srcComponent)
        before = self.signing.stream_timestamps.get(stream)
        if before is None:
            before = self._timestamps.upcoming() - _NEW_STREAM_LAG - 1
        if timestamp <= before:
            raise mavlink.MAVError(REPLAYED)
        self.signing.stream_timestamps[stream] = timestamp
        self._timestamps.hear(timestamp)
        return True
