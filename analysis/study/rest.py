"""Where the exact arm comes to rest under deployed commands: the static bias of a segment grid.

Called by `analysis.study.convergence`. The balance of the exact model (theory, sections 5 and 6),
    N = int_s^L u d ds,   EI theta' = int_s^L (1 + e) N.n ds,   EA e = N.t,   theta(0) = 0,
is solved by Newton's method in the curvature at Gauss points of every segment; no dynamics, no plant's
grid. The commands are the holding load alone, or with what observer and controller add at rest.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from numpy.polynomial import legendre

from deploy import DenseStep
from wire.artefact import Arm

Array = npt.NDArray[np.float64]

GAUSS = 6
"""Points a segment: the load is linear there, so the shape is smooth."""
MOST_STEPS = 50
TOLERANCE = 1e-12


@dataclass(frozen=True, eq=False)
class _Points:
    """Gauss points of all segments with their integrals, p of them; the load per command."""

    s_m: Array
    """(p,)."""
    weights_m: Array
    """(p,)."""
    from_root: Array
    """(p, p): int_0^s."""
    to_tip: Array
    """(p, p): int_s^L."""
    faces_to_tip: Array
    """(n, p): int from the inner faces to the tip."""
    load: Array
    """(p, n): what the arm carries there for unit commands, see `deploy.feedforward`."""


def _points(faces_m: Array) -> _Points:
    x, w = legendre.leggauss(GAUSS)
    degree = np.arange(GAUSS)
    higher = legendre.legvander(x, GAUSS)
    integral = np.empty((GAUSS, GAUSS))
    integral[:, 0] = 1.0 + x
    integral[:, 1:] = (higher[:, 2:] - higher[:, :-2]) / (2.0 * degree[1:] + 1.0)
    running = integral @ ((degree + 0.5) * higher[:, :-1] * w[:, None]).T
    n, half = len(faces_m) - 1, 0.5 * np.diff(faces_m)
    s = (faces_m[:-1, None] + half[:, None] * (x + 1.0)).ravel()
    weights = (half[:, None] * w).ravel()
    segment = np.repeat(np.arange(n), GAUSS)
    whole = (segment[None, :] < segment[:, None]) * weights
    from_root = whole + np.kron(np.diag(half), running)
    behind = segment[None, :] >= np.arange(n)[:, None]
    load = np.stack([np.interp(s, faces_m[1:], unit) for unit in np.eye(n)], axis=1)
    return _Points(s, weights, from_root, weights - from_root, behind * weights, load)


def rest_gain(step: DenseStep) -> Array:
    """What observer and controller command at rest per deviation of the curvatures, (n, n).

    The fixed point (xh, u) of the deployed tick for measurements that stay, v_y = 0. Raises
    numpy.linalg.LinAlgError if there is none.
    """
    n = step.M.shape[0] // 5
    blocks = step.M.reshape(5 * n, n, 7)
    own = blocks[:, :, :5].reshape(5 * n, 5 * n)
    fixed = np.linalg.solve(np.eye(5 * n) - own, blocks[:, :, 6])
    return np.asarray(fixed[4::5])


def rest_tip(
    arm: Arm, faces_m: Array, commands: Array, curvature: Array, feedback: Array | None = None
) -> Array:
    """Position (2,) in m of the tip at rest under commands + feedback (k - curvature).

    commands: (n,) in N/m; curvature: (n,) of the setpoint at the inner faces in 1/m, k the arm's
    there; feedback: (n, n), `rest_gain`, none for held commands. Raises ArithmeticError if Newton's
    method, started from the setpoint, does not converge.
    """
    at, n = _points(faces_m), len(commands)
    gain = np.zeros((n, n)) if feedback is None else feedback
    follow = arm.actuator == "normal"
    EA, EI = arm.axial_stiffness_n, arm.bending_stiffness_n_m2
    p = len(at.s_m)
    bend, inner = np.interp(at.s_m, faces_m[:-1], curvature), curvature.copy()
    for _ in range(MOST_STEPS):
        angle = at.from_root @ bend
        t, normal = np.exp(1j * angle), 1j * np.exp(1j * angle)
        along = normal if follow else np.full(p, 1j)
        u = at.load @ (commands + gain @ (inner - curvature))
        force = at.to_tip @ (u * along)
        axial, shear = (force * t.conj()).real, (force * normal.conj()).real
        e = axial / EA
        moment = (1.0 + e) * shear
        residual = np.concatenate(
            [bend - at.to_tip @ moment / EI, inner - at.faces_to_tip @ moment / EI]
        )
        # derivatives by (bend, inner)
        d_angle = np.hstack([at.from_root, np.zeros((p, n))])
        d_force = (at.to_tip * along) @ np.hstack([np.zeros((p, p)), at.load @ gain]).astype(
            complex
        )
        if follow:
            d_force = d_force + (at.to_tip * (-u * t)) @ d_angle
        d_axial = (d_force * t.conj()[:, None]).real + shear[:, None] * d_angle
        d_shear = (d_force * normal.conj()[:, None]).real - axial[:, None] * d_angle
        d_moment = shear[:, None] * d_axial / EA + (1.0 + e)[:, None] * d_shear
        jacobian = np.eye(p + n) - np.vstack([at.to_tip, at.faces_to_tip]) @ d_moment / EI
        change = np.linalg.solve(jacobian, residual)
        bend, inner = bend - change[:p], inner - change[p:]
        if np.max(np.abs(change)) * faces_m[-1] <= TOLERANCE * max(1.0, np.max(np.abs(bend))):
            tip = complex(at.weights_m @ ((1.0 + e) * t))
            return np.array([tip.real, tip.imag])
    raise ArithmeticError(f"no rest found in {MOST_STEPS} steps of Newton's method")
