"""Signals of norm one: the program's Gram matrices are then of order one, whatever the user's units."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from design.operators import PIOperator
from design.pde.convert import Pie


@dataclass(frozen=True)
class Scaled:
    """A PIE with B1, D21 divided by one number and C1 by another; true gamma = gamma of `pie` times `gamma`."""

    pie: Pie
    gamma: float


def scaled(pie: Pie) -> Scaled:
    """Divide disturbances by |B1| and regulated outputs by |C1| (Hilbert-Schmidt); y and its gain stay."""
    w = size(pie.B1) or size(pie.D21) or 1.0
    z = size(pie.C1) or 1.0
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


def size(operator: PIOperator) -> float:
    """Root of the sum of all squared coefficients: the Hilbert-Schmidt norm, multipliers by their L2 norm."""
    arrays = (operator.p, operator.q1, operator.q2, operator.r0, operator.r1, operator.r2)
    return float(np.sqrt(sum(float(np.sum(a**2)) for a in arrays)))
