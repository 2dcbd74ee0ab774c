"""The lives of a node process in a recording: what can be replayed from where, what is a gap, what was lost.

Between the rows of `analysis.replay` and whatever replays them. A process that died and was replaced has two
lives: the second begins with the state that its first row has (wire.channels.Degraded.JOINED), in a process
that knows nothing of the first. A tick without a row is no loss where nothing was to be recorded: the plant
called it late, or the node was not on time, being frozen or dead.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from wire.channels import Degraded

Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Life:
    """Ticks of one process, in order, that can be replayed one after the other."""

    ticks: tuple[int, ...]
    joined: bool
    """Whether it begins with the state of its first row, not with that of the configuration."""
    doubtful: frozenset[int] = frozenset()
    """Of these: the node was not on time in the ticks without a row before it. Either it skipped them, or it
    did them late and what it recorded was lost; the state tells."""


@dataclass(frozen=True)
class Loss:
    """Rows that are not there, although the node was on time."""

    first: int
    last: int
    later: int
    """Ticks after it that are there, but cannot be replayed: the state before them is not known."""
    dead: bool
    """The node was dead afterwards: its last rows went with it."""


@dataclass(frozen=True)
class Lives:
    """The lives of one process, and what lies between them."""

    lives: tuple[Life, ...]
    losses: tuple[Loss, ...]
    gaps: tuple[tuple[int, int], ...]
    """First and last tick of each stretch in which the node was out: a replacement begins in the tick after it,
    or the recording ends."""


def lives_of(there: Bools, late: Bools, on_time: Bools, alive: Bools, flags: Ints) -> Lives:
    """The lives in a recording, all arguments of shape (ticks,).

    there: a whole row; late: the tick had no sweep; on_time, alive: what the plant says of the node, True where
    it says nothing; flags: wire.channels.Degraded.
    """
    joined = there & ((flags & int(Degraded.JOINED)) != 0)
    if there.size == 0 or not there.any():
        joined = np.zeros_like(there)
    found = _Found()
    for k in range(there.size):
        if joined[k]:
            found.begin(k)
        elif there[k]:
            found.go_on(k)
        elif late[k]:
            found.out.extend([k] if found.out else [])
        elif on_time[k]:
            found.lose(k)
        else:
            found.out.append(k)
    found.end(alive)
    losses = tuple(
        Loss(first, last, later, dead=not alive[last + 1 : _next(there, last)].all())
        for first, last, later in found.losses
    )
    return Lives(tuple(found.lives), losses, tuple(found.gaps))


def _next(there: Bools, tick: int) -> int:
    """The next tick after this one that is there, or the end."""
    following = np.flatnonzero(there[tick + 1 :])
    return tick + 1 + int(following[0]) if following.size else there.size


class _Found:
    """What has been found up to a tick."""

    def __init__(self) -> None:
        self.lives: list[Life] = []
        self.losses: list[tuple[int, int, int]] = []
        self.gaps: list[tuple[int, int]] = []
        self.out: list[int] = []
        """Ticks without a row since the last one, from the first in which the node was not on time on."""
        self._ticks: list[int] = []
        self._doubtful: set[int] = set()
        self._joined = False
        self._known = True
        """Whether the state is, that comes into the tick."""

    def begin(self, k: int) -> None:
        """A replacement's first row."""
        self._close()
        if self.out:
            self.gaps.append((self.out[0], k - 1))
        self.out, self._joined, self._known = [], True, True
        self._ticks = [k]

    def go_on(self, k: int) -> None:
        """A row of the process that there was."""
        if not self._known:
            first, last, later = self.losses[-1]
            self.losses[-1] = first, last, later + 1
        else:
            self._ticks.append(k)
            if self.out:
                self._doubtful.add(k)
        self.out = []

    def lose(self, k: int) -> None:
        """No row, although there should be one."""
        if self._known or not self.losses:
            self.losses.append((k, k, 0))
        else:
            first, _, later = self.losses[-1]
            if not later:  # rows that come later cannot be replayed, whatever else is missing
                self.losses[-1] = first, k, later
        self._known = False
        self.out = []

    def end(self, alive: Bools) -> None:
        """The recording ends."""
        self._close()
        if self.out and not alive[self.out].all():
            self.gaps.append((self.out[0], int(alive.size) - 1))

    def _close(self) -> None:
        if self._ticks:
            life = Life(tuple(self._ticks), self._joined, frozenset(self._doubtful))
            self.lives.append(life)
        self._ticks, self._doubtful = [], set()
