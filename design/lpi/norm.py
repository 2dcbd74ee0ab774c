"""The smallest c with |N f| <= c |D f|: norms of operators, the constants of Poincare and Wirtinger.

c^2 |D f|^2 - |N f|^2 must be a Gram form of rows made from D f. Every x that meets the boundary conditions is
T f for one f, so the conditions are in the operators already (chapter (9)).
"""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np

from design.lpi.inequality import Certificate
from design.lpi.rows import ENDS, family, functions, independent, stack, times
from design.lpi.sdp import GramProgram, Point
from design.pde.convert import Pie
from design.quadratic import coefficient_matrix, forms, unit_rows, weighted
from design.semidefinite import Layout

_NULL = 1e-7
"""Relative size below which the denominator of a polynomial counts as zero."""


class NormInequality:
    """c^2 |D f|^2 - |N f|^2 >= 0 with rows of one degree."""

    def __init__(self, pie: Pie, degree: int) -> None:
        self.degree = degree
        self.numerator = functions(pie.numerator)
        self.denominator = functions(pie.denominator)
        self.rows = unit_rows(independent(stack(family(self.denominator, degree), self.numerator)))
        self.multiples = times(self.denominator, degree - 1)

    @cached_property
    def program(self) -> GramProgram:
        """Number: c^2."""
        tables = [
            forms(self.numerator, self.numerator).trace() * 0.5,
            forms(self.denominator, self.denominator).trace() * -0.5,
            forms(self.rows, self.rows).upper(0.5),
        ]
        grams = [("inequality", self.rows.shape_out.functions)]
        if self.multiples is not None:
            for name, weight in zip(("inequality s", "inequality 1-s"), ENDS, strict=True):
                table = forms(weighted(self.multiples, weight), self.multiples)
                tables.append(table.upper(0.5))
                grams.append((name, self.multiples.shape_out.functions))
        layout = Layout(numbers=("c2",), free=0, grams=tuple(grams))
        return GramProgram(coefficient_matrix(tables), layout)

    def certificate(self, point: Point, sections: tuple[int, int] = (14, 20)) -> Certificate:
        """c, raised by what negative eigenvalues of the Gram matrices can do; the form's margin on sections.

        The rows are bounded by K |D f| (measured on the sections), so Gram matrices >= -eta give at most
        eta K^2 more.
        """
        rows = stack(self.rows, self.multiples)
        negative = max(
            (-float(np.linalg.eigvalsh(g)[0]) for g in point.grams.values() if g.size), default=0.0
        )
        values, margins = [], []
        for size in sections:
            D = self.denominator.discretise(size, size + 8)
            N = self.numerator.discretise(size, size + 8)
            scale = np.linalg.norm(D, axis=0)
            scale = scale.clip(1e-6 * scale.max())
            _, seen, axes = np.linalg.svd(D / scale, full_matrices=False)
            there = seen > _NULL * seen[0]  # where D f = 0, N f must vanish as well
            unit = (axes[there].T / seen[there]) / scale[:, None]  # columns with |D f| = 1
            unseen = np.linalg.norm((N / scale) @ axes[~there].T)
            bound = 0.0 if unseen <= _NULL * np.linalg.norm(N / scale) else math.inf
            if negative > 0.0 and rows is not None:
                R = rows.discretise(size, size + 2 * self.degree + 8) @ unit
                bound += float(np.linalg.norm(R, 2)) ** 2 * negative
            c2 = point.numbers["c2"] + bound
            margins.append(c2 - float(np.linalg.norm(N @ unit, 2)) ** 2)
            values.append(c2)
        change = abs(values[1] - values[0]) / max(abs(values[1]), 1e-300)
        return Certificate(
            P=None,
            Z=None,
            gamma=math.sqrt(max(values)) if max(values) > 0.0 else math.nan,
            margin=min(margins),
            coercivity=math.nan,
            change=change,
        )
