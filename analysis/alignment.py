"""Which messages of two recordings belong together, channel by channel, and whether they are in one order.

First step of comparing two recordings: tables in, numbers of rows out. Messages of one tick belong together;
where a channel has several in a tick, in their order; where two runs have different ticks, those of an instant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from analysis.table import Table

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Pairs:
    """The messages of one topic: rows that both have, and rows that one has alone."""

    a: Ints
    """(pairs,) rows of the first recording's table."""
    b: Ints
    """(pairs,) rows of the second's."""
    moments_a: Ints
    """(rows of A,) when: the tick, or the instant in ns where the ticks differ."""
    moments_b: Ints
    only_a: Ints
    """Rows of the first recording that the second has not."""
    only_b: Ints


@dataclass(frozen=True)
class OrderDifference:
    """Where messages that both have are not in the same order."""

    after: int
    """So many of the common messages are in the same order."""
    topic_a: str
    """Whose message comes next in the first recording."""
    tick_a: int
    topic_b: str
    tick_b: int


def pair(a: Table, b: Table, ticks_s: tuple[float, float]) -> Pairs:
    """Pair the messages of one topic; `ticks_s` are the periods of a tick of the two runs."""
    same = ticks_s[0] == ticks_s[1]
    moments = [
        _moments(t, None if same else tick_s) for t, tick_s in zip((a, b), ticks_s, strict=True)
    ]
    keys_a, keys_b = _unique_keys(*moments)
    _, rows_a, rows_b = np.intersect1d(keys_a, keys_b, assume_unique=True, return_indices=True)
    return Pairs(
        a=rows_a.astype(np.int64),
        b=rows_b.astype(np.int64),
        moments_a=moments[0],
        moments_b=moments[1],
        only_a=_others(len(keys_a), rows_a),
        only_b=_others(len(keys_b), rows_b),
    )


def _moments(table: Table, tick_s: float | None) -> Ints:
    if "tick" not in table.columns:  # a channel of another program's making: counted
        return np.arange(table.rows, dtype=np.int64)
    if tick_s is None:
        return table.ticks
    moments: Ints = np.rint(table.ticks * tick_s * 1e9).astype(np.int64)
    return moments


def _unique_keys(a: Ints, b: Ints) -> tuple[Ints, Ints]:
    """The moments themselves, or numbers that tell several messages of one moment apart."""
    if np.unique(a).size == a.size and np.unique(b).size == b.size:
        return a, b
    known: dict[tuple[int, int], int] = {}

    def numbered(moments: Ints) -> Ints:
        seen: dict[int, int] = {}
        out = []
        for moment in moments.tolist():
            before = seen.get(moment, 0)
            seen[moment] = before + 1
            out.append(known.setdefault((moment, before), len(known)))
        return np.array(out, dtype=np.int64)

    return numbered(a), numbered(b)


def _others(rows: int, taken: npt.NDArray[np.intp]) -> Ints:
    left = np.ones(rows, dtype=np.bool_)
    left[taken] = False
    return np.flatnonzero(left)


def order_difference(
    orders: tuple[Sequence[str], Sequence[str]],
    pairs: Mapping[str, Pairs],
    tables: tuple[Mapping[str, Table], Mapping[str, Table]],
) -> OrderDifference | None:
    """Where the messages that both recordings have first come in another order; None if nowhere.

    `orders` are the topics of all messages in file order, `pairs` of the topics that both have.
    """
    places: tuple[list[Ints], list[Ints]] = ([], [])
    owners: list[tuple[str, int]] = []
    where = [_places(order) for order in orders]
    for topic, paired in pairs.items():
        if not paired.a.size or not all(topic in one for one in where):
            continue
        owners += [(topic, row) for row in paired.a.tolist()]
        places[0].append(where[0][topic][paired.a])
        places[1].append(where[1][topic][paired.b])
    if not owners:
        return None
    a, b = (np.argsort(np.concatenate(one), kind="stable") for one in places)
    wrong = np.flatnonzero(a != b)
    if not wrong.size:
        return None
    first = int(wrong[0])
    found = []
    for number in (int(a[first]), int(b[first])):
        topic, row = owners[number]
        table = tables[0][topic]
        found.append((topic, int(table.ticks[row]) if "tick" in table.columns else row))
    return OrderDifference(first, *found[0], *found[1])


def _places(order: Sequence[str]) -> dict[str, Ints]:
    """Per topic where in the file its messages are."""
    codes: dict[str, int] = {}
    numbers = np.array([codes.setdefault(topic, len(codes)) for topic in order], dtype=np.int64)
    sorted_ = np.argsort(numbers, kind="stable")
    ends = np.cumsum(np.bincount(numbers, minlength=len(codes)))
    starts = np.concatenate([[0], ends[:-1]]) if codes else ends
    return {
        topic: sorted_[starts[code] : ends[code]].astype(np.int64) for topic, code in codes.items()
    }
