"""A PDE as small matrices, by a spectral method: the independent check of what the LPIs certify.

Shares no code with the conversion to a PIE or with PI operators, only the Legendre basis. The states are
polynomials that meet all conditions exactly. Tested with the same polynomials (Galerkin), the equations keep
what is dissipative in plain L2; but where conditions couple states that count differently in the energy,
fast modes grow that are none of the PDE's. Tested with all polynomials below a degree (the Legendre tau
method) they keep every energy with constant weights, so that is what is done.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy import linalg

from design.channel import Channel
from design.legendre import Array
from design.pde.model import Pde
from design.pde.trial_space import TrialSpace, trial_space

Method = Literal["tau", "galerkin"]
_SINGULAR = 1e13
"""Condition number of the mass matrix above which the tau method has no solution."""
_NEVER = 1e-11
"""|denominator| below this share of its largest value is zero."""


@dataclass(frozen=True, eq=False)
class System:
    """q_t = A q + B1 w + B2 u, z = C1 q + D11 w + D12 u, y = C2 q + D21 w + D22 u.

    |q| is the norm of the state in R^m x L2. Signals: the scalar ones in the PDE's order, then for every
    distributed one `size` coefficients in orthonormal Legendre functions; |w|, |u|, |z|, |y| are L2 norms.
    state: (odes + n rows, len(q)), the primary state: ode states, then `rows` Legendre coefficients of each
    of the n functions. force: (len(q), odes + n rows), what a right-hand side in that form adds to q_t.
    """

    A: Array
    B1: Array
    B2: Array
    C1: Array
    D11: Array
    D12: Array
    C2: Array
    D21: Array
    D22: Array
    state: Array
    force: Array
    odes: int
    size: int
    rows: int
    method: Method

    @cached_property
    def _modes(self) -> tuple[npt.NDArray[np.complex128], npt.NDArray[np.complex128]]:
        values, vectors = np.linalg.eig(self.A)
        return values.astype(np.complex128), vectors.astype(np.complex128)

    @property
    def eigenvalues(self) -> npt.NDArray[np.complex128]:
        """Of A; the fastest ones are not the PDE's."""
        return self._modes[0]

    def abscissa(self) -> float:
        """Largest real part of the eigenvalues."""
        return float(self.eigenvalues.real.max())

    def grows(self) -> bool:
        """Whether a mode grows by more than rounding; those of a conservative PDE do not."""
        return bool(np.any(self._growing))

    def undecided(self) -> bool:
        """Whether modes grow, but only some with over 10 % of their energy in the top third of degrees.

        These need not be the PDE's: conditions that amplify, with damping inside that makes up for it, bring
        them about at every size. Then neither `grows` nor an infinite `gain` says anything.
        """
        return self.grows() and bool(np.all(self._tails[self._growing] > 0.1))

    @property
    def _growing(self) -> npt.NDArray[np.bool_]:
        sizes = np.abs(self.eigenvalues)
        return np.asarray(self.eigenvalues.real > 1e-9 * sizes + 1e-14 * sizes.max())

    @property
    def _tails(self) -> Array:
        """Share of every mode's energy in the top third of the Legendre coefficients."""
        energy = np.abs(self.state @ self._modes[1]) ** 2
        functions = energy[self.odes :].reshape(-1, self.rows, energy.shape[1])
        return np.asarray(functions[:, 2 * self.rows // 3 :].sum(axis=(0, 1)) / energy.sum(axis=0))

    def gain(self) -> float:
        """H-infinity norm from w to z without control; infinite unless every mode decays."""
        return Channel(self.A, self.B1, self.C1, self.D11).hinf_norm()


def discretise(pde: Pde, size: int, method: Method = "tau") -> System:
    """The matrices with polynomials of degree below `size` + order for each state.

    The tau method has no solution where the Legendre functions that the tests do not see meet the conditions
    by themselves, as for periodic x and even `size`. Then all states get a degree more, or every second one;
    Galerkin's method, named in the result, is the last resort. Raises ValueError if there are not as many
    independent conditions as the orders of the states add up to, or if a term does not fit to its state or
    place.
    """
    if method == "tau":
        plain, step = (size,) * len(pde.states), range(len(pde.states))
        for sizes in (plain, tuple(n + 1 for n in plain), tuple(size + i % 2 for i in step)):
            space = trial_space(pde, size, sizes)
            basis, tests = _basis_and_tests(space)
            if np.linalg.cond(tests @ basis) < _SINGULAR:
                return _system(space, basis, tests, "tau")
    space = trial_space(pde, size)
    basis, _ = _basis_and_tests(space)
    return _system(space, basis, basis.T, "galerkin")


def _spans(space: TrialSpace) -> list[tuple[int, int | None]]:
    """Ode states, then functions: place in the PDE, and number of coefficients of its equation."""
    spans = [(i, None if s.order is None else space.top) for i, s in enumerate(space.pde.states)]
    return sorted(spans, key=lambda span: span[1] is not None)


def _basis_and_tests(space: TrialSpace) -> tuple[Array, Array]:
    """From q to the coefficients of the state, and from those of the equations to their tests."""
    pde, spans = space.pde, _spans(space)
    basis = np.vstack([_padded(space.derivatives[i][0], n or 1) for i, n in spans])
    tests = linalg.block_diag(*(space.tests(i) for i, _ in spans))
    if len(tests) != space.dimension:
        wanted = sum(s.order or 0 for s in pde.states)
        raise ValueError(
            f"{pde.name or 'PDE'}: {wanted + len(tests) - space.dimension} independent conditions, "
            f"but the orders of the states add up to {wanted}: there must be as many"
        )
    return basis, tests


def _system(space: TrialSpace, basis: Array, tests: Array, method: Method) -> System:
    pde, size, spans = space.pde, space.size, _spans(space)
    sources = [space.matrices(pde.equations[i], n) for i, n in spans]
    mass = tests @ basis
    A, B1, B2 = (
        np.linalg.solve(mass, tests @ np.vstack(blocks)) for blocks in zip(*sources, strict=True)
    )
    C1, D11, D12 = space.outputs(pde.regulated, size)
    C2, D21, D22 = space.outputs(pde.measured, size)
    kept = np.concatenate([np.arange(n or 1) < space.rows for _, n in spans])
    force = np.asarray(np.linalg.solve(mass, tests[:, kept]), dtype=np.float64)
    odes = sum(n is None for _, n in spans)
    return System(
        A, B1, B2, C1, D11, D12, C2, D21, D22, basis[kept], force, odes, size, space.rows, method
    )


def norm_ratio(pde: Pde, size: int) -> float:
    """The smallest c with |numerator| <= c |denominator| for the polynomials that meet the conditions.

    Degrees as in `discretise`. Infinite if the denominator vanishes for a state where the numerator does
    not.
    """
    space = trial_space(pde, size)
    over, under = (space.outputs(o, space.top).q for o in (pde.numerator, pde.denominator))
    _, values, axes = np.linalg.svd(under)
    rank = int(np.sum(values > _NEVER * values.max(initial=0.0)))
    if np.linalg.norm(over @ axes[rank:].T) > 1e-9 * np.linalg.norm(over):
        return float("inf")
    ratios = np.linalg.svd(over @ (axes[:rank].T / values[:rank]), compute_uv=False)
    return float(ratios.max(initial=0.0))


def _padded(coefficients: Array, rows: int) -> Array:
    return np.pad(coefficients, [(0, rows - len(coefficients)), (0, 0)])
