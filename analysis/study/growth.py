"""How deployment, memory, messages and the time of a tick grow with the number of segments, up to 10,000.

From one gains artefact: every n is deployed (`deploy.structured`; `deploy` itself for comparison, as far as it
goes), its nodes run in one process under simulated links (`analysis.study.growth_case`), whose hops are
measured first. The verb `octarm study growth` shows it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from analysis.study.growth_case import SEGMENTS, case, dense_case
from analysis.study.hop import Hop, hop_of_file, measure_hop
from analysis.study.tick_cases import CORES, JITTER, Hosts, crossing
from analysis.study.workers import call_all
from wire.artefact import GainsArtefact, digest
from wire.errors import UsageError

NODES = (10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10000)
MOST_NODES = 20_000
"""Factors and objects of so many need 5 GB."""
MOST_DENSE = 200
"""`deploy` on 500 nodes takes minutes, nearly all of it for the eigenvalues of its check."""
TICK_S = 0.1
HOSTS = (
    Hosts(f"one host, {CORES} cores", 1),
    Hosts("a core each", 0),
    Hosts("10 hosts, 100 us", 10, 100.0),
    Hosts("10 hosts, 500 us", 10, 500.0),
)
"""Latencies between hosts are assumed."""


def run(
    artefact: GainsArtefact,
    progress: Callable[[str], None],
    *,
    nodes: Sequence[int] = NODES,
    tick_s: float = TICK_S,
    latency: Path | None = None,
    jobs: int | None = None,
) -> dict[str, Any]:
    """Facts of the study, ready for JSON.

    latency: file with samples of a hop (`analysis.study.hop.hop_of_file`), default a measurement of a second.
    jobs: processes, default one a processor. Raises UsageError for a number of nodes out of range.
    """
    counts = sorted(set(nodes))
    if not counts or counts[0] < 2 or counts[-1] > MOST_NODES:
        raise UsageError(
            f"nodes: expected numbers from 2 to {MOST_NODES}, got {counts or 'none'}; beyond, the nodes do "
            "not fit into the memory of one process"
        )
    progress("a hop between two processes")
    hop = measure_hop() if latency is None else hop_of_file(latency)
    large = [("case", artefact, n, tick_s, hop, HOSTS) for n in counts[::-1]]
    dense = [("dense", artefact, n, tick_s) for n in counts[::-1] if n <= MOST_DENSE]
    work: list[tuple[Any, ...]] = [*large, *dense]
    found = call_all(
        _job,
        work,
        jobs,
        lambda done: progress(f"{done} of {len(work)} deployments"),
        fresh=True,
    )
    rows = found[: len(large)][::-1]
    return {
        "gains_sha256": digest(artefact),
        "setpoints": [one.name for one in artefact.setpoints],
        "tick_s": tick_s,
        "hop": _hop_facts(hop),
        "cores_per_host": CORES,
        "link_jitter": JITTER,
        "rows": rows,
        "dense": found[len(large) :][::-1],
        "on_paper": [_on_paper(row, hop) for row in rows],
        "fits": _fits(rows, 1e3 * tick_s),
    }


def _job(kind: str, *arguments: Any) -> dict[str, Any]:
    return case(*arguments) if kind == "case" else dense_case(*arguments)


def _hop_facts(hop: Hop) -> dict[str, Any]:
    def facts(samples: Any) -> dict[str, float]:
        p50, p99 = np.percentile(samples, [50.0, 99.0])
        return {"p50_us": float(p50), "mean_us": float(np.mean(samples)), "p99_us": float(p99)}

    return {
        "source": hop.source,
        "samples": len(hop.same_core_us),
        "same_core": facts(hop.same_core_us),
        "other_core": facts(hop.other_core_us),
        "cpu_us": hop.cpu_us,
    }


def _on_paper(row: dict[str, Any], hop: Hop) -> dict[str, float]:
    """Times from medians, ms: one segment a process, `CORES` cores where the cores are what limits."""
    n, cpu = row["nodes"], hop.cpu_us
    _, forward, backward = next(c["handling_us"] for c in row["cases"])
    step = float(np.median(hop.other_core_us)) + max(forward, backward)
    return {
        "nodes": n,
        "chain_messages": 2 * (n - 1),
        "chain_ms": 1e-3 * (n - 1) * step,
        "tree_messages": 2 * (n - 1),
        "tree_ms": 1e-3 * 2 * math.ceil(math.log2(n)) * step,
        "star_messages": 2 * n,
        "star_ms": 1e-3 * n * (cpu + forward + backward),
        "all_to_all_messages": n * (n - 1),
        "all_to_all_ms": 1e-3 * n * (n - 1) * cpu / CORES,
    }


def _fits(rows: Sequence[dict[str, Any]], limit_ms: float) -> list[dict[str, Any]]:
    """Per case, the number of nodes at which the 99th percentile of the sweep reaches the tick."""
    out = []
    for segments in SEGMENTS:
        for hosts in HOSTS:
            points = [
                (row["nodes"], one["p99_ms"])
                for row in rows
                for one in row["cases"]
                if (one["segments"], one["hosts"]) == (segments, hosts.name)
            ]
            if len(points) > 1:
                at = crossing([n for n, _ in points], [ms for _, ms in points], limit_ms)
                out.append(
                    {
                        "segments": segments,
                        "hosts": hosts.name,
                        "nodes": at,
                        "extrapolated": at > points[-1][0] or at < points[0][0],
                    }
                )
    return out


def table(facts: dict[str, Any]) -> str:
    """Deployment and messages, simulated ticks, formulas, limits."""
    hop, rows = facts["hop"], facts["rows"]
    dense = {one["nodes"]: one for one in facts["dense"]}
    same, other = hop["same_core"], hop["other_core"]
    lines = [
        f"setpoints {', '.join(facts['setpoints'])}, tick {facts['tick_s']:g} s, gains SHA-256 "
        f"{facts['gains_sha256'][:16]}",
        f"a hop ({hop['source']}, {hop['samples']} samples), p50 / mean / p99 in us: on one core "
        f"{_three(same)}, between cores {_three(other)};",
        f"processor time of a message {hop['cpu_us']:.1f} us",
        "deployment: processor time, and how much memory grew at most; difference from a direct solve",
        "",
        f"{'':>6}  {'deploy, structured':^26}  {'dense':^14}  {'numbers':^9}  {'bytes a message':^15}  "
        f"{'KiB a node':^15}",
        f"{'n':>6}  {'s':>7} {'MiB':>7} {'difference':>10}  {'s':>7} {'MiB':>6}  {'c':>4} {'d':>4}  "
        f"{'mean':>8} {'most':>6}  {'factors':>7} {'objects':>7}",
    ]
    lines.append("─" * len(lines[-1]))
    for row in rows:
        old = dense.get(row["nodes"])
        lines.append(
            f"{row['nodes']:>6}  {row['deploy_cpu_seconds']:>7.2f} {row['deploy_peak_mib']:>7.0f} "
            f"{row['difference']:>10.1e}  "
            + (
                f"{old['cpu_seconds']:>7.2f} {old['peak_mib']:>6.0f}"
                if old
                else f"{'-':>7} {'-':>6}"
            )
            + f"  {row['forward_numbers']:>4} {row['backward_numbers']:>4}  "
            f"{row['message_bytes_mean']:>8.1f} {row['message_bytes_max']:>6}  "
            f"{row['factor_bytes'] / 1024.0:>7.1f} {row['object_bytes'] / 1024.0:>7.1f}"
        )
    lines += ["", "sweep, simulated, p50 / p99 in ms; the nodes' states are the sums bit for bit"]
    names = [one.name for one in HOSTS]
    lines.append(f"{'n':>6} {'segments':>9}" + "".join(f"{name:>21}" for name in names))
    lines.append("─" * len(lines[-1]))
    for segments in SEGMENTS:
        for row in rows:
            of = {c["hosts"]: c for c in row["cases"] if c["segments"] == segments}
            if of:
                lines.append(
                    f"{row['nodes']:>6} {segments:>9}"
                    + "".join(f"{_pair(of[name]):>21}" for name in names)
                )
    lines += [
        "",
        f"on paper, from medians, one segment a process, {facts['cores_per_host']} cores where these limit",
        f"{'':>6} {'messages a tick':^24} {'ms':^44}",
        f"{'n':>6} {'chain':>11} {'all-to-all':>12} {'chain':>11} {'tree':>10} {'star':>10} {'all-to-all':>10}",
    ]
    lines.append("─" * len(lines[-1]))
    lines += [
        f"{one['nodes']:>6} {one['chain_messages']:>11} {one['all_to_all_messages']:>12} "
        + " ".join(
            f"{one[key]:>10.3g}" for key in ("chain_ms", "tree_ms", "star_ms", "all_to_all_ms")
        )
        for one in facts["on_paper"]
    ]
    lines += [
        "",
        f"the sweep's p99 reaches the tick of {facts['tick_s']:g} s at about so many segments:",
    ]
    lines += [
        f"{one['segments']:>4} a process, {one['hosts']:<18} {one['nodes']:>8.0f}"
        + ("  (extrapolated)" if one["extrapolated"] else "")
        for one in facts["fits"]
    ]
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _three(one: dict[str, float]) -> str:
    return f"{one['p50_us']:.1f} / {one['mean_us']:.1f} / {one['p99_us']:.0f}"


def _pair(one: dict[str, Any]) -> str:
    return f"{one['p50_ms']:.3g} / {one['p99_ms']:.3g}"


def plot(facts: dict[str, Any], path: Path) -> None:
    """Four log-log panels over n: deployment, peak memory, sweeps, bytes of a message and of a node."""
    from analysis.study.growth_plot import draw_growth

    draw_growth(facts, path)
