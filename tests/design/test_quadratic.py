"""Quadratic forms of rows: coefficients against double integrals of random rows and functions."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from pi_reference import (
    at,
    function_part,
    inner,
    kernel_at,
    polynomial,
    random_operator,
    rule,
    values,
)

from design import quadratic
from design.operators import PIOperator, Shape
from design.quadratic import (
    FormTable,
    coefficient_matrix,
    forms,
    lifted,
    unit_rows,
    weighted,
)

Array = npt.NDArray[np.float64]
SPACES = [Shape(0, 1), Shape(0, 3), Shape(2, 2), Shape(2, 0)]
NAMES = [f"R{m} x L2^{n}" for m, n in SPACES]
ENDS = (np.zeros(1), np.ones(1))


def rows(space: Shape, count: int, seed: int) -> PIOperator:
    return random_operator(np.random.default_rng(seed), Shape(0, count), space)


def vectors(space: Shape, count: int = 4) -> list[tuple[Array, Array]]:
    rng = np.random.default_rng(77)
    return [
        (rng.normal(size=space.finite), rng.normal(size=(space.functions, 5))) for _ in range(count)
    ]


def table_value(table: FormTable, a: int, b: int, x: Array, y: Array) -> float:
    """x'Px + 2 int y'Qx + int y'R0 y + 2 int int_{t < s} y(s)'R1(s,t) y(t), by quadrature."""
    f = polynomial(y)
    s, w = (v[0] for v in rule(*ENDS))
    left = f(s)
    total = float(x @ table.p[a, b] @ x)
    total += 2.0 * float(np.einsum("nk,knm,m,k->", left, at(table.q[a, b], s), x, w))
    total += float(np.einsum("nk,knm,mk,k->", left, at(table.r0[a, b], s), left, w))
    t, v = rule(np.zeros_like(s), s)
    right = f(t.ravel()).reshape(-1, *t.shape)
    kernel = kernel_at(table.r1[a, b], np.broadcast_to(s[:, None], t.shape), t)
    total += 2.0 * float(np.einsum("nk,kanm,mka,ka,k->", left, kernel, right, v, w, optimize=True))
    return total


def product(one: PIOperator, a: int, other: PIOperator, b: int, x: Array, y: Array) -> float:
    """2 <row a of one, row b of other> at (x, y), from the definition of the operators."""
    f = function_part(one.rows([], [a]), x, polynomial(y))
    g = function_part(other.rows([], [b]), x, polynomial(y))
    return 2.0 * inner(np.zeros(0), f, np.zeros(0), g)


@pytest.mark.parametrize("space", SPACES, ids=NAMES)
def test_forms_are_the_inner_products(space: Shape) -> None:
    left, right = rows(space, 2, 1), rows(space, 3, 2)
    table = forms(left, right)
    assert table.p.shape[:2] == table.q.shape[:2] == table.r1.shape[:2] == (2, 3)
    for x, y in vectors(space):
        for a in range(2):
            for b in range(3):
                expected = product(left, a, right, b, x, y)
                assert abs(expected) > 1e-6
                got = table_value(table, a, b, x, y)
                assert got == pytest.approx(expected, rel=1e-10, abs=1e-10)


def test_rows_of_few_components_and_in_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Entries that are zero are left out and long products are cut into batches; the forms stay the same."""
    space = Shape(2, 3)
    left, right = rows(space, 4, 1), rows(space, 3, 2)
    left.q2[1], left.r0[1], left.r1[1], left.r2[1] = 0.0, 0.0, 0.0, 0.0  # a row of zeros
    left.q2[2], left.r1[2, :2], left.r2[2, 1] = 0.0, 0.0, 0.0
    right.r0[0], right.q2[1, 0], right.r1[2], right.r2[2, 2] = 0.0, 0.0, 0.0, 0.0
    whole = forms(left, right)
    for x, y in vectors(space):
        for a in range(4):
            for b in range(3):
                expected = product(left, a, right, b, x, y)
                assert abs(expected) > 1e-6 or a == 1
                got = table_value(whole, a, b, x, y)
                assert got == pytest.approx(expected, rel=1e-10, abs=1e-10)
    monkeypatch.setattr(quadratic, "_BATCH", 1)
    one_by_one = coefficient_matrix([forms(left, right)])
    np.testing.assert_allclose(one_by_one, coefficient_matrix([whole]), rtol=0.0, atol=1e-13)


