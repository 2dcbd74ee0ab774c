"""The links between the nodes of a run, by the final counters of both of their ends.

Pure counting, between `analysis.recording`, which supplies the counters, and the summary and the plot.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

_FLOW = ("messages", "bytes", "crc32")


@dataclass(frozen=True)
class Link:
    """One direction between two neighbours, by the final counters of both."""

    way: str
    """"forward" or "backward"."""
    sender: int
    receiver: int
    sent: int
    received: int
    intact: bool
    """Both ends agree in number, bytes and checksum."""
    whole: bool = True
    """Neither end was replaced: the counters of a process that died died with it, so that the two ends of its
    links have not counted the same."""


def links_between(counts: Sequence[Mapping[str, int]], replaced: Collection[int]) -> list[Link]:
    """Directed links between neighbours in different processes, forward ones first, each from the root on.

    counts: the final counters of each segment; replaced: segments whose processes were.
    """
    segments = len(counts)
    pairs = [("forward", i, i + 1) for i in range(segments - 1)]
    pairs += [("backward", i + 1, i) for i in range(segments - 1)]
    return [
        Link(
            way,
            a,
            b,
            counts[a][f"{way}_sent_messages"],
            counts[b].get(f"{way}_received_messages", 0),
            all(
                counts[a].get(f"{way}_sent_{what}", -1) == counts[b].get(f"{way}_received_{what}")
                for what in _FLOW
            ),
            a not in replaced and b not in replaced,
        )
        for way, a, b in pairs
        if f"{way}_sent_messages" in counts[a]  # else both are in one process
    ]
