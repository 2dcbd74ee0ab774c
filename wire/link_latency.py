"""How long each link between neighbours takes, from the instants that the nodes note.

A pure function on arrays: `octarm info` gives it those of a recording (/node/NN/timing), the live page those of
the last ticks.

The latency of a link is the time from the instant when the sender had all that its sum needs (its measurement,
and the sum of the neighbour before it) to the instant when the receiver had the sum: the sender's arithmetic,
the transport, and the waiting for a core on both sides.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MESSAGES = "messages"
IN_MEMORY = "in memory"
CLOCKS = "clocks"


@dataclass(frozen=True, eq=False)
class LinkLatencies:
    """Nanoseconds; not finite where an instant is missing (a late tick, a lost row)."""

    forward_ns: Array
    """(K, n - 1), column i: from node i to node i + 1."""
    backward_ns: Array
    """(K, n - 1), column i: from node i + 1 to node i."""


def link_latencies(measured: Array, forward: Array, backward: Array) -> LinkLatencies:
    """Latencies of all links from the instants at which each node received its messages.

    All three are (K, n), in ns on one clock: measurement, forward sum (column 0 unused: the root receives
    none), backward sum (last column unused). NaN marks what was not recorded.
    """
    ready_forward = np.maximum(measured, forward)
    ready_forward[:, 0] = measured[:, 0]
    ready_backward = np.maximum(measured, backward)
    ready_backward[:, -1] = measured[:, -1]
    return LinkLatencies(
        forward_ns=forward[:, 1:] - ready_forward[:, :-1],
        backward_ns=backward[:, :-1] - ready_backward[:, 1:],
    )


def link_kinds(nodes: int, firsts: Sequence[int], own_clocks: frozenset[int]) -> list[str]:
    """What each of the n - 1 links is, for its latency: MESSAGES, or why it has none.

    IN_MEMORY: both nodes are in one process (`firsts` has the first node of each process). CLOCKS: one of them
    is in `own_clocks`, whose instants count from their own first measurement.
    """
    starts = set(firsts)
    kinds = []
    for i in range(nodes - 1):
        if i + 1 not in starts:
            kinds.append(IN_MEMORY)
        elif own_clocks & {i, i + 1}:
            kinds.append(CLOCKS)
        else:
            kinds.append(MESSAGES)
    return kinds
