"""The rows of the Gram forms, chosen from the PDE's structure so that the programs have a strict interior.

Rows of the Lyapunov operator P are functions of the primary state x, rows of the inequality functions of the
fundamental state f. Both are polynomials phi_a(s) times x, or times int_0^s phi_b x and int_s^1 phi_b x, with
a + b <= degree. Two choices make the difference between a program that solves and one that stalls:

- Dissipation order. A state whose own equation has the derivative d^j can lose no more than its derivative
  m = j // 2 in L2 (parabolic: half of the order; wave-like: none). The inequality's rows are built on d^m x.
- Admissible kernels. A kernel row R may enter P only if its derivative along the dynamics, R A f, is again
  among the inequality's rows (or among the measurements, which Z can cancel): otherwise boundary values that
  nothing dominates force its Gram entries to zero. Those rows are a null space, computed to rounding. They
  are what the Krylov rows A^-1 x of theory, section 3, are for the arm, for any PDE.

Multiples also appear in Gram forms weighted with s and 1 - s: a polynomial that is positive on [0, 1] need not
be a sum of squares, and for transport the multiplier of P must fall along the flow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from design.legendre import Array
from design.operators import PIOperator, Shape, vertical
from design.pde import model
from design.pde.convert import Pie
from design.pde.model import Pde
from design.quadratic import lifted, unit_rows, weighted

_ADMISSIBLE = 1e-9
"""Largest share of a unit row's derivative outside the span that counts as rounding."""
_DEPENDENT = 1e-5
"""A unit row whose part outside the rows before it is smaller than this adds nothing."""

_UNBOUNDED = 1e-6
"""An output whose part outside the span of the rows is larger than this share of it is not bounded by them."""


@dataclass(frozen=True)
class Rows:
    """lyapunov: on x in R^m x L2^n; inequality, norm: on f. All have function outputs only; `multiples` are the
    rows without integrals, for the weighted Gram forms.

    norm: the rows whose squares the dissipation is measured in; top: the highest of them, to which a strict
    inequality gives a margin; state: x itself, ode states as constants.
    """

    lyapunov: PIOperator
    lyapunov_multiples: PIOperator | None
    inequality: PIOperator
    inequality_multiples: PIOperator | None
    norm: PIOperator
    top: PIOperator
    state: PIOperator


def functions(operator: PIOperator) -> PIOperator:
    """All outputs as functions: distributed ones as they are, then numbers as constants."""
    parts = []
    if operator.shape_out.functions:
        parts.append(operator.rows([], range(operator.shape_out.functions)))
    if operator.shape_out.finite:
        parts.append(lifted(operator.rows(range(operator.shape_out.finite), [])))
    return vertical(*parts) if parts else operator


def stack(*operators: PIOperator | None) -> PIOperator | None:
    """Vertical stack of those that are there."""
    present = [o for o in operators if o is not None and o.shape_out.functions]
    return vertical(*present) if present else None


ENDS = (np.array([0.5, 0.5 / np.sqrt(3.0)]), np.array([0.5, -0.5 / np.sqrt(3.0)]))
"""The weights s and 1 - s in the orthonormal basis."""


def weight(index: int) -> Array:
    """phi_index as a polynomial."""
    return np.asarray(np.eye(index + 1)[index])


def times(rows: PIOperator | None, degree: int) -> PIOperator | None:
    """Every row times phi_0 .. phi_degree."""
    if rows is None:
        return None
    return stack(*(weighted(rows, weight(a)) for a in range(degree + 1)))


def kernels(rows: PIOperator, degree: int) -> PIOperator | None:
    """phi_a int_0^s phi_b r and phi_a int_s^1 phi_b r for a + b <= degree."""
    if degree < 0:
        return None
    n = rows.shape_out.functions
    zero = PIOperator.zeros(Shape(0, n), Shape(0, n))
    lower = zero.replace(r1=np.eye(n)[:, :, None, None])
    upper = lower.adjoint
    out = []
    for b in range(degree + 1):
        inside = weighted(rows, weight(b))
        for integral in (lower @ inside, upper @ inside):
            out += [weighted(integral, weight(a)) for a in range(degree + 1 - b)]
    return vertical(*out)


