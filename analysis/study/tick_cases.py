"""How long a tick takes on given hosts: cases, drawn durations, percentiles over many simulated ticks.

Between measured samples (`analysis.study.hop`, handling times of real node code) and `analysis.study.growth`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.study.hop import Hop
from analysis.study.virtual_chain import Durations, Relay, What, run_tick

Array = npt.NDArray[np.float64]

CORES = 2
"""Of a host."""
JITTER = 0.1
"""Share of a link's latency between hosts that is exponentially distributed; assumed, as the latency itself."""


@dataclass(frozen=True)
class Hosts:
    """Where the processes run: contiguous parts of the chain on each core, contiguous cores on each host."""

    name: str
    hosts: int
    """0: every process has a host with one core for itself, linked like two cores of one host."""
    link_us: float = 0.0
    """Mean latency of a message between hosts, without the processor time at its ends."""

    def cores(self, processes: int) -> list[int]:
        """The core of each process."""
        total = CORES * self.hosts
        return [total * i // processes if self.hosts else i for i in range(processes)]


@dataclass(frozen=True, eq=False)
class Costs:
    """What a message costs: the link's samples, and how long the node's own code handles it."""

    hop: Hop
    handling_us: tuple[Array, Array, Array]
    """Samples by `What`."""


def draw(hosts: Hosts, costs: Costs, processes: int, random: np.random.Generator) -> Durations:
    """Durations of one tick: bootstrap from the samples.

    A hop's processor time is the receiver's service, the rest of the hop its latency: a hop between idle cores
    takes what was measured.
    """
    core = np.array(hosts.cores(processes))
    host = core // CORES if hosts.hosts else np.zeros_like(core)
    cpu = costs.hop.cpu_us
    service = np.stack([random.choice(one, processes) for one in costs.handling_us], axis=1)
    service[:, What.MEASUREMENT] += cpu
    same = np.diff(core) == 0
    near = np.diff(host) == 0
    latency = np.empty((processes - 1, 2))
    for column in range(2):
        hop = np.where(
            same,
            random.choice(costs.hop.same_core_us, processes - 1),
            random.choice(costs.hop.other_core_us, processes - 1),
        )
        far = hosts.link_us * (1.0 - JITTER + JITTER * random.exponential(size=processes - 1))
        used = np.where(near, np.minimum(hop, cpu), cpu)
        latency[:, column] = np.where(near, hop - used, far)
        if column == 0:
            service[1:, What.FORWARD] += used
        else:
            service[:-1, What.BACKWARD] += used
    return Durations(
        np.rint(1e3 * service).astype(np.int64), np.rint(1e3 * latency).astype(np.int64)
    )


def tick_times(hosts: Hosts, costs: Costs, processes: int, ticks: int, seed: int) -> dict[str, Any]:
    """Percentiles over simulated ticks, each from rest: ms, and how busy the busiest core is meanwhile."""
    random = np.random.default_rng(seed)
    core = hosts.cores(processes)
    relays = [Relay(i, processes) for i in range(processes)]
    nothing = [np.zeros(0)] * processes
    sweeps: list[float] = []
    busy: list[float] = []
    for _ in range(ticks):
        found = run_tick(relays, core, draw(hosts, costs, processes, random), nothing)
        sweeps.append(1e-6 * found.sweep_ns)
        busy.append(float(found.busy_ns.max()) / found.sweep_ns)
    p50, p99 = np.percentile(sweeps, [50.0, 99.0])
    return {
        "hosts": hosts.name,
        "processes": processes,
        "ticks": ticks,
        "p50_ms": float(p50),
        "p99_ms": float(p99),
        "busiest_core": float(np.mean(busy)),
        "messages": found.messages,
    }


def crossing(counts: Sequence[int], milliseconds: Sequence[float], limit_ms: float) -> float:
    """At how many nodes a time reaches the limit: from the last two counts below and above on a log-log line,
    extrapolated where all are below."""
    x, y = np.log(np.asarray(counts)), np.log(np.asarray(milliseconds) / limit_ms)
    if len(counts) < 2:
        return float("nan")
    above = np.flatnonzero(y > 0.0)
    at = int(np.clip(above[0] if above.size else len(y) - 1, 1, len(y) - 1))
    slope = (y[at] - y[at - 1]) / (x[at] - x[at - 1])
    return float(np.exp(x[at] - y[at] / slope)) if slope > 0.0 else float("inf")
