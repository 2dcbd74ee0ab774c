"""`octarm solve` behind its command line: problem file and choices in, the LPI engine's answer out, as facts.

`prepare` reads and checks everything before any work is done, `answer` calls the engine, `facts` says in plain
data what the tables of `analysis.solve_table` and --json show.
"""

from __future__ import annotations

import math
import os
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from design.lpi.gain_facts import gain_facts
from design.lpi.reporter import Reporter
from design.lpi.result import Attempt, Options, Result
from design.pde.convert import convert
from design.pde.model import Output, Pde, Signal
from design.pde.names import suggestion
from design.pde.problem_file import (
    Bisection,
    Problem,
    Task,
    check_task,
    parse_problem,
    read_problem_file,
)
from wire.errors import UsageError

MAX_DEGREE = 20
"""Three times what the engine tries by itself; a beam takes a gigabyte at half of it."""
_USES: dict[Task, frozenset[str]] = {
    Task.STABILITY: frozenset(),
    Task.GAIN: frozenset({"inputs.disturbances", "outputs.regulated"}),
    Task.OBSERVER: frozenset({"inputs.disturbances", "outputs.regulated", "outputs.measured"}),
    Task.CONTROLLER: frozenset({"inputs.disturbances", "outputs.regulated", "inputs.controls"}),
    Task.NORM: frozenset({"norm"}),
    Task.H2: frozenset({"inputs.disturbances", "outputs.regulated"}),
    Task.H2_OBSERVER: frozenset({"inputs.disturbances", "outputs.regulated", "outputs.measured"}),
}
"""What of a problem a task is about; of two with the same needs the first is what a file without task means."""


@dataclass(frozen=True)
class Choices:
    """What the command line says; None leaves the choice to the file or to the engine."""

    task: str | None = None
    bisect: tuple[str, float, float] | None = None
    parameters: tuple[str, ...] = ()
    """NAME=VALUE each."""
    degree: int | None = None
    time_limit_s: float = 120.0
    solver: str = "CLARABEL"
    dump: Path | None = None


@dataclass(frozen=True)
class Request:
    """One question to the engine, checked; picklable, for a process of its own."""

    problem: Problem
    task: Task
    bisect: Bisection | None
    options: Options


def prepare(path: Path, choices: Choices) -> Request:
    """Read the problem file and decide what is asked; UsageError naming the file or option at fault."""
    options = _options(choices)
    overrides = _overrides(choices.parameters)
    problem = read_problem_file(path, overrides)
    if choices.task is not None:
        task = _known_task(choices.task)
    elif choices.bisect is not None:
        task = Task.STABILITY
    else:
        task = problem.task or _implied_task(problem)
    _check_task(problem, task)
    try:
        convert(problem.pde)  # refuses ill-posed problems before any work
    except UsageError as error:
        what = str(error).removeprefix("the problem: ")
        raise UsageError(f"problem file {problem.source}: {what}") from None
    return Request(problem, task, _bisection(problem, task, choices, overrides), options)


def answer(request: Request, reporter: Reporter | None = None) -> Result:
    """The engine's answer. UsageError for a solver that is not there or a problem that no LPI can state."""
    from design.lpi import engine  # CVXPY takes a second to load: only where it is used
    from design.semidefinite import solvers

    reporter = reporter or Reporter()
    options = request.options
    if options.solver not in solvers():
        raise UsageError(
            f"--solver {options.solver}: expected a semidefinite solver that is installed: "
            f"{', '.join(solvers())}"
        )
    if options.dump is not None:
        try:
            options.dump.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(f"--dump-problem {options.dump}: {error.strerror or error}") from None
    problem, bisect = request.problem, request.bisect
    if bisect is None:
        return engine.solve(problem.pde, request.task, options, reporter)

    def pde(value: float) -> Pde:
        values = {**problem.pde.parameters, bisect.parameter: value}
        return parse_problem(problem.text, problem.source, values).pde

    try:
        return engine.stability_limit(pde, bisect.low, bisect.high, options, reporter)
    except ValueError as error:
        if "no limit between" not in str(error):
            raise
        raise UsageError(
            f"problem file {problem.source}: bisect {bisect.parameter}: {error}; give other ends with --bisect"
        ) from None