def test_forms_hold_self_adjoint_operators() -> None:
    """P and R0 of every entry are symmetric matrices: the part that is not carries no information."""
    table = forms(rows(Shape(2, 3), 2, 1), rows(Shape(2, 3), 2, 2))
    np.testing.assert_allclose(table.p, table.p.transpose(0, 1, 3, 2), atol=1e-14)
    np.testing.assert_allclose(table.r0, table.r0.transpose(0, 1, 3, 2, 4), atol=1e-14)


def test_forms_refuse_rows_that_do_not_fit() -> None:
    rng = np.random.default_rng(0)
    one = rows(Shape(1, 2), 2, 1)
    with pytest.raises(ValueError, match="one space"):
        forms(one, rows(Shape(0, 2), 2, 2))
    with pytest.raises(ValueError, match="one space"):
        forms(one, random_operator(rng, Shape(1, 1), Shape(1, 2)))


@pytest.mark.parametrize("space", SPACES, ids=NAMES)
def test_symmetric_trace_sum_and_scale(space: Shape) -> None:
    left, right = rows(space, 3, 3), rows(space, 3, 4)
    table, other = forms(left, right), forms(right, rows(space, 3, 5))
    symmetric, trace, combined = table.symmetric(), table.trace(), table * -2.5 + other
    assert trace.p.shape[:2] == (1, 1)
    for x, y in vectors(space, 2):
        whole = sum(product(left, a, right, a, x, y) for a in range(3))
        assert table_value(trace, 0, 0, x, y) == pytest.approx(whole, rel=1e-10, abs=1e-10)
        for a in range(3):
            for b in range(3):
                plus = product(left, a, right, b, x, y) + product(left, b, right, a, x, y)
                got = table_value(symmetric, a, b, x, y)
                assert got == pytest.approx(plus, rel=1e-9, abs=1e-9)
                value = -2.5 * table_value(table, a, b, x, y) + table_value(other, a, b, x, y)
                assert table_value(combined, a, b, x, y) == pytest.approx(value, rel=1e-9, abs=1e-9)


def test_masked_and_repeated_tables() -> None:
    table = forms(rows(Shape(1, 2), 2, 3), rows(Shape(1, 2), 3, 4))
    keep = np.array([[True, False, True], [False, True, False]])
    for name in ("p", "q", "r0", "r1"):
        all_entries = getattr(table, name)
        expected = np.where(keep.reshape(2, 3, *[1] * (all_entries.ndim - 2)), all_entries, 0.0)
        np.testing.assert_array_equal(getattr(table.masked(keep), name), expected)
        total = table.masked(keep).trace().repeated(4)
        assert total.entries == (4, 1)
        diagonal = sum(all_entries[a, a] for a in range(2) if keep[a, a])
        np.testing.assert_allclose(getattr(total, name)[3, 0], diagonal, rtol=1e-14)


def test_upper_triangle_represents_a_gram_matrix() -> None:
    """sum over a <= b of G[a, b] upper(a, b) is <Psi xi, G Psi xi>, with the diagonal halved once."""
    space, count = Shape(1, 2), 3
    psi = rows(space, count, 6)
    gram = np.random.default_rng(8).normal(size=(count, count))
    gram = gram + gram.T
    i, j = np.triu_indices(count)
    upper = forms(psi, psi).upper(0.5)
    assert upper.p.shape[:2] == (6, 1)
    for x, y in vectors(space):
        direct = 0.5 * sum(
            gram[a, b] * product(psi, a, psi, b, x, y) for a in range(count) for b in range(count)
        )
        got = sum(gram[i[k], j[k]] * table_value(upper, k, 0, x, y) for k in range(6))
        assert got == pytest.approx(direct, rel=1e-10)


def test_matrix_vanishes_exactly_where_the_form_does() -> None:
    """Columns |r1 + r2|^2, |r1|^2, |r2|^2, <r1, r2>: one linear relation among them and no other."""
    space = Shape(2, 2)
    one, two = rows(space, 1, 1), rows(space, 1, 2)
    both = one + two
    matrix = coefficient_matrix(
        [forms(both, both), forms(one, one), forms(two, two), forms(one, two)]
    )
    assert matrix.shape[1] == 4
    relation = np.array([1.0, -1.0, -1.0, -2.0])
    size = float(np.abs(matrix).max())
    np.testing.assert_allclose(matrix @ relation, 0.0, atol=1e-12 * size)
    singular = np.linalg.svd(matrix, compute_uv=False)
    assert singular[2] > 1e-2 * singular[0]
    assert np.all(np.any(matrix != 0.0, axis=1))  # no row without a condition


