"""The engine's own rule: raise the degree until the bound stops improving, keep the best that is certified.

One degree is one `Attempt`: rows, program, solution, certificate. The rule is the same for every problem:
stop when the bound is within CLOSE of the independent value no bound can be below, or when two further degrees
improve it by less than CLOSE together, or when the next degree would not end in time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from design.lpi.inequality import Certificate, Inequality
from design.lpi.norm import NormInequality
from design.lpi.reporter import Reporter
from design.lpi.result import Attempt, Options, Progress, Result, Status
from design.lpi.sdp import GramProgram, Point

CLOSE = 5e-3
"""Relative gap, or improvement, that is not worth a further degree."""
HIGHEST_DEGREE = 7
TRACES = (1e2, 1e3, 1e4)
"""Bounds of the Gram matrices' traces in the program's units, tried in order: small ones solve best."""
RESIDUAL_TOLERANCE = 1e-8
SECTION_TOLERANCE = 1e-3
"""A certificate counts when its value changes by less between the two polynomial sections."""
_GROWTH = 5.0
"""How much longer a degree takes than the one before it, at least."""


@dataclass(frozen=True)
class Certified:
    """The best so far: its numbers and the operators behind them."""

    attempt: Attempt
    certificate: Certificate


@dataclass
class Search:
    """Runs attempts of growing degree within the options; `lower` is a value no true bound is below."""

    task: str
    options: Options
    progress: Progress
    lower: float | None = None
    attempts: list[Attempt] = field(default_factory=list)
    best: Certified | None = None
    started: float = field(default_factory=time.perf_counter)

    def remaining_s(self) -> float:
        """Of the time limit."""
        return self.options.time_limit_s - (time.perf_counter() - self.started)

    def run(self, attempt: Callable[[int], tuple[Attempt, Certificate | None]]) -> None:
        """Attempts from degree 1 (or the one the user chose) until the rule says stop."""
        degrees = range(1, HIGHEST_DEGREE + 1)
        if self.options.degree is not None:
            degrees = range(self.options.degree, self.options.degree + 1)
        without_progress = 0
        for degree in degrees:
            started = time.perf_counter()
            done, certificate = attempt(degree)
            self.attempts.append(done)
            before = self.best
            if certificate is not None and (before is None or done.value < before.attempt.value):
                self.best = Certified(done, certificate)
                self._tell(done)
            self.progress(self._line(done, certificate is not None))
            if self.best is None:  # nothing yet: any time that is left is well spent
                if self.remaining_s() > 0.0:
                    continue
                return
            if self.lower is not None and self.best.attempt.value <= self.lower * (1.0 + CLOSE):
                return
            if before is not None:
                improved = self.best.attempt.value < before.attempt.value * (1.0 - CLOSE)
                without_progress = 0 if improved else without_progress + 1
                if without_progress == 2:
                    return
            if _GROWTH * (time.perf_counter() - started) > self.remaining_s():
                return

    def replace(self, done: Attempt, certificate: Certificate | None) -> None:
        """Take a further attempt for the best whatever its value, if it is certified."""
        self.attempts.append(done)
        if certificate is not None:
            self.best = Certified(done, certificate)
            self.progress(f"moderate gain: {self._line(done, True)}")

    def _tell(self, best: Attempt) -> None:
        """Hand the best so far to those who keep it."""
        if isinstance(self.progress, Reporter):
            self.progress.best(
                Result(
                    task=self.task,
                    status=Status.CERTIFIED,
                    message="stopped before the discretisation could confirm it; proven by the inequality of "
                    "degree "
                    f"{best.degree}",
                    gamma=None if self.task == "stability" else best.value,
                    best=best,
                    attempts=tuple(self.attempts),
                    seconds=time.perf_counter() - self.started,
                )
            )

    def _line(self, attempt: Attempt, certified: bool) -> str:
        value = "nothing"
        if certified:
            value = "stable" if self.task == "stability" else f"{attempt.value:.6g}"
        return (
            f"degree {attempt.degree}: {value}{' certified' if certified else ''}, "
            f"Gram matrices {'/'.join(map(str, attempt.gram_sizes))}, {attempt.seconds:.1f} s"
        )


def solve_ladder(
    program: GramProgram,
    cost: dict[str, float],
    fixed: dict[str, float],
    judge: Callable[[Point], tuple[bool, Certificate]],
    *,
    options: Options,
    positive: tuple[str, ...] = (),
    remaining_s: Callable[[], float],
    dump_name: str,
) -> tuple[Point, Certificate | None, bool, float, float, float]:
    """Solve with growing trace bounds until `judge` accepts; returns (point, certificate, accepted, times).

    The times are those of CVXPY, the solver and the judging, over all tries.
    """
    modelling = solver = verification = 0.0
    point, certificate, accepted = None, None, False
    for trace in TRACES:
        dump = None if options.dump is None else _dump_path(options.dump, dump_name, trace)
        tried = program.solve(
            cost,
            fixed,
            positive=positive,
            trace=trace,
            solver=options.solver,
            time_limit_s=max(remaining_s(), 1.0),
            dump=dump,
        )
        modelling += tried.modelling_s
        solver += tried.solver_s
        if point is None or tried.found:
            point = tried
        if tried.found:
            start = time.perf_counter()
            accepted, certificate = judge(tried)
            verification += time.perf_counter() - start
            if accepted:
                break
        if remaining_s() <= 0.0:
            break
    if point is None:
        raise ValueError("a ladder needs at least one step")
    return point, certificate, accepted, modelling, solver, verification


def _dump_path(directory: Path, name: str, trace: float) -> Path:
    return directory / f"{name}_trace_{trace:.0f}.dat-s"


def make_attempt(
    inequality: Inequality | NormInequality,
    assembly_s: float,
    solved: tuple[Point, Certificate | None, bool, float, float, float],
    solver: str,
    value: Callable[[Certificate], float],
) -> Attempt:
    """The record of one degree."""
    point, certificate, _, modelling, solver_s, verification = solved
    return Attempt(
        degree=inequality.degree,
        gram_sizes=inequality.program.gram_sizes,
        equalities=inequality.program.equalities,
        iterations=point.iterations,
        solver=solver,
        solver_status=point.status,
        residual=point.residual,
        smallest_gram_eigenvalue=point.smallest_eigenvalue,
        margin=certificate.margin if certificate else math.nan,
        value=value(certificate) if certificate else math.nan,
        section_change=certificate.change if certificate else math.nan,
        assembly_s=assembly_s,
        modelling_s=modelling,
        solver_s=solver_s,
        verification_s=verification,
    )
