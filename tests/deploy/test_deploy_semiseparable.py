"""Semiseparable realisation: sweeps equal the dense product, sums as short as the ranks."""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from deploy.semiseparable import multiply, realise

Array = npt.NDArray[np.float64]
OUT, IN = 5, 7


def random_map(seed: int, n: int, lower: int, upper: int) -> Array:
    """Dense matrix with off-diagonal blocks of these ranks, from random generators, spelled out."""
    random = np.random.default_rng(seed)
    matrix = np.zeros((n, OUT, n, IN))
    for rank, sign in ((lower, 1), (upper, -1)):
        read = random.standard_normal((n, OUT, rank))
        write = random.standard_normal((n, rank, IN))
        keep = random.standard_normal((n, rank, rank)) / max(1.0, np.sqrt(rank))
        for j in range(n):
            carried = write[j]
            i = j + sign
            while 0 <= i < n:
                matrix[i, :, j] = read[i] @ carried
                carried = keep[i] @ carried
                i += sign
    for i in range(n):
        matrix[i, :, i] = random.standard_normal((OUT, IN))
    return matrix.reshape(n * OUT, n * IN)


def relative_difference(matrix: Array, seed: int = 0) -> float:
    n = matrix.shape[0] // OUT
    vector = np.random.default_rng(seed).standard_normal((n, IN))
    expected = (matrix @ vector.ravel()).reshape(n, OUT)
    difference = multiply(realise(matrix, OUT, IN), vector) - expected
    return float(np.max(np.abs(difference)) / np.max(np.abs(expected)))


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(1, 30),
    lower=st.integers(0, 9),
    upper=st.integers(0, 9),
)
def test_sweeps_equal_the_dense_product(seed: int, n: int, lower: int, upper: int) -> None:
    assert relative_difference(random_map(seed, n, lower, upper)) < 1e-11


@pytest.mark.parametrize(("n", "lower", "upper"), [(12, 3, 4), (5, 9, 0), (2, 8, 8), (30, 1, 2)])
def test_sums_are_as_short_as_the_ranks_of_the_blocks(n: int, lower: int, upper: int) -> None:
    matrix = random_map(5, n, lower, upper)
    nodes = realise(matrix, OUT, IN)
    for cut in range(1, n):
        below, above = matrix[cut * OUT :, : cut * IN], matrix[: cut * OUT, cut * IN :]
        assert nodes[cut].W.shape[1] == np.linalg.matrix_rank(below, tol=1e-10)
        assert nodes[cut - 1].V.shape[1] == np.linalg.matrix_rank(above, tol=1e-10)
    assert nodes[0].W.shape[1] == 0
    assert nodes[-1].W.shape[0] == 0
    assert nodes[-1].V.shape[1] == 0
    assert nodes[0].V.shape[0] == 0


def test_a_matrix_without_structure_still_comes_out() -> None:
    matrix = np.random.default_rng(1).standard_normal((8 * OUT, 8 * IN))
    assert relative_difference(matrix) < 1e-13


@pytest.mark.parametrize("n", [1, 2, 6])
def test_a_zero_matrix_needs_no_message(n: int) -> None:
    nodes = realise(np.zeros((n * OUT, n * IN)), OUT, IN)
    assert all(node.W.size == node.V.size == 0 for node in nodes)
    assert not multiply(nodes, np.ones((n, IN))).any()


def test_sums_are_input_normal() -> None:
    """[W Q] has orthonormal rows: a sum is never longer than the inputs behind it."""
    for node in realise(random_map(9, 10, 4, 3), OUT, IN):
        forward = np.hstack([node.W, node.Q])
        np.testing.assert_allclose(forward @ forward.T, np.eye(len(forward)), atol=1e-13)
        backward = np.hstack([node.V, node.R])
        np.testing.assert_allclose(backward @ backward.T, np.eye(len(backward)), atol=1e-13)


def test_a_looser_tolerance_shortens_the_sums_and_bounds_the_difference() -> None:
    matrix = random_map(4, 10, 2, 2)
    noisy = matrix + 1e-7 * np.random.default_rng(2).standard_normal(matrix.shape)
    nodes = realise(noisy, OUT, IN, tolerance=1e-5)
    assert max(node.W.shape[1] for node in nodes) == 2
    vector = np.random.default_rng(3).standard_normal((10, IN))
    difference = multiply(nodes, vector).ravel() - noisy @ vector.ravel()
    bound = 2 * 9 * 1e-5 * np.linalg.norm(np.abs(noisy), 2) * np.linalg.norm(vector)
    assert 0.0 < np.linalg.norm(difference) < bound
