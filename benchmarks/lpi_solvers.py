"""The engine's semidefinite programs by several solvers and in several forms.

Programs: reference problems at degrees 2 and 3, as the engine states them, traces bounded by 100. Forms:

- dual: a linear matrix inequality with one variable per equality, the Gram matrices come back as dual values.
  Through CVXPY that is what ships; `direct` hands the same numbers to the solver's own interface.
- primal: Gram matrices as variables under equalities.

Each run has a process of its own. gamma is what the solver's point says, certified what P and Z made from that
point prove (an operator composition, design.lpi.inequality). Solvers that are not installed are named and left
out; none but Clarabel and SCS comes with the project:

    nice -n 5 python benchmarks/lpi_solvers.py --json lpi_solvers.json
"""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import importlib.util
import json
import math
import multiprocessing
import os
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
PROBLEMS = Path(__file__).parents[1] / "examples" / "problems"
TRUE = {"g24": 8.2141230, "n1": 0.636866, "nc1b": 1.273241, "g29": 6.1307749, "n6": 0.390951}
"""Independent values (theory, section 7): no certified gamma is below."""
FIXED = {"delta": 1e-3, "epsilon": 1e-5}
TRACE = 100.0
SHIPPED = {"reduced_tol_gap_abs": 1e-1, "reduced_tol_gap_rel": 1e-1}
"""Clarabel: its last point is returned within these tolerances also where it ends early."""
SETTINGS: dict[str, dict[str, Any]] = {
    "defaults": {},
    "qdldl": {"direct_solve_method": "qdldl"},
    "faer, 1 thread": {"direct_solve_method": "faer", "max_threads": 1},
    "no equilibration": {"equilibrate_enable": False},
    "regularisation 1e-6": {"static_regularization_constant": 1e-6},
    "regularisation 1e-10": {"static_regularization_constant": 1e-10},
    "regularisation 1e-12": {"static_regularization_constant": 1e-12},
    "no static regularisation": {"static_regularization_enable": False},
    "refinement to 1e-15": {
        "iterative_refinement_reltol": 1e-15,
        "iterative_refinement_abstol": 1e-15,
        "iterative_refinement_max_iter": 50,
    },
    "shorter steps, 0.9": {"max_step_fraction": 0.9},
}


@dataclass(frozen=True)
class Run:
    """One program by one way. gammas in the problem's units; NaN where there is no point."""

    problem: str
    degree: int
    way: str
    status: str
    gamma: float = math.nan
    certified: float = math.nan
    smallest_eigenvalue: float = math.nan
    """Over all Gram matrices, relative to the largest of all."""
    iterations: int = 0
    seconds: float = math.nan
    """The call as a whole, with what CVXPY takes."""
    equalities: int = 0
    gram_sizes: tuple[int, ...] = ()


