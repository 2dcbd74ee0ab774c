"""Dense block matrix to sequentially semiseparable form: the sums that neighbours pass on (theory,
section 5).

A map out = M in with one block of inputs and outputs a node is run by two sweeps along the chain,
    c[i+1] = W[i] c[i] + Q[i] in[i],   d[i-1] = V[i] d[i] + R[i] in[i],   out[i] = D in + P c[i] + U
    d[i].
The least number of entries of c at a cut is the rank of the block of M that leads across it (its
Hankel block); Rice and Verhaegen 2009 [IEEE Trans. Automatic Control 54(10)].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

TOLERANCE = 1e-13
"""Singular values of Hankel blocks below this fraction of the matrix's norm count as rounding."""


@dataclass(frozen=True, eq=False)
class NodeMatrices:
    """The matrices of one node; it receives c from the root's and d from the tip's side."""

    D: Array
    P: Array
    Q: Array
    W: Array
    U: Array
    R: Array
    V: Array


@dataclass(frozen=True, eq=False)
class _Sums:
    """One direction: sums to output (read), input to passed sums (write), sums to sums (keep)."""

    read: list[Array]
    write: list[Array]
    keep: list[Array]


def realise(
    matrix: Array, outputs: int, inputs: int, tolerance: float = TOLERANCE
) -> list[NodeMatrices]:
    """Minimal semiseparable form of a matrix of shape (n * outputs, n * inputs), node by node.

    The sums are input-normal: [W Q] and [V R] have orthonormal rows, so a sum is never longer than
    the inputs behind it. Singular values below tolerance times (a bound of) the matrix's norm are
    dropped; the result differs from the matrix by at most that much a cut. Cost: one SVD of a
    (rows, rank + inputs) matrix a node and direction.
    """
    n = matrix.shape[0] // outputs
    blocks = matrix.reshape(n, outputs, n, inputs)
    size = np.abs(matrix)
    threshold = tolerance * math.sqrt(size.sum(axis=0).max() * size.sum(axis=1).max())
    forward = _one_direction(blocks, threshold)
    backward = _one_direction(blocks[::-1, :, ::-1, :], threshold)
    return [
        NodeMatrices(
            D=blocks[i, :, i, :].copy(),
            P=forward.read[i],
            Q=forward.write[i],
            W=forward.keep[i],
            U=backward.read[n - 1 - i],
            R=backward.write[n - 1 - i],
            V=backward.keep[n - 1 - i],
        )
        for i in range(n)
    ]


def _one_direction(blocks: Array, threshold: float) -> _Sums:
    """Realise the part below the block diagonal.

    With rows[i] = (outputs of nodes >= i) the Hankel block of cut i is O[i] Z[i], Z[i] with
    orthonormal rows (never formed). The next one is [O[i] without node i, column i of M]
    blkdiag(Z[i], I): its singular value decomposition is that of its small first factor.
    """
    n, outputs, _, inputs = blocks.shape
    read: list[Array] = []
    write: list[Array] = []
    keep: list[Array] = []
    observe = np.zeros((n * outputs, 0))
    for i in range(n):
        rank = observe.shape[1]
        read.append(observe[:outputs].copy())
        column = blocks[i + 1 :, :, i, :].reshape((n - 1 - i) * outputs, inputs)
        left, singular, right = np.linalg.svd(
            np.hstack([observe[outputs:], column]), full_matrices=False
        )
        kept = int(np.count_nonzero(singular > threshold))
        observe = left[:, :kept] * singular[:kept]
        keep.append(right[:kept, :rank].copy())
        write.append(right[:kept, rank:].copy())
    return _Sums(read=read, write=write, keep=keep)


def multiply(nodes: Sequence[NodeMatrices], vector: Array) -> Array:
    """The two sweeps in one process: in of shape (n, inputs) to out of shape (n, outputs)."""
    n = len(nodes)
    out = np.stack([node.D @ vector[i] for i, node in enumerate(nodes)])
    c = np.zeros(nodes[0].W.shape[1])
    for i, node in enumerate(nodes):
        out[i] += node.P @ c
        c = node.W @ c + node.Q @ vector[i]
    d = np.zeros(nodes[-1].V.shape[1])
    for i in range(n - 1, -1, -1):
        node = nodes[i]
        out[i] += node.U @ d
        d = node.V @ d + node.R @ vector[i]
    return out
