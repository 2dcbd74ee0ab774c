"""Arms with Kelvin-Voigt damping, normal actuators and strain-only sensors, deployed."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from deploy_artefacts import ARM, CURVED, gains, make_artefact

from deploy import deploy
from deploy.equilibrium import equilibrium
from deploy.grid import make_grid
from deploy.step import IMPLICITNESS, make_loop, make_step
from design import legendre
from design.arm_file import axial_ratio
from design.export import load_unit
from design.setpoint import Setpoint, equilibrium_load
from wire.artefact import Arm, GainsArtefact, PolynomialMatrix

OPTIONS: list[dict[str, Any]] = [
    {"kelvin_voigt_s": 0.4},
    {"actuator": "normal"},
    {"kelvin_voigt_s": 5.0, "actuator": "normal"},
]


def optional(**options: Any) -> GainsArtefact:
    return make_artefact([CURVED], msgspec.structs.replace(ARM, **options))


@pytest.mark.parametrize("options", OPTIONS)
def test_the_options_cost_no_number_in_a_message(options: dict[str, Any]) -> None:
    """tau G* G has the range of G*: the implicit step's off-diagonal ranks stay those of the plain arm."""
    plain, other = deploy(make_artefact([CURVED]), 12, 0.05), deploy(optional(**options), 12, 0.05)
    assert other.ranks_forward == plain.ranks_forward
    assert other.ranks_backward == plain.ranks_backward
    assert not np.allclose(other.dense[0].M, plain.dense[0].M, rtol=1e-6, atol=0.0)
    assert other.check < 1e-12


def test_a_tick_takes_out_the_drag_and_the_strain_rates() -> None:
    """|x|^2 of the scaled state falls by 2 h (damping of the midpoint) and by the step's own part."""
    arm = msgspec.structs.replace(ARM, kelvin_voigt_s=0.7)
    loop = make_loop(
        arm, make_artefact([CURVED], arm).setpoints[0], make_grid(1.25, 7, "equispaced")
    )
    h, p = 0.3, IMPLICITNESS
    x = np.random.default_rng(3).standard_normal(28)
    y = make_step(loop, h).transition @ x
    middle = p * y + (1.0 - p) * x
    scale = loop.state_scale
    rates = (scale[:, None] * loop.model.A0 / scale) @ np.where(np.arange(28) % 4 < 2, middle, 0.0)
    velocity = middle[np.arange(28) % 4 < 2]
    lost = ARM.drag_per_s * velocity @ velocity + 0.7 * rates @ rates
    change = (2.0 * p - 1.0) * (y - x) @ (y - x)
    assert y @ y - x @ x == pytest.approx(-2.0 * h * lost - change, rel=1e-10)


def test_noise_of_a_sensor_that_is_not_there_does_not_enter() -> None:
    observer, controller = gains()

    def without_velocity(matrix: PolynomialMatrix) -> PolynomialMatrix:
        array = matrix.array.copy()
        array[:, 0] = 0.0
        return PolynomialMatrix.from_array(array)

    strain_only = msgspec.structs.replace(
        observer,
        n0=without_velocity(observer.n0),
        n1b=without_velocity(observer.n1b),
        n2b=without_velocity(observer.n2b),
    )
    arm = msgspec.structs.replace(ARM, measured=["k"])
    deployed = deploy(make_artefact([CURVED], arm, [(strain_only, controller)]), 6, 0.05)
    columns = deployed.dense[0].M.reshape(30, 6, 7)
    assert not columns[:, :, 5].any()
    assert columns[:, :, 6].any()


@pytest.mark.parametrize("actuator", ["transverse", "normal"])
def test_design_and_deployment_hold_a_shape_by_the_same_load(actuator: str) -> None:
    """Two codes for one equilibrium: design.setpoint, nondimensional, and deploy.equilibrium, in SI."""
    arm: Arm = msgspec.structs.replace(ARM, actuator=actuator)
    c = 2.4
    curvature = np.array([c / 3.0, -c / 2.0, c / 6.0])  # c (1 - s/L)^2 as a Legendre series
    found = equilibrium(arm, curvature, "shape")
    setpoint = Setpoint("shape", legendre.from_plain(curvature * arm.length_m))
    load, strain = equilibrium_load(setpoint, axial_ratio(arm) ** 2, actuator)
    s = np.linspace(0.0, 1.0, 9)
    expected = legendre.basis(s, load.size) @ load * load_unit(arm)
    got = np.polynomial.legendre.legval(2.0 * s - 1.0, found.load_n_per_m)
    np.testing.assert_allclose(got, expected, atol=1e-8 * np.abs(expected).max())
    expected = legendre.basis(s, strain.size) @ strain
    got = np.polynomial.legendre.legval(2.0 * s - 1.0, found.strain)
    np.testing.assert_allclose(got, expected, atol=1e-9 * np.abs(expected).max())
