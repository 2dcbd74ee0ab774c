"""The LPI engine: a PDE and a task in, a verdict with its evidence out.

Every task is one inequality (design.lpi.inequality, h2, norm) of growing degree (design.lpi.search); the answer
is judged by the operators P and Z (design.lpi.verdict) and confirmed on matrices that share no code with them
(design.lpi.achieved).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

from design.lpi.bisection import bisect_stability
from design.lpi.quotient import norm
from design.lpi.result import Options, Progress, Result, silent
from design.lpi.stability import stability
from design.lpi.synthesis import controller, gain, observer
from design.lpi.variance import h2, h2_observer
from design.pde.convert import convert
from design.pde.model import Pde
from design.pde.problem_file import Task, check_task

TASKS: dict[str, Callable[[Pde, Options, Progress], Result]] = {
    "stability": stability,
    "gain": gain,
    "observer": observer,
    "controller": controller,
    "norm": norm,
    "h2": h2,
    "h2-observer": h2_observer,
}


def solve(
    pde: Pde, task: str, options: Options | None = None, progress: Progress = silent
) -> Result:
    """Answer one task: 'stability', 'gain', 'observer', 'controller', 'norm', 'h2' or 'h2-observer'.

    Raises UsageError for ill-posed boundary conditions or signals that the task needs and the PDE lacks,
    ValueError for an unknown task.
    """
    options = options or Options()
    start = time.perf_counter()
    if task not in TASKS:
        raise ValueError(f"task {task!r}: expected one of {', '.join(TASKS)}")
    check_task(pde, Task(task), pde.name or "the problem")
    convert(pde)  # ill-posed conditions are refused before anything else
    result = TASKS[task](pde, options, progress)
    return replace(result, seconds=time.perf_counter() - start)


def stability_limit(
    problem: Callable[[float], Pde],
    low: float,
    high: float,
    options: Options | None = None,
    progress: Progress = silent,
) -> Result:
    """The largest certified stable parameter on the way from the stable end towards the other.

    Raises ValueError if the discretisation is stable, or unstable, at both ends.
    """
    return bisect_stability(stability, problem, low, high, options or Options(), progress)
