"""Stands in for Zenoh in one thread: what is put waits until the test delivers it, in any order."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from random import Random
from types import SimpleNamespace

import pytest
import zenoh


@dataclass
class Publisher:
    """Puts messages of one key on the bus."""

    bus: Bus
    key: str

    def put(self, raw: bytes) -> None:
        assert type(raw) is bytes  # the same bytes at every receiver, whatever the sender does next
        self.bus.put(self.key, raw)

    def declare_matching_listener(self, _handler: object) -> None:
        """Nobody comes or goes here."""

    @property
    def matching_status(self) -> SimpleNamespace:
        return SimpleNamespace(matching=bool(self.bus.subscribers[self.key]))


@dataclass
class Bus:
    """The session of every process. Use `install` first: subscribers' handlers are plain functions then."""

    subscribers: dict[str, list[Callable[[bytes], None]]] = field(
        default_factory=lambda: defaultdict(list)
    )
    watchers: dict[str, list[Callable[[object], None]]] = field(
        default_factory=lambda: defaultdict(list)
    )
    sent: list[tuple[str, bytes]] = field(default_factory=list)
    waiting: list[tuple[str, bytes]] = field(default_factory=list)

    @staticmethod
    def install(monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setattr("wire.session.direct", lambda function: function)
        monkeypatch.setattr("wire.session.observe", lambda function: function)

    def declare_publisher(self, key: str, **_how: object) -> Publisher:
        return Publisher(self, key)

    def liveliness(self) -> SimpleNamespace:
        """Everybody is there, until `vanish`."""

        def watch(key: str, handler: Callable[[object], None], **_how: object) -> None:
            self.watchers[key].append(handler)

        return SimpleNamespace(declare_subscriber=watch)

    def vanish(self, key: str) -> None:
        """Tell those who watch it that the token of this key is gone."""
        for watcher in self.watchers[key]:
            watcher(SimpleNamespace(kind=zenoh.SampleKind.DELETE))

    def declare_subscriber(self, key: str, handler: Callable[[bytes], None]) -> None:
        self.subscribers[key].append(handler)

    def put(self, key: str, raw: bytes) -> None:
        self.sent.append((key, raw))
        self.waiting.append((key, raw))

    def give(self, key: str, raw: bytes) -> None:
        """Deliver a message at once, as if somebody had sent it."""
        for handler in self.subscribers[key]:
            handler(raw)

    def deliver(self, order: Random | None = None) -> None:
        """Deliver everything that waits and what comes of it, first in first out or in a random order."""
        while self.waiting:
            at = order.randrange(len(self.waiting)) if order else 0
            self.give(*self.waiting.pop(at))

    def of(self, key: str) -> list[bytes]:
        """What has been sent with this key."""
        return [raw for one, raw in self.sent if one == key]