class Case:
    """One semidefinite program of the engine, with its way back to P and Z."""

    def __init__(self, name: str, degree: int) -> None:
        from design.lpi.inequality import Inequality, dissipated_ends
        from design.lpi.rows import structure
        from design.lpi.scaling import scaled
        from design.pde.adjoint import dual_system
        from design.pde.convert import convert
        from design.pde.problem_file import Task, read_problem_file

        (path,) = PROBLEMS.glob(f"{name}_*.toml")
        problem = read_problem_file(path)
        measured = problem.task is not Task.GAIN
        pde = dual_system(problem.pde) if problem.task is Task.CONTROLLER else problem.pde
        scale = scaled(convert(pde))
        shape = structure(scale.pie)
        ends = dissipated_ends(scale.pie, shape, measured)
        self.inequality = Inequality(scale.pie, shape, degree, measured=measured, ends=ends)
        self.unit = scale.gamma
        self.program = self.inequality.program

    def rows(self) -> Array:
        """The equalities as the solver sees them: columns constant, numbers, free, upper triangles."""
        program = self.program
        head = 1 + len(program.layout.numbers) + program.layout.free
        parts = [program.column(k)[:, None] for k in range(head)]
        for block in program.blocks():
            i, j = np.triu_indices(block.shape[1])
            parts.append(np.where(i == j, 1.0, 2.0) * block[:, i, j])
        return np.concatenate(parts, axis=1)

    def judge(self, run: Run, grams: Sequence[Array]) -> Run:
        """Complete a run from reduced Gram matrices: the nearest point on the equalities, P, Z, gamma."""
        rows, layout = self.rows(), self.program.layout
        head = 1 + len(layout.numbers) + layout.free
        corners = [np.triu_indices(len(g)) for g in grams]
        x = np.concatenate([np.zeros(head), *(g[c] for g, c in zip(grams, corners, strict=True))])
        x[0] = 1.0
        for name, value in FIXED.items():
            x[1 + layout.numbers.index(name)] = value
        held = [0, *(1 + layout.numbers.index(name) for name in FIXED)]
        moving = np.setdiff1d(np.arange(head), held)
        x[moving] = np.linalg.lstsq(rows[:, moving], -rows @ x, rcond=None)[0]
        moving = np.setdiff1d(np.arange(x.size), held)
        off = [np.where(i == j, 1.0, math.sqrt(0.5)) for i, j in corners]
        weight = np.concatenate([np.ones(head), *off])[moving]
        for _ in range(2):
            step = np.linalg.lstsq(rows[:, moving] * weight, -rows @ x, rcond=1e-12)[0]
            x[moving] += weight * step
        full: dict[str, Array] = {}
        values: list[Array] = [np.zeros(1)]
        start = head
        for (name, size), (i, j) in zip(layout.grams, corners, strict=True):
            kept = self.program.kept[name]
            gram = np.zeros((len(kept), len(kept)))
            gram[i, j] = gram[j, i] = x[start : start + i.size]
            start += i.size
            values.append(np.asarray(np.linalg.eigvalsh(gram)))
            full[name] = np.zeros((size, size))
            full[name][np.ix_(kept, kept)] = gram
        numbers = dict(zip(layout.numbers, map(float, x[1:]), strict=False))
        return self.certify(run, numbers, x[1 + len(numbers) : head], full, np.concatenate(values))

    def certify(
        self,
        run: Run,
        numbers: dict[str, float],
        free: Array,
        grams: dict[str, Array],
        eigenvalues: Array,
    ) -> Run:
        """Complete a run from a point on the equalities."""
        from design.lpi.sdp import Point

        point = Point(run.status, numbers, free, grams, 0.0, 0.0, 0, 0.0, 0.0)
        found = self.inequality.certificate(*self.inequality.operators(point))
        good = found.coercivity > 0.0 and found.margin > 0.0
        return replace(
            run,
            gamma=numbers["gamma"] * self.unit,
            certified=found.gamma * self.unit if good else math.nan,
            smallest_eigenvalue=float(eigenvalues.min() / max(eigenvalues.max(), 1e-300)),
        )


def through_cvxpy(case: Case, run: Run, limit_s: float, solver: str) -> Run:
    """The dual form, as shipped."""
    start = time.perf_counter()
    point = case.program.solve(
        {"gamma": 1.0}, FIXED, trace=TRACE, solver=solver, time_limit_s=limit_s
    )
    seconds = time.perf_counter() - start
    run = replace(run, status=point.status, seconds=seconds, iterations=point.iterations)
    if not point.found:
        return run
    values = np.concatenate([np.linalg.eigvalsh(g) for g in point.grams.values()])
    return case.certify(run, point.numbers, point.free, point.grams, values)


def primal_form(case: Case, run: Run, limit_s: float, solver: str) -> Run:
    """Gram matrices as the variables, through CVXPY; traces are not bounded."""
    import cvxpy as cp

    from design.semidefinite import ACCEPTED, TIME_LIMITS, orthonormal_equalities

    layout, present = case.program.layout, case.program.gram_sizes
    numbers = {name: cp.Variable() for name in layout.numbers}
    grams = [cp.Variable((k, k), symmetric=True) if k else None for k in present]
    columns = [cp.hstack(list(numbers.values())), cp.Variable(layout.free)]
    for gram, k in zip(grams, present, strict=True):
        if gram is not None:
            i, j = np.triu_indices(k)
            columns.append(cp.vec(gram, order="F")[i + j * k])
    rows = orthonormal_equalities(case.rows())
    constraints = [rows[:, 0] + rows[:, 1:] @ cp.hstack(columns) == 0]
    constraints += [gram >> 0 for gram in grams if gram is not None]
    constraints += [numbers[name] == value for name, value in FIXED.items()]
    program = cp.Problem(cp.Minimize(numbers["gamma"]), constraints)
    start = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # 'may be inaccurate': the status says so
            program.solve(solver=solver, **{TIME_LIMITS[solver]: limit_s})
        status = str(program.status)
    except cp.error.SolverError:
        status = "solver_error"
    run = replace(run, status=status, seconds=time.perf_counter() - start)
    if status not in ACCEPTED:
        return run
    run = replace(run, iterations=int(program.solver_stats.num_iters or 0))
    return case.judge(run, [np.zeros((0, 0)) if g is None else np.asarray(g.value) for g in grams])


