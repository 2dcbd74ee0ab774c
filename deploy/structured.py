"""The factors of every node without a matrix of n columns: `deploy` for chains of thousands of segments.

From gains artefact to `NodeFactors`, the same map as `deploy.deployment.deploy`, in O(n) time and memory. The
tick of `deploy.step` is written as a chain of small implicit relations (what a node's innovation, predicted
state and command take from its neighbours and from the running sums of the gains), whose elimination gives the
sums.
Nothing here says whether the sampled loop is stable: that is for `deploy`, whose eigenvalues need the matrix.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import accumulate, pairwise

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre
from scipy.linalg import solveh_banded

from deploy.deployment import in_si, node_factors, offsets
from deploy.equilibrium import equilibrium
from deploy.grid import (
    COMMAND_PLACES,
    MEASURED_STATES,
    MEASUREMENT_PLACES,
    STATE_PLACES,
    Place,
    SegmentGrid,
    make_grid,
)
from deploy.implicit_chain import ImplicitChain, one_way_sums
from deploy.separable import REACH, SeparableGain, banded_model, separable_gain, shifted
from deploy.shorten import shorten
from deploy.step import IMPLICITNESS
from wire.artefact import Arm, GainsArtefact, Setpoint
from wire.errors import UsageError
from wire.factors import INPUTS, OUTPUTS, STATES, NodeFactors, SweepFactors

Array = npt.NDArray[np.float64]

MOST_HELD = 200
"""Up to so many segments the setpoint is what the commands really hold (`deploy.held`, 800 cells, dense);
beyond, the difference is of second order in the segment length and the setpoint itself is taken."""
GAUSS = 8
"""Quadrature points a segment for the load of a command."""


@dataclass(frozen=True, eq=False)
class StructuredStep:
    """The parts of one tick at one setpoint for scaled quantities, O(n) numbers; scales as in `deploy.step`."""

    A: Array
    """(2 REACH + 1, n, 4, 4), as in `deploy.separable.BandedModel`."""
    B: Array
    """(n, 4, 1)."""
    C: Array
    """(n, 2, 4)."""
    L: SeparableGain
    K: SeparableGain
    tick_s: float
    scale_in: Array
    """(7n,)."""
    scale_out: Array
    """(5n,)."""

    @property
    def chain(self) -> ImplicitChain:
        """The whole tick as relations of neighbours."""
        return _chain(self.A, self.B, self.C, self.L, self.K, self.tick_s)


@dataclass(frozen=True, eq=False)
class StructuredDeployment:
    """What a run needs of a large chain."""

    faces_m: Array
    """(n + 1,)."""
    tick_s: float
    nodes: tuple[NodeFactors, ...]
    ranks_forward: tuple[tuple[int, ...], ...]
    """Per setpoint, numbers in the forward sum at each cut, root to tip, before padding."""
    ranks_backward: tuple[tuple[int, ...], ...]


def structured_deploy(
    artefact: GainsArtefact,
    nodes: int,
    tick_s: float,
    spacing: str | Sequence[float] = "equispaced",
    progress: Callable[[str], None] = lambda _: None,
) -> StructuredDeployment:
    """Put the gains of all setpoints on `nodes` segments, as `deploy` does, in O(nodes).

    Raises UsageError for a grid or tick that `deploy` would refuse, except for stability, which is not checked.
    """
    if isinstance(tick_s, bool) or not (math.isfinite(tick_s) and tick_s > 0.0):
        raise UsageError(f"tick: expected a positive number of seconds, got {tick_s!r}")
    grid = make_grid(artefact.arm.length_m, nodes, spacing)
    factors: list[list[SweepFactors]] = []
    for setpoint in artefact.setpoints:
        progress(f"{nodes} nodes, setpoint {setpoint.name}")
        step = structured_step(artefact.arm, setpoint, grid, tick_s)
        sums = shorten(one_way_sums(step.chain))
        rest = setpoint_offsets(artefact.arm, setpoint, grid)
        factors.append(in_si(sums, step.scale_in, step.scale_out, *rest))
    return StructuredDeployment(
        faces_m=grid.faces_m,
        tick_s=float(tick_s),
        nodes=tuple(node_factors(i, [f[i] for f in factors], grid) for i in range(grid.nodes)),
        ranks_forward=tuple(tuple(f.forward_sent for f in one[:-1]) for one in factors),
        ranks_backward=tuple(tuple(f.backward_sent for f in one[1:]) for one in factors),
    )


def structured_step(
    arm: Arm, setpoint: Setpoint, grid: SegmentGrid, tick_s: float
) -> StructuredStep:
    """The tick of `deploy.step.make_step` as an implicit chain; UsageError for a tick that is too long."""
    model = banded_model(arm, setpoint.curvature_per_m, grid)
    x = np.sqrt(2.0 * model.energy_weights)
    y = x[:, MEASURED_STATES]
    u = np.sqrt(grid.dual_widths_m(COMMAND_PLACES[0]))[:, None]
    K = separable_gain(setpoint.controller, grid, COMMAND_PLACES, STATE_PLACES).scaled(u, x)
    size = K.norm()
    if size > 0.0:
        K, u = K.scaled(np.full_like(u, 1.0 / size), np.ones_like(x)), u / size
    L = separable_gain(setpoint.observer, grid, STATE_PLACES, MEASUREMENT_PLACES).scaled(x, y)
    A = np.stack(
        [
            x[:, :, None]
            * model.A[REACH + o]
            / np.where(inside := shifted(x, o), inside, 1.0)[:, None]
            for o in range(-REACH, REACH + 1)
        ]
    )
    B = x[:, :, None] * model.B / u[:, None, :]
    select = np.zeros((grid.nodes, 2, STATES))
    select[:, [0, 1], MEASURED_STATES] = 1.0
    rate = max(K.composed(before=B).norm(), L.composed(after=select).norm())
    if tick_s * rate > 1.0:
        raise UsageError(
            f"tick {tick_s:g} s is too long: at setpoint {setpoint.name!r} the gains act within "
            f"{1.0 / rate:.3g} s; use a tick well below that"
        )
    return StructuredStep(
        A=A,
        B=B,
        C=select,
        L=L,
        K=K,
        tick_s=tick_s,
        scale_in=np.hstack([x, u, y]).ravel(),
        scale_out=np.hstack([x, u]).ravel(),
    )


_VELOCITIES = 2


def _cuts(sizes: dict[str, int]) -> dict[str, slice]:
    """Consecutive places of parts with these sizes."""
    ends = list(accumulate(sizes.values(), initial=0))
    return {
        name: slice(start, end) for name, (start, end) in zip(sizes, pairwise(ends), strict=True)
    }


def _chain(
    A: Array, B: Array, C: Array, L: SeparableGain, K: SeparableGain, h: float
) -> ImplicitChain:
    """The tick of `deploy.step`, scaled, with these unknowns of a node:

    e = C xh - y + h C L e, the innovation after the correction;   xf = xh + h L e;
    z - p h A z = xf / p + h B u,   x+ = z - (1 - p) / p xf;   q = x+ + h B u+,   u+ = K q.
    """
    n, p = len(B), IMPLICITNESS
    w = _cuts({"e": 2, "z": STATES, "q": STATES, "u": 1})
    # from the root's side: the sums of L and K up to the node before the last, the last one's e and q, and the
    # velocities of two nodes; from the tip's side likewise, with whole states
    a = _cuts({
        "L": L.lower_b.shape[1], "e": 2, "v1": _VELOCITIES, "v2": _VELOCITIES,
        "K": K.lower_b.shape[1], "q": STATES,
    })  # fmt: skip
    b = _cuts({
        "L": L.upper_b.shape[1], "e": 2, "z1": STATES, "z2": STATES,
        "K": K.upper_b.shape[1], "q": STATES,
    })  # fmt: skip
    inputs = _cuts({"x": STATES, "u": 1, "y": 2})
    na, nb = a["q"].stop, b["q"].stop
    own = w["u"].stop

    # columns: own unknowns, a, b, inputs
    def columns(rows: int) -> tuple[Array, ...]:
        whole = np.zeros((n, rows, own + na + nb + INPUTS))
        return whole, *np.split(whole, [own, own + na, own + na + nb], axis=2)

    Le, of_own, of_a, of_b, _ = columns(STATES)
    of_own[:, :, w["e"]], of_a[:, :, a["e"]], of_b[:, :, b["e"]] = L.band[1], L.band[0], L.band[2]
    of_a[:, :, a["L"]], of_b[:, :, b["L"]] = L.lower_a, L.upper_a

    xf, _, _, _, of_in = columns(STATES)
    of_in[:, :, inputs["x"]] = np.eye(STATES)
    xf += h * Le

    e, _, _, _, of_in = columns(2)
    of_in[:, :, inputs["x"]], of_in[:, :, inputs["y"]] = C, -np.eye(2)
    e += h * (C @ Le)

    z, of_own, of_a, of_b, of_in = columns(STATES)
    of_own[:, :, w["z"]] = p * h * A[REACH]
    of_a[:, :, a["v1"]] = p * h * A[REACH - 1][:, :, :_VELOCITIES]
    of_a[:, :, a["v2"]] = p * h * A[REACH - 2][:, :, :_VELOCITIES]
    of_b[:, :, b["z1"]], of_b[:, :, b["z2"]] = p * h * A[REACH + 1], p * h * A[REACH + 2]
    of_in[:, :, inputs["u"]] = h * B
    z += xf / p

    after, of_own, _, _, _ = columns(STATES)
    of_own[:, :, w["z"]] = np.eye(STATES)
    after -= (1.0 - p) / p * xf

    q, of_own, _, _, _ = columns(STATES)
    of_own[:, :, w["u"]] = h * B
    q += after

    u, of_own, of_a, of_b, _ = columns(1)
    of_own[:, :, w["q"]], of_a[:, :, a["q"]], of_b[:, :, b["q"]] = K.band[1], K.band[0], K.band[2]
    of_a[:, :, a["K"]], of_b[:, :, b["K"]] = K.lower_a, K.upper_a

    relations = np.concatenate([e, z, q, u], axis=1)
    solved = np.linalg.solve(np.eye(own) - relations[:, :, :own], relations[:, :, own:])

    def given(whole: Array) -> Array:
        """Rows in own unknowns, a, b, inputs: in a, b and inputs only."""
        return np.asarray(whole[:, :, :own] @ solved + whole[:, :, own:])

    a_next, of_own, of_a, _, _ = columns(na)
    for name, gain, value in (("L", L, "e"), ("K", K, "q")):
        of_a[:, a[name], a[name]] = np.eye(gain.lower_b.shape[1])
        of_a[:, a[name], a[value]] = shifted(gain.lower_b, -1)
        of_own[:, a[value], w[value]] = np.eye(w[value].stop - w[value].start)
    of_own[:, a["v1"], w["z"]] = np.eye(_VELOCITIES, STATES)
    of_a[:, a["v2"], a["v1"]] = np.eye(_VELOCITIES)

    b_previous, of_own, _, of_b, _ = columns(nb)
    for name, gain, value in (("L", L, "e"), ("K", K, "q")):
        of_b[:, b[name], b[name]] = np.eye(gain.upper_b.shape[1])
        of_b[:, b[name], b[value]] = shifted(gain.upper_b, 1)
        of_own[:, b[value], w[value]] = np.eye(w[value].stop - w[value].start)
    of_own[:, b["z1"], w["z"]] = np.eye(STATES)
    of_b[:, b["z2"], b["z1"]] = np.eye(STATES)

    last, of_own, _, _, _ = columns(1)
    of_own[:, :, w["u"]] = 1.0
    out = np.concatenate([after, last], axis=1)
    parts = [np.split(given(one), [na, na + nb], axis=2) for one in (a_next, b_previous, out)]
    return ImplicitChain(*parts[0], *parts[1], *parts[2])


def setpoint_offsets(arm: Arm, setpoint: Setpoint, grid: SegmentGrid) -> tuple[Array, Array]:
    """The setpoint as inputs (n, 7) and outputs (n, 5), see `MOST_HELD`."""
    if grid.nodes <= MOST_HELD:
        return offsets(arm, setpoint, grid)
    series = np.asarray(setpoint.curvature_per_m, dtype=np.float64)
    rest = equilibrium(arm, series, f"setpoint {setpoint.name}")
    out = np.zeros((grid.nodes, OUTPUTS))
    for column, place, one in ((2, Place.CENTRE, rest.strain), (3, Place.INNER_FACE, series)):
        places = 2.0 * grid.locations_m(place) / grid.length_m - 1.0
        out[:, column] = legendre.legval(places, one)
    out[:, 4] = projected(rest.load_n_per_m, grid)
    return np.hstack([out, out[:, MEASURED_STATES]]), out


def projected(series: Array, grid: SegmentGrid) -> Array:
    """`deploy.feedforward.holding_commands` with a tridiagonal matrix: commands (n,), series in 2 s / L - 1."""
    x, weights = legendre.leggauss(GAUSS)
    width, n = grid.cell_widths_m, grid.nodes
    places = grid.faces_m[:-1, None] + 0.5 * width[:, None] * (x + 1.0)
    load = (
        legendre.legval(2.0 * places / grid.length_m - 1.0, series) * weights * 0.5 * width[:, None]
    )
    up = 0.5 * (x + 1.0)  # of the outer face's command on its segment; on the first one 1
    right = load @ up
    right[0] = load[0].sum()
    right[:-1] += (load @ (1.0 - up))[1:]
    matrix = np.zeros((2, n))  # upper form: above the diagonal, diagonal
    matrix[1] = width / 3.0
    matrix[1, 0] = width[0]
    matrix[1, :-1] += width[1:] / 3.0
    matrix[0, 1:] = width[1:] / 6.0
    return np.asarray(solveh_banded(matrix, right))
