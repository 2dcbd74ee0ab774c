"""A chain in which every node uses what both neighbours give, to sums that run one way each.

Between `deploy.structured`, which writes a tick as such a chain, and `deploy.shorten`. Node i takes a_i from
the root's side and b_i from the tip's side, and a_(i+1), b_(i-1) depend on both: nothing can be computed in one
pass. With the reflections of what lies on either side of a cut, known beforehand,

    a_(i+1) = G_i b_i + c_(i+1),   b_(i-1) = H_i a_i + d_(i-1),

c and d can: c depends on the inputs on the root's side only, d on those on the tip's side. It is block
elimination from both ends, as for the inverse of a semiseparable matrix (Rice and Verhaegen 2009).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deploy.semiseparable import NodeMatrices

Array = npt.NDArray[np.float64]

CHUNK = 500
"""Nodes whose small systems are solved in one call: bounds the memory."""


@dataclass(frozen=True, eq=False)
class ImplicitChain:
    """Per node: a_next = aa a + ab b + ai in, b_previous = ba a + bb b + bi in, out = oa a + ob b + oi in.

    All (n, rows, columns); a is zero at the root and b at the tip.
    """

    aa: Array
    ab: Array
    ai: Array
    ba: Array
    bb: Array
    bi: Array
    oa: Array
    ob: Array
    oi: Array


def one_way_sums(chain: ImplicitChain) -> list[NodeMatrices]:
    """The same map by sums that run one way each; they are as long as a and b, see `deploy.shorten`.

    LinAlgError if a part of the chain has no solution of its own.
    """
    n = len(chain.aa)
    root = _reflections(chain.aa, chain.ab, chain.ba, chain.bb)
    turned = [m[::-1] for m in (chain.bb, chain.ba, chain.ab, chain.aa)]
    tip = _reflections(*turned)[::-1]
    out: list[NodeMatrices] = []
    for start in range(0, n, CHUNK):
        out.extend(_chunk(chain, root, tip, slice(start, min(n, start + CHUNK))))
    return out


def _reflections(aa: Array, ab: Array, ba: Array, bb: Array) -> Array:
    """G (n, a, b): of the nodes before each one, by what their last one takes from the other side."""
    n, a, b = ab.shape
    G = np.zeros((n, a, b))
    identity = np.eye(b)
    for i in range(n - 1):
        passed = np.linalg.solve(identity - ba[i] @ G[i], bb[i])
        G[i + 1] = ab[i] + aa[i] @ (G[i] @ passed)
    return G


def _chunk(chain: ImplicitChain, root: Array, tip: Array, part: slice) -> list[NodeMatrices]:
    """The sums of some nodes; root: G (before each node), tip: H (after each node)."""
    aa, ab, ai = chain.aa[part], chain.ab[part], chain.ai[part]
    ba, bb, bi = chain.ba[part], chain.bb[part], chain.bi[part]
    oa, ob = chain.oa[part], chain.ob[part]
    G, H = root[part], tip[part]
    nodes, a, b = G.shape
    inputs = ai.shape[2]
    # a - G (ba a + bb b + bi in) = c,   b - H (aa a + ab b + ai in) = d
    system = np.block([[np.eye(a) - G @ ba, -G @ bb], [-H @ aa, np.eye(b) - H @ ab]])
    right = np.zeros((nodes, a + b, a + b + inputs))
    right[:, :, : a + b] = np.eye(a + b)
    right[:, :a, a + b :] = G @ bi
    right[:, a:, a + b :] = H @ ai
    both = np.linalg.solve(system, right)
    out = np.concatenate([oa, ob], axis=2) @ both
    P, U, D = out[:, :, :a], out[:, :, a : a + b], chain.oi[part] + out[:, :, a + b :]
    # the sums themselves, without the other side
    c = np.linalg.solve(
        np.eye(a) - G @ ba,
        np.concatenate([np.broadcast_to(np.eye(a), (nodes, a, a)), G @ bi], axis=2),
    )
    d = np.linalg.solve(
        np.eye(b) - H @ ab,
        np.concatenate([np.broadcast_to(np.eye(b), (nodes, b, b)), H @ ai], axis=2),
    )
    W, Q = aa @ c[:, :, :a], ai + aa @ c[:, :, a:]
    V, R = bb @ d[:, :, :b], bi + bb @ d[:, :, b:]
    return [
        NodeMatrices(D=D[k], P=P[k], Q=Q[k], W=W[k], U=U[k], R=R[k], V=V[k]) for k in range(nodes)
    ]
