"""Sums to the shortest sums of the same map: from long node matrices to those that nodes run.

Between `deploy.implicit_chain` and the factors of a node. The result has the form that
`deploy.semiseparable.realise` gives for a dense matrix: [W Q] and [V R] with orthonormal rows, singular values
of the Hankel blocks above a threshold. Cost: a QR and an SVD of the sums' lengths a node and direction.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from deploy.semiseparable import TOLERANCE, NodeMatrices

Array = npt.NDArray[np.float64]

SAMPLES = 16
"""Nodes whose rows and columns stand for all in the bound of the norm, equally spaced, both ends among them."""


def shorten(nodes: Sequence[NodeMatrices], tolerance: float = TOLERANCE) -> list[NodeMatrices]:
    """The shortest sums: singular values below tolerance times (a bound of) the map's norm are dropped."""
    threshold = tolerance * norm_bound(nodes)
    forward = _one_direction([(m.P, m.W, m.Q) for m in nodes], threshold)
    backward = _one_direction([(m.U, m.V, m.R) for m in reversed(nodes)], threshold)[::-1]
    return [
        NodeMatrices(D=m.D, P=P, Q=Q, W=W, U=U, R=R, V=V)
        for m, (P, W, Q), (U, V, R) in zip(nodes, forward, backward, strict=True)
    ]


def _one_direction(
    sums: Sequence[tuple[Array, Array, Array]], threshold: float
) -> list[tuple[Array, Array, Array]]:
    """(read, keep, write) of each node, in the direction of the sum.

    Backwards: R_i, what all nodes from i on read of the sum, as a triangle (QR). Forwards: with the sum as T_i
    times the short one, the singular values of R_(i+1) [W_i T_i, Q_i] are those of the Hankel block.
    """
    n = len(sums)
    read: list[Array] = [np.zeros((0, 0))] * (n + 1)
    read[n] = np.zeros((0, sums[-1][1].shape[0]))
    for i in range(n - 1, 0, -1):
        P, W, _ = sums[i]
        read[i] = np.asarray(np.linalg.qr(np.vstack([P, read[i + 1] @ W]), mode="r"))
    out = []
    T = np.zeros((sums[0][1].shape[1], 0))
    for i, (P, W, Q) in enumerate(sums):
        rank = T.shape[1]
        reached = np.hstack([W @ T, Q])
        _, singular, right = np.linalg.svd(read[i + 1] @ reached, full_matrices=False)
        right = right[: np.count_nonzero(singular > threshold)]
        out.append((P @ T, right[:, :rank].copy(), right[:, rank:].copy()))
        T = reached @ right.T
    return out


def norm_bound(nodes: Sequence[NodeMatrices]) -> float:
    """sqrt(|M|_1 |M|_inf), an upper bound of the 2-norm, from the columns and rows of `SAMPLES` nodes."""
    at = np.unique(np.linspace(0, len(nodes) - 1, SAMPLES).astype(int))
    return math.sqrt(_largest_column(nodes, at) * _largest_column(_transposed(nodes), at))


def _largest_column(nodes: Sequence[NodeMatrices], at: npt.NDArray[np.int64]) -> float:
    inputs = nodes[0].D.shape[1]
    unit = np.zeros((len(nodes), inputs, len(at) * inputs))
    for k, node in enumerate(at):
        unit[node, :, k * inputs : (k + 1) * inputs] = np.eye(inputs)
    # `deploy.semiseparable.multiply` for many columns at once
    out = np.stack([m.D @ unit[i] for i, m in enumerate(nodes)])
    c = np.zeros((nodes[0].W.shape[1], unit.shape[2]))
    for i, m in enumerate(nodes):
        out[i] += m.P @ c
        c = m.W @ c + m.Q @ unit[i]
    d = np.zeros((nodes[-1].V.shape[1], unit.shape[2]))
    for i in range(len(nodes) - 1, -1, -1):
        m = nodes[i]
        out[i] += m.U @ d
        d = m.V @ d + m.R @ unit[i]
    return float(np.abs(out).sum(axis=(0, 1)).max())


def _transposed(nodes: Sequence[NodeMatrices]) -> list[NodeMatrices]:
    return [
        NodeMatrices(D=m.D.T, P=m.R.T, Q=m.U.T, W=m.V.T, U=m.Q.T, R=m.P.T, V=m.W.T) for m in nodes
    ]