# What is printed


def facts(request: Request, result: Result, peak_memory_mb: float | None = None) -> dict[str, Any]:
    """The answer as plain data; numbers may be infinite or NaN (see `finite`)."""
    best = result.best or (result.attempts[-1] if result.attempts else None)
    achieved = result.achieved
    return {
        "problem": _problem_facts(request),
        "task": str(request.task),
        "bisect": request.bisect and asdict(request.bisect),
        "status": str(result.status),
        "message": result.message,
        "gamma": result.gamma,
        "limit": result.limit,
        "achieved": achieved and achieved.value,
        "achieved_by_size": [list(pair) for pair in achieved.by_size] if achieved else [],
        "achieved_converged": achieved and achieved.converged,
        "open_loop": achieved and achieved.open_loop,
        "optimum": achieved and achieved.optimum,
        "formulation": result.formulation,
        "gain": result.gain and gain_facts(result.gain, request.problem.pde),
        "degree": best and best.degree,
        "sdp": {
            "gram_sizes": list(best.gram_sizes) if best else [],
            "equalities": best.equalities if best else 0,
            "iterations": best.iterations if best else 0,
            "solver": best.solver if best else request.options.solver,
            "residual": best and best.residual,
            "smallest_gram_eigenvalue": best and best.smallest_gram_eigenvalue,
            "margin": best and best.margin,
        },
        "attempts": [_attempt_facts(attempt) for attempt in result.attempts],
        "seconds": result.seconds,
        "seconds_by_part": {
            part: sum(getattr(attempt, f"{part}_s") for attempt in result.attempts)
            for part in ("assembly", "modelling", "solver", "verification")
        },
        "peak_memory_mb": peak_memory_mb,
    }


def _attempt_facts(attempt: Attempt) -> dict[str, Any]:
    return asdict(attempt) | {"gram_sizes": list(attempt.gram_sizes), "seconds": attempt.seconds}


def _problem_facts(request: Request) -> dict[str, Any]:
    pde = request.problem.pde

    def signals(group: tuple[Signal, ...]) -> list[str]:
        return [f"{s.name}(s)" if s.distributed else s.name for s in group]

    def outputs(group: tuple[Output, ...]) -> list[str]:
        return [output.expression.text for output in group]

    return {
        "name": pde.name,
        "file": request.problem.source,
        "domain": list(pde.domain),
        "parameters": dict(pde.parameters),
        "states": {s.name: "ode" if s.order is None else s.order for s in pde.states},
        "disturbances": signals(pde.disturbances),
        "controls": signals(pde.controls),
        "regulated": outputs(pde.regulated),
        "measured": outputs(pde.measured),
        "norm_of": outputs(pde.numerator),
        "norm_by": outputs(pde.denominator),
    }


# What is asked


def _options(choices: Choices) -> Options:
    limit, degree = choices.time_limit_s, choices.degree
    if not 0.0 < limit < math.inf:
        raise UsageError(f"--time-limit: expected a positive number of seconds, got {limit!r}")
    if degree is not None and not 0 <= degree <= MAX_DEGREE:
        raise UsageError(f"--degree: expected a whole number from 0 to {MAX_DEGREE}, got {degree}")
    if choices.dump is not None:
        _check_dump(choices.dump)
    return Options(degree, limit, choices.solver, choices.dump)


