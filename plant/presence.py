"""Who of the nodes is there: one that is gone or stuck is left out while it is replaced, then waited for again.

Beside the plant's process, which asks in every wait, and the exchange, which knows whose commands come. A node
that will not be replaced, is not in time, or is one of too many that are out, is a reason to stop.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from plant.exchange import Exchange
from plant.pace import Pace
from wire.child import Deadline
from wire.messages import Stop

REPLACED_S = 5.0
"""A dead node must be replaced within this time, wall clock; then the arm goes passive."""


class Presence:
    """The node processes of a run, so many, as the plant sees them."""

    def __init__(
        self, exchange: Exchange, processes: int, report: Callable[..., Any], *, restart: bool
    ) -> None:
        """`report` tells the launcher (wire.child.Child.status); `restart`: dead nodes are replaced."""
        self._exchange = exchange
        self._processes = processes
        self._report = report
        self._restart = restart
        self._out_since: dict[int, Deadline] = {}
        """Nodes that are left out, and until when they must be there again."""

    def see_who_is_gone(self, k: int) -> Stop | None:
        """Leave nodes out whose tokens have vanished, if they will be replaced; the order to stop if that is
        not so, or takes too long."""
        exchange = self._exchange
        gone = sorted(exchange.vanished.difference(exchange.out, self._out_since))
        if gone and not self._restart:
            return Stop(k, "safety", f"tick {k}: {named(gone)} {_are(gone)} gone")
        for node in gone:
            self._leave_out(node, k, "gone")
        late = [node for node, limit in self._out_since.items() if limit.passed]
        if late:
            text = f"tick {k}: {named(late)} {_are(late)} gone and not replaced within {REPLACED_S:g} s"
            return Stop(k, "safety", text)
        if len(exchange.out) > self._processes // 2:
            text = f"tick {k}: {named(exchange.out)} are gone, more than half of the arm's"
            return Stop(k, "safety", text)
        return None

    def leave_stuck_out(self, pace: Pace, k: int) -> bool:
        """In real time, with replacement: leave those out whose commands alone are missing again and again;
        whether there is anybody, so that the others can go on."""
        stuck = self._exchange.stuck()
        alone = pace.late_in_a_row > pace.wait_ticks + 1 and len(stuck) <= self._processes // 2
        if not (self._restart and alone):
            return False
        for node in stuck:
            self._leave_out(node, k, "stuck")
        return True

    def tell_back(self, k: int) -> None:
        """Say which nodes are waited for again."""
        for node in [one for one in self._out_since if one not in self._exchange.out]:
            del self._out_since[node]
            self._report("back", node=node, tick=k)

    def _leave_out(self, node: int, k: int, why: str) -> None:
        self._exchange.give_up(node)
        self._out_since[node] = Deadline(REPLACED_S)
        self._report("out", node=node, tick=k, why=why)


def _are(indices: list[int]) -> str:
    return "is" if len(indices) == 1 else "are"


def named(indices: list[int]) -> str:
    """Nodes in words: at most a dozen, then how many more."""
    shown = ", ".join(map(str, indices[:12]))
    more = f" and {len(indices) - 12} more" if len(indices) > 12 else ""
    plural = "nodes" if len(indices) > 1 else "node"
    return f"{plural} {shown}{more}"
