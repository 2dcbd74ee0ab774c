"""What keys cost a run: the same run over unix sockets, over TCP, and with TLS and access control, in turn.

    python benchmarks/tls_cost.py
    python benchmarks/tls_cost.py --case lockstep-10 --rounds 7 --json

Every round runs each way once, in another order; a figure is the median of the rounds. A hop is one of the
n + 1 messages of the longest way of a tick: measurement, n - 1 sums, command.
"""

from __future__ import annotations

import argparse
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from live_overhead import CASES, ROOT, Figures, as_json, in_turn, medians, run_once

HOPS = {"lockstep-10": 11, "lockstep-50": 51, "fifo-250Hz-10": 11}


def measure(
    cases: Sequence[str], ways: dict[str, list[str]], rounds: int
) -> dict[str, dict[str, list[Figures]]]:
    """Figures of every round by case and way."""

    def run(case: str, way: str) -> Figures:
        return run_once([*CASES[case], *ways[way]], live=False, watchers=())

    return in_turn(cases, list(ways), rounds, run)


def table(found: dict[str, dict[str, list[Figures]]]) -> str:
    """Rows of Markdown: medians over the rounds; the cost of a hop against the way before."""
    lines = [
        "| run | links | sweep p50 | sweep p99 | ticks/s | late ticks | a hop more, p50 |",
        "|---|---|---|---|---|---|---|",
    ]
    for case, ways in found.items():
        before: list[Figures] = []
        for way, runs in ways.items():
            p50, p99, rate, late = medians(runs)
            # Of one round each: what the machine does in the meantime is in both.
            more = [
                1e3 * (run.p50_ms - other.p50_ms) / HOPS[case]
                for run, other in zip(runs, before, strict=False)
            ]
            cost = f"{statistics.median(more):+.1f} us" if more else "-"
            figures = f"{p50:.3g} ms | {p99:.3g} ms | {rate:.4g} | {late:g} | {cost}"
            lines.append(f"| {case} | {way} | {figures} |")
            before = runs
    return "\n".join(lines)


def main() -> None:
    """Make keys, measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--case", action="append", choices=list(CASES), help="default: all")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--json", action="store_true", help="print every run's figures instead")
    given = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tls-cost-") as temporary:
        keys = Path(temporary) / "keys"
        make = [sys.executable, str(ROOT / "launcher.py"), "keys", "--nodes", "50"]
        subprocess.run([*make, "--out", str(keys)], check=True, stdout=subprocess.DEVNULL)
        ways = {"unix": [], "tcp": ["--transport", "tcp"], "keys": ["--keys", str(keys)]}
        found = measure(given.case or list(CASES), ways, given.rounds)
    print(as_json(found) if given.json else table(found))


if __name__ == "__main__":
    main()