def test_columns_keep_the_order_of_the_entries() -> None:
    left, right = rows(Shape(1, 1), 2, 1), rows(Shape(1, 1), 3, 2)
    whole = coefficient_matrix([forms(left, right), forms(left, left)])
    assert whole.shape[1] == 10
    entry = [forms(left.rows([], [a]), right.rows([], [b])) for a in range(2) for b in range(3)]
    entry += [forms(left.rows([], [a]), left.rows([], [b])) for a in range(2) for b in range(2)]
    np.testing.assert_allclose(whole, coefficient_matrix(entry), rtol=0.0, atol=1e-12)


def test_rounding_is_no_equality() -> None:
    one = rows(Shape(0, 1), 1, 1)
    table = forms(one, one)
    kernels = np.pad(table.r1, [(0, 0)] * 4 + [(0, 3), (0, 3)])
    kernels[..., -1, -1] = 1e-16
    noisy = FormTable(table.p, table.q, table.r0, kernels)
    np.testing.assert_array_equal(noisy.r1, kernels)
    assert coefficient_matrix([table]).shape == coefficient_matrix([noisy]).shape


def test_weighted_rows() -> None:
    space = Shape(1, 2)
    psi = rows(space, 2, 9)
    weight = np.array([0.3, -1.0, 0.5])
    got = weighted(psi, weight)
    s = np.linspace(0.0, 1.0, 5)
    for x, y in vectors(space, 2):
        expected = (values(s, 3) @ weight) * function_part(psi, x, polynomial(y))(s)
        np.testing.assert_allclose(
            function_part(got, x, polynomial(y))(s), expected, atol=1e-12 * np.abs(expected).max()
        )


def test_lifted_is_constant() -> None:
    finite = random_operator(np.random.default_rng(3), Shape(3, 0), Shape(2, 2))
    s = np.linspace(0.0, 1.0, 5)
    x, y = vectors(Shape(2, 2), 1)[0]
    t, w = (v[0] for v in rule(*ENDS))
    number = finite.p @ x + np.einsum("kpn,nk,k->p", at(finite.q1, t), polynomial(y)(t), w)
    got = function_part(lifted(finite), x, polynomial(y))(s)
    np.testing.assert_allclose(got, np.repeat(number[:, None], 5, axis=1), atol=1e-12)


def hilbert_schmidt(row: PIOperator) -> float:
    """Root of int |Q2|^2 + |R0|^2 ds + int int |R1|^2 (t < s) + |R2|^2 (t > s), by quadrature."""
    s, w = (v[0] for v in rule(*ENDS))
    total = float(np.einsum("kqm,kqm,k->", at(row.q2, s), at(row.q2, s), w))
    total += float(np.einsum("kqm,kqm,k->", at(row.r0, s), at(row.r0, s), w))
    for kernel, low, high in ((row.r1, np.zeros_like(s), s), (row.r2, s, np.ones_like(s))):
        t, v = rule(low, high)
        k = kernel_at(kernel, np.broadcast_to(s[:, None], t.shape), t)
        total += float(np.einsum("kaqn,kaqn,ka,k->", k, k, v, w))
    return float(np.sqrt(total))


def test_only_functions_are_weighted() -> None:
    numbers = random_operator(np.random.default_rng(3), Shape(1, 2), Shape(2, 2))
    with pytest.raises(ValueError, match="only functions"):
        weighted(numbers, np.ones(2))


def test_unit_rows_have_norm_one() -> None:
    """Exact where the kernel is one on both triangles or symmetric about the other diagonal."""
    rng = np.random.default_rng(4)
    space = Shape(2, 2)
    base = random_operator(rng, Shape(0, 4), space)
    smooth = base.replace(r2=base.r1)
    volterra = PIOperator.zeros(Shape(0, 1), space).replace(r1=np.full((1, 2, 1, 1), 7.0))
    for psi in (smooth, volterra):
        got = unit_rows(psi)
        for i in range(psi.shape_out.functions):
            row, before = got.rows([], [i]), psi.rows([], [i])
            assert hilbert_schmidt(row) == pytest.approx(1.0, rel=1e-12)
            factor = 1.0 / hilbert_schmidt(before)
            np.testing.assert_allclose(row.r1, before.r1 * factor, rtol=1e-12)
            np.testing.assert_allclose(row.q2, before.q2 * factor, rtol=1e-12)


def test_unit_rows_balance_any_row() -> None:
    got = unit_rows(random_operator(np.random.default_rng(5), Shape(0, 6), Shape(1, 3)) * 1e5)
    for i in range(6):
        assert 0.3 < hilbert_schmidt(got.rows([], [i])) < 3.0
