"""Dead nodes and their replacements in a run with `--restart`: who, by what, and how long it took.

Beside the conductor, which sees the deaths and forks, and the plant, which sees when a node works again.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from time import monotonic

from supervise.plan import Plan
from wire.run_config import NodeConfig

MOST_REPLACEMENTS = 3
"""Of one node in a run: one that keeps dying has a reason, and the arm is better passive."""


@dataclass
class Replacements:
    """What has happened so far."""

    plan: Plan
    count: dict[int, int] = field(default_factory=dict)
    """Replacements of each node."""
    times_s: list[float] = field(default_factory=list)
    """From each death, or from when a node was left out, until the plant had a command of it, wall clock."""
    left_out: set[int] = field(default_factory=set)
    """Nodes that the plant did not wait for at some time."""
    _since: dict[int, float] = field(default_factory=dict)

    def out(self, node: int) -> None:
        """The plant goes on without a node."""
        self.left_out.add(node)
        self._since.setdefault(node, monotonic())

    def replaceable(self, node: int) -> bool:
        """Whether a node that has died now is replaced."""
        return (
            self.plan.run.restart
            and node not in self.plan.by_hand
            and self.count.get(node, 0) < MOST_REPLACEMENTS
        )

    def replacement(self, node: int) -> NodeConfig:
        """The configuration of the process that takes the place of a node that has died now."""
        self.count[node] = self.count.get(node, 0) + 1
        self._since.setdefault(node, monotonic())
        config = next(one for one in self.plan.nodes if one.index == node)
        return replace(config, joins=True)

    def back(self, node: int) -> float | None:
        """A node works again; how long it did not, in s, None if nobody had missed it."""
        since = self._since.pop(node, None)
        if since is None:
            return None
        self.times_s.append(monotonic() - since)
        return self.times_s[-1]

    def trouble(self) -> str:
        """What to say of a run in which nodes were replaced or left out; empty if none was."""
        names = [f"node {node}" for node in sorted(self.left_out - self.count.keys())]
        parts = [f"left out: {', '.join(names)}"] if names else []
        each = ", ".join(
            f"node {node}" + (f" ({times} times)" if times > 1 else "")
            for node, times in sorted(self.count.items())
        )
        longest = f", at most {max(self.times_s):.2f} s without it" if self.times_s else ""
        still = [f"node {node}" for node in sorted(self._since)]
        away = f"; {', '.join(still)} did not come back before the end" if still else ""
        if self.count:
            parts.insert(0, f"replaced: {each}")
        return f"{'; '.join(parts)}{longest}{away}" if parts else ""
