"""The arm at a setpoint as a partial integral equation T f_t = A f + B w (theory, section 2).

Nondimensional energy states x = (v_x, v_y, e, k): velocity in the fixed frame, axial strain times alpha,
curvature perturbation; fundamental state f = (t.v' alpha, (n.v')', N'), so that the conservative part of
the dynamics is a permutation of f and skew-adjoint for EVERY polynomial frame t, n. |x|^2 is twice the
energy in units of EI / L.

With G v = (alpha t.v', (n.v')') and strains s = (e, k) the arm and its adjoint system are
    v_t =  -G*(s + tau G v) - d v,   s_t =  G v       T f = (V (p, q), -V* g - tau (p, q))
    v_t =   G*(s - tau G v) - d v,   s_t = -G v       T f = (V (p, q), -V* g + tau (p, q))
with V = G^-1 and g = N', the viscous part included. The retardation time tau of the Kelvin-Voigt damping
is in T, not in A, and with tau > 0 the two systems differ in T: a problem of the arm is posed with
(`T`, `A`, `inverse()`), its adjoint with (`T_adjoint`, `A_adjoint`, `inverse(adjoint=True)`), always as
x = T f and x_t = A f. T then has a multiplier on the strains; <x, x_t> = -d |v|^2 - tau |(p, q)|^2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from design import legendre
from design.legendre import Array
from design.operators import PIOperator, Shape, horizontal, vertical
from wire.artefact import ACTUATORS

STATES = ("v_x", "v_y", "e", "k")
PAIR = Shape(0, 2)


@dataclass(frozen=True, eq=False)
class ArmPIE:
    """T f_t = (conservative + dissipative) f; see `arm_pie`."""

    alpha: float
    drag: float
    retardation: float
    """tau of the Kelvin-Voigt damping, in units of time; 0: none."""
    normal: Array
    """n = (-sin, cos) theta_e in the polynomial frame, coefficients (2, d)."""
    virtual: PIOperator
    """K: strain rates (p, q) -> velocity, v(s) = int_0^s t p + int_0^s (int_z^s n) q dz."""
    elastic: PIOperator
    """T without Kelvin-Voigt damping, the same for both systems."""
    conservative: PIOperator
    dissipative: PIOperator

    @property
    def T(self) -> PIOperator:
        """f -> x."""
        return self._with_viscous_strain(-self.retardation)

    @property
    def T_adjoint(self) -> PIOperator:
        """f -> x of the adjoint system; that of the arm if there is no Kelvin-Voigt damping."""
        return self._with_viscous_strain(self.retardation)

    def _with_viscous_strain(self, factor: float) -> PIOperator:
        if factor == 0.0:
            return self.elastic
        r0 = np.zeros((4, 4, 1))
        r0[2:, :2, 0] = factor * np.eye(2)
        return self.elastic.replace(r0=r0)

    @property
    def A(self) -> PIOperator:
        """The dynamics of the arm, f -> x_t."""
        return self.conservative + self.dissipative

    @property
    def A_adjoint(self) -> PIOperator:
        """f -> x_t of the adjoint system, x = T_adjoint f (theory, 3, 'Controller without the trap')."""
        return self.dissipative - self.conservative

    def command(self, actuator: str) -> PIOperator:
        """x -> the velocity that does work with the command: v_y, or n.v for a normal force.

        It is B2* for the controller's problem; B2 itself is its adjoint. Raises ValueError for another
        actuator than `wire.artefact.ACTUATORS`.
        """
        if actuator == "transverse":
            return selection("v_y")
        if actuator == "normal":
            row = np.zeros((1, 4, self.normal.shape[1]))
            row[0, :2] = self.normal
            return PIOperator.multiplier(row)
        raise ValueError(f"actuator: expected one of {ACTUATORS}, got {actuator!r}")

    @cached_property
    def _compliance(self) -> PIOperator:
        return PIOperator.multiplier(np.diag([1.0 / self.alpha, 1.0])[:, :, None])

    def inverse(self, *, adjoint: bool = False) -> PIOperator:
        """y = A^-1 x on the primary states (4 -> 4), or of the adjoint dynamics.

        A y = x reads, with K sc the map from strains (e, k) to displacement:
        y_v = +-K sc (e, k) and y_s = -+ sc K* (v + d y_v) - tau (e, k). It follows that y_t = x along the
        dynamics, so moments of y differentiate to moments of x (`design.moments`).
        """
        sign = -1.0 if adjoint else 1.0
        to_displacement = self.virtual @ self._compliance
        to_moment = self._compliance @ self.virtual.adjoint
        identity = PIOperator.identity(Shape(0, 4))
        velocity, strain = identity.rows([], [0, 1]), identity.rows([], [2, 3])
        y_v = (to_displacement @ strain) * sign
        y_s = (to_moment @ (velocity + y_v * self.drag)) * (-sign)
        if self.retardation > 0.0:
            y_s = y_s - strain * self.retardation
        return vertical(y_v, y_s)


def arm_pie(
    cosine: Array, sine: Array, alpha: float, drag: float, retardation: float = 0.0
) -> ArmPIE:
    """Build the PIE from polynomial frame coefficients (orthonormal basis), alpha = L sqrt(EA/EI), drag d.

    `retardation`: tau of Kelvin-Voigt damping. Raises ValueError if the frame's two polynomials differ in
    length or tau is negative.
    """
    if not retardation >= 0.0:
        raise ValueError(f"retardation: expected a time, zero or positive, got {retardation!r}")
    if cosine.shape != sine.shape:
        raise ValueError(
            f"frame polynomials of lengths {cosine.size} and {sine.size}; expected equal"
        )
    size = cosine.size
    step = legendre.integration(size, size + 1)
    tangent = np.stack([cosine, sine])
    normal_integral = np.stack([-(sine @ step), cosine @ step])
    kernel = np.zeros((2, 2, size + 1, size + 1))
    kernel[:, 0, 0, :size] = tangent
    kernel[:, 1, :, 0] += normal_integral
    kernel[:, 1, 0, :] -= normal_integral
    zero = PIOperator.zeros(PAIR, PAIR)
    one = PIOperator.identity(PAIR)
    virtual = zero.replace(r1=kernel)
    compliance = PIOperator.multiplier(np.diag([1.0 / alpha, 1.0])[:, :, None])
    velocity = virtual @ compliance  # f carries alpha t.v', so that A has no large entries
    return ArmPIE(
        alpha=alpha,
        drag=drag,
        retardation=retardation,
        normal=np.stack([-sine, cosine]),
        virtual=virtual,
        elastic=vertical(
            horizontal(velocity, zero), horizontal(zero, (compliance @ virtual.adjoint) * -1.0)
        ),
        conservative=vertical(horizontal(zero, one), horizontal(one, zero)),
        dissipative=vertical(horizontal(velocity * -drag, zero), horizontal(zero, zero)),
    )


def functional(*states: str) -> PIOperator:
    """x -> (int_0^1 x_i ds) for the named states: R^len(states) from 4 functions; see `STATES`."""
    q1 = _picked(states)[:, :, None]
    return PIOperator.zeros(Shape(len(states), 0), Shape(0, 4)).replace(q1=q1)


def selection(*states: str) -> PIOperator:
    """x -> the named states as functions; see `STATES`."""
    return PIOperator.multiplier(_picked(states)[:, :, None])


def _picked(states: tuple[str, ...]) -> Array:
    """Rows of the identity; ValueError if a name is unknown."""
    for name in states:
        if name not in STATES:
            raise ValueError(f"unknown state {name!r}; expected one of {STATES}")
    return np.eye(4)[[STATES.index(name) for name in states]]
