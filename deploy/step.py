"""One tick of observer and controller as one matrix: what the sweeps distribute over the nodes.

In deviations from the setpoint, with xh_t = A xh + B u + L (C xh - y) and u = K xh, a tick of
length h is
    xf      = xh(k) + X (C xh(k) - y(k)),   X  = h L (I - h C L)^-1           correct with y
    xh(k+1) = S xf + F u(k),                S  = (I - p h A)^-1 (I + (1-p) h A)   predict
                                            F  = h (I - p h A)^-1 B
    u(k+1)  = Kh xh(k+1),                   Kh = (I - h K B)^-1 K.
p = 1/2 would be the implicit midpoint rule, which keeps the conservative energy exactly at every
tick. p is slightly larger (`IMPLICITNESS`), so that modes too fast for the tick (h w >> 1), which
no rule of one solve turns at the right rate, die out of the estimate (by (1-p)/p a tick) instead of
ringing on in it.

The correction is the implicit Euler step of xh_t = L (C xh - y) and Kh that of x_t = B K x. Where
the gains only take energy out, I + X C and S both contract, so the observer is stable at any tick,
and no gain acts as more than 1/h. All of it agrees with the continuous gains to first order in h.
Off the diagonal X and Kh have the ranks of L and K and S has that of A, so the sums are as short as
with the explicit Euler step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from deploy.grid import (
    COMMAND_PLACES,
    MEASURED_STATES,
    MEASUREMENT_PLACES,
    STATE_PLACES,
    SegmentGrid,
)
from deploy.model import GridModel, make_model
from deploy.operators import operator_matrix
from wire.artefact import Arm, Setpoint
from wire.factors import INPUTS, OUTPUTS

Array = npt.NDArray[np.float64]

IMPLICITNESS = 0.55
"""The weight p of the new state in the prediction; 1/2 to 1."""


@dataclass(frozen=True, eq=False)
class Loop:
    """Model and gains of one setpoint on the grid, continuous in time, SI units."""

    model: GridModel
    L: Array
    """Observer gain, (4n, 2n)."""
    K: Array
    """Controller gain, (n, 4n)."""
    state_scale: Array
    """(4n,): half the squared length of state_scale * x is the energy of x in J."""
    measurement_scale: Array
    """(2n,): the scales of the states that are measured."""
    command_scale: Array
    """(n,): makes the controller gain's norm 1 on scaled quantities."""


@dataclass(frozen=True, eq=False)
class Step:
    """The parts of one tick for scaled quantities (`Loop`), in which they are well conditioned."""

    transition: Array
    """S, (4n, 4n)."""
    force: Array
    """F, (4n, n)."""
    correction: Array
    """X, (4n, 2n)."""
    measure: Array
    """C, (2n, 4n)."""
    feedback: Array
    """Kh, (n, 4n)."""
    scale_in: Array
    """(7n,): scaled input = scale_in * input, flattened node by node as (xh, u, y)."""
    scale_out: Array
    """(5n,): scaled output = scale_out * output, flattened node by node as (xh, u)."""

    @property
    def command_scale(self) -> Array:
        """(n,): scaled command = command_scale * u."""
        return self.scale_out[OUTPUTS - 1 :: OUTPUTS]

    @property
    def measurement_scale(self) -> Array:
        """(2n,): scaled measurement = measurement_scale * y."""
        return self.scale_in.reshape(-1, INPUTS)[:, OUTPUTS:].ravel()

    def whole(self) -> Array:
        """The whole tick, scaled, (5n, 7n): inputs (xh, u, y) and outputs (xh, u) node by node."""
        n = self.feedback.shape[0]
        observed = self.transition @ self.correction
        inputs = np.empty((4 * n, n, INPUTS))
        inputs[:, :, :4] = (self.transition + observed @ self.measure).reshape(4 * n, n, 4)
        inputs[:, :, 4] = self.force
        inputs[:, :, 5:] = -observed.reshape(4 * n, n, 2)
        estimate = inputs.reshape(4 * n, INPUTS * n)
        out = np.empty((n, OUTPUTS, INPUTS * n))
        out[:, :4] = estimate.reshape(n, 4, INPUTS * n)
        out[:, 4] = self.feedback @ estimate
        return out.reshape(OUTPUTS * n, INPUTS * n)

    def observer_error(self) -> Array:
        """Map of the scaled error xh - x over one tick, (4n, 4n)."""
        return self.transition + (self.transition @ self.correction) @ self.measure

    def controlled_state(self) -> Array:
        """Map of the scaled state over one tick with u = Kh x, (4n, 4n)."""
        return self.transition + self.force @ self.feedback


def make_loop(arm: Arm, setpoint: Setpoint, grid: SegmentGrid) -> Loop:
    """Put the model and the gains of one setpoint on the grid."""
    model = make_model(arm, setpoint.curvature_per_m, grid)
    K = operator_matrix(setpoint.controller, grid, COMMAND_PLACES, STATE_PLACES)
    scale = np.sqrt(2.0 * model.energy_weights)
    command_scale = np.sqrt(grid.dual_widths_m(COMMAND_PLACES[0]))
    gain = float(np.linalg.norm(command_scale[:, None] * K / scale.ravel(), 2))
    return Loop(
        model=model,
        L=operator_matrix(setpoint.observer, grid, STATE_PLACES, MEASUREMENT_PLACES),
        K=K,
        state_scale=scale.ravel(),
        measurement_scale=scale[:, MEASURED_STATES].ravel(),
        command_scale=command_scale / gain if gain > 0.0 else command_scale,
    )


def gain_rate(loop: Loop) -> float:
    """How fast the gains act, 1/s: the larger norm of K B and C L on scaled quantities.

    A tick longer than its inverse leaves nothing of the designed loop: the implicit step stays stable
    (no gain acts as more than 1 / tick) but neither observer nor controller is the certified one.
    """
    y, u = loop.measurement_scale, loop.command_scale
    feedback = u[:, None] * (loop.K @ loop.model.B) / u
    innovation = y[:, None] * (loop.model.C @ loop.L) / y
    return float(max(np.linalg.norm(feedback, 2), np.linalg.norm(innovation, 2)))


def make_step(loop: Loop, tick_s: float) -> Step:
    """Discretise one tick of length tick_s."""
    h, n = tick_s, len(loop.command_scale)
    x, y, u = loop.state_scale, loop.measurement_scale, loop.command_scale
    A = x[:, None] * loop.model.A / x
    B = x[:, None] * loop.model.B / u
    C = y[:, None] * loop.model.C / x
    L = x[:, None] * loop.L / y
    K = u[:, None] * loop.K / x
    p = IMPLICITNESS
    identity = np.eye(4 * n)
    solved = _solve(identity - p * h * A, np.hstack([identity / p, h * B]))
    scales = np.hstack([x.reshape(n, 4), u[:, None], y.reshape(n, 2)])
    return Step(
        transition=solved[:, : 4 * n] - (1.0 - p) / p * identity,
        force=solved[:, 4 * n :],
        correction=_solve(np.eye(2 * n) - h * (C @ L).T, h * L.T).T,
        measure=C,
        feedback=_solve(np.eye(n) - h * (K @ B), K),
        scale_in=scales.ravel(),
        scale_out=scales[:, :OUTPUTS].ravel(),
    )


def _solve(matrix: Array, right: Array) -> Array:
    return np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
