"""H2: the variance of z under white noise w, as an LPI, for a system and for its observer.

With 2 <T f, P A f + Z C2 f> + |C1 f|^2 <= 0, the error of the observer L = P^-1 Z has the H2 norm
tr((P B1 + Z D21)* P^-1 (P B1 + Z D21))^(1/2) at the most, and tr W bounds the trace if the form

    <w, W w> + 2 <x, (P B1 + Z D21) w> + <x, P x>  >=  0.

Both forms share one Gram matrix: that of P, with rows of constants w added. w must be finite-dimensional: the
variance of distributed white noise is infinite.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
import numpy.typing as npt

from design.lpi.gains import gain_operator
from design.lpi.inequality import Inequality
from design.lpi.rows import ENDS, Structure, functions, times
from design.lpi.sdp import GramProgram
from design.operators import PIOperator, Shape, vertical
from design.pde.convert import Pie
from design.quadratic import FormTable, coefficient_matrix, forms, weighted
from design.semidefinite import Layout


class H2Inequality(Inequality):
    """The two forms for one degree; number `mu` is the trace of W, the square of the H2 norm."""

    def __init__(
        self,
        pie: Pie,
        structure: Structure,
        degree: int,
        *,
        measured: bool = False,
        ends: PIOperator | None = None,
    ) -> None:
        super().__init__(
            pie, structure, degree, channels=False, measured=measured, ends=ends, weighed=True
        )
        count = pie.B1.shape_in.finite
        constants = functions(PIOperator.identity(Shape(count, 0)))
        profile = pie.B1.q2.shape[2]
        spread = times(constants, degree + profile - 1)
        self._noise = constants if spread is None else spread

    def _lyapunov_rows(self, of: PIOperator) -> PIOperator:
        rows = super()._lyapunov_rows(of)
        silent = PIOperator.zeros(Shape(0, self._noise.shape_out.functions), rows.shape_in)
        return vertical(silent, rows)

    @cached_property
    def program(self) -> GramProgram:
        """Numbers delta, epsilon, mu; the equalities of both forms and that of the trace."""
        tables, layout = self._tables()
        matrix = np.concatenate(
            [coefficient_matrix(tables), coefficient_matrix(self._cross(layout))]
        )
        before = 1 + len(layout.numbers)
        matrix = np.insert(matrix, before, 0.0, axis=1)
        trace = np.zeros(matrix.shape[1])
        trace[before] = -1.0
        i, j = np.triu_indices(dict(layout.grams)["P"])
        first = before + 1 + layout.free
        trace[first + np.flatnonzero((i == j) & (i < self._noise.shape_out.functions))] = 1.0
        wide = Layout((*layout.numbers, "mu"), layout.free, layout.grams)
        return GramProgram(np.vstack([matrix, trace]), wide)

    def _cross(self, layout: Layout) -> list[FormTable]:
        """2 <x, (P B1 + Z D21) w> minus the Gram form's part that has both x and w, on (w, x)."""
        count = self.pie.B1.shape_in.finite
        m, n = self.pie.T.shape_in
        eye = PIOperator.identity(Shape(count + m, n))
        w = eye.rows(range(count), [])
        state = eye.rows(range(count, count + m), range(n))
        driven = self.pie.B1 @ w
        rows = self.rows.lyapunov
        delta = forms(functions(state), functions(driven)).trace()
        numbers = {"delta": delta, "epsilon": delta * 0.0}
        tables = [delta * 0.0, *(numbers[name] for name in layout.numbers)]
        if self.measured:
            noise = functions(self.pie.D21 @ w)
            tables.append(forms(self.gain_rows @ state, noise))
        of_noise = self._noise @ w
        both = vertical(of_noise, rows @ state)
        drive = vertical(of_noise * 0.0, rows @ driven)
        own = forms(both, drive).symmetric()
        cross = forms(both, both)
        first = of_noise.shape_out.functions
        total = both.shape_out.functions
        kind = np.arange(total) < first
        in_p = ~kind[:, None] & ~kind
        mixed = kind[:, None] ^ kind
        tables.append((_masked(own, in_p) + _masked(cross, mixed) * -1.0).upper(0.5))
        for name, size in layout.grams[1:]:
            multiples = self.rows.lyapunov_multiples
            if name.startswith("P") and multiples is not None:
                end = ENDS[0] if name == "P s" else ENDS[1]
                table = forms(weighted(multiples @ state, end), multiples @ driven)
                tables.append(table.symmetric().upper(0.5))
            else:
                entries = size * (size + 1) // 2
                tables.append(_repeated(delta * 0.0, entries))
        return tables

    def bound(self, P: PIOperator, Z: PIOperator | None) -> float:
        """The H2 norm that P and Z prove, from the operators: tr((P B1 + Z D21)* (B1 + L D21))^(1/2)."""
        driven, forced = self.pie.B1, P @ self.pie.B1
        if Z is not None:
            gain, _ = gain_operator(P, Z)
            driven = driven + gain @ self.pie.D21
            forced = forced + Z @ self.pie.D21
        return float(np.sqrt(np.trace((forced.adjoint @ driven).p)))


def _masked(table: FormTable, keep: npt.NDArray[np.bool_]) -> FormTable:
    """The entries (a, b) that are kept, the others zero."""
    return FormTable(
        *(
            x * keep.reshape(*keep.shape, *[1] * (x.ndim - 2))
            for x in (table.p, table.q, table.r0, table.r1)
        )
    )


def _repeated(table: FormTable, count: int) -> FormTable:
    """A (1, 1) table as a (count, 1) table."""
    return FormTable(*(np.repeat(x, count, axis=0) for x in (table.p, table.q, table.r0, table.r1)))
