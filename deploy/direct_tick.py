"""One tick of observer and controller by a banded solve and two fixed points: what sweeps must equal.

Beside `deploy.structured`, from the same parts but without sums, reflections or ranks; a check for chains whose
dense matrix does not fit.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_banded

from deploy.separable import REACH
from deploy.step import IMPLICITNESS
from deploy.structured import StructuredStep
from wire.errors import OctarmError
from wire.factors import STATES

Array = npt.NDArray[np.float64]

MOST_ROUNDS = 400
WIDTH = STATES * (REACH + 1) - 1
"""Diagonals on either side of the model's matrix."""


def direct_tick(step: StructuredStep, inputs: Array) -> Array:
    """Scaled inputs (n, 7) to scaled outputs (n, 5), deviations from the setpoint.

    OctarmError if a gain is so strong for the tick that its fixed point is not reached.
    """
    h, p, n = step.tick_s, IMPLICITNESS, len(inputs)
    x, u, y = inputs[:, :STATES], inputs[:, STATES : STATES + 1], inputs[:, STATES + 1 :]

    def local(matrix: Array, vector: Array) -> Array:
        return np.asarray(np.einsum("nab,nb->na", matrix, vector))

    before = local(step.C, x) - y
    e = _fixed_point(lambda one: before + h * local(step.C, step.L(one)), before, "observer")
    corrected = x + h * step.L(e)
    ab = np.zeros((2 * WIDTH + 1, n * STATES))
    for o in range(-REACH, REACH + 1):
        rows = np.arange(max(0, -o), n - max(0, o))
        for a in range(STATES):
            for b in range(STATES):
                row, column = STATES * rows + a, STATES * (rows + o) + b
                ab[WIDTH + row - column, column] = -p * h * step.A[REACH + o, rows, a, b]
    ab[WIDTH] += 1.0
    right = corrected / p + h * local(step.B, u)
    z = solve_banded((WIDTH, WIDTH), ab, right.ravel()).reshape(n, STATES)
    after = z - (1.0 - p) / p * corrected
    wanted = step.K(after)
    command = _fixed_point(
        lambda one: wanted + h * step.K(local(step.B, one)), wanted, "controller"
    )
    return np.hstack([after, command])


def _fixed_point(function: Callable[[Array], Array], start: Array, what: str) -> Array:
    now = start
    for _ in range(MOST_ROUNDS):
        then = function(now)
        if np.max(np.abs(then - now)) <= 1e-15 * np.max(np.abs(then)):
            return then
        now = then
    raise OctarmError(
        f"{what}: no fixed point in {MOST_ROUNDS} rounds; the gain is strong for a tick of this length, check "
        "with `deploy` on fewer segments"
    )
