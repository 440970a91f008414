"""A screen that is a page: what is shown goes to every browser that has it open."""

from __future__ import annotations

from collections.abc import Sequence

from companion.watch.feed import Histories, feed
from companion.watch.fleet import Fleet
from companion.watch.listen import News
from companion.watch.server import PageServer


class Page:
    """Feeds the page five times a second, also where there is nothing new: ages go on."""

    period_s = 0.2

    def __init__(self, bind: str, port: int) -> None:
        """Raises OSError where it cannot listen there."""
        self._histories = Histories()
        self._server = PageServer(bind, port)
        self.url = self._server.url

    def show(self, fleet: Fleet, news: Sequence[News], missing: str, now_ns: int) -> None:
        """Keep what came, and tell it."""
        fresh = self._histories.add(news)
        self._server.tell(
            feed(fleet, missing, fresh, now_ns),
            lambda: feed(fleet, missing, self._histories.all(), now_ns),
        )

    def close(self) -> None:
        """End every open page's stream."""
        self._server.close()
