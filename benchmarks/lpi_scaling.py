"""Time to solution of the LPI engine against degree and number of coupled states, and where the time goes.

The plant is a chain of reaction-diffusion equations, each state coupled to its neighbours,

    x_i_t = x_i_ss + 2 x_i + (x_{i-1} - x_i) + (x_{i+1} - x_i),   x_i(0) = x_i_s(1) = 0,

with a disturbance w at the first state, z = int of all states, and for the observer y = x_1(1) + noise. A
cell is one call of the engine at a fixed degree, in a process of its own that is ended at the time limit; cells
beyond one that ran out of time are left out. Prints a table, writes JSON and a plot:

    nice -n 5 python benchmarks/lpi_scaling.py --json lpi_scaling.json --plot docs/lpi_scaling.png
"""

from __future__ import annotations

import argparse
import json
import math
import multiprocessing
import os
import resource
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

TASKS = ("gain", "observer")
GRACE = 1.2
"""A process is ended when it takes this many time limits."""
PARTS = {
    "assembly": "assembly (rows, forms, equalities)",
    "cvxpy": "CVXPY",
    "solver": "solver (Clarabel)",
    "certificate": "certificate",
    "rest": "rest (conversion, independent check)",
}


@dataclass(frozen=True)
class Cell:
    """One run of the engine. status 'time' and 'skipped' have no numbers; seconds by part, memory in MB."""

    task: str
    states: int
    degree: int
    status: str
    seconds: float = math.nan
    gamma: float | None = None
    achieved: float | None = None
    gram_sizes: tuple[int, ...] = ()
    equalities: int = 0
    iterations: int = 0
    memory_mb: float = math.nan
    parts: dict[str, float] | None = None


def problem(states: int, task: str) -> str:
    """The chain as a problem file."""
    names = [f"x{i}" for i in range(1, states + 1)]
    equations = []
    for i, name in enumerate(names):
        terms = [f"{name}_ss + 2*{name}"]
        terms += [f"{names[j]} - {name}" for j in (i - 1, i + 1) if 0 <= j < states]
        terms += ["w"] if i == 0 else []
        equations.append(f'{name} = "{" + ".join(terms)}"')
    conditions = ", ".join(f'"{name}(0)", "{name}_s(1)"' for name in names)
    observer = task == "observer"
    lines = [
        f'name = "chain of {states}"',
        "[states]",
        *(f"{name} = 2" for name in names),
        "[inputs]",
        'disturbances = ["w", "v"]' if observer else 'disturbances = ["w"]',
        "[equations]",
        *equations,
        "[boundary]",
        f"conditions = [{conditions}]",
        "[outputs]",
        f'regulated = ["int({" + ".join(names)})"]',
        *(['measured = ["x1(1) + v"]'] if observer else []),
    ]
    return "\n".join(lines)


def solve_cell(task: str, states: int, degree: int, limit_s: float) -> Cell:
    """One run of the engine in this process."""
    from design.lpi.engine import solve
    from design.lpi.result import Options
    from design.pde.problem_file import parse_problem

    pde = parse_problem(problem(states, task), f"chain of {states}").pde
    start = time.perf_counter()
    result = solve(pde, task, Options(degree=degree, time_limit_s=limit_s))
    seconds = time.perf_counter() - start
    attempts = result.attempts
    parts = {
        "assembly": sum(a.assembly_s for a in attempts),
        "cvxpy": sum(a.modelling_s for a in attempts),
        "solver": sum(a.solver_s for a in attempts),
        "certificate": sum(a.verification_s for a in attempts),
    }
    last = attempts[-1] if attempts else None
    return Cell(
        task=task,
        states=states,
        degree=degree,
        status=str(result.status),
        seconds=seconds,
        gamma=result.gamma,
        achieved=result.achieved.value if result.achieved else None,
        gram_sizes=last.gram_sizes if last else (),
        equalities=last.equalities if last else 0,
        iterations=sum(a.iterations for a in attempts),
        memory_mb=resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0,
        parts={**parts, "rest": max(seconds - sum(parts.values()), 0.0)},
    )


def _child(pipe: Connection, task: str, states: int, degree: int, limit_s: float) -> None:
    pipe.send(solve_cell(task, states, degree, limit_s))


