"""Gains artefact, number of nodes, spacing and tick to the factors of every node (section 5).

The design is done once on the continuous arm; this step puts it on any number of segments. Every
deployment is checked before it is handed out: sweeps against the dense matrix, and stability of the
sampled loop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NoReturn

import numpy as np
import numpy.typing as npt

from deploy.arm import ArmModes, make_arm_modes
from deploy.equilibrium import equilibrium
from deploy.grid import MEASURED_STATES, Place, SegmentGrid, make_grid
from deploy.held import Holder
from deploy.semiseparable import NodeMatrices, multiply, realise
from deploy.stability import SpectralRadius, longest_stable_tick, spectral_radius
from deploy.step import Loop, gain_rate, make_loop, make_step
from wire.artefact import Arm, GainsArtefact, Setpoint
from wire.errors import OctarmError, UsageError
from wire.factors import INPUTS, OUTPUTS, STATES, NodeFactors, SweepFactors

Array = npt.NDArray[np.float64]

SWEEP_TOLERANCE = 1e-10
"""Largest relative difference between sweeps and dense matrix that is accepted."""


@dataclass(frozen=True, eq=False)
class DenseStep:
    """The same tick for a central computer: out = M (in - in_offset) + out_offset.

    M (5n, 7n), in_offset (7n,), out_offset (5n,), flattened node by node in the order of
    `SweepFactors`.
    """

    M: Array
    in_offset: Array
    out_offset: Array

    def __call__(self, inputs: Array) -> Array:
        """One tick at the setpoint: absolute inputs (n, 7) to absolute outputs (n, 5)."""
        out = self.M @ (inputs.ravel() - self.in_offset) + self.out_offset
        return np.asarray(out.reshape(-1, OUTPUTS), dtype=np.float64)

    def about(self, inputs: Array, now: Array, then: Array) -> Array:
        """One tick around a reference that moves: `now` and `then`, each (n, 5), at this tick and the next."""
        deviation = inputs - np.concatenate([now, now[:, MEASURED_STATES]], axis=1)
        return np.asarray((self.M @ deviation.ravel()).reshape(-1, OUTPUTS) + then)


@dataclass(frozen=True, eq=False)
class Deployment:
    """Everything that a run needs from the gains, and the evidence that it is right."""

    faces_m: Array
    """Segment boundaries, (n + 1,)."""
    tick_s: float
    setpoint_names: tuple[str, ...]
    nodes: tuple[NodeFactors, ...]
    dense: tuple[DenseStep, ...]
    """Per setpoint, the centralised reference."""
    ranks_forward: tuple[tuple[int, ...], ...]
    """Per setpoint, numbers in the forward sum at each of the n - 1 cuts, root to tip. Sums shorter than
    another setpoint's are padded with zeros in the factors, so that messages have one length."""
    ranks_backward: tuple[tuple[int, ...], ...]
    """Per setpoint, numbers in the backward sum at each of the n - 1 cuts, root to tip."""
    check: float
    """Largest relative difference of sweeps and dense matrix, random inputs, over all setpoints."""
    spectral_radius: tuple[SpectralRadius, ...]
    """Per setpoint, of one tick of the closed loop."""
    energy_weights: Array
    """(n, 4): sum(energy_weights * x**2) is the energy in J of a deviation x (n, 4)."""
    _loops: tuple[tuple[Loop, ArmModes], ...] = field(repr=False)

    @cached_property
    def longest_stable_tick_s(self) -> float:
        """Longest tick at which all loops are stable on this grid, to 2 %; inf if all are.

        Computed when asked for (some seconds at 100 nodes).
        """
        return longest_stable_tick(self._loops, self.tick_s, stable=True)

    def without_control(self) -> Deployment:
        """The same without feedback: the commands are the reference's own, whatever the estimate is."""
        open_nodes = []
        for node in self.nodes:
            factors = []
            for one in node.setpoints:
                D, P, U = one.D.copy(), one.P.copy(), one.U.copy()
                D[STATES], P[STATES], U[STATES] = 0.0, 0.0, 0.0
                factors.append(replace(one, D=D, P=P, U=U))
            open_nodes.append(replace(node, setpoints=tuple(factors)))
        open_dense = []
        for step in self.dense:
            M = step.M.copy()
            M[STATES::OUTPUTS] = 0.0
            open_dense.append(replace(step, M=M))
        return replace(self, nodes=tuple(open_nodes), dense=tuple(open_dense))

    @property
    def forward_widths(self) -> tuple[int, ...]:
        """Numbers in the forward sum that each node receives (0 at the root)."""
        return tuple(node.forward_received for node in self.nodes)

    @property
    def backward_widths(self) -> tuple[int, ...]:
        """Numbers in the backward sum that each node receives (0 at the tip)."""
        return tuple(node.backward_received for node in self.nodes)

    @property
    def messages_per_tick(self) -> int:
        """Messages between neighbours a tick, 2 (n - 1)."""
        return 2 * (len(self.nodes) - 1)


