"""SI factors on SI functions against the nondimensional gain on scaled functions, for another arm."""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from numpy.polynomial import legendre as plain
from pi_reference import function_part, polynomial

from design.export import controller_factors, load_unit, observer_factors, state_units
from design.factors import GainFactors
from wire.artefact import Arm, OperatorFactors, PolynomialMatrix

Array = npt.NDArray[np.float64]
Function = Callable[[Array], Array]

LENGTH, RADIUS, MODULUS, DENSITY = 0.7, 0.03, 2.2e4, 950.0
ARM = Arm("short", LENGTH, RADIUS, MODULUS, DENSITY, 0.05)
AREA = math.pi * RADIUS**2
STIFFNESS = MODULUS * math.pi * RADIUS**4 / 4.0
TIME = LENGTH**2 * math.sqrt(DENSITY * AREA / STIFFNESS)
UNITS = np.array([LENGTH / TIME, LENGTH / TIME, RADIUS / (2.0 * LENGTH), 1.0 / LENGTH])
X, W = plain.leggauss(30)


def gain(q: int, m: int, ranks: tuple[int, int], seed: int = 1) -> GainFactors:
    rng = np.random.default_rng(seed)
    r1, r2 = ranks
    shapes = [(q, m, 2), (q, r1, 3), (r1, m, 4), (q, r2, 5), (r2, m, 3)]
    return GainFactors(*(rng.normal(size=shape) for shape in shapes))


def matrix_at(matrix: PolynomialMatrix, rows: int, columns: int, s: Array) -> Array:
    """Values (rows, columns, len(s)) of Legendre series in 2 s / L - 1."""
    out = np.zeros((rows, columns, s.size))
    for i in range(rows):
        for j in range(columns):
            out[i, j] = plain.legval(2.0 * s / LENGTH - 1.0, matrix.coefficients[i][j])
    return out


def apply_si(factors: OperatorFactors, q: int, m: int, function: Function, s: Array) -> Array:
    """(N x)(s) of chapter (6) in SI units, by Gauss rules on [0, s] and [s, L]."""
    r1, r2 = len(factors.n1b.coefficients), len(factors.n2b.coefficients)
    out = np.einsum("qms,ms->qs", matrix_at(factors.n0, q, m, s), function(s))
    for outer, inner, rank, low, high in (
        (factors.n1a, factors.n1b, r1, np.zeros_like(s), s),
        (factors.n2a, factors.n2b, r2, s, np.full_like(s, LENGTH)),
    ):
        for k in range(s.size):
            half = 0.5 * (high[k] - low[k])
            t = low[k] + half * (X + 1.0)
            inside = np.einsum("rma,ma,a->r", matrix_at(inner, rank, m, t), function(t), half * W)
            out[:, k] += matrix_at(outer, q, rank, s[k : k + 1])[:, :, 0] @ inside
    return np.asarray(out)


def compare(
    nondimensional: GainFactors, si: OperatorFactors, inputs: Array, outputs: Array
) -> None:
    """inputs, outputs: the SI value of one nondimensional unit of each component."""
    shape = polynomial(np.random.default_rng(4).normal(size=(inputs.size, 5)))
    points = np.array([0.0, 0.11, 0.4, 0.7])

    def function(s: Array) -> Array:
        return inputs[:, None] * shape(s / LENGTH)

    expected = function_part(nondimensional.operator(), np.zeros(0), shape)(points / LENGTH)
    expected = outputs[:, None] * expected
    got = apply_si(si, outputs.size, inputs.size, function, points)
    for row in range(outputs.size):
        scale = np.abs(expected[row]).max()
        np.testing.assert_allclose(got[row], expected[row], atol=1e-11 * scale)


@pytest.mark.parametrize("ranks", [(2, 3), (0, 2), (1, 0), (0, 0)])
def test_observer(ranks: tuple[int, int]) -> None:
    """Rates of the estimate, per second, from innovations in m/s and 1/m."""
    nondimensional = gain(4, 2, ranks)
    si = observer_factors(nondimensional, ARM)
    compare(nondimensional, si, UNITS[[1, 3]], UNITS / TIME)


def test_an_observer_that_sees_the_curvature_only_has_a_zero_column() -> None:
    """Innovations of the velocity, which nobody measures, leave its estimate alone."""
    strain_only = msgspec.structs.replace(ARM, measured=["k"])
    nondimensional = gain(4, 1, (2, 3))
    si = observer_factors(nondimensional, strain_only)
    for part in (si.n0, si.n1b, si.n2b):
        assert part.array.shape[1] == 2
        assert not part.array[:, 0].any()
    whole = GainFactors(
        n0=np.concatenate([np.zeros_like(nondimensional.n0), nondimensional.n0], axis=1),
        n1a=nondimensional.n1a,
        n1b=np.concatenate([np.zeros_like(nondimensional.n1b), nondimensional.n1b], axis=1),
        n2a=nondimensional.n2a,
        n2b=np.concatenate([np.zeros_like(nondimensional.n2b), nondimensional.n2b], axis=1),
    )
    compare(whole, si, UNITS[[1, 3]], UNITS / TIME)
    with pytest.raises(ValueError, match="1 inputs"):
        observer_factors(nondimensional, ARM)


@pytest.mark.parametrize("ranks", [(2, 3), (0, 2), (1, 0), (0, 0)])
def test_controller(ranks: tuple[int, int]) -> None:
    """N/m from m/s, m/s, 1 and 1/m."""
    nondimensional = gain(1, 4, ranks)
    si = controller_factors(nondimensional, ARM)
    compare(nondimensional, si, UNITS, np.array([STIFFNESS / LENGTH**3]))


def test_units_make_the_arm_nondimensional() -> None:
    """With them the bending equation rho A v_t = -EI k'' + f and k_t = v'' have coefficients one."""
    np.testing.assert_allclose(state_units(ARM), UNITS, rtol=1e-13)
    velocity, curvature, load = UNITS[1], UNITS[3], load_unit(ARM)
    inertia = DENSITY * AREA * velocity / TIME
    assert STIFFNESS * curvature / LENGTH**2 == pytest.approx(inertia, rel=1e-12)
    assert load == pytest.approx(inertia, rel=1e-12)
    assert velocity / LENGTH**2 == pytest.approx(curvature / TIME, rel=1e-12)
    # equal energies: rho A v^2 = EA e^2 = EI k^2
    energies = [DENSITY * AREA, DENSITY * AREA, MODULUS * AREA, STIFFNESS] * UNITS**2
    np.testing.assert_allclose(energies, energies[0], rtol=1e-12)
