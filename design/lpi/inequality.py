"""The one inequality behind all tasks: stability, gain, observer, and state feedback as the adjoint's observer.

For T f_t = A f - B1 w, z = C1 f - D11 w, y = C2 f - D21 w find P >= delta I and Z such that for all f, w, z

    2 <T f, P (A f - B1 w)> + 2 <T f, Z (C2 f - D21 w)> + 2 <z, C1 f - D11 w>
        - gamma (|z|^2 + |w|^2) + epsilon |top f|^2 <= 0      (chapter (16), (18))

with x = T f: then V = <x, P x> proves |z| <= gamma |w| for T f_t = (A + L C2) f - (B1 + L D21) w, L = P^-1 Z,
and, as epsilon > 0, decay. The left side is a form in rows; its negative is a Gram form.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy import linalg

from design.lpi.rows import (
    ENDS,
    Rows,
    Structure,
    build_rows,
    functions,
    stack,
    times,
)
from design.lpi.sdp import GramProgram, Point
from design.operators import PIOperator, Shape, vertical
from design.pde.convert import Pie
from design.quadratic import FormTable, coefficient_matrix, forms, unit_rows, weighted
from design.semidefinite import Layout


@dataclass(frozen=True)
class Certificate:
    """P and Z, and what the inequality's form, recomputed from them, says on polynomial sections.

    gamma: the smallest for which the form is not positive (NaN where the state's part alone is not negative).
    margin: minus the largest eigenvalue of the state's part, relative to the norm rows. coercivity: smallest
    eigenvalue of P. change: relative change of gamma (of the margin without channels) between the sections.
    """

    P: PIOperator | None
    Z: PIOperator | None
    gamma: float
    margin: float
    coercivity: float
    change: float


class Inequality:
    """The inequality for one PIE and one degree.

    channels=False leaves w and z away (stability); measured=False leaves Z away; lossless=True asks for
    equality, a conserved V, instead of an inequality; weighed=True adds |C1 f|^2 (H2).
    """

    def __init__(
        self,
        pie: Pie,
        structure: Structure,
        degree: int,
        *,
        channels: bool = True,
        measured: bool = False,
        lossless: bool = False,
        ends: PIOperator | None = None,
        weighed: bool = False,
    ) -> None:
        self.pie = pie
        self.degree = degree
        self.measured = measured
        self.lossless = lossless
        self._levels = structure.levels
        none = Shape(0, 0)
        self._nz = pie.C1.shape_out if channels else none
        self._nw = pie.B1.shape_in if channels else none
        m, n = pie.T.shape_in
        self._finite = self._nz.finite + self._nw.finite
        self._functions = self._nz.functions + self._nw.functions
        eye = PIOperator.identity(Shape(self._finite + m, self._functions + n))
        self.z = eye.rows(range(self._nz.finite), range(self._nz.functions))
        self.w = eye.rows(
            range(self._nz.finite, self._finite), range(self._nz.functions, self._functions)
        )
        self.f = eye.rows(
            range(self._finite, self._finite + m), range(self._functions, self._functions + n)
        )
        self.x = pie.T @ self.f
        self.x_t = pie.A @ self.f
        if channels:
            self.x_t = self.x_t - pie.B1 @ self.w
            self.z_of = pie.C1 @ self.f - pie.D11 @ self.w
        if measured:
            self.y = pie.C2 @ self.f
            if channels:
                self.y = self.y - pie.D21 @ self.w
        self.weighed = functions(pie.C1) @ self.f if weighed else None
        self.rows: Rows = build_rows(pie, structure, degree, pie.C2 if measured else None, ends)

    @cached_property
    def gain_rows(self) -> PIOperator:
        """Rows on x that Z is made of: polynomials for numbers measured, the rows of P for functions."""
        if self.pie.C2.shape_out.functions:
            return self.rows.lyapunov
        both = times(self.rows.state, 2 * self.degree + 1)
        return both if both is not None else self.rows.state

    @cached_property
    def program(self) -> GramProgram:
        """The semidefinite program; numbers gamma (with channels), delta and epsilon."""
        tables, layout = self._tables()
        return GramProgram(coefficient_matrix(tables), layout)

    def _lyapunov_rows(self, of: PIOperator) -> PIOperator:
        """The rows of P applied to x or x_t."""
        return self.rows.lyapunov @ of

    def _tables(self) -> tuple[list[FormTable], Layout]:
        """All terms of the inequality, in the order of the layout's columns."""
        tables: list[FormTable] = []
        names: list[str] = []
        top = self.rows.top @ self.f
        epsilon = forms(top, top).trace() * 0.5
        constant = epsilon * 0.0
        if self.weighed is not None:
            constant = forms(self.weighed, self.weighed).trace() * 0.5
        inequality = [] if self.lossless else [self.rows.inequality @ self.f]
        if self._finite + self._functions:
            z, w = functions(self.z), functions(self.w)
            channels = stack(z, w)
            if channels is None:
                raise ValueError("an inequality with channels needs a signal")
            if sum(self._nz):
                constant = forms(z, functions(self.z_of)).trace()
            tables.append(forms(channels, channels).trace() * -0.5)
            names.append("gamma")
            inequality = [*self._channel_rows(), *inequality]
        names += ["delta", "epsilon"]
        x, x_t = functions(self.x), functions(self.x_t)
        tables += [forms(x, x_t).trace(), epsilon]
        free = 0
        if self.measured:
            z_table = forms(self.gain_rows @ self.x, functions(self.y))
            free = z_table.p.shape[0] * z_table.p.shape[1]
            tables.append(z_table)
        Px, Px_t = self._lyapunov_rows(self.x), self._lyapunov_rows(self.x_t)
        tables.append(forms(Px, Px_t).symmetric().upper(0.5))
        grams = [("P", Px.shape_out.functions)]
        for name, end in zip(("P s", "P 1-s"), ENDS, strict=True):
            multiples = self.rows.lyapunov_multiples
            if multiples is not None:
                table = forms(weighted(multiples @ self.x, end), multiples @ self.x_t)
                tables.append(table.symmetric().upper(0.5))
                grams.append((name, multiples.shape_out.functions))
        if inequality:
            rows = unit_rows(vertical(*inequality))
            tables.append(forms(rows, rows).upper(0.5))
            grams.append(("inequality", rows.shape_out.functions))
            for name, end in zip(("inequality s", "inequality 1-s"), ENDS, strict=True):
                if self.rows.inequality_multiples is not None:
                    multiples = self.rows.inequality_multiples @ self.f
                    tables.append(forms(weighted(multiples, end), multiples).upper(0.5))
                    grams.append((name, multiples.shape_out.functions))
        layout = Layout(numbers=tuple(names), free=free, grams=tuple(grams))
        return [constant, *tables], layout

    def _channel_rows(self) -> list[PIOperator]:
        """Numbers as constants times polynomials, functions plain.

        A number meets the state in integrals like w int_0^1 h x with h = (A^-1)* B1, which completing the
        square needs: as many polynomials as the profile and the integrations by parts can make.
        """
        out = []
        highest = self.degree + max(0, 2 * max((below for _, below in self._levels), default=0) - 1)
        profile = self.pie.B1.q2.shape[2] - 1 if self._nw.finite else 0
        for signal, degree in ((self.z, highest), (self.w, highest + profile)):
            finite = signal.rows(range(signal.shape_out.finite), [])
            if finite.shape_out.finite:
                spread = times(functions(finite), degree)
                if spread is not None:
                    out.append(spread)
            if signal.shape_out.functions:
                out.append(signal.rows([], range(signal.shape_out.functions)))
        return out

    def operators(self, point: Point) -> tuple[PIOperator, PIOperator | None]:
        """P = delta I + R* G R + weighted multiples, and Z from a point of the program."""
        rows = self.rows.lyapunov
        own = point.grams["P"][-rows.shape_out.functions :, -rows.shape_out.functions :]
        gram = PIOperator.multiplier(own[:, :, None])
        P = PIOperator.identity(self.pie.T.shape_out) * point.numbers["delta"]
        P = P + rows.adjoint @ gram @ rows
        for name, end in zip(("P s", "P 1-s"), ENDS, strict=True):
            multiples = self.rows.lyapunov_multiples
            if multiples is not None:
                gram = PIOperator.multiplier(point.grams[name][:, :, None] * end)
                P = P + multiples.adjoint @ gram @ multiples
        if not self.measured:
            return P, None
        out = self.pie.C2.shape_out
        lift = functions(PIOperator.identity(out))
        zeta = PIOperator.multiplier(
            point.free.reshape(self.gain_rows.shape_out.functions, -1)[:, :, None]
        )
        return P, self.gain_rows.adjoint @ zeta @ lift

    def certificate(
        self, P: PIOperator, Z: PIOperator | None, sections: tuple[int, int] = (14, 20)
    ) -> Certificate:
        """Judge P and Z by composition and eigenvalues on f of degree below each of the sections.

        No Gram matrix and no solver value enters but those in P and Z.
        """
        half = self.x.adjoint @ (P @ self.x_t)
        if Z is not None:
            half = half + self.x.adjoint @ (Z @ self.y)
        if self.weighed is not None:
            half = half + (self.weighed.adjoint @ self.weighed) * 0.5
        if sum(self._nz):
            half = half + self.z.adjoint @ self.z_of
        try:
            found = [self._on_section(half, P, size) for size in sections]
        except linalg.LinAlgError:  # a norm too ill-conditioned to say anything
            found = [(float("nan"), float("-inf"), float("-inf"))] * 2
        gammas = [f[0] for f in found]
        margins = [f[1] for f in found]
        values = gammas if self._finite + self._functions else margins
        change = abs(values[1] - values[0]) / max(abs(values[1]), 1e-12)
        return Certificate(
            P=P,
            Z=Z,
            gamma=max(gammas) if np.all(np.isfinite(gammas)) else float("nan"),
            margin=min(margins),
            coercivity=min(f[2] for f in found),
            change=float(change),
        )

    def _on_section(self, half: PIOperator, P: PIOperator, size: int) -> tuple[float, float, float]:
        matrix = half.discretise(size)
        matrix = matrix + matrix.T
        m = self.pie.T.shape_in.finite
        channel = np.zeros(len(matrix), bool)
        channel[: self._finite] = True
        first = self._finite + m
        channel[first : first + self._functions * size] = True
        norm = self.rows.norm.discretise(size, size + 8)
        weight = norm.T @ norm
        scale = np.sqrt(np.diag(weight).clip(1e-300))  # f's high degrees count little in the norm
        state = matrix[np.ix_(~channel, ~channel)] / scale[:, None] / scale
        weight = weight / scale[:, None] / scale
        largest = float(linalg.eigh(state, weight, eigvals_only=True)[-1])
        coercive = P.discretise(size)
        smallest = float(np.linalg.eigvalsh(coercive + coercive.T)[0]) / 2.0
        if not channel.any():
            return float("nan"), -largest, smallest
        if largest >= 0.0:
            return float("nan"), -largest, smallest
        cross = matrix[np.ix_(channel, ~channel)] / scale
        factor = linalg.cho_factor(-state)
        reduced = matrix[np.ix_(channel, channel)] + cross @ linalg.cho_solve(factor, cross.T)
        return float(np.linalg.eigvalsh(reduced)[-1]), -largest, smallest


def dissipated_ends(pie: Pie, structure: Structure, measured: bool) -> PIOperator | None:
    """End values whose squares some V can dissipate, as rows of constants; None if there are none.

    Found by the equalities of an inequality of low degree alone (higher where coefficients vary): a square that
    no P can make is forced to zero, and rows of that kind would only spoil the program (they are unbounded in
    the norm).
    """
    ends = structure.ends
    if ends is None:
        return None
    structure = replace(structure, above=None)  # which are dissipated is asked without their help
    degree = 1 + min((_coefficient_degree(pie) + 1) // 2, 3)
    rows = build_rows(pie, structure, degree, pie.C2 if measured else None, ends)
    bounded = build_rows(pie, structure, degree, pie.C2 if measured else None).inequality
    inequality = unit_rows(vertical(bounded, ends))
    P = rows.lyapunov
    power = forms(P @ pie.T, P @ pie.A)
    tables = [power.trace() * 0.0, power.symmetric().upper(0.5)]
    tables.append(forms(inequality, inequality).upper(0.5))
    grams = [("P", P.shape_out.functions), ("inequality", inequality.shape_out.functions)]
    for name, end in zip(("s", "1-s"), ENDS, strict=True):
        # without the weights, a coefficient of odd degree would force squares, too
        multiples = rows.lyapunov_multiples
        if multiples is not None:
            table = forms(weighted(multiples @ pie.T, end), multiples @ pie.A)
            tables.append(table.symmetric().upper(0.5))
            grams.append((f"P {name}", multiples.shape_out.functions))
        multiples = rows.inequality_multiples
        if multiples is not None:
            tables.append(forms(weighted(multiples, end), multiples).upper(0.5))
            grams.append((f"inequality {name}", multiples.shape_out.functions))
    layout = Layout(numbers=(), free=0, grams=tuple(grams))
    program = GramProgram(coefficient_matrix(tables), layout)
    kept = program.kept["inequality"] - bounded.shape_out.functions
    places = [int(k) for k in kept if k >= 0]
    return ends.rows([], places) if places else None


def _coefficient_degree(pie: Pie) -> int:
    """By how many degrees in s A exceeds T: those of the PDE's coefficients, about."""
    of_A, of_T = (
        max(a.r0.shape[2], a.r1.shape[2], a.r2.shape[2], a.q2.shape[2]) for a in (pie.A, pie.T)
    )
    return int(max(of_A - of_T, 0))
