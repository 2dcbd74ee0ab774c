"""Server-sent events to every open page: the newest of each kind, nothing that queues up.

Between the process that makes events and the threads of `live.server`, one for each page. A page that is slow
finds the newest event when it has time, and never the ones between.
"""

from __future__ import annotations

from collections.abc import Callable
from threading import Condition

MOST_PAGES = 8
HEARTBEAT_S = 1.0
HEARTBEAT = b":\n\n"
RETRY_MS = 2000
"""After so long a page that has lost the stream asks again."""


class Broadcast:
    """Where events are put, and waited for by any number of threads up to `MOST_PAGES`."""

    def __init__(self, changed: Callable[[], None] = lambda: None) -> None:
        """`changed` is called, on any thread, when a page comes or goes."""
        self._news = Condition()
        self._latest: dict[str, tuple[int, bytes]] = {}
        self._number = 0
        self._changed = changed
        self._pages = 0
        self._ended = False

    @property
    def watched(self) -> bool:
        """Whether a page is open."""
        return self._pages > 0

    def put(self, kind: str, data: bytes) -> None:
        """Publish an event, one line of JSON; it takes the place of the last one of its kind."""
        with self._news:
            self._number += 1
            text = b"id: %d\nevent: %s\ndata: %s\n\n" % (self._number, kind.encode(), data)
            # The last one comes last, so that a page that gets several reads them in their order.
            self._latest.pop(kind, None)
            self._latest[kind] = self._number, text
            self._news.notify_all()

    def forget(self, kind: str) -> None:
        """The last event of this kind is too old for a page that comes."""
        with self._news:
            self._latest.pop(kind, None)

    def end(self) -> None:
        """Nothing more will come: whoever waits gets what is there, then None."""
        with self._news:
            self._ended = True
            self._news.notify_all()

    def enter(self) -> bool:
        """A page comes; False if there are too many."""
        with self._news:
            if self._pages >= MOST_PAGES:
                return False
            self._pages += 1
        self._changed()
        return True

    def leave(self) -> None:
        """A page has gone."""
        with self._news:
            self._pages -= 1
            self._news.notify_all()
        self._changed()

    def empty(self, seconds: float) -> bool:
        """Wait until no page is open, so long at most; whether it is so."""
        with self._news:
            return self._news.wait_for(lambda: not self._pages, seconds)

    def after(self, seen: int) -> tuple[int, bytes] | None:
        """What is newer than event number `seen`, waited for at most `HEARTBEAT_S`, and the number it goes to.

        A heartbeat if there is nothing new; None when there will be nothing.
        """
        with self._news:
            self._news.wait_for(lambda: self._ended or self._number > seen, HEARTBEAT_S)
            fresh = [text for number, text in self._latest.values() if number > seen]
            if fresh:
                return self._number, b"".join(fresh)
            return None if self._ended else (seen, HEARTBEAT)
