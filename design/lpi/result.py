"""What the LPI engine returns: a verdict, its numbers, and the evidence for them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from design.lpi.gains import Gain


class Status(StrEnum):
    """CERTIFIED: proven, to rounding, and confirmed on an independent discretisation. INFEASIBLE: shown to be
    impossible (an eigenvalue grows, no gain can help). UNRELIABLE: neither; the message says why."""

    CERTIFIED = "certified"
    INFEASIBLE = "infeasible"
    UNRELIABLE = "unreliable"


@dataclass(frozen=True)
class Options:
    """What a user can change; None leaves the choice to the engine."""

    degree: int | None = None
    """Polynomial degree of the rows; None: raised until the bound stops improving or time is up."""
    time_limit_s: float = 120.0
    """For the whole answer, verification included."""
    solver: str = "CLARABEL"
    dump: Path | None = None
    """Directory for the semidefinite programs as solved (SDPA sparse format)."""


@dataclass(frozen=True)
class Attempt:
    """One degree: what it gave and what it cost."""

    degree: int
    gram_sizes: tuple[int, ...]
    equalities: int
    iterations: int
    solver: str
    solver_status: str
    residual: float
    """Largest violated coefficient equality, relative to the largest coefficient used."""
    smallest_gram_eigenvalue: float
    """Over all Gram matrices, relative to the largest eigenvalue of them all."""
    margin: float
    """Minus the largest eigenvalue of the inequality's form in the dissipation norm, recomputed from P and Z:
    positive is strict."""
    value: float
    """gamma, norm or 1.0 / NaN for stable / not shown, recomputed from P and Z, never the solver's word."""
    section_change: float
    """Relative change of `value` (or margin) between the last two polynomial sections it was computed on."""
    assembly_s: float
    modelling_s: float
    """Spent in CVXPY."""
    solver_s: float
    verification_s: float

    @property
    def seconds(self) -> float:
        """All of it."""
        return self.assembly_s + self.modelling_s + self.solver_s + self.verification_s


@dataclass(frozen=True)
class Achieved:
    """The same quantity on the Galerkin discretisation, which shares no code with the LPI."""

    value: float
    by_size: tuple[tuple[int, float], ...]
    """(polynomials per state, value), refined."""
    converged: bool
    open_loop: float | None = None
    """Without the gain (observer, controller)."""
    optimum: float | None = None
    """The best any gain could reach (Riccati), where it can be computed."""


@dataclass(frozen=True)
class Result:
    """The answer to one task.

    gamma: certified bound (gain, observer, controller, norm); limit: largest certified parameter value of a
    bisection; formulation: how the LPI was posed, e.g. 'adjoint system' for state feedback.
    """

    task: str
    status: Status
    message: str
    gamma: float | None = None
    limit: float | None = None
    achieved: Achieved | None = None
    formulation: str = ""
    best: Attempt | None = None
    attempts: tuple[Attempt, ...] = field(default=())
    gain: Gain | None = None
    seconds: float = 0.0


Progress = Callable[[str], None]


def silent(_: str) -> None:
    """Progress for those who want none."""
