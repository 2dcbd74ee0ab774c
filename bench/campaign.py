"""The whole measurement: which groups live when, whose bursts alternate, what is kept of them.

Between `bench.execute`, which reads and writes files, and `bench.group`. For each n: every group alone
(start-up, memory), then together with bursts in turn, then rates.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import IO, Any

import numpy as np

from bench.configs import expected_messages
from bench.group import Burst, Group, GroupMemory, Signals, Totals
from bench.layout import Placement, choose_placement
from bench.options import BenchOptions
from bench.real_nodes import RealNodes, deploy_nodes
from bench.statistics import first_rate, highest_rate, most_late, spread, trial_facts

BURST_S = 20.0
"""A burst ends after so long, whatever number of ticks it has done: all-to-all with many nodes."""
CROWD = 50
"""All-to-all with so many nodes lives during its own bursts only."""
KINDS = ("exchange", "measurement", "command")

Progress = Callable[[str], None]


class Campaign:
    """All measurements of one benchmark; `rows` and `rates` grow as they are finished."""

    def __init__(
        self, options: BenchOptions, log: IO[bytes], signals: Signals, progress: Progress
    ) -> None:
        self.rows: list[dict[str, Any]] = []
        self.rates: list[dict[str, Any]] = []
        self.notes: list[str] = []
        self._options = options
        self._log, self._signals, self._progress = log, signals, progress
        self._placement: Placement = choose_placement(pin=options.pin, fifo=options.sched == "fifo")

    def run(self) -> None:
        """Measure everything; KeyboardInterrupt or OctarmError leave what is finished in place."""
        for nodes in self._options.nodes:
            self._signals.check()
            real = deploy_nodes(self._options.gains, nodes, self._options.segments_per_process)
            series = {p: Series(p, real) for p in self._options.pattern}
            for one in series.values():
                self._alone(one)
            try:
                self._in_turn(series)
            finally:
                self.rows += [one.facts() for one in series.values() if one.bursts]
            if self._options.rates:
                for pattern in self._options.rate_pattern:
                    self._rate(pattern, real)

    def _group(self, pattern: str, real: RealNodes) -> Group:
        return Group(
            pattern,
            real,
            self._placement,
            seed=self._options.seed,
            log=self._log,
            signals=self._signals,
            note=self._note,
        )

    def _note(self, text: str) -> None:
        """What the system did not permit: said once a process kind would be said n times."""
        group, _, what = text.partition(": ")
        what = what.partition(": ")[2] or what
        if what not in self.notes:
            self.notes.append(what)
            self._progress(f"{group}: {what}")

    def _alone(self, series: Series) -> None:
        """Start-up and memory of a group beside which no other lives."""
        with self._group(series.pattern, series.real) as group:
            group.burst(1, limit_s=1.0)
            series.start_s = group.start_s
            series.memory = group.memory()

    def _in_turn(self, series: dict[str, Series]) -> None:
        """Bursts of all groups in turn; a repetition begins with another group than the one before."""
        with ExitStack() as stack:
            living: dict[str, Group] = {}
            for pattern, one in series.items():
                if not one.crowd:
                    living[pattern] = stack.enter_context(self._group(pattern, one.real))
            order = list(series)
            nodes = next(iter(series.values())).real.nodes
            self._progress(f"{nodes} nodes: bursts of {', '.join(order)} in turn")
            for repetition in range(self._options.repetitions):
                for pattern in order:
                    one = series[pattern]
                    if one.crowd:
                        with self._group(pattern, one.real) as group:
                            self._burst(one, group)
                            one.close(group.finish())
                    else:
                        self._burst(one, living[pattern])
                order.append(order.pop(0))
                self._progress(
                    f"{nodes} nodes: repetition {repetition + 1} of "
                    f"{self._options.repetitions}, sweep p50 in us: "
                    + ", ".join(f"{p} {s.last_us:.0f}" for p, s in series.items())
                )
            for pattern, group in living.items():
                series[pattern].close(group.finish())

    def _burst(self, one: Series, group: Group) -> None:
        one.add(group.burst(self._options.ticks, limit_s=BURST_S))

    def _rate(self, pattern: str, real: RealNodes) -> None:
        """The highest rate that a group alone holds."""
        asked = self._options.rate_ticks
        trials: list[dict[str, Any]] = []
        with self._group(pattern, real) as group:
            first = group.burst(min(asked, 1000), limit_s=BURST_S)

            def trial(hz: int) -> bool:
                burst = group.burst(
                    asked, limit_s=0.0, period_ns=round(1e9 / hz), most_late=most_late(asked)
                )
                facts = trial_facts(hz, asked, burst.times_ns)
                trials.append(facts)
                took = facts["finish_ms"]
                self._progress(
                    f"{real.nodes} nodes, {pattern}, {hz} Hz: finish p99.9 {took['p99_9']:.2f} ms "
                    f"of {1e3 / hz:.2f} ms, late {facts['late']} of {facts['ticks']}: "
                    + ("held" if facts["held"] else "not held")
                )
                return bool(facts["held"])

            # p99, not p99.9: too high a start costs little, its trials are given up early.
            estimate_s = spread(first.times_ns, 1e9)["p99"]
            held = highest_rate(trial, first_rate(estimate_s))
            entry = {"pattern": pattern, "nodes": real.nodes, "held_hz": held}
            self.rates.append(entry | {"estimate_ms": 1e3 * estimate_s, "trials": trials})


class Series:
    """What one pattern at one n gave so far."""

    def __init__(self, pattern: str, real: RealNodes) -> None:
        self.pattern = pattern
        self.real = real
        self.start_s: float | None = None
        self.memory: GroupMemory | None = None
        self.bursts: list[Burst] = []
        self._chain: list[Any] = []
        self._closed: list[Totals] = []
        self._open = 0

    @property
    def crowd(self) -> bool:
        """Whether the group has so many links that it disturbs others even when idle."""
        return self.pattern == "all-to-all" and self.real.processes >= CROWD

    @property
    def last_us(self) -> float:
        """Median of the last burst."""
        return spread(self.bursts[-1].times_ns, 1e3)["p50"]

    def add(self, burst: Burst) -> None:
        """Keep a burst."""
        self.bursts.append(burst)

    def close(self, totals: Totals) -> None:
        """Keep what the receivers counted in the life of the group that gave the last bursts."""
        self._closed.append(totals)
        if totals.chain_ns is not None:
            for burst in self.bursts[self._open :]:
                times = totals.chain_ns[burst.first : burst.first + len(burst.times_ns)]
                self._chain.append(times[times >= 0.0])
        self._open = len(self.bursts)

    def facts(self) -> dict[str, Any]:
        """The row of the JSON file; what is not known because of an interruption is None."""
        times = np.concatenate([burst.times_ns for burst in self.bursts])
        chain = np.concatenate(self._chain) if self._chain else np.array([])
        processes = self.real.processes
        return {
            "pattern": self.pattern,
            "nodes": self.real.nodes,
            "processes": processes,
            "payload_bytes": self.real.payload_bytes,
            "repetitions": len(self.bursts),
            "expected_messages_per_tick": expected_messages(self.pattern, processes),
            "messages_per_tick": self._per_tick("messages"),
            "bytes_per_tick": self._per_tick("bytes"),
            "counted_ticks": sum(t.ticks for t in self._closed),
            "rejected_messages": sum(t.rejected for t in self._closed) if self._closed else None,
            "sweep_us": spread(times, 1e3),
            "sweep_p50_us_of_repetitions": [spread(b.times_ns, 1e3)["p50"] for b in self.bursts],
            "chain_us": spread(chain, 1e3) if chain.size else None,
            "cpu_us_per_tick": 1e-3
            * sum(b.cpu_ns for b in self.bursts)
            / sum(b.all_ticks for b in self.bursts),
            "memory_mb": self._memory(),
            "start_s": self.start_s,
        }

    def _per_tick(self, what: str) -> dict[str, float | None]:
        """Of each kind; over the whole life of the groups, warm-up too."""
        ticks = sum(t.ticks for t in self._closed)
        if not ticks:
            return dict.fromkeys(KINDS)
        sums = {kind: sum(getattr(t, what)[kind] for t in self._closed) for kind in KINDS}
        return {kind: total / ticks for kind, total in sums.items()}

    def _memory(self) -> dict[str, float] | None:
        if self.memory is None or not self.memory.workers:
            return None
        workers = self.memory.workers
        return {
            "pss_per_node": sum(m.pss_kb for m in workers) / len(workers) / 1024,
            "private_per_node": sum(m.private_kb for m in workers) / len(workers) / 1024,
            "pss_total": self.memory.total_pss_kb / 1024,
        }
