"""Gram programs in their dual form: programs with an optimum by construction, reductions, failures, dumps."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import cvxpy as cp
import numpy as np
import numpy.typing as npt
import pytest

from design.lpi.sdp import GramProgram, Point
from design.semidefinite import Layout

Array = npt.NDArray[np.float64]


def triangle(matrix: Array) -> Array:
    return np.asarray(matrix[np.triu_indices(len(matrix))])


def coefficients(matrix: Array) -> Array:
    """The row by which an upper triangle gives <matrix, G>."""
    i, j = np.triu_indices(len(matrix))
    return np.asarray(np.where(i == j, 1.0, 2.0) * matrix[i, j])


def point_vector(point: Point, layout: Layout) -> Array:
    grams = [triangle(point.grams[name]) for name, _ in layout.grams]
    numbers = [point.numbers[name] for name in layout.numbers]
    return np.concatenate([[1.0], numbers, point.free, *grams])


@dataclass(frozen=True)
class Known:
    """A program whose optimum is known: primal and dual solutions drawn first, strictly complementary.

    Gram matrices G (5, rank 2) and H (4, rank 1); numbers a, b, and p >= 0 with p = 0 at the optimum; two free
    numbers; ten equalities.
    """

    seed: int = 1

    layout = Layout(("a", "b", "p"), 2, (("G", 5), ("H", 4)))

    @cached_property
    def parts(self) -> tuple[Array, dict[str, float], Array, list[Array]]:
        """Matrix, cost, numbers and Gram matrices."""
        rng = np.random.default_rng(self.seed)
        multipliers = np.append(rng.uniform(0.5, 1.5, 9) * rng.choice([-1.0, 1.0], 9), 1.0)
        grams, columns = [], []
        for size, rank in ((5, 2), (4, 1)):
            axes = np.linalg.qr(rng.normal(size=(size, size)))[0]
            weights = rng.uniform(1.0, 2.0, size)
            inside = axes * weights * (np.arange(size) < rank)
            slack = axes * weights - inside
            grams.append(inside @ axes.T)
            constraints = rng.normal(size=(10, size, size))
            constraints += constraints.transpose(0, 2, 1)
            rest = np.einsum("e,ekl->kl", multipliers[:-1], constraints[:-1])
            constraints[-1] = slack @ axes.T - rest
            columns.append(np.array([coefficients(c) for c in constraints]))
        of_numbers = rng.normal(size=(10, 3))
        free = rng.normal(size=(10, 2))
        free[-1] = -multipliers[:-1] @ free[:-1]
        cost = -multipliers @ of_numbers + np.array([0.0, 0.0, 0.7])
        numbers = np.append(rng.normal(size=2), 0.0)
        at = [c @ triangle(g) for c, g in zip(columns, grams, strict=True)]
        constant = -(of_numbers @ numbers + free @ rng.normal(size=2) + sum(at))
        matrix = np.column_stack([constant, of_numbers, free, *columns])
        return matrix, dict(zip("abp", map(float, cost), strict=True)), numbers, grams

    @cached_property
    def optimum(self) -> float:
        _, cost, numbers, _ = self.parts
        return float(np.array(list(cost.values())) @ numbers)

    @cached_property
    def program(self) -> GramProgram:
        return GramProgram(self.parts[0], self.layout)

    def value(self, point: Point) -> float:
        return sum(c * point.numbers[name] for name, c in self.parts[1].items())


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_known_optimum(seed: int) -> None:
    known = Known(seed)
    matrix, cost, numbers, grams = known.parts
    assert known.program.equalities == 10
    assert known.program.gram_sizes == (5, 4)
    point = known.program.solve(cost, {}, positive=("p",))
    assert point.status == "optimal"
    assert point.found
    assert known.value(point) == pytest.approx(known.optimum, abs=1e-6)
    np.testing.assert_allclose(list(point.numbers.values()), numbers, atol=1e-3)
    for got, expected in zip(point.grams.values(), grams, strict=True):
        np.testing.assert_allclose(got, expected, atol=1e-3)
    x = point_vector(point, known.layout)
    assert np.abs(matrix @ x).max() < 1e-12 * np.abs(matrix * x).max()
    assert point.residual == pytest.approx(
        np.abs(matrix @ x).max() / np.abs(matrix * x).max(), abs=1e-15
    )
    spectra = [np.linalg.eigvalsh(g) for g in point.grams.values()]
    smallest = min(0.0, *(v[0] for v in spectra)) / max(v[-1] for v in spectra)
    assert point.smallest_eigenvalue == pytest.approx(float(smallest), rel=1e-6, abs=1e-14)
    assert point.smallest_eigenvalue > -1e-6
    assert point.iterations > 3
    assert min(point.modelling_s, point.solver_s) > 0.0


def test_dual_form_equals_the_direct_form() -> None:
    """One number fixed away from the optimum, where only the direct form is there to compare with."""
    known = Known(4)
    matrix, cost, numbers, _ = known.parts
    fixed = {"b": float(numbers[1]) - 0.5}
    free = cp.Variable(2)
    variables = {name: cp.Variable() for name in known.layout.numbers}
    direct = {name: cp.Variable((k, k), symmetric=True) for name, k in known.layout.grams}
    columns = [cp.hstack(list(variables.values())), free]
    for name, k in known.layout.grams:
        i, j = np.triu_indices(k)
        columns.append(cp.vec(direct[name], order="F")[i + j * k])
    constraints = [matrix[:, 0] + matrix[:, 1:] @ cp.hstack(columns) == 0]
    constraints += [gram >> 0 for gram in direct.values()]
    constraints += [variables[name] == value for name, value in {**fixed, "p": 0.0}.items()]
    program = cp.Problem(cp.Minimize(sum(c * variables[n] for n, c in cost.items())), constraints)
    program.solve(solver="CLARABEL")
    point = known.program.solve(cost, {**fixed, "p": 0.0})
    assert program.status == point.status == "optimal"
    assert point.numbers["b"] == fixed["b"]  # exactly: it is not moved onto the equalities
    assert point.numbers["a"] == pytest.approx(float(variables["a"].value), abs=1e-5)
    assert known.value(point) > known.optimum + 1e-3
    for name in ("G", "H"):
        np.testing.assert_allclose(point.grams[name], direct[name].value, atol=1e-3)


def test_scaled_mixed_and_repeated_equalities_change_nothing() -> None:
    known = Known(2)
    matrix, cost, _, _ = known.parts
    rng = np.random.default_rng(8)
    many = np.vstack(
        [matrix * np.geomspace(1e-3, 1e3, 10)[:, None], rng.normal(size=(6, 10)) @ matrix]
    )
    program = GramProgram(many, known.layout)
    assert program.equalities == 10
    point = program.solve(cost, {}, positive=("p",))
    assert known.value(point) == pytest.approx(known.optimum, abs=1e-6)


def forcing(*squares: dict[tuple[int, int], float], constant: float = 0.0) -> GramProgram:
    """A 4 x 4 Gram matrix G with the given combinations of entries zero, trace(G) = t; rows mixed at random."""
    size = 4
    rows = []
    for entries in squares:
        block = np.zeros((size, size))
        for (i, j), factor in entries.items():
            block[i, j] = factor
        rows.append([constant, 0.0, *triangle(block)])
    rows.append([0.0, -1.0, *triangle(np.eye(size))])
    matrix = np.array(rows)
    mix = np.random.default_rng(3).normal(size=(len(rows), len(rows)))
    return GramProgram(mix @ matrix, Layout(("t",), 0, (("G", size),)))


@pytest.mark.parametrize(
    ("program", "kept"),
    [
        (forcing({(2, 2): 1.0}), [0, 1, 3]),
        (forcing({(1, 1): 1.0, (3, 3): 1.0}), [0, 2]),
        (forcing({(2, 2): 1.0}, {(0, 0): 3.0, (0, 2): -5.0}), [1, 3]),
        (forcing({(2, 2): 1.0, (0, 0): -1.0}), [0, 1, 2, 3]),
        (forcing({(0, 1): 1.0}, {(2, 3): 1.0}), [0, 1, 2, 3]),
        (forcing({(2, 2): 1.0}, constant=-1.0), [0, 1, 2, 3]),
    ],
    ids=["one", "a sum", "by the next round", "a difference", "no square", "to one, not zero"],
)
def test_facial_reduction(program: GramProgram, kept: list[int]) -> None:
    assert program.kept["G"].tolist() == kept
    assert program.gram_sizes == (len(kept),)


def test_reduced_rows_are_zero_in_the_solution() -> None:
    program = forcing({(2, 2): 1.0}, {(0, 0): 3.0, (0, 2): -5.0})
    point = program.solve({"t": 1.0}, {"t": 2.0})
    gram = point.grams["G"]
    assert gram.shape == (4, 4)
    dropped = [0, 2]
    assert not gram[dropped].any() and not gram[:, dropped].any()
    assert np.trace(gram) == pytest.approx(2.0, abs=1e-12)
    assert point.smallest_eigenvalue > -1e-7


def test_everything_forced_to_zero() -> None:
    """G = 0 and t = 1: no Gram matrix is left to the solver."""
    program = GramProgram(
        np.array([[0.0, 0.0, 1.0], [-1.0, 1.0, 0.0]]), Layout(("t",), 0, (("G", 1),))
    )
    assert program.gram_sizes == (0,)
    point = program.solve({"t": 1.0}, {})
    assert point.numbers["t"] == pytest.approx(1.0, abs=1e-9)
    assert point.grams["G"].tolist() == [[0.0]]


def no_point(point: Point) -> None:
    assert not point.found
    assert all(np.isnan(v) for v in point.numbers.values())
    assert np.isnan(point.free).all()
    assert all(np.isnan(g).all() for g in point.grams.values())
    assert point.residual == np.inf
    assert point.smallest_eigenvalue == -np.inf


ONE = Layout(("t",), 0, (("G", 1),))
TWO = Layout(("t", "u"), 1, (("G", 1),))


def test_number_that_no_equality_holds() -> None:
    """t + u + 2 x = 5 - G with x free: a cost on t alone has no minimum."""
    program = GramProgram(np.array([[-5.0, 1.0, 1.0, 2.0, 1.0]]), TWO)
    no_point(program.solve({"t": 1.0}, {}))
    assert program.solve({"t": 1.0}, {}).status == "unbounded"
    point = program.solve({}, {"u": 1.0})
    assert point.residual < 1e-15
    absent = GramProgram(
        np.array([[-5.0, 1.0, 0.0, 0.0, 1.0]]), TWO
    )  # t = 5 - G; u and x are nowhere
    assert absent.solve({"t": -1.0}, {}).numbers["t"] == pytest.approx(5.0, abs=1e-6)
    assert absent.solve({"u": 1.0}, {}).status == "unbounded"


@pytest.mark.parametrize(
    "rows",
    [
        [[1.0, 1.0, -1.0], [2.0, 1.0, -1.0]],
        [[1.0, 0.0, 1.0], [0.0, 1.0, 1.0]],
        [[1.0, 0.0, 0.0], [0.0, 1.0, -1.0]],
        [[-1.0, 1.0, 1.0], [0.0, 0.0, 1.0], [-2.0, 1.0, 0.0]],
        [[-500.0, 0.0, 1.0], [0.0, 1.0, 1.0]],
    ],
    ids=["t + 1 = G = t + 2", "G = -1", "1 = 0", "G = 0, t = 1, t = 2", "trace over its bound"],
)
def test_infeasible(rows: list[list[float]]) -> None:
    point = GramProgram(np.array(rows), ONE).solve({"t": 1.0}, {})
    assert point.status.startswith("infeasible")
    no_point(point)


def test_infeasible_for_the_fixed_number() -> None:
    program = GramProgram(np.array([[-50.0, 1.0, 1.0]]), ONE)  # t = 50 - G
    assert program.solve({}, {"t": 45.0}).numbers == {"t": 45.0}
    no_point(program.solve({}, {"t": 55.0}))
    no_point(program.solve({}, {"t": 35.0}, trace=10.0))


def test_trace_bounds_what_would_be_unbounded() -> None:
    """max t = G: the bound on the trace is reached. With p >= 0, and without, the sign is kept."""
    program = GramProgram(np.array([[0.0, -1.0, 1.0]]), ONE)
    for trace in (10.0, 1e3):
        assert program.solve({"t": -1.0}, {}, trace=trace).numbers["t"] == pytest.approx(
            trace, rel=1e-6
        )
    falling = GramProgram(np.array([[-5.0, 1.0, 1.0]]), ONE)  # t = 5 - G
    assert falling.solve({"t": 1.0}, {}).numbers["t"] == pytest.approx(-95.0, rel=1e-6)
    signed = falling.solve({"t": 1.0}, {}, positive=("t",))
    assert signed.numbers["t"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("solver", ["NO SUCH SOLVER", "OSQP"])
def test_unusable_solver_is_no_exception(solver: str) -> None:
    point = Known().program.solve(Known().parts[1], {}, solver=solver)
    assert point.status == "solver_error"
    no_point(point)


def test_another_solver() -> None:
    known = Known()
    point = known.program.solve(known.parts[1], {}, positive=("p",), solver="SCS")
    assert point.found
    assert known.value(point) == pytest.approx(known.optimum, abs=1e-2)


@pytest.mark.parametrize("solver", ["CLARABEL", "SCS"])
def test_time_limit_gives_no_false_optimum(solver: str) -> None:
    known = Known()
    point = known.program.solve(known.parts[1], {}, solver=solver, time_limit_s=1e-9)
    assert not point.found or point.residual < 1e-12
    if not point.found:
        no_point(point)


def test_wrong_number_of_columns() -> None:
    with pytest.raises(ValueError, match="30 columns, the layout needs 31"):
        GramProgram(np.ones((2, 30)), Known.layout)


@dataclass(frozen=True)
class Sdpa:
    """min c.x with F_1 x_1 + ... - F_0 >= 0, by blocks; a negative size is a diagonal block."""

    cost: Array
    sizes: list[int]
    matrices: list[Array]
    """Per block (variables + 1, k, k)."""

    @classmethod
    def read(cls, path: Path) -> Sdpa:
        lines = [x for x in path.read_text(encoding="ascii").splitlines() if x[0] not in '"*']
        variables, blocks = int(lines[0]), int(lines[1])
        sizes = [int(x) for x in lines[2].split()]
        cost = np.array([float(x) for x in lines[3].split()])
        assert len(sizes) == blocks and len(cost) == variables
        matrices = [np.zeros((variables + 1, abs(k), abs(k))) for k in sizes]
        for line in lines[4:]:
            k, block, i, j = (int(x) for x in line.split()[:4])
            value = float(line.split()[4])
            assert value != 0.0 and i <= j
            if sizes[block - 1] < 0:
                assert i == j
            matrices[block - 1][k, i - 1, j - 1] = matrices[block - 1][k, j - 1, i - 1] = value
        return cls(cost, sizes, matrices)

    def solve(self) -> tuple[float, list[Array]]:
        """Optimum and the multipliers of the blocks, which solve max sum F_0 Y: F_k Y = c_k, Y >= 0."""
        x = cp.Variable(len(self.cost))
        constraints = []
        for block in self.matrices:
            k = block.shape[1]
            flat = block[1:].reshape(len(self.cost), k * k).T @ x - block[0].ravel()
            constraints.append(cp.reshape(flat, (k, k), order="C") >> 0)
        problem = cp.Problem(cp.Minimize(self.cost @ x), constraints)
        problem.solve(solver="CLARABEL")
        return float(problem.value), [np.asarray(c.dual_value) for c in constraints]


def test_dump_is_the_program(tmp_path: Path) -> None:
    """What the file's multipliers are: the program's Gram matrices, then p and the slack of the trace bound."""
    known = Known(3)
    _, cost, _, grams = known.parts
    for trace in (40.0, 400.0):
        path = tmp_path / f"{trace}.dat-s"
        point = known.program.solve(cost, {}, positive=("p",), trace=trace, dump=path)
        read = Sdpa.read(path)
        assert read.sizes == [5, 4, -2]
        _, (G, H, signs) = read.solve()
        np.testing.assert_allclose(G, grams[0], atol=1e-3)
        np.testing.assert_allclose(H, grams[1], atol=1e-3)
        np.testing.assert_allclose(G, point.grams["G"], atol=2e-3)
        assert signs[0, 0] == pytest.approx(point.numbers["p"], abs=1e-4)
        used = sum(np.trace(g) for g in grams)
        assert signs[1, 1] == pytest.approx(1.0 - used / trace, abs=1e-4)


def test_dump_of_a_program_that_the_bound_decides(tmp_path: Path) -> None:
    """max t = G under the bound alone: the file's optimum is the bound, so the bound is in the file."""
    program = GramProgram(np.array([[0.0, -1.0, 1.0]]), ONE)
    for trace in (10.0, 30.0):
        program.solve({"t": -1.0}, {}, trace=trace, dump=tmp_path / "bound.dat-s")
        _, (G, signs) = Sdpa.read(tmp_path / "bound.dat-s").solve()
        assert G[0, 0] == pytest.approx(trace, rel=1e-5)
        assert signs[0, 0] == pytest.approx(0.0, abs=1e-6)


def test_dump_holds_the_reduced_program(tmp_path: Path) -> None:
    program = forcing({(2, 2): 1.0})
    program.solve({"t": 1.0}, {"t": 2.0}, dump=tmp_path / "reduced.dat-s")
    assert Sdpa.read(tmp_path / "reduced.dat-s").sizes == [3, -1]
