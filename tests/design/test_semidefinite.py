"""Semidefinite programs of known optimum, and what happens when there is none."""

from __future__ import annotations

import cvxpy as cp
import numpy as np
import numpy.typing as npt
import pytest
from scipy import linalg

from design.semidefinite import (
    ACCEPTED,
    Layout,
    Program,
    Solution,
    orthonormal_equalities,
    solvers,
)

Array = npt.NDArray[np.float64]


def triangle(matrix: Array) -> Array:
    """Upper triangle of a symmetric matrix in the order of the layout."""
    return np.asarray(matrix[np.triu_indices(len(matrix))])


def selectors(size: int) -> Array:
    """Rows that pick the entries of the upper triangle out of a Gram block."""
    return np.eye(size * (size + 1) // 2)


def eigenvalue_program(matrix: Array) -> Program:
    """t I - matrix = G >= 0, equality by equality: the smallest t is the largest eigenvalue."""
    n = len(matrix)
    rows = np.column_stack([-triangle(matrix), triangle(np.eye(n)), -selectors(n)])
    return Program(rows, Layout(numbers=("t",), free=0, grams=(("G", n),)))


def minimise(program: Program, name: str, **fixed: float) -> Solution:
    return program.solve(lambda numbers, _: numbers[name], fixed)


@pytest.mark.parametrize("solver", ["CLARABEL", "SCS"])
def test_largest_eigenvalue(solver: str) -> None:
    matrix = np.random.default_rng(1).normal(size=(5, 5))
    matrix = matrix + matrix.T
    solution = eigenvalue_program(matrix).solve(lambda numbers, _: numbers["t"], {}, solver=solver)
    exact = float(np.linalg.eigvalsh(matrix)[-1])
    tolerance = 1e-6 if solver == "CLARABEL" else 1e-3
    assert solution.status in ACCEPTED
    assert solution.numbers["t"] == pytest.approx(exact, abs=tolerance)
    assert solution.residual < tolerance
    assert solution.smallest_gram_eigenvalue > -tolerance
    np.testing.assert_allclose(
        solution.grams["G"], exact * np.eye(5) - matrix, atol=20.0 * tolerance
    )


def test_fixed_number_is_kept() -> None:
    program = eigenvalue_program(np.diag([1.0, 2.0]))
    solution = minimise(program, "t", t=5.0)
    assert solution.numbers["t"] == pytest.approx(5.0, abs=1e-7)
    np.testing.assert_allclose(solution.grams["G"], np.diag([4.0, 3.0]), atol=1e-6)


def lyapunov_program(A: Array) -> Program:
    """P = I + G1, A'P + P A + I = -G2: feasible iff A is stable; the number t is the trace of P."""
    n = len(A)
    pairs = list(zip(*np.triu_indices(n), strict=True))
    columns = [triangle(A.T + A + np.eye(n))]
    columns.append(np.zeros(len(pairs)))
    for i, j in pairs:
        unit = np.zeros((n, n))
        unit[i, j] = unit[j, i] = 1.0
        columns.append(triangle(A.T @ unit + unit @ A))
    rows = np.column_stack([*columns, selectors(n)])
    trace = np.concatenate([[n, -1.0], triangle(np.eye(n)), np.zeros(len(pairs))])
    return Program(np.vstack([rows, trace]), Layout(("t",), 0, (("excess", n), ("decay", n))))


def test_lyapunov_of_an_oscillator() -> None:
    """The smallest P >= I with A'P + P A <= -I; checked against a brute-force search over P."""
    A = np.array([[0.0, 1.0], [-2.0, -0.6]])
    solution = minimise(lyapunov_program(A), "t")
    assert solution.status in ACCEPTED
    P = np.eye(2) + solution.grams["excess"]
    assert np.linalg.eigvalsh(P)[0] >= 1.0 - 1e-6
    assert np.linalg.eigvalsh(A.T @ P + P @ A)[-1] <= -1.0 + 1e-6
    assert solution.numbers["t"] == pytest.approx(float(np.trace(P)), abs=1e-6)

    # no admissible P has a smaller trace: P = X(Q) of the Lyapunov equation for Q >= I
    best = np.inf
    for a in np.linspace(1.0, 8.0, 71):
        for b in np.linspace(1.0, 8.0, 71):
            c = np.linspace(-1.0, 1.0, 81) * np.sqrt((a - 1.0) * (b - 1.0))
            Q = np.array([[np.full_like(c, a), c], [c, np.full_like(c, b)]])
            # A'X + X A = -Q solved by hand for A = [[0, 1], [-k, -d]]
            k, d = 2.0, 0.6
            x12 = Q[0, 0] / (2.0 * k)
            x22 = (Q[1, 1] + 2.0 * x12) / (2.0 * d)
            x11 = k * x22 + d * x12 - Q[0, 1]
            smallest = 0.5 * (x11 + x22) - np.sqrt(0.25 * (x11 - x22) ** 2 + x12**2)
            best = min(best, float(np.min(np.where(smallest >= 1.0, x11 + x22, np.inf))))
    check = linalg.solve_continuous_lyapunov(A.T, -np.eye(2))
    assert float(np.trace(check)) > 0.0
    assert solution.numbers["t"] <= best + 1e-6
    assert solution.numbers["t"] == pytest.approx(best, rel=5e-3)


@pytest.mark.parametrize("solver", ["CLARABEL", "SCS"])
def test_unstable_system_has_no_lyapunov_matrix(solver: str) -> None:
    A = np.array([[0.0, 1.0], [-2.0, 0.6]])
    solution = lyapunov_program(A).solve(lambda numbers, _: numbers["t"], {}, solver=solver)
    assert solution.status.startswith("infeasible")
    no_numbers(solution)


def no_numbers(solution: Solution) -> None:
    assert all(np.isnan(v) for v in solution.numbers.values())
    assert np.all(np.isnan(solution.free))
    assert all(np.all(np.isnan(g)) for g in solution.grams.values())
    assert solution.residual == np.inf
    assert solution.smallest_gram_eigenvalue == -np.inf


def test_contradicting_equalities() -> None:
    rows = np.array([[1.0, 1.0, -1.0], [2.0, 1.0, -1.0]])  # t + 1 = G and t + 2 = G
    solution = minimise(Program(rows, Layout(("t",), 0, (("G", 1),))), "t")
    assert solution.status.startswith("infeasible")
    no_numbers(solution)


def test_unbounded() -> None:
    rows = np.array([[0.0, 1.0, 1.0]])  # t = -G
    solution = minimise(Program(rows, Layout(("t",), 0, (("G", 1),))), "t")
    assert solution.status.startswith("unbounded")
    no_numbers(solution)


def test_failing_solver_is_no_exception() -> None:
    program = eigenvalue_program(np.eye(2))
    for solver in ("NO SUCH SOLVER", "OSQP"):  # unknown; unable to solve semidefinite programs
        solution = program.solve(lambda numbers, _: numbers["t"], {}, solver=solver)
        assert solution.status == "solver_error"
        no_numbers(solution)


def test_free_numbers() -> None:
    """Least norm solution of x1 + 2 x2 + 3 x3 = 14 with G = x1 >= 0."""
    rows = np.array([[-14.0, 1.0, 2.0, 3.0, 0.0], [0.0, 1.0, 0.0, 0.0, -1.0]])
    program = Program(rows, Layout((), 3, (("G", 1),)))
    solution = program.solve(lambda _, free: cp.norm(free), {})
    np.testing.assert_allclose(solution.free, [1.0, 2.0, 3.0], atol=1e-4)
    np.testing.assert_allclose(solution.grams["G"], [[1.0]], atol=1e-4)


def test_dependent_and_badly_scaled_rows() -> None:
    """The same program with every equality repeated, combined and scaled over eight decades."""
    matrix = np.random.default_rng(2).normal(size=(4, 4))
    matrix = matrix + matrix.T
    rows = np.column_stack([-triangle(matrix), triangle(np.eye(4)), -selectors(4)])
    mixed = np.random.default_rng(3).normal(size=(7, len(rows))) @ rows
    many = np.vstack([rows * np.geomspace(1e-4, 1e4, len(rows))[:, None], rows, mixed])
    program = Program(many, Layout(("t",), 0, (("G", 4),)))
    assert program.equalities == len(rows)
    solution = minimise(program, "t")
    assert solution.numbers["t"] == pytest.approx(float(np.linalg.eigvalsh(matrix)[-1]), abs=1e-6)
    assert solution.equalities == len(rows)


def test_residual_is_that_of_the_rows_that_were_given() -> None:
    """Rows that contradict each other below the rank tolerance are solved in the mean, and it shows."""
    matrix = np.diag([1.0, 3.0])
    rows = np.column_stack([-triangle(matrix), triangle(np.eye(2)), -selectors(2)])
    layout = Layout(("t",), 0, (("G", 2),))
    clean = minimise(Program(rows, layout), "t")
    assert clean.residual < 1e-10
    contradiction = rows[:1].copy()
    contradiction[0, 0] += 6e-8
    whole = np.vstack([rows, contradiction])
    program = Program(whole, layout)
    assert program.equalities == len(rows)
    solution = minimise(program, "t")
    assert solution.numbers["t"] == pytest.approx(3.0, abs=1e-6)
    point = np.concatenate([[1.0, solution.numbers["t"]], triangle(solution.grams["G"])])
    expected = np.abs(whole @ point).max() / np.abs(whole * point).max()
    assert solution.residual == pytest.approx(expected, rel=1e-6)
    assert solution.residual == pytest.approx(3e-8 / 3.0, rel=0.2)


def test_gram_eigenvalue_is_recomputed() -> None:
    solution = minimise(eigenvalue_program(np.diag([1.0, 2.0])), "t", t=5.0)
    assert solution.smallest_gram_eigenvalue == pytest.approx(0.75, abs=1e-5)  # of diag(4, 3)


def test_wrong_number_of_columns() -> None:
    layout = Layout(("gamma", "delta"), 3, (("P", 2), ("Q", 4)))
    assert layout.columns == 1 + 2 + 3 + 3 + 10
    with pytest.raises(ValueError, match="18 columns, the layout needs 19"):
        Program(np.ones((2, 18)), layout)


def test_installed_solvers_solve_semidefinite_programs() -> None:
    assert {"CLARABEL", "SCS"} <= set(solvers())
    for solver in solvers():
        program = eigenvalue_program(np.diag([1.0, 2.0]))
        solution = program.solve(lambda numbers, _: numbers["t"], {}, solver=solver)
        assert solution.numbers["t"] == pytest.approx(2.0, abs=1e-3)


@pytest.mark.parametrize("solver", ["CLARABEL", "SCS"])
def test_time_limit_gives_no_false_optimum(solver: str) -> None:
    matrix = np.random.default_rng(5).normal(size=(20, 20))
    program = eigenvalue_program(matrix + matrix.T)
    solution = program.solve(lambda numbers, _: numbers["t"], {}, solver=solver, time_limit_s=1e-9)
    assert solution.status != "optimal" or solution.residual < 1e-6
    if solution.status not in ACCEPTED:
        no_numbers(solution)


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
