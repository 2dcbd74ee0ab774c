"""Orthonormal Legendre polynomials on [0, 1]: the one basis in which every kernel of the design is stored.

phi_i(s) = sqrt(2 i + 1) P_i(2 s - 1), so that int_0^1 phi_i phi_j ds = 1 if i = j, else 0. An
orthonormal basis keeps the semidefinite programs well scaled (theory, section 3, point 2).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

Array = npt.NDArray[np.float64]


@lru_cache(maxsize=512)
def gauss(count: int) -> tuple[Array, Array]:
    """Gauss-Legendre nodes and weights on [0, 1], each of shape (count,)."""
    x, w = legendre.leggauss(count)
    nodes, weights = 0.5 * (x + 1.0), 0.5 * w
    nodes.setflags(write=False)
    weights.setflags(write=False)
    return nodes, weights


def basis(s: npt.ArrayLike, size: int) -> Array:
    """Values phi_0..phi_{size-1} at points s of shape (m,); returns (m, size)."""
    points = np.atleast_1d(np.asarray(s, dtype=np.float64))
    scale = np.sqrt(2.0 * np.arange(size) + 1.0)
    return np.asarray(legendre.legvander(2.0 * points - 1.0, size - 1) * scale)


@lru_cache(maxsize=512)
def projection(size: int) -> tuple[Array, Array, Array]:
    """Nodes, values and the exact transform for polynomials of degree below `size`.

    Returns (nodes (size,), values V (size, size) with V[a, i] = phi_i(s_a), transform F (size, size)),
    such that coefficients = F @ (samples at the nodes).
    """
    nodes, weights = gauss(size)
    values = basis(nodes, size)
    transform = values.T * weights
    values.setflags(write=False)
    transform.setflags(write=False)
    return nodes, values, transform


@lru_cache(maxsize=512)
def antiderivative_of_products(left: int, right: int, size: int) -> Array:
    """F[j, k, q]: coefficients of int_0^s phi_j phi_k, for j < left, k < right, in `size` basis functions.

    Exact where size > left + right - 1, the degree of the antiderivative plus one.
    """
    top = left + right
    nodes, weights = gauss(top)
    lower, upper = basis(nodes, left), basis(nodes, right)
    product = np.einsum("aj,ak,ap,a->jkp", lower, upper, basis(nodes, top - 1), weights)
    out: Array = product @ integration(top - 1, size)
    out.setflags(write=False)
    return out


@lru_cache(maxsize=512)
def integration(size_in: int, size_out: int) -> Array:
    """J[p, q]: coefficients of int_0^s phi_p; tridiagonal: only p-1, p+1 (and 0 for p = 0) appear."""
    out = np.zeros((size_in, max(size_out, size_in + 1)))
    for p in range(size_in):
        # int_{-1}^x P_p = (P_{p+1} - P_{p-1}) / (2p + 1), and ds = dx / 2
        factor = 0.5 * np.sqrt(2.0 * p + 1.0) / (2.0 * p + 1.0)
        out[p, p + 1] = factor / np.sqrt(2.0 * p + 3.0)
        if p > 0:
            out[p, p - 1] = -factor / np.sqrt(2.0 * p - 1.0)
        else:
            out[p, 0] = 0.5
    result = np.ascontiguousarray(out[:, :size_out])
    result.setflags(write=False)
    return result


def fit(samples_of: npt.ArrayLike) -> Array:
    """Coefficients from samples at `gauss(m)` nodes along the LAST axis, m = its length."""
    samples = np.asarray(samples_of, dtype=np.float64)
    _, _, transform = projection(samples.shape[-1])
    return np.asarray(samples @ transform.T)


@lru_cache(maxsize=512)
def _interpolation(size: int) -> Array:
    """The inverse of `projection`'s values, to rounding."""
    out = np.asarray(np.linalg.inv(projection(size)[1]), dtype=np.float64)
    out.setflags(write=False)
    return out


def interpolate(samples_of: npt.ArrayLike) -> Array:
    """`fit`, without the rounding of the weights: those near the ends are good to 1e-12 only.

    At the ends, where every polynomial is largest, the sum is then right to 1e-15 and not to 1e-12 of the
    largest sample: for factors that grow along the arm and stand beside others that decay.
    """
    samples = np.asarray(samples_of, dtype=np.float64)
    return np.asarray(samples @ _interpolation(samples.shape[-1]).T)


@lru_cache(maxsize=512)
def products(left: int, right: int) -> Array:
    """M[i, j, p]: coefficients of phi_i phi_j for i < left, j < right; p < left + right - 1."""
    size = left + right - 1
    _, values, transform = projection(size)
    out: Array = np.einsum("ai,aj,pa->ijp", values[:, :left], values[:, :right], transform)
    out.setflags(write=False)
    return out


@lru_cache(maxsize=512)
def products_with_antiderivatives(outer: int, left: int, right: int) -> Array:
    """G[i, j, k, p]: coefficients of phi_i(s) int_0^s phi_j phi_k; p < outer + left + right - 1."""
    primitive = antiderivative_of_products(left, right, left + right)
    out = np.asarray(np.tensordot(products(outer, left + right), primitive, axes=(1, 2)))
    out = np.ascontiguousarray(out.transpose(0, 2, 3, 1))
    out.setflags(write=False)
    return out


def multiply(left: Array, right: Array) -> Array:
    """Product of matrix polynomials (m, k, p) and (k, n, q): shape (m, n, p + q - 1)."""
    table = products(left.shape[2], right.shape[2])
    spread = np.tensordot(left, table, axes=(2, 0))  # (m, k, q, p + q - 1)
    return np.asarray(np.tensordot(spread, right, axes=((1, 2), (0, 2))).transpose(0, 2, 1))


def to_plain(coefficients: Array) -> Array:
    """Orthonormal coefficients (last axis) to those of plain P_i(2 s - 1), the artefact's basis."""
    return np.asarray(coefficients * np.sqrt(2.0 * np.arange(coefficients.shape[-1]) + 1.0))


def from_plain(coefficients: npt.ArrayLike) -> Array:
    """Inverse of `to_plain`."""
    plain = np.asarray(coefficients, dtype=np.float64)
    return np.asarray(plain / np.sqrt(2.0 * np.arange(plain.shape[-1]) + 1.0))


def trim(coefficients: Array, axes: tuple[int, ...], tolerance: float = 0.0) -> Array:
    """Drop trailing coefficients along `axes` that are all at most `tolerance` in magnitude.

    At least one coefficient stays. Non-finite coefficients are never dropped.
    """
    magnitudes = np.abs(coefficients)
    keep = [slice(None)] * coefficients.ndim
    for axis in axes:
        others = tuple(k for k in range(coefficients.ndim) if k != axis % coefficients.ndim)
        largest = magnitudes.max(axis=others, initial=0.0)
        present = np.flatnonzero(~((largest <= tolerance) & np.isfinite(largest)))
        keep[axis] = slice(int(present[-1]) + 1 if present.size else 1)
    return np.ascontiguousarray(coefficients[tuple(keep)])
