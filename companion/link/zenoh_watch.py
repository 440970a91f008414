"""Listening in on Zenoh for people: samples of one key expression, and who is alive."""

from __future__ import annotations

from collections import deque

import zenoh

from companion.link.zenoh_publish import Answer, Heard, heard
from companion.link.zenoh_session import Opener, words
from companion.network_settings import RangesSettings

_BACKLOG = 4096
"""Samples that wait to be drained at most; the oldest give way."""
_MOST_KEYS = 1024
"""Tokens and answers kept at most: strangers must not fill the memory."""
_ANSWER_S = 2.0


class WatchLink:
    """A session that listens, opened now or as soon as somebody answers. No method blocks."""

    def __init__(self, settings: RangesSettings, samples: str, tokens: str, most_bytes: int) -> None:
        """Listen to `samples` and to the liveliness `tokens`; longer payloads than `most_bytes` stay unread.

        Raises OSError where an endpoint is malformed or cannot be listened on.
        """
        self._samples, self._tokens, self._most_bytes = samples, tokens, most_bytes
        self._heard: deque[Heard] = deque(maxlen=_BACKLOG)
        self._alive: set[str] = set()
        self._answers: dict[str, Answer] = {}
        self.lost = 0
        """Samples that nobody drained in time."""
        try:
            self._opener = Opener(settings, self._listen)
        except zenoh.ZError as error:
            raise OSError(words(error)) from None

    @property
    def reason(self) -> str:
        """Why there is no session yet."""
        return self._opener.reason

    @property
    def is_open(self) -> bool:
        """True once there is a session."""
        return self._opener.session is not None

    def _listen(self, session: zenoh.Session) -> None:
        session.declare_subscriber(self._samples, zenoh.handlers.Callback(self._note, indirect=False))
        session.liveliness().declare_subscriber(
            self._tokens, zenoh.handlers.Callback(self._note_token, indirect=False), history=True
        )

    def _note(self, sample: zenoh.Sample) -> None:
        """In Zenoh's thread: no parsing, no waiting."""
        if len(self._heard) == _BACKLOG:
            self.lost += 1
        self._heard.append(heard(sample, self._most_bytes))

    def _note_token(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            self._alive.discard(str(sample.key_expr))
        elif len(self._alive) < _MOST_KEYS:
            self._alive.add(str(sample.key_expr))

    def drain(self) -> list[Heard]:
        """Everything heard since the last call, in order."""
        return [self._heard.popleft() for _ in range(len(self._heard))]

    def alive(self) -> frozenset[str]:
        """The keys of all tokens that are held now."""
        return frozenset(self._alive)

    def ask(self, key: str) -> None:
        """Send a query for whoever answers on `key`; what comes back is in `answers`."""
        if self._opener.session is not None:
            self._opener.session.get(key, self._note_answer, timeout=_ANSWER_S)

    def _note_answer(self, reply: zenoh.Reply) -> None:
        if (ok := reply.ok) is None or len(ok.payload) > self._most_bytes:
            return
        if len(self._answers) < _MOST_KEYS:
            self._answers[str(ok.key_expr)] = Answer(ok.payload.to_bytes(), str(ok.encoding))

    def answers(self) -> dict[str, Answer]:
        """The last answer on each key."""
        return dict(self._answers)

    def connected(self) -> int:
        """How many routers and peers there are."""
        return self._opener.connected()

    def close(self) -> None:
        """Leave the network."""
        self._opener.close()
