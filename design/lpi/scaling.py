"""Signals of norm one: the program's Gram matrices are then of order one, whatever the user's units."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from design.operators import PIOperator
from design.pde.convert import Pie

SECTION = 5
"""Degrees of f that the size of an output is measured on."""


@dataclass(frozen=True)
class Scaled:
    """A PIE with B1, D21 divided by one number and C1 by another; true gamma = gamma of `pie` times `gamma`."""

    pie: Pie
    gamma: float


def scaled(pie: Pie) -> Scaled:
    """Divide disturbances by |B1| (Hilbert-Schmidt) and regulated outputs by |C1| on x; y and its gain stay."""
    w = size(pie.B1) or size(pie.D21) or 1.0
    z = size_on_state(pie.C1, pie.T) or 1.0
    return Scaled(
        pie=replace(
            pie,
            B1=pie.B1 * (1.0 / w),
            D21=pie.D21 * (1.0 / w),
            C1=pie.C1 * (1.0 / z),
            D11=pie.D11 * (1.0 / (w * z)),
        ),
        gamma=w * z,
    )


def size_on_state(operator: PIOperator, T: PIOperator) -> float:
    """Largest |operator f| / |T f| over polynomials f of low degree: a size also where it is unbounded on x."""
    state = T.discretise(SECTION, SECTION + 12)
    value = operator.discretise(SECTION, SECTION + 12)
    if not value.size:
        return 0.0
    scale = np.sqrt(np.sum(state**2, axis=0).clip(1e-300))
    _, values, right = np.linalg.svd(state / scale, full_matrices=False)
    seen = values > 1e-9 * values[0]
    return float(np.linalg.norm((value / scale) @ right[seen].T / values[seen], 2))


def size(operator: PIOperator) -> float:
    """Root of the sum of all squared coefficients: the Hilbert-Schmidt norm, multipliers by their L2 norm."""
    arrays = (operator.p, operator.q1, operator.q2, operator.r0, operator.r1, operator.r2)
    return float(np.sqrt(sum(float(np.sum(a**2)) for a in arrays)))
