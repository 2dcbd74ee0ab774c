"""A recording published again over Zenoh, for viewers that look at a run while it goes on.

The recorder's way back: telemetry rows out of the file, batches on the same keys and in the same messages as in
the run. The session is a router, as the plant's is: viewers are its clients. Nothing but telemetry is
published, and the tokens by which viewers know that a node is there; there is no node, no plant, no control.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from time import monotonic, sleep
from typing import Any, Protocol

from analysis.recording import Recording
from analysis.replay_check import WHOLE, Span
from analysis.telemetry_rows import telemetry_rows, whole
from supervise.endpoints import LONGEST_SOCKET_PATH, SPECIAL, choose, port_taken
from wire import session as zsession
from wire.channels import label
from wire.child import remove_sockets
from wire.errors import UsageError
from wire.keys import Keys
from wire.messages import PLANT, encode_batch, encode_counters, run_tag

SAY_EVERY_S = 2.0
LOST_S = 0.5
"""Behind by more than this (the machine slept, or the rate cannot be held), the clock starts again from now: no
burst makes up for it."""
POLL_S = 0.01
LAST_S = 0.2
"""What was put last has so long to leave before the session is closed."""


class Clock(Protocol):
    """What time it is, and the wait for another; the event ends the wait."""

    def now(self) -> float:
        """Seconds, monotonic."""

    def wait(self, seconds: float, event: Event) -> None:
        """Wait so long, or until the event is set."""


class WallClock:
    """The machine's monotonic clock."""

    def now(self) -> float:
        """Seconds."""
        return monotonic()

    def wait(self, seconds: float, event: Event) -> None:
        """Wait so long, or until the event is set."""
        event.wait(seconds)


@dataclass
class Published:
    """What has been published so far."""

    ticks: int = 0
    rows: int = 0
    """One a sender and tick that is not lost or late."""
    rounds: int = 0
    """Whole passes through the span."""
    seconds: float = 0.0
    """Wall clock, of publishing."""

    def rate(self, tick_s: float) -> float | None:
        """Seconds of the arm's time in one of the clock; None before there is any."""
        return self.ticks * tick_s / self.seconds if self.seconds > 0.0 else None


