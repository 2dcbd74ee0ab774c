"""The study of convergence: its references against closed forms and scipy, observed orders, refusals."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from closed_form import ARM, artefact
from scipy.integrate import quad, solve_bvp

from analysis.study import convergence
from analysis.study.continuum import apply_gain, arm_matrices, make_line
from analysis.study.rest import rest_gain, rest_tip
from deploy import DenseStep
from deploy.equilibrium import equilibrium
from design.arm_file import time_unit_s
from wire.artefact import GainsArtefact, OperatorFactors, PolynomialMatrix
from wire.errors import UsageError

Array = npt.NDArray[np.float64]

WEIGHTS = {"measurement_noise": 0.1, "control_effort": 0.1}


def balanced(gains: GainsArtefact) -> GainsArtefact:
    """The same with strain, load and tip of the exact equilibria."""
    setpoints = []
    for one in gains.setpoints:
        rest = equilibrium(gains.arm, one.curvature_per_m, one.name)
        changes = {
            "strain": rest.strain.tolist(),
            "feedforward_n_per_m": rest.load_n_per_m.tolist(),
            "tip_m": rest.position_m.sum(axis=1).tolist(),  # Legendre series at the end
        }
        setpoints.append(msgspec.structs.replace(one, **changes))
    return msgspec.structs.replace(gains, setpoints=setpoints, weights=WEIGHTS)


GAINS = balanced(artefact(strength=3.0))
CLAMPED_FREE = [1.8751040687119611, 4.694091132974175, 7.854757438237613]


def matrix(*rows: tuple[tuple[float, ...], ...]) -> PolynomialMatrix:
    return PolynomialMatrix([[list(entry) for entry in row] for row in rows])


# The references


def test_gains_are_applied_as_the_equation_says() -> None:
    """s x + (1 + s) int_0^s t x dt + int_s^L (t - 2) x dt with x = cos(3 t), by adaptive quadrature."""
    # Legendre series in x = s - 1 on [0, 2]: s = P0 + P1
    s, one = (1.0, 1.0), (1.0,)
    factors = OperatorFactors(
        n0=matrix((s,)), n1a=matrix(((2.0, 1.0),)), n1b=matrix((s,)),
        n2a=matrix((one,)), n2b=matrix(((-1.0, 1.0),)),
    )  # fmt: skip
    line, places = make_line(2.0, 24), np.array([0.0, 0.3, 1.1, 2.0])
    found = apply_gain(factors, line, places)[:, 0, :, 0] @ np.cos(3.0 * line.s_m)
    for here, value in zip(places, found, strict=True):
        before = quad(lambda t: t * math.cos(3.0 * t), 0.0, here)[0]
        after = quad(lambda t: (t - 2.0) * math.cos(3.0 * t), here, 2.0)[0]
        expected = here * math.cos(3.0 * here) + (1.0 + here) * before + after
        assert value == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("retardation_s", [0.0, 0.02])
def test_straight_arm_has_the_modes_of_a_beam(retardation_s: float) -> None:
    """Bending modes beta of a clamped beam: a^2 + (drag + tau beta^4) a + beta^4 = 0."""
    arm = msgspec.structs.replace(ARM, kelvin_voigt_s=retardation_s)
    unit = time_unit_s(arm)
    values = np.linalg.eigvals(arm_matrices(arm, GAINS.setpoints[0], 20).A)
    for beta in CLAMPED_FREE:
        damping = (arm.drag_per_s * unit) + retardation_s / unit * beta**4
        exact = np.roots([1.0, damping, beta**4])[0]
        assert np.min(np.abs(values - exact)) < 1e-8 * abs(exact)


@pytest.mark.parametrize("actuator", ["transverse", "normal"])
def test_rest_is_the_balance_of_the_exact_arm(actuator: str) -> None:
    """A load that bends the arm by more than a radian, against scipy's boundary value problem."""
    arm = msgspec.structs.replace(ARM, actuator=actuator)
    EA, EI, load = arm.axial_stiffness_n, arm.bending_stiffness_n_m2, 0.02
    faces = np.array([0.0, 0.2, 0.5, 1.0])

    def slopes(_: Array, y: Array) -> Array:
        angle, moment, north, west = y  # N = (-west, north)
        axial = -west * np.cos(angle) + north * np.sin(angle)
        shear = west * np.sin(angle) + north * np.cos(angle)
        along = angle if actuator == "normal" else np.zeros_like(angle)
        return np.stack(
            [
                moment / EI, -(1.0 + axial / EA) * shear,
                -load * np.cos(along), -load * np.sin(along),
            ]
        )  # fmt: skip

    s = np.linspace(0.0, 1.0, 50)
    solved = solve_bvp(
        slopes,
        lambda a, b: np.array([a[0], b[1], b[2], b[3]]),
        s,
        np.zeros((4, 50)),
        tol=1e-9,
        max_nodes=20000,
    )
    assert solved.success and solved.sol(1.0)[0] > 1.0
    x = np.linspace(0.0, 1.0, 20001)
    y = solved.sol(x)
    axial = -y[3] * np.cos(y[0]) + y[2] * np.sin(y[0])
    tip = [np.trapezoid((1.0 + axial / EA) * turn(y[0]), x) for turn in (np.cos, np.sin)]
    found = rest_tip(arm, faces, np.full(3, load), np.zeros(3))
    np.testing.assert_allclose(found, tip, atol=1e-7)
    # the same load, brought about by feedback of the curvature at the root only
    root = float(y[1, 0]) / EI
    feedback = np.zeros((3, 3))
    feedback[:, 0] = load / root
    held = rest_tip(arm, faces, np.zeros(3), np.zeros(3), 0.9 * feedback)
    assert np.hypot(*held) == pytest.approx(1.0, abs=1e-12)  # less than what would hold itself
    half = rest_tip(arm, faces, np.full(3, 0.9 * load), np.zeros(3), 0.1 * feedback)
    np.testing.assert_allclose(half, tip, atol=1e-7)


