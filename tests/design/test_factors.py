"""Factors of gains: minimal rank, what truncation costs, adjoints, and gains without kernels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from numpy.polynomial import legendre as plain
from pi_reference import function_part, inner, polynomial, values

from design.factors import GainFactors, factorise
from design.inverse import SampledKernels

Array = npt.NDArray[np.float64]
COUNT = 24
X, W = plain.leggauss(COUNT)
S, W = 0.5 * (X + 1.0), 0.5 * W
NOTHING = np.zeros(0)


def samples(coefficients: Array) -> Array:
    """Orthonormal series (a, b, d) at the Gauss nodes: (a, b, COUNT)."""
    return np.asarray(coefficients @ values(S, coefficients.shape[2]).T)


def redundant(
    rng: np.random.Generator, rank: int, terms: int, q: int, m: int
) -> tuple[Array, Array]:
    """Factors outer (q, terms, N), inner (terms, m, N) of a kernel of the given rank only."""
    outer = rng.normal(size=(q, rank, 5))
    inner = np.einsum("rk,kmi->rmi", rng.normal(size=(rank, terms)), rng.normal(size=(terms, m, 6)))
    mixing = rng.normal(size=(rank, terms))
    spread = np.einsum("qri,rk->qki", outer, mixing)
    back = np.einsum("kr,rmi->kmi", np.linalg.pinv(mixing), inner)
    return samples(spread), samples(back)


def sampled(
    ranks: tuple[int, int], terms: int = 6, q: int = 4, m: int = 2, seed: int = 1
) -> SampledKernels:
    rng = np.random.default_rng(seed)
    outer1, inner1 = redundant(rng, ranks[0], terms, q, m)
    outer2, inner2 = redundant(rng, ranks[1], terms, q, m)
    return SampledKernels(
        samples(rng.normal(size=(q, m, 3))), outer1, inner1, outer2, inner2, tail=0.0
    )


def kernel_samples(outer: Array, inner_: Array) -> Array:
    """The kernel at all pairs of nodes: (q, m, COUNT, COUNT)."""
    return np.asarray(np.einsum("qra,rmb->qmab", outer, inner_))


def factor_kernels(factors: GainFactors) -> tuple[Array, Array]:
    return (
        kernel_samples(samples(factors.n1a), samples(factors.n1b)),
        kernel_samples(samples(factors.n2a), samples(factors.n2b)),
    )


def singular_values(kernel: Array) -> Array:
    """Singular values in L2 of a kernel given at all pairs of Gauss nodes."""
    q, m = kernel.shape[:2]
    root = np.sqrt(W)
    weighted = kernel * root[:, None] * root
    flat = weighted.transpose(0, 2, 1, 3).reshape(q * COUNT, m * COUNT)
    return np.asarray(np.linalg.svd(flat, compute_uv=False))


@pytest.mark.parametrize("ranks", [(2, 3), (1, 1), (5, 2), (0, 2), (3, 0), (0, 0)])
@pytest.mark.parametrize(("q", "m"), [(4, 2), (1, 4)])
def test_minimal_rank_is_found(ranks: tuple[int, int], q: int, m: int) -> None:
    gain = sampled(ranks, q=q, m=m)
    factors, dropped = factorise(gain, 1e-9)
    assert factors.ranks == ranks
    assert factors.n1a.shape[:2] == (q, ranks[0])
    assert factors.n2b.shape[:2] == (ranks[1], m)
    assert dropped < 1e-12
    np.testing.assert_allclose(samples(factors.n0), gain.multiplier, atol=1e-9)
    for got, outer, inner_ in zip(
        factor_kernels(factors),
        (gain.outer1, gain.outer2),
        (gain.inner1, gain.inner2),
        strict=True,
    ):
        kernel = kernel_samples(outer, inner_)
        np.testing.assert_allclose(got, kernel, atol=1e-7 * max(1.0, np.abs(kernel).max()))


def test_degrees_are_cut_to_what_is_there() -> None:
    factors, _ = factorise(sampled((2, 3)), 1e-9)
    assert factors.n0.shape[2] == 3
    assert factors.n1a.shape[2] == factors.n2a.shape[2] == 5
    assert factors.n1b.shape[2] == factors.n2b.shape[2] == 6


@pytest.mark.parametrize("tolerance", [0.5, 0.2, 0.05, 1e-3])
def test_truncation_costs_what_is_reported(tolerance: float) -> None:
    """Share of the largest L2 norm of a multiplier entry or singular value of a kernel."""
    gain = sampled((5, 5), seed=3)
    factors, dropped = factorise(gain, tolerance)
    kernels = [kernel_samples(gain.outer1, gain.inner1), kernel_samples(gain.outer2, gain.inner2)]
    spectra = [singular_values(k) for k in kernels]
    multiplier = float(np.sqrt(np.sum(gain.multiplier**2 * W, axis=2)).max())
    level = max(multiplier, *(float(v[0]) for v in spectra))
    assert factors.ranks == tuple(int(np.sum(v > tolerance * level)) for v in spectra)
    differences = [
        got - kernel for got, kernel in zip(factor_kernels(factors), kernels, strict=True)
    ]
    lost = np.sqrt(sum(float(np.sum(singular_values(d) ** 2)) for d in differences))
    assert lost == pytest.approx(dropped * level, rel=1e-4, abs=1e-6 * level)

    # and the operators differ by no more than that: kernels on their own triangles, by quadrature
    exact, _ = factorise(gain, 1e-12)
    apart = exact.operator() - factors.operator()
    assert float(np.linalg.norm(apart.discretise(20), 2)) <= dropped * level + 1e-6 * level


def test_no_tolerance_drops_what_is_large() -> None:
    gain = sampled((4, 4), seed=5)
    previous = -1.0
    for tolerance in (1e-6, 0.05, 0.2, 0.6, 0.99):
        factors, dropped = factorise(gain, tolerance)
        assert dropped >= previous
        assert max(factors.ranks) >= 1 or tolerance > 0.9
        previous = dropped
    assert previous > 0.1


def test_operator_is_the_sum_of_its_factors() -> None:
    factors, _ = factorise(sampled((2, 3)), 1e-9)
    function = polynomial(np.random.default_rng(2).normal(size=(2, 4)))
    points = np.array([0.0, 0.3, 1.0])
    got = function_part(factors.operator(), NOTHING, function)(points)
    for index, s in enumerate(points):
        expected = (factors.n0 @ values(np.array([s]), factors.n0.shape[2])[0]) @ function(
            np.array([s])
        )[:, 0]
        for a, b, low, high in (
            (factors.n1a, factors.n1b, 0.0, s),
            (factors.n2a, factors.n2b, s, 1.0),
        ):
            t, w = low + (high - low) * S, (high - low) * W
            inside = np.einsum("rma,ma,a->r", b @ values(t, b.shape[2]).T, function(t), w)
            expected = expected + (a @ values(np.array([s]), a.shape[2])[0]) @ inside
        np.testing.assert_allclose(got[:, index], expected, atol=1e-12)


@pytest.mark.parametrize("ranks", [(2, 3), (0, 1), (0, 0)])
def test_adjoint(ranks: tuple[int, int]) -> None:
    factors, _ = factorise(sampled(ranks), 1e-9)
    adjoint = factors.adjoint
    assert adjoint.ranks == ranks[::-1]
    rng = np.random.default_rng(9)
    x, y = polynomial(rng.normal(size=(2, 5))), polynomial(rng.normal(size=(4, 5)))
    forward = function_part(factors.operator(), NOTHING, x)
    backward = function_part(adjoint.operator(), NOTHING, y)
    left, right = inner(NOTHING, forward, NOTHING, y), inner(NOTHING, x, NOTHING, backward)
    assert abs(left) > 1e-3
    assert left == pytest.approx(right, rel=1e-11)
    for key in ("n0", "n1a", "n1b", "n2a", "n2b"):
        np.testing.assert_array_equal(getattr(adjoint.adjoint, key), getattr(factors, key))


def test_norm() -> None:
    """Of a multiplier its largest value; of int_0^s the known 2 / pi (theory, section 7, O1)."""
    none = np.zeros((1, 0, COUNT))
    empty = np.zeros((0, 1, COUNT))
    multiplier = SampledKernels((1.0 + S)[None, None], none, empty, none, empty, 0.0)
    factors, dropped = factorise(multiplier, 1e-9)
    assert (factors.ranks, dropped) == ((0, 0), 0.0)
    assert factors.norm(80) == pytest.approx(2.0, rel=1e-3)
    one = np.ones((1, 1, COUNT))
    volterra = SampledKernels(0.0 * one, one, one, none, empty, 0.0)
    factors, _ = factorise(volterra, 1e-9)
    assert factors.ranks == (1, 0)
    assert factors.norm() == pytest.approx(2.0 / np.pi, rel=1e-6)


def test_gain_of_zero() -> None:
    zero = SampledKernels(
        np.zeros((4, 2, COUNT)),
        np.zeros((4, 3, COUNT)),
        np.zeros((3, 2, COUNT)),
        np.zeros((4, 3, COUNT)),
        np.zeros((3, 2, COUNT)),
        0.0,
    )
    factors, dropped = factorise(zero, 1e-9)
    assert factors.ranks == (0, 0)
    assert dropped == 0.0
    assert factors.norm() == 0.0