class Publisher:
    """Publishes a recording's telemetry, one row a tick of every sender, paced by the clock.

        with Publisher(recording, rate=2.0) as publisher:
            print(publisher.endpoint)       # what clients connect to
            publisher.publish()             # until the end, `stop`, or KeyboardInterrupt

    A row goes on the key and in the message that it had in the run, in the order nodes, plant; rows that the
    recording has not (late ticks, lost telemetry) are not sent. At the end, also an early one, every process's
    counters follow, as far as the recording has them, so that a subscriber knows that no more comes.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        rate: float = 1.0,
        span: Span = WHOLE,
        loop: bool = False,
        wait: bool = True,
        listen: str | None = None,
        progress: Callable[[str], None] = lambda _: None,
        clock: Clock | None = None,
    ) -> None:
        """`rate`: seconds of the arm's time in one of the clock, inf for as fast as it goes; `wait`: begin when
        somebody has subscribed; `listen`: a Zenoh endpoint, default a free port of loopback; `clock`: default
        the machine's. UsageError for what makes no sense, or an endpoint that cannot be used."""
        if not rate > 0.0:
            raise UsageError(f"--rate {rate:g}: expected a positive number")
        self._recording = recording
        self._rows = telemetry_rows(recording)
        ticks = len(self._rows[PLANT])
        if not ticks:
            raise UsageError(
                f"recording {recording.path}: no tick in it, so there is nothing to publish"
            )
        span.check(ticks)
        self._whole = {sender: whole(own) for sender, own in self._rows.items()}
        self._first, self._last = span.first, ticks - 1 if span.last is None else span.last
        self._next = self._first
        self._period_s = recording.tick_s / rate
        self._loop, self._wait = loop, wait
        self._say, self._clock = progress, clock or WallClock()
        self._run = run_tag(recording.configuration.run_id)
        self._keys = Keys(self._run)
        self.endpoint = _free() if listen is None else _checked(listen)
        """Where the router listens; clients connect to it."""
        self.done = Published()
        self._stopped = Event()
        self._said = 0.0
        self._publishers: dict[int, Any] = {}
        self._tokens: list[Any] = []
        self._session: Any = None

    def __enter__(self) -> Publisher:
        self._session = zsession.open_session("router", [self.endpoint], [])
        for sender in self._rows:
            key = self._keys.telemetry(sender)
            self._publishers[sender] = zsession.telemetry_publisher(self._session, key)
        liveliness = self._session.liveliness()
        for first in self._recording.configuration.firsts:
            self._tokens.append(liveliness.declare_token(self._keys.ready(first)))
        return self

    def __exit__(self, *_: object) -> None:
        self._publishers.clear()
        self._tokens.clear()
        self._session.close()
        remove_sockets([self.endpoint])

    def stop(self) -> None:
        """End `publish` after the tick that it is at; from any thread."""
        self._stopped.set()

    @property
    def watched(self) -> bool:
        """Whether anybody has subscribed."""
        return any(map(zsession.matched, self._publishers.values()))

    def publish(self) -> Published:
        """Publish until the end of the span, or without an end with `loop`; `stop` ends it earlier."""
        if self._wait and not self.watched:
            self._say(f"waiting for a subscriber on {self.endpoint}")
            while not (self.watched or self._stopped.is_set()):
                self._stopped.wait(POLL_S)
        began = self._said = self._clock.now()
        try:
            while not self._stopped.is_set():
                self._pass(began)
                if not self._loop:
                    break
        finally:
            self.done.seconds = self._clock.now() - began
            self._counters()
        return self.done

    def _pass(self, began: float) -> None:
        """All ticks of the span once."""
        due = self._clock.now()
        for k in range(self._first, self._last + 1):
            self._tick(k)
            due += self._period_s
            now = self._clock.now()
            if now - self._said >= SAY_EVERY_S:
                self._said = now
                self._tell(k, now - began)
            if now - due > LOST_S:
                due = now
            # also after the last tick: it lasts as long as any other
            while (left := due - self._clock.now()) > 0.0 and not self._stopped.is_set():
                self._clock.wait(left, self._stopped)
            if self._stopped.is_set():
                return
        self.done.rounds += 1

    def _tick(self, k: int) -> None:
        for sender, rows in self._rows.items():
            if self._whole[sender][k]:
                raw = encode_batch(self._run, k, sender, rows[k : k + 1])
                self._publishers[sender].put(raw)
                self.done.rows += 1
        self.done.ticks += 1
        self._next = k + 1

    def _tell(self, k: int, seconds: float) -> None:
        """What the progress is."""
        self.done.seconds = seconds
        tick_s = self._recording.tick_s
        rate = self.done.rate(tick_s)
        held = "" if rate is None else f", {rate:.3g} x real time"
        self._say(f"tick {k} of {self._last}, {k * tick_s:.1f} s{held}")

    def _counters(self) -> None:
        """Everybody's last word."""
        n = self._recording.nodes
        for sender, publisher in self._publishers.items():
            who = "plant" if sender == PLANT else f"node/{label(sender, n)}"
            counters = self._recording.process_counters(who)
            publisher.put(encode_counters(self._run, self._next, sender, counters))
        sleep(LAST_S)


def _free() -> str:
    return choose(1, "tcp", None, None).plant


def _checked(endpoint: str) -> str:
    """The endpoint, if a Zenoh session can listen there; UsageError naming --listen otherwise."""
    protocol, _, place = endpoint.partition("/")
    if protocol == "unixsock-stream":
        path = Path(place)
        if not place or any(one in place for one in SPECIAL):
            raise UsageError(f"--listen {endpoint}: expected a path without any of {SPECIAL!r}")
        if len(str(path.absolute()) + ".lock") > LONGEST_SOCKET_PATH:
            raise UsageError(
                f"--listen {endpoint}: too long, a socket's path has at most {LONGEST_SOCKET_PATH} bytes"
            )
        if path.exists():
            raise UsageError(f"--listen {endpoint}: it exists already; give another path")
        if not path.parent.is_dir():
            raise UsageError(f"--listen {endpoint}: there is no directory {path.parent}")
        return endpoint
    address, _, port = place.rpartition(":")
    if protocol != "tcp" or not address or not port.isdecimal() or not 0 < int(port) < 65_536:
        raise UsageError(
            f"--listen {endpoint}: expected tcp/ADDRESS:PORT or unixsock-stream/PATH, for example "
            "tcp/127.0.0.1:7447"
        )
    if reason := port_taken(int(port), address.strip("[]")):
        raise UsageError(
            f"--listen {endpoint}: nothing can listen there ({reason}); give another port, or leave it out"
        )
    return endpoint
