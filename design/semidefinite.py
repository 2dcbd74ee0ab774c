"""What all semidefinite programs share: solvers, the columns of a Gram program, and sound equalities.

Equalities are scaled and orthonormalised before a solver sees them (theory, section 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import cvxpy as cp
import numpy as np

from design.legendre import Array

ROW_FLOOR = 1e-5
"""Rows are scaled to norm one, but never by more than 1 / ROW_FLOOR: rounding must not become an equality."""
RANK_TOLERANCE = 1e-7
"""Singular values of the scaled equalities below this (relative) are dependent rows."""
ACCEPTED = ("optimal", "optimal_inaccurate")
TIME_LIMITS = {
    "CLARABEL": "time_limit",
    "SCS": "time_limit_secs",
    "MOSEK": "",
    "COPT": "",
    "CVXOPT": "",
    "SDPA": "",
}
"""CVXPY's solvers of semidefinite programs, and the option that limits their time where there is one."""


def solvers() -> tuple[str, ...]:
    """The semidefinite solvers that are installed here."""
    return tuple(name for name in TIME_LIMITS if name in cp.installed_solvers())


@dataclass(frozen=True)
class Layout:
    """Which columns of the coefficient matrix belong to what.

    Column 0 is the constant term; then `numbers` scalars, then per Gram matrix its upper triangle in the
    order of numpy.triu_indices.
    """

    numbers: tuple[str, ...]
    free: int
    """How many free (unnamed) numbers follow the named ones, e.g. the coefficients of Z."""
    grams: tuple[tuple[str, int], ...]

    @property
    def columns(self) -> int:
        """Total number of columns."""
        return 1 + len(self.numbers) + self.free + sum(k * (k + 1) // 2 for _, k in self.grams)


def orthonormal_equalities(matrix: Array) -> Array:
    """An orthonormal basis of the matrix's row space, rows scaled first; rounding is no equality.

    The basis are the right singular vectors, largest singular value first: solvers are sensitive to more than
    the space that they span. A QR factorisation leaves a small square matrix for the SVD.
    """
    norms = np.linalg.norm(matrix, axis=1)
    scaled = matrix / np.maximum(norms, ROW_FLOOR * norms.max())[:, None]
    if len(scaled) > scaled.shape[1]:
        scaled = np.linalg.qr(scaled, mode="r")
    basis, triangle = np.linalg.qr(scaled.T)
    _, values, rotation = np.linalg.svd(triangle.T)
    rank = int(np.count_nonzero(values > RANK_TOLERANCE * values[0]))
    return np.asarray(rotation[:rank] @ basis.T)