def run_cell(task: str, states: int, degree: int, limit_s: float) -> Cell:
    """The cell, in a process that is ended at the limit: status 'time', or 'failed' if it died."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(sender, task, states, degree, limit_s))
    process.start()
    sender.close()
    cell = Cell(task, states, degree, "time")
    if receiver.poll(GRACE * limit_s):
        try:
            cell = receiver.recv()
        except EOFError:
            cell = Cell(task, states, degree, "failed")
    process.kill()
    process.join()
    return cell


def measure(
    tasks: Sequence[str], states: Sequence[int], degrees: Sequence[int], limit_s: float
) -> list[Cell]:
    """All cells; those with no fewer states and no lower degree than one that ran out of time are left out."""
    cells: list[Cell] = []
    print(HEADER)
    for task in tasks:
        for count in states:
            for degree in degrees:
                beyond = any(
                    c.status == "time"
                    and (c.task, c.states <= count, c.degree <= degree) == (task, True, True)
                    for c in cells
                )
                cell = Cell(task, count, degree, "skipped")
                cells.append(cell if beyond else run_cell(task, count, degree, limit_s))
                print(line(cells[-1], limit_s), flush=True)
    return cells


HEADER = (
    f"{'task':9}{'states':>6}{'degree':>7}  {'verdict':11}{'gamma':>9}{'achieved':>9}{'seconds':>9}"
    f"{'assembly':>10}{'CVXPY':>7}{'solver':>7}{'cert.':>7}{'rest':>6}  {'MB':>5}  equalities, Gram matrices"
)


def line(cell: Cell, limit_s: float) -> str:
    """A row of the table; shares in per cent of the seconds."""
    head = f"{cell.task:9}{cell.states:>6}{cell.degree:>7}  "
    if cell.parts is None:
        why = {"time": f"more than {limit_s:g} s", "skipped": "skipped: beyond the time limit"}
        return head + why.get(cell.status, cell.status)
    shares = {name: f"{100.0 * part / cell.seconds:.0f}%" for name, part in cell.parts.items()}
    return (
        f"{head}{cell.status:11}{_number(cell.gamma):>9}{_number(cell.achieved):>9}{cell.seconds:>9.1f}"
        f"{shares['assembly']:>10}{shares['cvxpy']:>7}{shares['solver']:>7}{shares['certificate']:>7}"
        f"{shares['rest']:>6}  {cell.memory_mb:>5.0f}  {cell.equalities}, "
        f"{'/'.join(map(str, cell.gram_sizes))}"
    )


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.5f}"


def plot(cells: Sequence[Cell], path: Path, limit_s: float) -> None:
    """Seconds against degree, and shares of the time, for every number of states."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot

    tasks = [t for t in TASKS if any(c.task == t for c in cells)]
    states = sorted({c.states for c in cells})
    figure, axes = pyplot.subplots(
        2, len(tasks), figsize=(5.5 * len(tasks), 7.5), squeeze=False, layout="constrained"
    )
    colours = dict(zip(PARTS, pyplot.colormaps["viridis"](_spread(len(PARTS))), strict=True))
    lines = dict(zip(states, pyplot.colormaps["plasma"](_spread(len(states))), strict=True))
    for task, (above, below) in zip(tasks, axes.T, strict=True):
        done = [c for c in cells if c.task == task and c.parts is not None]
        for count in states:
            mine = [c for c in done if c.states == count]
            label = f"{count} state{'s' if count > 1 else ''}"
            style: dict[str, Any] = {"color": lines[count], "marker": "o", "label": label}
            above.semilogy([c.degree for c in mine], [c.seconds for c in mine], **style)
        above.axhline(limit_s, color="0.6", linestyle=":", label=f"limit, {limit_s:g} s")
        above.set(title=task, xlabel="degree", ylabel="time to solution (s)")
        above.set_xticks(sorted({c.degree for c in cells}))
        above.grid(alpha=0.3)
        above.legend(fontsize=8)
        places = range(len(done))
        bottom = [0.0] * len(done)
        for part, label in PARTS.items():
            shares = [100.0 * (c.parts or {})[part] / c.seconds for c in done]
            below.bar(places, shares, bottom=bottom, color=colours[part], label=label, width=0.85)
            bottom = [b + s for b, s in zip(bottom, shares, strict=True)]
        below.set_xticks(places, [f"{c.states}/{c.degree}" for c in done], rotation=90, fontsize=8)
        below.set(xlabel="states / degree", ylabel="share of the time (%)", ylim=(0.0, 100.0))
    handles, labels = axes[1][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3, fontsize=8)
    figure.savefig(path, dpi=130)
    pyplot.close(figure)


def _spread(count: int) -> list[float]:
    return [0.9 * k / max(count - 1, 1) for k in range(count)]


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--states", nargs="+", type=int, default=[1, 2, 4, 6])
    parser.add_argument("--degrees", nargs="+", type=int, default=[1, 2, 3, 4, 5])
    parser.add_argument("--time-limit", type=float, default=120.0, help="seconds per cell")
    parser.add_argument("--json", type=Path, help="write the cells here")
    parser.add_argument("--plot", type=Path, help="write a plot here (PNG)")
    return parser.parse_args()


def main() -> None:
    """Measure, print, write."""
    options = arguments()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    cells = measure(options.tasks, options.states, options.degrees, options.time_limit)
    if options.json:
        text = json.dumps([asdict(c) for c in cells], indent=1)
        options.json.write_text(text.replace("NaN", "null") + "\n", encoding="utf-8")
    if options.plot:
        plot(cells, options.plot, options.time_limit)


if __name__ == "__main__":
    main()
