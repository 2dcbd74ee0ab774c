"""Rows of many senders, batched and in any order, become one sequence by tick: what a recording
needs.

Between the messages that the recorder receives and its file. A tick is handed out when every sender
has given its row, so the order in the file does not depend on who was faster.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from wire.messages import Batch

Row = list[float]


@dataclass(frozen=True)
class Gap:
    """Ticks [first, after) of one sender that never came."""

    sender: int
    first: int
    after: int


class TickMerge:
    """Collects batches of known senders and yields complete ticks in order."""

    def __init__(self, senders: Sequence[int]) -> None:
        self._rows: dict[int, deque[tuple[int, Row]]] = {s: deque() for s in senders}
        self._next: dict[int, int] = dict.fromkeys(senders, 0)
        self._ends: dict[int, int] = {}
        self.gaps: list[Gap] = []
        """Filled as gaps are seen."""

    def add(self, batch: Batch) -> bool:
        """Take a batch; False if its ticks were here already (a repeated message)."""
        sender, expected = batch.sender, self._next[batch.sender]
        if batch.tick < expected:
            return False
        if batch.tick > expected:
            self.gaps.append(Gap(sender, expected, batch.tick))
        self._rows[sender].extend(enumerate(batch.rows.tolist(), batch.tick))
        self._next[sender] = batch.tick + len(batch.rows)
        return True

    def end(self, sender: int, tick: int) -> None:
        """The sender says that it has nothing from `tick` on."""
        if tick > self._next[sender]:
            self.gaps.append(Gap(sender, self._next[sender], tick))
            self._next[sender] = tick
        self._ends[sender] = tick

    def waiting_for(self) -> list[int]:
        """Senders that have not said their last word, in order."""
        return [s for s in self._rows if s not in self._ends]

    def complete(self) -> Iterator[tuple[int, dict[int, Row]]]:
        """Yield (tick, row per sender) for every tick about which all senders have spoken."""
        known = min(
            (n for s, n in self._next.items() if s not in self._ends),
            default=max(self._next.values(), default=0),
        )
        yield from self._up_to(known)

    def rest(self) -> Iterator[tuple[int, dict[int, Row]]]:
        """Yield everything that is left, ticks with missing rows included."""
        yield from self._up_to(max(self._next.values(), default=0))

    def _up_to(self, known: int) -> Iterator[tuple[int, dict[int, Row]]]:
        while True:
            heads = [rows[0][0] for rows in self._rows.values() if rows]
            tick = min(heads, default=known)
            if tick >= known:
                return
            out = {}
            for sender, rows in self._rows.items():
                if rows and rows[0][0] == tick:
                    out[sender] = rows.popleft()[1]
            yield tick, out
