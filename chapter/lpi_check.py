"""The arm with the chapter's outputs on a staggered grid: what judges the gains of `chapter.lpi_solve`.

It shares no code with the design: exact angles of the setpoint instead of the polynomial frame, differences
instead of integral operators. Nondimensional; coordinates are scaled so that the norm of a state is Euclidean.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from design.channel import Channel

Array = npt.NDArray[np.float64]
Functions = Callable[[Array], Array]
"""Points (m,) -> values (outputs, 4, m): a gain along the arm."""


@dataclass(frozen=True)
class GridArm:
    """x_t = A x + B w on cells cells; C1: (mean v_y, mean k); tip: displacement; root: force N_y(0).

    positions: where each entry of the state stands, widths: the share of the arm it stands for, states: which
    of (v_x, v_y, e, k) it is.
    """

    A: Array
    B: Array
    C1: Array
    tip: Array
    root: Array
    positions: Array
    widths: Array
    states: npt.NDArray[np.int64]

    @property
    def outputs(self) -> Array:
        """(tip, root), the chapter's y for this state."""
        return np.stack([self.tip, self.root])

    def gain(self, functions: Functions) -> Array:
        """Samples of L, (entries, outputs), in the grid's coordinates."""
        values = functions(self.positions)
        picked = values[:, self.states, np.arange(len(self.states))]
        return np.asarray((picked * np.sqrt(self.widths)).T)


def grid_arm(angle: Callable[[Array], Array], alpha: float, drag: float, cells: int) -> GridArm:
    """Velocities at the nodes 1..n, strain in the n cells, curvature at the nodes 0..n-1.

    angle: theta_e(s). Skew-symmetric but for the drag by construction, so the energy balance holds on the grid.
    """
    n, h = cells, 1.0 / cells
    nodes = np.arange(n + 1) * np.float64(h)
    middles = nodes[:-1] + 0.5 * h
    cos, sin = np.cos(angle(middles)), np.sin(angle(middles))
    step = (np.eye(n) - np.eye(n, k=-1)) / h  # v_1..v_n -> v' in the cells, v_0 = 0
    stretch = alpha * np.hstack([cos[:, None] * step, sin[:, None] * step])
    turn = np.hstack([-sin[:, None] * step, cos[:, None] * step])
    bend = step @ turn  # turn at node 0 is zero, and half a cell away
    bend[0] *= 2.0
    of_v, of_k = np.full(n, h), np.full(n, h)
    of_v[-1], of_k[0] = 0.5 * h, 0.5 * h
    widths = np.concatenate([of_v, of_v, np.full(n, h), of_k])
    root_widths = np.sqrt(widths)
    G = root_widths[2 * n :, None] * np.vstack([stretch, bend]) / root_widths[: 2 * n]
    A = np.zeros((4 * n, 4 * n))
    A[2 * n :, : 2 * n], A[: 2 * n, 2 * n :] = G, -G.T
    A[: 2 * n, : 2 * n] = -drag * np.eye(2 * n)
    load = np.zeros(4 * n)
    load[n : 2 * n] = 1.0
    curvature = np.zeros(4 * n)
    curvature[3 * n :] = 1.0
    # statics: a unit force at the tip along y does work with the tip's displacement
    virtual = np.linalg.solve(G.T, np.eye(2 * n)[2 * n - 1] / root_widths[2 * n - 1])
    tip = np.concatenate([np.zeros(2 * n), virtual])
    momentum = load * root_widths
    # momentum_t = -N_y(0) - drag momentum + w
    root = -(momentum @ A) - drag * momentum
    return GridArm(
        A=A,
        B=(load * root_widths)[:, None],
        C1=np.stack([momentum, curvature * root_widths]),
        tip=tip,
        root=root,
        positions=np.concatenate([nodes[1:], nodes[1:], middles, nodes[:-1]]),
        widths=widths,
        states=np.repeat(np.arange(4), n),
    )


def error_channel(arm: GridArm, gain: Array, noise: Array, outputs: Array) -> Channel:
    """e_t = (A + L C) e - B w - L diag(noise) n, z = outputs e: (17) on the grid."""
    B = np.hstack([-arm.B, -gain * noise])
    return Channel(arm.A + gain @ arm.outputs, B, outputs, np.zeros((len(outputs), B.shape[1])))