def family(rows: PIOperator, degree: int) -> PIOperator | None:
    """Multiples and kernels of the rows."""
    return None if degree < 0 else stack(times(rows, degree), kernels(rows, degree))


@dataclass(frozen=True)
class Structure:
    """What the rows are built from: the levels (f -> d^j x_i, m_i - j) that state i can dissipate, and the end
    values that these do not bound. For a Pie by `structure`, for its dual by design.lpi.dual."""

    levels: tuple[tuple[PIOperator, int], ...]
    ends: PIOperator | None
    above: PIOperator | None = None
    """The derivatives one above the levels: products with them are traded by parts, if ends are dissipated."""


def build_rows(
    pie: Pie,
    structure: Structure,
    degree: int,
    measured: PIOperator | None = None,
    ends: PIOperator | None = None,
) -> Rows:
    """Rows for an LPI of this degree.

    measured: f -> outputs, what a gain Z may cancel. ends: the end values that can be dissipated.
    """
    m, n = pie.T.shape_in
    state = PIOperator.identity(Shape(m, n))
    ode = lifted(state.rows(range(m), [])) if m else None
    levels = structure.levels
    inequality = independent(
        stack(
            *(family(row, degree - below) for row, below in levels),
            times(ode, degree),
            times(ends, degree),
        )
    )
    allowed = [inequality]
    if measured is not None and measured.shape_out != Shape(0, 0):
        allowed.append(_nonempty(times(functions(measured), degree + 1)))
    if ends is not None and structure.above is not None:
        allowed.append(_nonempty(family(structure.above, degree)))
    multiples = stack(*(times(state.rows([], [i]), degree) for i in range(n)), times(ode, degree))
    candidates = kernels(state.rows([], range(n)), degree) if n else None
    smooth = _admissible(candidates, pie.A, vertical(*allowed)) if candidates else None
    norm = _nonempty(stack(*(row for row, _ in levels), ode))
    top = _nonempty(stack(*(row for row, below in levels if below == 0), ode))
    return Rows(
        lyapunov=unit_rows(_nonempty(stack(multiples, smooth))),
        lyapunov_multiples=(
            times(state.rows([], range(n)), degree - 1) if n and degree > 0 else None
        ),
        inequality=inequality,
        inequality_multiples=times(
            stack(*(row for row, below in levels if below == 0)), degree - 1
        ),
        norm=norm,
        top=top,
        state=functions(state),
    )


def unbounded(outputs: PIOperator, inequality: PIOperator) -> list[int]:
    """Places of the numbers f -> R that are not in the span of the rows: no V = <x, P x> can bound them."""
    found = []
    for k in range(outputs.shape_out.finite):
        row = lifted(outputs.rows([k], []))
        flat = flattened(vertical(inequality, row))
        size = np.linalg.norm(flat[-1])
        basis = flat[:-1] / np.maximum(np.linalg.norm(flat[:-1], axis=1), 1e-300)[:, None]
        rest = flat[-1] - basis.T @ np.linalg.lstsq(basis.T, flat[-1], rcond=1e-12)[0]
        if np.linalg.norm(rest) > _UNBOUNDED * size:
            found.append(k)
    return found


def dissipation_order(pde: Pde, state: int) -> int:
    """Half of the highest derivative of a state in its own equation, rounded down."""
    return _own_derivative(pde, state) // 2


def independent(rows: PIOperator | None) -> PIOperator:
    """Rows that depend on those before them left out (Gram-Schmidt on the coefficients, in order)."""
    rows = _nonempty(rows)
    flat = flattened(rows)
    norms = np.linalg.norm(flat, axis=1)
    basis = np.zeros((0, flat.shape[1]))
    keep = []
    for i in np.flatnonzero(norms > 1e-12):
        rest = flat[i] / norms[i]
        for _ in range(2):  # twice is enough
            rest = rest - basis.T @ (basis @ rest)
        length = np.linalg.norm(rest)
        if length > _DEPENDENT:
            basis = np.vstack([basis, rest / length])
            keep.append(int(i))
    return rows.rows([], keep)