def _check_dump(directory: Path) -> None:
    """UsageError, before minutes of work, unless an empty directory is or can be made there."""
    where = f"--dump-problem {directory}"
    try:
        occupied = next(directory.iterdir(), None) if directory.exists() else None
    except OSError as error:
        raise UsageError(f"{where}: {error.strerror or error}; give a directory") from None
    if occupied is not None:
        raise UsageError(
            f"{where}: there is something in it already ({occupied.name}); nothing is written over, give "
            "another directory"
        )
    existing = directory
    while not existing.exists() and existing != existing.parent:
        existing = existing.parent
    if not existing.is_dir() or not os.access(existing, os.W_OK | os.X_OK):
        raise UsageError(f"{where}: {existing} is no directory that can be written to")


def _overrides(settings: tuple[str, ...]) -> dict[str, float]:
    out: dict[str, float] = {}
    for setting in settings:
        name, equals, text = (part.strip() for part in setting.partition("="))
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (name and equals and math.isfinite(value)):
            raise UsageError(
                f"--set {setting}: expected NAME=VALUE with a finite number, as in lam=4.5"
            )
        if name in out:
            raise UsageError(f"--set {setting}: {name} is set twice; leave one")
        out[name] = value
    return out


def _known_task(name: str) -> Task:
    try:
        return Task(name)
    except ValueError:
        known = [task.value for task in Task]
        raise UsageError(
            f"--task: expected one of {', '.join(known)}; got {name!r}{suggestion(name, known)}"
        ) from None


def _given(problem: Problem) -> frozenset[str]:
    """What the problem gives that a task may be about."""
    pde = problem.pde
    groups = {
        "inputs.disturbances": pde.disturbances,
        "inputs.controls": pde.controls,
        "outputs.regulated": pde.regulated,
        "outputs.measured": pde.measured,
        "norm": pde.numerator,
    }
    return frozenset(key for key, group in groups.items() if group)


def _has_equations(problem: Problem) -> bool:
    return "equations" in tomllib.loads(problem.text)


def _implied_task(problem: Problem) -> Task:
    """The task that is about all that the problem gives; UsageError with the choices if there is none."""
    if problem.bisect is not None:
        return Task.STABILITY
    given = _given(problem)
    for task, uses in _USES.items():
        if uses == given and (task is not Task.NORM or not _has_equations(problem)):
            return task
    possible = [
        task.value
        for task, uses in _USES.items()
        if uses <= given and (task is Task.NORM or _has_equations(problem))
    ]
    raise UsageError(
        f"problem file {problem.source}: it does not say which task is meant, and gives "
        f"{', '.join(sorted(given))}; choose with --task or the key task: {', '.join(possible)}"
    )


def _check_task(problem: Problem, task: Task) -> None:
    where = f"problem file {problem.source}: --task"
    check_task(problem.pde, task, where)
    if task is not Task.NORM and not _has_equations(problem):
        raise UsageError(
            f"{where}: {task.value!r} needs equations, which the problem does not give"
        )


def _bisection(
    problem: Problem, task: Task, choices: Choices, overrides: Mapping[str, float]
) -> Bisection | None:
    """The command line's, else the file's unless its parameter was set by hand; for stability only."""
    if choices.bisect is None:
        own = problem.bisect if task is Task.STABILITY else None
        return None if own is None or own.parameter in overrides else own
    name, low, high = choices.bisect
    known = problem.pde.parameters
    if task is not Task.STABILITY:
        raise UsageError(
            f"--bisect {name}: looks for the limit of stability, but --task is {task.value!r}; "
            "leave one of them"
        )
    if name not in known:
        raise UsageError(
            f"--bisect {name}: the problem file {problem.source} has no parameter {name!r}"
            f"{suggestion(name, known)} (declared: {', '.join(known) or 'none'})"
        )
    if name in overrides:
        raise UsageError(f"--bisect {name}: --set gives {name} a value as well; leave one of them")
    if not (math.isfinite(low) and math.isfinite(high) and low < high):
        raise UsageError(f"--bisect {name}: expected finite LOW < HIGH, got {low:g} and {high:g}")
    return Bisection(name, low, high)