def clarabel_direct(case: Case, run: Run, limit_s: float, settings: dict[str, Any]) -> Run:
    """The dual form by Clarabel's own interface."""
    import clarabel
    from scipy import sparse

    cost, blocks, signs = _standard_form(case)
    start = time.perf_counter()
    triangles = [_triangle(np.asarray(b)) for b in blocks]
    A = np.concatenate([*(t[1:].T for t in triangles), signs[1:].T])
    b = np.concatenate([*(t[0] for t in triangles), signs[0]])
    cones = [clarabel.PSDTriangleConeT(block.shape[1]) for block in blocks]
    options = clarabel.DefaultSettings()
    options.verbose = False
    options.time_limit = limit_s
    for name, value in (SHIPPED | settings).items():
        setattr(options, name, value)
    n = cost.size
    solution = clarabel.DefaultSolver(
        sparse.csc_matrix((n, n)),
        cost,
        sparse.csc_matrix(-A),
        -b,
        [*cones, clarabel.NonnegativeConeT(signs.shape[1])],
        options,
    ).solve()
    seconds = time.perf_counter() - start
    run = replace(run, status=str(solution.status), seconds=seconds, iterations=solution.iterations)
    z = np.array(solution.z)
    if not np.all(np.isfinite(z)) or "Infeasible" in run.status:
        return run
    found = []
    for block, triangle in zip(blocks, triangles, strict=True):
        found.append(_matrix(z[: triangle.shape[1]], block.shape[1]))
        z = z[triangle.shape[1] :]
    sizes = iter(found)
    return case.judge(
        run, [next(sizes) if k else np.zeros((0, 0)) for k in case.program.gram_sizes]
    )


def _standard_form(case: Case) -> tuple[Array, list[Array], Array]:
    """Costs c, blocks F (1 + n, k, k) and signs (1 + n, k): min c.m, sum m_k F_k >= F_0. From the SDPA file."""
    with tempfile.TemporaryDirectory() as folder:
        dump = Path(folder) / "program.dat-s"
        case.program.solve({"gamma": 1.0}, FIXED, trace=TRACE, time_limit_s=0.01, dump=dump)
        lines = dump.read_text(encoding="ascii").splitlines()
    count, sizes = int(lines[0]), [int(k) for k in lines[2].split()]
    cost = np.array(lines[3].split(), dtype=np.float64)
    entries = np.array([row.split() for row in lines[4:]], dtype=np.float64)
    k, block, i, j = (entries[:, :4].astype(int) - [0, 1, 1, 1]).T
    blocks = []
    for number, size in enumerate(sizes):
        mine = block == number
        values = np.zeros((count + 1, abs(size), abs(size)))
        values[k[mine], i[mine], j[mine]] = values[k[mine], j[mine], i[mine]] = entries[mine, 4]
        blocks.append(values)
    return cost, blocks[:-1], np.einsum("kii->ki", blocks[-1])


def _triangle(matrices: Array) -> Array:
    """Upper triangles column by column, off-diagonals times sqrt(2): Clarabel's order."""
    j, i = np.tril_indices(matrices.shape[-1])
    return np.asarray(np.where(i == j, 1.0, math.sqrt(2.0)) * matrices[:, i, j])


def _matrix(triangle: Array, size: int) -> Array:
    j, i = np.tril_indices(size)
    out = np.zeros((size, size))
    out[i, j] = out[j, i] = np.where(i == j, 1.0, math.sqrt(0.5)) * triangle
    return out