def deploy(
    artefact: GainsArtefact,
    nodes: int,
    tick_s: float,
    spacing: str | Sequence[float] = "equispaced",
) -> Deployment:
    """Put the gains of all setpoints on `nodes` segments for a tick of `tick_s` seconds.

    `spacing` is "equispaced", "chebyshev" or the nodes + 1 segment boundaries in m. Raises
    UsageError for fewer than 2 nodes, boundaries that do not divide the arm, a tick that is not a
    positive number, or one that is too long for the gains (the message names the longest).
    """
    grid = make_grid(artefact.arm.length_m, nodes, spacing)
    if isinstance(tick_s, bool) or not (math.isfinite(tick_s) and tick_s > 0.0):
        raise UsageError(f"tick: expected a positive number of seconds, got {tick_s!r}")
    loops = tuple(make_loop(artefact.arm, setpoint, grid) for setpoint in artefact.setpoints)
    for setpoint, loop in zip(artefact.setpoints, loops, strict=True):
        rate = gain_rate(loop)
        if tick_s * rate > 1.0:
            raise UsageError(
                f"tick {tick_s:g} s is too long: at setpoint {setpoint.name!r} the gains act within "
                f"{1.0 / rate:.3g} s, and what they do in one tick is not what was designed; use a "
                "tick well below that"
            )
    steps = [make_step(loop, tick_s) for loop in loops]
    modes = [make_arm_modes(artefact.arm, one.curvature_per_m, grid) for one in artefact.setpoints]
    pairs = tuple(zip(loops, modes, strict=True))
    radii = tuple(
        spectral_radius(step, one, tick_s) for step, one in zip(steps, modes, strict=True)
    )
    for setpoint, radius in zip(artefact.setpoints, radii, strict=True):
        if not radius.stable:
            _refuse_tick(setpoint, radius, pairs)
    dense: list[DenseStep] = []
    factors: list[list[SweepFactors]] = []
    worst = 0.0
    for setpoint, step in zip(artefact.setpoints, steps, strict=True):
        scaled = step.whole()
        realisation = realise(scaled, OUTPUTS, INPUTS)
        worst = max(worst, _difference(realisation, scaled))
        in_offset, out_offset = offsets(artefact.arm, setpoint, grid)
        matrix = scaled * step.scale_in / step.scale_out[:, None]
        dense.append(DenseStep(matrix, in_offset.ravel(), out_offset.ravel()))
        factors.append(in_si(realisation, step.scale_in, step.scale_out, in_offset, out_offset))
    if not worst <= SWEEP_TOLERANCE:
        raise OctarmError(
            f"deployment on {grid.nodes} nodes, tick {tick_s:g} s: sweeps and dense matrix differ "
            f"by {worst:.1e} relative, expected at most {SWEEP_TOLERANCE:g}; the gains or the "
            "spacing are too badly scaled, try a shorter tick or longer segments"
        )
    return Deployment(
        faces_m=grid.faces_m,
        tick_s=float(tick_s),
        setpoint_names=tuple(setpoint.name for setpoint in artefact.setpoints),
        nodes=tuple(node_factors(i, [f[i] for f in factors], grid) for i in range(grid.nodes)),
        dense=tuple(dense),
        ranks_forward=tuple(tuple(f.forward_sent for f in one[:-1]) for one in factors),
        ranks_backward=tuple(tuple(f.backward_sent for f in one[1:]) for one in factors),
        check=worst,
        spectral_radius=radii,
        energy_weights=grid.energy_weights(artefact.arm),
        _loops=pairs,
    )


