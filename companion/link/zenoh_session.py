"""Zenoh sessions as this project opens them: explicit endpoints, nothing found by itself."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from threading import Event, Thread

import zenoh

from companion.link import credentials
from companion.network_settings import RangesSettings

os.environ.setdefault("ZENOH_RUNTIME", "(rx: (handover: app))")
"""Zenoh reads this once, with the process's first session. What waits for the sockets also receives: Zenoh's
two receiving threads are woken by that one, both for every message, and one of them finds nothing to do."""

_RETRY_S = 0.1
LEASE_MS = 2000
_TLS_HINT = (
    "(nobody is there, or one does not accept the other: the router's certificate must be of the same site "
    "and name this address; Zenoh does not say which)"
)


def is_client(settings: RangesSettings) -> bool:
    """A router hands nothing from one peer to another (Zenoh 1.10), but everything from and to clients.

    A client connects to one endpoint and does not open before it answers; whoever listens, or connects to
    several beacons, is a peer.
    """
    return not settings.listen and len(settings.connect) == 1


def zenoh_config(settings: RangesSettings, caps_hz: Mapping[str, float] | None = None) -> zenoh.Config:
    """An explicit configuration: nothing listens, connects or scouts that is not named in it.

    A peer's endpoints that do not answer yet are tried again for ever, 0.1 to 0.5 s apart. `caps_hz`: of what
    comes on a key expression Zenoh itself lets no more through, whatever is sent.
    Raises CredentialsError where `ranges.tls` and the endpoints let nobody in, or everybody.
    """
    client = is_client(settings)
    config: dict[str, object] = {
        "mode": "client" if client else "peer",
        "connect": {
            "endpoints": list(settings.connect),
            "timeout_ms": 0 if client else -1,
            "exit_on_failure": False,
            "retry": {"period_init_ms": 100, "period_max_ms": 500, "period_increase_factor": 2},
        },
        "listen": {"endpoints": list(settings.listen), "exit_on_failure": True},
        "scouting": {
            "delay": 0,
            "multicast": {"enabled": settings.multicast_scouting},
            "gossip": {"enabled": settings.multicast_scouting},
        },
    }
    if caps_hz:
        # One rule for each: of a rule's keys together no more than its rate passes.
        config["downsampling"] = [
            {"flows": ["ingress"], "messages": ["put", "delete"], "rules": [{"key_expr": key, "freq": hz}]}
            for key, hz in caps_hz.items()
        ]
    if problems := credentials.contradictions(settings):
        raise credentials.CredentialsError("; ".join(problems))
    link: dict[str, object] = {"tx": {"lease": LEASE_MS}}
    if settings.tls:
        link["tls"] = credentials.tls_config(credentials.read(Path(settings.tls)))
    config["transport"] = {"link": link}
    return zenoh.Config.from_json5(json.dumps(config))


def words(error: zenoh.ZError) -> str:
    """What Zenoh says, without the place in its own source."""
    return str(error).splitlines()[0].partition(" at /")[0][:200]


def neighbours(session: zenoh.Session) -> int:
    """How many routers and peers a session is connected to."""
    return len(session.info.routers_zid()) + len(session.info.peers_zid())


class Opener:
    """A session that opens now (a peer), or in a thread of its own, again and again, until somebody answers.

    `opened` is called with the session, in that thread; what it raises there `session` and `connected` raise.
    """

    def __init__(
        self,
        settings: RangesSettings,
        opened: Callable[[zenoh.Session], None],
        caps_hz: Mapping[str, float] | None = None,
    ) -> None:
        """Raises CredentialsError; zenoh.ZError where a peer's endpoint is malformed or cannot be used."""
        self._session: zenoh.Session | None = None
        self._failure: Exception | None = None
        self.reason = ""
        """Why there is no session yet."""
        self._config = zenoh_config(settings, caps_hz)
        self._hint = _TLS_HINT if settings.tls else ""
        self._opened = opened
        self._closing = Event()
        self._thread: Thread | None = None
        if is_client(settings):
            self._thread = Thread(target=self._try, name="zenoh-opener", daemon=True)
            self._thread.start()
        else:
            self._session = zenoh.open(self._config)
            opened(self._session)

    def _try(self) -> None:
        """An address where nothing is may take seconds to fail."""
        while not self._closing.is_set():
            try:
                session = zenoh.open(self._config)
            except zenoh.ZError as error:
                self.reason = f"{words(error)} {self._hint}".strip()
                self._closing.wait(_RETRY_S)
                continue
            self._session = session
            try:
                self._opened(session)
            except Exception as error:  # a bug must not die unnoticed with this thread
                self._failure = error
            return

    @property
    def session(self) -> zenoh.Session | None:
        """The session, once it is open."""
        if self._failure is not None:
            raise self._failure
        return self._session

    def connected(self) -> int:
        """How many routers and peers there are. None at all is silent in Zenoh, and worth telling."""
        return 0 if self.session is None else neighbours(self.session)

    def close(self) -> None:
        """Leave the network."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join(1.0)
        if self._session is not None:
            self._session.close()  # type: ignore[no-untyped-call]
