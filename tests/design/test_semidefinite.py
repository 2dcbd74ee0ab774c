"""Equalities as solvers get them, and the solvers that are there."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import numpy.typing as npt
import pytest
from scipy import linalg

from design.semidefinite import TIME_LIMITS, Layout, orthonormal_equalities, solvers

Array = npt.NDArray[np.float64]


def test_columns_of_a_layout() -> None:
    layout = Layout(("gamma", "delta"), 3, (("P", 2), ("Q", 4)))
    assert layout.columns == 1 + 2 + 3 + 3 + 10


def test_installed_solvers_solve_semidefinite_programs() -> None:
    """And take the option by which their time is limited."""
    assert {"CLARABEL", "SCS"} <= set(solvers())
    for solver in solvers():
        t = cp.Variable()
        program = cp.Problem(cp.Minimize(t), [t * np.eye(2) >> np.diag([1.0, 2.0])])
        limit = TIME_LIMITS[solver]
        program.solve(solver=solver, **({limit: 60.0} if limit else {}))
        assert float(t.value) == pytest.approx(2.0, abs=1e-3)


def graded(values: Array, columns: int) -> Array:
    """A matrix of these singular values with rows of equal length, so that scaling changes nothing.

    Rotating by a Hadamard matrix spreads the singular values evenly over the rows.
    """
    right, _ = np.linalg.qr(np.random.default_rng(7).normal(size=(columns, values.size)))
    return np.asarray(
        linalg.hadamard(values.size) / np.sqrt(values.size) @ (values[:, None] * right.T)
    )


@pytest.mark.parametrize("columns", [16, 40])
def test_equalities_are_an_orthonormal_basis_at_every_size_of_singular_values(columns: int) -> None:
    """Down to the threshold 1e-7 of the largest, and without those below, whatever lies between."""
    kept = [1.0, 0.9, 0.3, 1e-2, 1.1e-3, 0.9e-3, 1e-4, 1e-5, 1e-6, 2e-7]
    matrix = graded(np.array([*kept, 4e-8, 1e-9, 1e-11, 0.0, 0.0, 0.0]), columns)
    rows = orthonormal_equalities(matrix)
    assert rows.shape == (len(kept), columns)
    np.testing.assert_allclose(rows @ rows.T, np.eye(len(kept)), atol=1e-11)
    _, values, right = np.linalg.svd(matrix, full_matrices=False)
    for number, value in enumerate(values[: len(kept)]):
        outside = right[number] - rows.T @ (rows @ right[number])
        assert float(np.linalg.norm(outside)) < 1e-14 / value


def test_equalities_of_more_rows_than_columns() -> None:
    rng = np.random.default_rng(8)
    matrix = rng.normal(size=(30, 4)) @ rng.normal(size=(4, 9))
    rows = orthonormal_equalities(matrix)
    assert rows.shape == (4, 9)
    np.testing.assert_allclose(rows @ rows.T, np.eye(4), atol=1e-13)
    np.testing.assert_allclose(matrix @ rows.T @ rows, matrix, atol=1e-12)


def test_single_equality() -> None:
    np.testing.assert_allclose(
        np.abs(orthonormal_equalities(np.array([[3.0, -4.0]]))), [[0.6, 0.8]]
    )