def _refuse_tick(
    setpoint: Setpoint, radius: SpectralRadius, loops: Sequence[tuple[Loop, ArmModes]]
) -> NoReturn:
    parts = {
        "observer": radius.observer_error,
        "controller": radius.controlled_state,
        "arm with observer and controller": radius.arm,
    }
    part = max(parts, key=lambda key: parts[key])
    longest = longest_stable_tick(loops, radius.tick_s, stable=False)
    remedy = (
        f"the longest stable tick on this grid is {longest:.3g} s"
        if longest > 0.0
        else "no tick makes these gains stable on this grid: use more nodes or weaker gains"
    )
    raise UsageError(
        f"tick {radius.tick_s:g} s is too long: at setpoint {setpoint.name!r} the sampled {part} "
        f"grows by a factor {radius.largest:.6g} a tick (must be below 1); {remedy}"
    )


def _difference(realisation: Sequence[NodeMatrices], scaled: Array) -> float:
    """Sweeps against dense matrix: largest difference, random inputs, relative per component."""
    random = np.random.default_rng(20090101)
    worst = 0.0
    for _ in range(4):
        vector = random.standard_normal((len(realisation), INPUTS))
        expected = (scaled @ vector.ravel()).reshape(-1, OUTPUTS)
        size = np.max(np.abs(expected), axis=0)
        error = np.max(np.abs(multiply(realisation, vector) - expected), axis=0)
        worst = max(worst, float(np.max(error / np.where(size > 0.0, size, 1.0))))
    return worst


def offsets(arm: Arm, setpoint: Setpoint, grid: SegmentGrid) -> tuple[Array, Array]:
    """The setpoint as n commands hold it, as inputs (n, 7) and outputs (n, 5): x_e, feed-forward, y_e."""
    series = np.asarray(setpoint.curvature_per_m, dtype=np.float64)
    what = f"setpoint {setpoint.name}"
    held = Holder(arm, grid).hold(series, equilibrium(arm, series, what), what)
    in_offset = np.zeros((grid.nodes, INPUTS))
    in_offset[:, 2] = held.strain
    in_offset[:, 3] = held.curvature_per_m
    in_offset[:, 4] = held.command_n_per_m
    in_offset[:, OUTPUTS:] = in_offset[:, MEASURED_STATES]
    return in_offset, in_offset[:, :OUTPUTS].copy()


def in_si(
    realisation: Sequence[NodeMatrices],
    scale_in: Array,
    scale_out: Array,
    in_offset: Array,
    out_offset: Array,
) -> list[SweepFactors]:
    """Factors for inputs and outputs in SI; the sums stay in scaled units (sqrt of an energy).

    Scales as in `deploy.step.Step`.
    """
    inputs = scale_in.reshape(-1, INPUTS)
    outputs = 1.0 / scale_out.reshape(-1, OUTPUTS, 1)
    return [
        SweepFactors(
            D=outputs[i] * node.D * inputs[i],
            P=outputs[i] * node.P,
            Q=node.Q * inputs[i],
            W=node.W,
            U=outputs[i] * node.U,
            R=node.R * inputs[i],
            V=node.V,
            in_offset=in_offset[i],
            out_offset=out_offset[i],
        )
        for i, node in enumerate(realisation)
    ]


def node_factors(index: int, factors: Sequence[SweepFactors], grid: SegmentGrid) -> NodeFactors:
    """One node's factors at all setpoints, sums padded to one length."""
    start = np.stack([one.out_offset for one in factors])
    return NodeFactors(
        index=index,
        nodes=grid.nodes,
        bend_m=float(grid.dual_widths_m(Place.INNER_FACE)[index]),
        initial_estimate=start[:, :STATES].copy(),
        initial_command=start[:, STATES].copy(),
        setpoints=tuple(_padded(factors)),
    )


def _padded(factors: Sequence[SweepFactors]) -> list[SweepFactors]:
    """The same maps with sums of one length: zeros where a setpoint's sums are shorter than another's."""
    c, c_next, d, d_previous = (
        max(getattr(one, name) for one in factors)
        for name in ("forward_received", "forward_sent", "backward_received", "backward_sent")
    )

    def wide(matrix: Array, rows: int, columns: int) -> Array:
        out = np.zeros((rows, columns))
        out[: matrix.shape[0], : matrix.shape[1]] = matrix
        return out

    return [
        replace(
            one,
            P=wide(one.P, OUTPUTS, c),
            Q=wide(one.Q, c_next, INPUTS),
            W=wide(one.W, c_next, c),
            U=wide(one.U, OUTPUTS, d),
            R=wide(one.R, d_previous, INPUTS),
            V=wide(one.V, d_previous, d),
        )
        for one in factors
    ]
