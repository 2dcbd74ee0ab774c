"""What R_1 = R_2 costs the arm: the LPI of octarm's design with P = q I + h W h*, without the virtual work S.

The kernels of h W h* are the same on both sides of the diagonal, those of S are not: with kappa = 0 the exact
formula of section 4 would apply.
"""

from __future__ import annotations

import cvxpy as cp
import numpy as np

from chapter.lpi_gains import chapter_pie
from design.gain_problem import observer_problem
from design.moment_lpi import MARGIN, MomentProgram
from design.moments import make_moments

NOISE = 0.1
COUNT = 2
DELTA = 0.05
"""P >= DELTA I, as in the design's first solve."""


class NotStrict(MomentProgram):
    """The program with <= 0 in place of <= -MARGIN |x|^2, which only kappa > 0 can give on strains."""

    def _rest(self, q: cp.Expression, parity: float) -> cp.Expression:
        return super()._rest(q, parity) - MARGIN

    def _matrices(self) -> list[cp.Expression]:
        form, *others = super()._matrices()
        moments = len(self.moments.state)
        before = len(self.moments.C1) + len(self.moments.B)
        back = np.zeros(form.shape[0])
        back[before : before + moments] = MARGIN
        return [form + np.diag(back), *others]


def least_gammas(name: str) -> tuple[float, float]:
    """(with kappa, without) at a setpoint, not strict. NaN if the solver finds none."""
    moments = make_moments(observer_problem(chapter_pie(name), NOISE), COUNT)
    program = NotStrict(observer_problem(chapter_pie(name), NOISE), moments)
    out = []
    for fixed in ({"delta": DELTA}, {"delta": DELTA, "positive": 0.0, "negative": 0.0}):
        solution = program.solve(program.gamma, fixed, "CLARABEL", 120.0)
        value = program.gamma.value
        out.append(float("nan") if solution.status != "optimal" else float(value))
    return out[0], out[1]
