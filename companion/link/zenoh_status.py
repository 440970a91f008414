"""The vehicle's status onto Zenoh, on the session that the ranges come by.

A thread of its own publishes the newest status from a slot: the loop pays one assignment, whatever the
network does (a put on a stalled link takes up to 3 ms even where it may be dropped, as it may here). What
fails here is told, and ends the publishing, never the flight. A loop that hangs fills no slot: nothing is
said twice.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable

import zenoh

from companion.link.zenoh_session import words
from companion.settings import Settings
from companion.types import Output, Status
from companion.wire_status import JSON, StatusMessage, alive_key, encode, status_key

_LOOK_S = 0.2
"""A session that is not open yet is looked for this often."""
_CLOSE_LIMIT_S = 1.0


class StatusLink:
    """The publishing end. `send` neither blocks nor raises."""

    def __init__(
        self,
        settings: Settings,
        session: Callable[[], zenoh.Session | None],
        tell: Callable[[str], None],
    ) -> None:
        """`session` gives the session once it is open; `tell` takes a line for a person."""
        self._settings = settings
        self._session = session
        self._tell = tell
        self._latest: Status | None = None
        self._wake = threading.Event()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        if settings.status.rate_hz > 0.0:
            self._thread = threading.Thread(target=self._run, name="status", daemon=True)
            self._thread.start()

    def send(self, output: Output) -> None:
        """Publish a status when it is due; a newer one replaces it until then. Other outputs are not its."""
        if isinstance(output, Status):
            self._latest = output
            self._wake.set()

    def close(self) -> None:
        """Publish what is left; the token goes with the session."""
        self._closing.set()
        self._wake.set()
        if self._thread is not None:
            self._thread.join(_CLOSE_LIMIT_S)

    def _run(self) -> None:
        try:
            session = self._opened()
            if session is not None:
                self._publish(session)
        except zenoh.ZError as error:
            self._tell(f"status is not published any more: {words(error)}")

    def _opened(self) -> zenoh.Session | None:
        while (session := self._session()) is None:
            if self._closing.wait(_LOOK_S):
                return None
        return session

    def _publish(self, session: zenoh.Session) -> None:
        """Every new status at its rate, one of a new phase at once, the last one before the end."""
        cfg = self._settings
        period_s = 1.0 / cfg.status.rate_hz
        token = session.liveliness().declare_token(alive_key(cfg.status.uav))
        publisher = session.declare_publisher(
            status_key(cfg.status.uav),
            encoding=JSON,
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.DATA_LOW,
        )
        name, seq, due, phase = secrets.token_hex(8), 0, 0.0, None
        while not self._closing.is_set() or self._latest is not None:
            self._wake.wait()
            self._wake.clear()
            status, self._latest = self._latest, None
            if status is None:
                continue
            if status.phase is phase and time.monotonic() < due and not self._closing.is_set():
                continue
            phase = status.phase
            due = time.monotonic() + 0.9 * period_s  # statuses come a little early or late
            publisher.put(encode(StatusMessage(name, seq, time.time_ns(), *cfg.aim, status)))
            seq += 1
        token.undeclare()  # type: ignore[no-untyped-call]
