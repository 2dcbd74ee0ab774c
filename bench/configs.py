"""The exchange patterns, and what the benchmark tells each process of a group, as JSON lines.

A group is one pattern with n nodes: a driver in the plant's place and n workers (star: and a hub).
Imported by every process of a group, so it needs the standard library only.
"""

from __future__ import annotations

from dataclasses import dataclass

from wire.errors import UsageError
from wire.run_config import LinkConfig

PATTERNS = ("neighbour", "bare", "star", "all-to-all", "raw")
"""docs/bench.md says exactly what each does."""
CHAINS = ("neighbour", "bare", "raw")
"""Those whose sums travel along the arm."""
HUB = "hub"
LEASE_MS = 3_600_000
"""An idle group sends no keep-alive that would disturb the one that is measured."""
PATIENCE_S = 3600.0
"""The deadline of a node that waits while other groups are measured."""


def expected_messages(pattern: str, nodes: int) -> int:
    """Exchange messages a tick, as the pattern's definition has it."""
    if pattern == "star":
        return 2 * nodes
    if pattern == "all-to-all":
        return nodes * (nodes - 1)
    return 2 * (nodes - 1)


@dataclass(frozen=True)
class WorkerConfig:
    """One worker of a pattern without mathematics."""

    run_id: str
    role: str
    """A pattern's name (not "neighbour": its workers are the real nodes), or "hub"."""
    index: int
    """0..n-1, the hub n."""
    nodes: int
    payload_bytes: int
    """Of an exchange message."""
    command_bytes: int
    links: LinkConfig

    def __post_init__(self) -> None:
        roles = (*PATTERNS[1:], HUB)
        if self.role not in roles:
            raise UsageError(f"role: expected one of {', '.join(roles)}, got {self.role!r}")
        if self.nodes < 2 or not 0 <= self.index <= self.nodes:
            raise UsageError(f"index: expected 0..{self.nodes}, got {self.index}")
        if min(self.payload_bytes, self.command_bytes) < 1:
            raise UsageError("payload_bytes, command_bytes: expected at least 1")


@dataclass(frozen=True)
class Port:
    """One process at the driver: it gets one measurement message a tick and gives one command."""

    index: int
    """The node number on the wire."""
    measured: int
    """Numbers in a measurement message."""
    commanded: int
    """Numbers in a command message."""


@dataclass(frozen=True)
class EndRows:
    """Where the telemetry rows of the chain's two end nodes have their instants, in ns after the epoch."""

    first_width: int
    """Columns of the rows of the root's node."""
    last_width: int
    last: int
    """The number of the process at the tip."""
    tip: int
    """The number that its telemetry has: the last segment's."""
    measured: int
    """Column of the instant at which the measurement came; negative: from the end."""
    arrived: int
    """Column of the instant at which the sum from the other end came."""


@dataclass(frozen=True)
class DriverConfig:
    """What the driver of a group needs."""

    run_id: str
    pattern: str
    ports: tuple[Port, ...]
    members: tuple[int, ...]
    """Everybody who reports ready and gives counters: the ports' numbers and the hub's."""
    centres: tuple[tuple[float, ...], ...]
    """What each port measures, without noise."""
    setpoint: int
    seed: int
    ends: EndRows | None
    """None for a pattern without a chain."""
    links: LinkConfig

    def __post_init__(self) -> None:
        if self.pattern not in PATTERNS:
            raise UsageError(f"pattern: expected one of {PATTERNS}, got {self.pattern!r}")
        if [len(c) for c in self.centres] != [p.measured for p in self.ports] or not self.ports:
            raise UsageError("centres: expected as many numbers as each port measures")
