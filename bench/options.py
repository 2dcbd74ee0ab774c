"""What the user can choose about a benchmark, checked before anything is started.

Between `launcher.py`, which shows it, and `bench.execute`. Nothing heavy is imported here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bench.configs import PATTERNS
from supervise.shipped import DEFAULT_GAINS
from wire.errors import UsageError

MOST_NODES = 200
"""All-to-all has n (n - 1) / 2 links, each with two ends and their buffers."""
MOST_TICKS = 100_000
QUICK = {"nodes": (5, 10), "ticks": 100, "repetitions": 2, "rate_ticks": 200}


@dataclass(frozen=True)
class BenchOptions:
    """Checked when made. The command line explains each."""

    gains: Path = DEFAULT_GAINS
    nodes: tuple[int, ...] = (5, 10, 20, 50, 100)
    pattern: tuple[str, ...] = PATTERNS
    ticks: int = 600
    repetitions: int = 3
    seed: int = 1
    sched: str = "fifo"
    pin: bool = True
    segments_per_process: int = 1
    rates: bool = True
    rate_pattern: tuple[str, ...] = ("neighbour",)
    rate_ticks: int = 2000
    quick: bool = False
    compare: Path | None = None
    out: Path | None = None

    def __post_init__(self) -> None:
        for nodes in self.nodes:
            if not 2 <= nodes <= MOST_NODES:
                raise UsageError(
                    f"--nodes: expected 2..{MOST_NODES}, got {nodes} (a chain needs a root and a tip "
                    "segment)"
                )
        for name in ("pattern", "rate_pattern"):
            for one in getattr(self, name):
                if one not in PATTERNS:
                    known = ", ".join(PATTERNS)
                    raise UsageError(f"{_option(name)}: expected one of {known}; got {one!r}")
        if self.sched not in ("fifo", "other"):
            raise UsageError(f"--sched: expected fifo or other, got {self.sched!r}")
        least_nodes = min(self.nodes)
        if not 1 <= self.segments_per_process < least_nodes:
            raise UsageError(
                f"--segments-per-process: expected 1..{least_nodes - 1} for {least_nodes} nodes, got "
                f"{self.segments_per_process}"
            )
        for name, least in (("ticks", 1), ("repetitions", 1), ("rate_ticks", 1), ("seed", 0)):
            value = getattr(self, name)
            if not least <= value <= MOST_TICKS:
                raise UsageError(f"{_option(name)}: expected {least}..{MOST_TICKS}, got {value}")

    def facts(self) -> dict[str, Any]:
        """As in the JSON file: what was asked for."""
        out = {name: value for name, value in vars(self).items() if name not in ("compare", "out")}
        return {n: list(v) if isinstance(v, tuple) else v for n, v in out.items()} | {
            "gains": str(self.gains)
        }


def choose_options(given: Mapping[str, Any], *, quick: bool) -> BenchOptions:
    """The options from what was given (None or nothing: the default), each value once.

    With `quick` the defaults are those of a first look. UsageError names the option that is wrong.
    """
    chosen: dict[str, Any] = dict(QUICK) if quick else {}
    for name, value in given.items():
        if value not in (None, ()):
            several = isinstance(value, tuple)
            chosen[name] = tuple(dict.fromkeys(value)) if several else value
    return BenchOptions(**chosen, quick=quick)


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"