Way = Callable[[Case, Run, float], Run]


def ways() -> dict[str, tuple[str, Way]]:
    """Name -> (module that must be installed, way)."""
    sdpa = "SDPA"
    if importlib.util.find_spec("sdpap") is not None:
        backend = importlib.import_module("sdpap.sdpacall.sdpacall").get_backend_info()
        sdpa += " (multiprecision)" if backend["gmp"] else " (double)"
    return {
        "Clarabel, CVXPY": ("clarabel", partial(through_cvxpy, solver="CLARABEL")),
        "Clarabel, direct": ("clarabel", partial(clarabel_direct, settings={})),
        "Clarabel, primal": ("clarabel", partial(primal_form, solver="CLARABEL")),
        "SCS, CVXPY": ("scs", partial(through_cvxpy, solver="SCS")),
        "CVXOPT, CVXPY": ("cvxopt", partial(through_cvxpy, solver="CVXOPT")),
        f"{sdpa}, CVXPY": ("sdpap", partial(through_cvxpy, solver="SDPA")),
        **{
            f"direct, {name}": ("clarabel", partial(clarabel_direct, settings=settings))
            for name, settings in SETTINGS.items()
        },
    }


def _child(pipe: Connection, run: Run, limit_s: float) -> None:
    case = Case(run.problem, run.degree)
    program = case.program
    run = replace(run, equalities=program.equalities, gram_sizes=program.gram_sizes)
    pipe.send(ways()[run.way][1](case, run, limit_s))


def perform(run: Run, limit_s: float) -> Run:
    """The run in a process of its own that is ended after the limit and a little."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(sender, run, limit_s))
    process.start()
    sender.close()
    done = replace(run, status=f"more than {limit_s:g} s")
    if receiver.poll(1.1 * limit_s + 20.0):
        try:
            done = receiver.recv()
        except EOFError:
            done = replace(run, status="failed")
    process.kill()
    process.join()
    return done


HEADER = (
    f"{'problem':8}{'degree':>6}  {'way':32}{'status':20}{'gamma':>10}{'certified':>11}{'over true':>11}"
    f"{'eigenvalue':>12}{'iterations':>11}{'seconds':>9}"
)


def line(run: Run) -> str:
    """A row of the table."""
    excess = run.certified / TRUE[run.problem] - 1.0
    return (
        f"{run.problem:8}{run.degree:>6}  {run.way:32}{run.status:20}{run.gamma:>10.6f}{run.certified:>11.6f}"
        f"{excess:>11.1e}{run.smallest_eigenvalue:>12.0e}{run.iterations:>11}{run.seconds:>9.2f}"
    )


def arguments() -> argparse.Namespace:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--problems", nargs="+", choices=list(TRUE), default=list(TRUE))
    parser.add_argument("--degrees", nargs="+", type=int, default=[2, 3])
    parser.add_argument("--ways", nargs="+", choices=list(ways()), default=list(ways()))
    parser.add_argument("--time-limit", type=float, default=120.0, help="seconds per run")
    parser.add_argument("--json", type=Path, help="write the runs here")
    return parser.parse_args()


def main() -> None:
    """Run, print, write."""
    options = arguments()
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    known = ways()
    missing = [w for w in options.ways if importlib.util.find_spec(known[w][0]) is None]
    for way in missing:
        print(f"{way}: the package {known[way][0]} is not installed, left out")
    for package in ("clarabel", "cvxpy", "scs", "cvxopt", "sdpa-python", "sdpa-multiprecision"):
        try:
            print(package, importlib.metadata.version(package))
        except importlib.metadata.PackageNotFoundError:
            print(package, "not installed")
    print(HEADER)
    runs = []
    for problem in options.problems:
        for degree in options.degrees:
            for way in options.ways:
                if way not in missing:
                    runs.append(perform(Run(problem, degree, way, ""), options.time_limit))
                    print(line(runs[-1]), flush=True)
    if options.json:
        text = json.dumps([asdict(r) for r in runs], indent=1)
        options.json.write_text(text.replace("NaN", "null") + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
