"""How processes of a run are ended if they do not end on their own: signals, each with a grace.

For the conductor, which says in which order. A process is known by its pidfd, a node on another host by what
its zygote says; the zygotes come last, for they end whatever they have forked in the meantime.
"""

from __future__ import annotations

import signal
from collections.abc import Callable, Sequence

from supervise.children import Handle, Process
from supervise.far import FarZygote
from wire.child import Deadline

ZYGOTE_GRACE_S = 5.0
"""The zygote needs more: it ends its own children first."""
GRACE_S = 1.0
"""Between SIGINT, SIGTERM and SIGKILL."""


class Ending:
    """Ends processes, and sees what happens meanwhile."""

    def __init__(self, turn: Callable[[float], None], hurried: Callable[[], bool]) -> None:
        """`turn` handles what happens within some seconds; `hurried`: the user does not want to wait."""
        self._turn = turn
        self._hurried = hurried

    def processes(self, handles: Sequence[Handle]) -> None:
        """SIGINT, SIGTERM, SIGKILL to those that this machine has."""
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
            self._end(number, handles)

    def zygotes(
        self, zygote: Process | None, far: Sequence[FarZygote], forked: Sequence[Handle]
    ) -> None:
        """The zygotes here and on other hosts, and what was forked here and is still there."""
        own = [] if zygote is None else [zygote]
        for one in own:
            one.control.close()
        self._await_end([one for one in far if one.up], ZYGOTE_GRACE_S)
        self._end(signal.SIGTERM, [*own, *far], ZYGOTE_GRACE_S)
        self._end(signal.SIGKILL, [*own, *far, *forked])

    def _end(
        self,
        number: signal.Signals,
        handles: Sequence[Handle],
        grace_s: float = GRACE_S,
    ) -> None:
        """Send a signal to those that live, and give them time."""
        self._turn(0.0)
        living = [handle for handle in handles if handle.alive]
        for handle in living:
            handle.signal(number)
        self._await_end(living, grace_s)

    def _await_end(self, handles: Sequence[Handle], grace_s: float) -> None:
        limit = Deadline(0.2 if self._hurried() else grace_s)
        while not limit.passed and any(handle.alive for handle in handles):
            self._turn(min(0.05, limit.left))
