"""Counts of what a process really sent, received and refused; reported once, when the run ends.

Neighbour messages are counted by their receivers, and a running checksum on both sides of every
link shows that what was sent is what arrived.
"""

from __future__ import annotations

from collections import deque
from zlib import crc32

from wire.messages import Reason


class Flow:
    """One direction of one kind of message: number, bytes, and the CRC-32 of everything in
    order.

    `add` takes an encoded message; it only puts it aside, so that nothing on the way of a tick waits for the
    sums. `settle` makes them, in one thread; `add` may go on in another meanwhile.
    """

    __slots__ = ("_waiting", "add", "bytes", "checksum", "messages")

    def __init__(self) -> None:
        self.messages = 0
        self.bytes = 0
        self.checksum = 0
        self._waiting: deque[bytes] = deque()
        self.add = self._waiting.append

    def settle(self) -> None:
        """Count what was put aside."""
        waiting = self._waiting
        count = len(waiting)
        together = b"".join(waiting.popleft() for _ in range(count))
        self.messages += count
        self.bytes += len(together)
        self.checksum = crc32(together, self.checksum)

    def report(self, name: str) -> dict[str, int]:
        """The three figures under `<name>_messages`, `<name>_bytes`, `<name>_crc32`."""
        self.settle()
        return {
            f"{name}_messages": self.messages,
            f"{name}_bytes": self.bytes,
            f"{name}_crc32": self.checksum,
        }


class Rejections:
    """Refused messages by reason."""

    def __init__(self) -> None:
        self._counts: dict[Reason, int] = {}

    def add(self, reason: Reason) -> None:
        """Count one refused message."""
        self._counts[reason] = self._counts.get(reason, 0) + 1

    def report(self) -> dict[str, int]:
        """The counts under `rejected_<reason>`, for the reasons that occurred, and
        `rejected_messages`."""
        out = {f"rejected_{reason.value}": n for reason, n in sorted(self._counts.items())}
        out["rejected_messages"] = sum(self._counts.values())
        return out