def test_rest_gain_is_where_the_tick_stays() -> None:
    random = np.random.default_rng(5)
    M = 0.2 * random.standard_normal((10, 14))
    deviation = random.standard_normal(2)
    state = np.zeros((2, 5))
    for _ in range(400):
        inputs = np.hstack([state, np.zeros((2, 1)), deviation[:, None]])
        state = DenseStep(M, np.zeros(14), np.zeros(10))(inputs)
    gain = rest_gain(DenseStep(M, np.zeros(14), np.zeros(10)))
    np.testing.assert_allclose(gain @ deviation, state[:, 4], rtol=1e-10)


# Observed orders


@pytest.fixture(scope="module")
def facts() -> dict[str, Any]:
    told: list[str] = []
    found = convergence.run(
        GAINS, told.append, nodes=(5, 10, 20), setpoints=("1",), ticks=0, jobs=1
    )
    assert told[-1] == "9 of 9 grids"
    return json.loads(json.dumps(found, allow_nan=False))  # type: ignore[no-any-return]


@pytest.fixture(scope="module")
def in_time() -> dict[str, Any]:
    return convergence.run(
        GAINS, lambda _: None, nodes=(5, 10), setpoints=("1",), spacings=("graded",),
        ticks=12, tick_s=0.5, jobs=1,
    )  # fmt: skip


@pytest.mark.parametrize("spacing", convergence.SPACINGS)
@pytest.mark.parametrize(
    ("quantity", "largest"),
    [
        ("observer gain", 3e-3),
        ("controller gain", 3e-3),
        ("observer gamma", 1e-2),
        ("observer eigenvalues", 5e-2),
        ("controller eigenvalues", 5e-2),
    ],
)
def test_second_order_on_every_spacing(
    facts: dict[str, Any], quantity: str, largest: float, spacing: str
) -> None:
    (row,) = (r for r in facts["rows"] if (r["quantity"], r["spacing"]) == (quantity, spacing))
    assert row["errors"][-1] < largest
    assert row["orders"][-1] == pytest.approx(2.0, abs=0.35)


def test_the_sampled_loop_converges_to_the_one_without_segments(in_time: dict[str, Any]) -> None:
    rows = {row["quantity"]: row for row in in_time["rows"]}
    assert rows["tip"]["errors"][-1] < 1.0  # mm, of 280 at the start
    assert rows["estimated shape"]["errors"][-1] < 3.0
    for quantity in ("tip", "estimated shape"):
        assert rows[quantity]["orders"] == pytest.approx([2.0], abs=0.35)
    assert rows["tip at rest"]["errors"][-1] < 0.01


def test_references_are_converged(facts: dict[str, Any], in_time: dict[str, Any]) -> None:
    own = facts["references"]["1"]["own_error"] | in_time["references"]["1"]["own_error"]
    assert own["observer gamma"] < 1e-10 and own["controller eigenvalues"] < 1e-10
    assert own["tip"] < 1e-4 and own["estimated shape"] < 1e-3  # mm


def test_orders_are_those_of_powers_and_stop_at_the_floor() -> None:
    found = convergence.orders([4, 8, 24], [3.0 / 16.0, 3.0 / 64.0, 3.0 / 576.0])
    np.testing.assert_allclose(np.array(found, dtype=np.float64), [2.0, 2.0])
    assert convergence.orders([4, 8, 16], [1.0, None, 0.1]) == [None, None]
    assert convergence.orders([4, 8], [1.0, 0.01], floor=0.02) == [None]


def test_table_and_plot(facts: dict[str, Any], tmp_path: Path) -> None:
    text = convergence.table(facts)
    row = next(r for r in facts["rows"] if r["spacing"] == "graded")
    assert f"{row['errors'][0]:.2g}" in text and f"{row['orders'][1]:.1f}" in text
    assert max(map(len, text.splitlines())) <= 120
    gone = {**facts, "rows": [{**row, "errors": [None, 0.1, 0.02], "orders": [None, 2.3]}]}
    assert "none" in convergence.table(gone)
    convergence.plot(gone, tmp_path / "p.png")
    assert (tmp_path / "p.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("choices", "message"),
    [
        ({"nodes": (5,)}, "at least two numbers"),
        ({"nodes": (1, 5)}, "of at least 2"),
        ({"spacings": ("even",)}, "'even': expected equispaced, chebyshev, graded"),
        ({"spacings": ()}, "at least one"),
        ({"setpoints": ("7",)}, "'7' is not in the gains artefact"),
        ({"ticks": -1}, "0 or more"),
        ({"initial": "crooked"}, "expected mode, "),
    ],
)
def test_refusals(choices: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        convergence.run(GAINS, lambda _: None, **choices)


def test_gains_without_weights_are_refused() -> None:
    with pytest.raises(UsageError, match="lack 'measurement_noise'"):
        convergence.run(artefact(), lambda _: None)


def test_the_given_example_is_a_division_of_the_arm() -> None:
    given = convergence.faces(2.0, 4, convergence.GRADED)
    assert given == pytest.approx((0.0, 0.25, 2.0 * 0.5**1.5, 2.0 * 0.75**1.5, 2.0))
    assert convergence.faces(2.0, 4, "chebyshev") == "chebyshev"