def flattened(rows: PIOperator) -> Array:
    """The coefficients of each row as a vector: (rows, coefficients)."""
    sizes = [max(rows.r1.shape[k], rows.r2.shape[k]) for k in (2, 3)]

    def padded(kernel: Array) -> Array:
        grow = [
            (0, 0),
            (0, 0),
            *((0, size - have) for size, have in zip(sizes, kernel.shape[2:], strict=True)),
        ]
        return np.pad(kernel, grow)

    count = rows.shape_out.functions
    parts = (rows.q2, rows.r0, padded(rows.r1), padded(rows.r2))
    return np.concatenate([p.reshape(count, p.size // max(count, 1)) for p in parts], axis=1)


def structure(pie: Pie) -> Structure:
    """Levels and end values of a PDE's own PIE."""
    derivatives = {(i, j): row for i, j, row in pie.derivatives}
    places = [
        (i, dissipation_order(pie.pde, i) + 1)
        for i, variable in enumerate(pie.pde.states)
        if variable.order
    ]
    above = stack(*(derivatives[place] for place in places if place in derivatives))
    return Structure(levels=tuple(_levels(pie)), ends=_end_values(pie), above=above)


def _levels(pie: Pie) -> list[tuple[PIOperator, int]]:
    """(f -> d^j x_i, m_i - j) for j = m_i .. 0: what state i can dissipate, and all below it."""
    derivatives = {(i, j): row for i, j, row in pie.derivatives}
    levels = []
    place = 0
    for i, variable in enumerate(pie.pde.states):
        if variable.order is None:
            continue
        if variable.order == 0:
            levels.append((pie.T.rows([], [place]), 0))
        else:
            highest = min(dissipation_order(pie.pde, i), variable.order - 1)
            levels += [(derivatives[i, j], highest - j) for j in range(highest, -1, -1)]
        place += 1
    return levels


def _end_values(pie: Pie) -> PIOperator | None:
    """End values that the inequality's rows do not bound; which can be dissipated, the equalities tell."""
    ends = []
    for i, j, _, row in pie.ends:
        if j >= min(dissipation_order(pie.pde, i), (pie.pde.states[i].order or 1) - 1) and np.any(
            flattened(lifted(row))
        ):
            if _own_derivative(pie.pde, i) % 2 == 0 and dissipation_order(pie.pde, i) > 0:
                continue  # parabolic: end values below m are integrals already, those above are unbounded
            ends.append(lifted(row))
    found = stack(*ends)
    return None if found is None else independent(found)


def _own_derivative(pde: Pde, state: int) -> int:
    return max(
        (
            atom.derivative
            for atom, _ in pde.equations[state].terms
            if isinstance(atom, model.Field) and atom.state == state
        ),
        default=0,
    )


def _admissible(candidates: PIOperator, A: PIOperator, span: PIOperator) -> PIOperator | None:
    """Orthonormal combinations R of the candidates with R A f in the span of the given rows."""
    count = candidates.shape_out.functions
    flat = flattened(vertical(candidates @ A, span))
    norms = np.linalg.norm(flat, axis=1)
    norms[norms == 0.0] = 1.0
    flat = flat / norms[:, None]
    _, values, vectors = np.linalg.svd(flat[count:], full_matrices=False)
    inside = vectors[values > _ADMISSIBLE * values[0]]
    outside = flat[:count] - (flat[:count] @ inside.T) @ inside
    left, values, _ = np.linalg.svd(outside, full_matrices=True)
    values = np.concatenate([values, np.zeros(count - len(values))])
    combinations = (left[:, values < _ADMISSIBLE] / norms[:count, None]).T
    if not len(combinations):
        return None
    return _orthonormal(_combine(combinations, candidates))


def _orthonormal(rows: PIOperator) -> PIOperator:
    flat = flattened(rows)
    norms = np.linalg.norm(flat, axis=1)
    left, values, _ = np.linalg.svd(flat / norms[:, None], full_matrices=False)
    rank = int(np.count_nonzero(values > 1e-7 * values[0]))
    return _combine((left[:, :rank] / values[:rank]).T / norms, rows)


def _combine(matrix: Array, rows: PIOperator) -> PIOperator:
    return PIOperator.multiplier(matrix[:, :, None]) @ rows


def _nonempty(rows: PIOperator | None) -> PIOperator:
    if rows is None:
        raise ValueError("an LPI needs at least one state")
    return rows
