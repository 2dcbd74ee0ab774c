"""The ticks of a burst: one after the other as fast as they go, or each at its due instant.

Between the driver, which takes orders, and its links (`send`, `wait`). Nothing but the tick itself
happens between the first measurement and the last command.
"""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Sequence
from time import monotonic_ns
from typing import Protocol

_PR_SET_TIMERSLACK = 29
PAUSE = 0.25
"""Of a tick's time, before the next in lock-step: in a run the plant computes meanwhile. Without it the
nodes' work after their commands fills the cores, and the kernel stops real-time processes for 50 ms."""
TICK_LIMIT_S = 10.0
"""A tick that takes longer has lost a message."""


class Links(Protocol):
    """What a burst needs of the driver's links."""

    def send(self, messages: Sequence[bytes]) -> int:
        """Send every port its measurement; the instant before the first, in ns."""
        ...

    def wait(self, limit_s: float) -> int:
        """The instant of the last command in ns; 0 if it did not come."""
        ...


class TickLostError(Exception):
    """Not every command came within `TICK_LIMIT_S`, or the driver was told to stop."""


Messages = Callable[[], Sequence[bytes]]
"""The measurements of the next tick, made before its clock starts."""


def lock_step(links: Links, messages: Messages, ticks: int, limit_s: float) -> list[int]:
    """Ticks one after the other, a short pause between.

    Of each the ns from the first measurement sent to the last command received; fewer than `ticks`
    when `limit_s` seconds are over.
    """
    sweeps: list[int] = []
    end_ns = monotonic_ns() + int(1e9 * limit_s)
    while len(sweeps) < ticks and monotonic_ns() < end_ns:
        ready = messages()
        started_ns = links.send(ready)
        complete_ns = links.wait(TICK_LIMIT_S)
        if not complete_ns:
            raise TickLostError
        sweeps.append(complete_ns - started_ns)
        time.sleep(1e-9 * PAUSE * sweeps[-1])
    return sweeps


def paced(
    links: Links,
    messages: Messages,
    ticks: int,
    period_ns: int,
    *,
    warm: int,
    most_late: int,
    idle: Callable[[], None],
) -> list[int]:
    """Ticks at due instants a period apart: of each the ns from its due instant to the last command.

    A tick that is not finished at the next due instant is late; the next one starts at the first due
    instant after its end. Ends early when more than `most_late` were late: the rate is not held then.
    The first `warm` ticks are not among them. `idle` is called in the pause before a tick.
    """
    ctypes.CDLL(None).prctl(
        _PR_SET_TIMERSLACK, 1, 0, 0, 0
    )  # sleep ends when it is due, not 50 us later
    took: list[int] = []
    late = 0
    to_warm = warm
    due_ns = monotonic_ns() + 2 * period_ns
    while len(took) < ticks and late <= most_late:
        idle()
        ready = messages()
        if (pause_ns := due_ns - monotonic_ns()) > 0:
            time.sleep(1e-9 * pause_ns)
        links.send(ready)
        complete_ns = links.wait(TICK_LIMIT_S)
        if not complete_ns:
            raise TickLostError
        if to_warm:
            to_warm -= 1
        else:
            took.append(complete_ns - due_ns)
            late += took[-1] >= period_ns
        due_ns = next_due(due_ns, period_ns, complete_ns)
    return took


def next_due(due_ns: int, period_ns: int, complete_ns: int) -> int:
    """The first due instant after the end of the tick that was due at `due_ns`."""
    return due_ns + period_ns * max(1, -((due_ns - complete_ns) // period_ns))
