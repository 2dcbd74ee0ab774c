"""Equilibria along the way against shooting from first principles."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from closed_form import ARM
from numpy.polynomial import legendre
from statics import SETPOINT_2, SETPOINT_3, rest, tip_to_root

from deploy.equilibrium import equilibrium, inertia_load
from wire.artefact import Arm
from wire.errors import UsageError

Array = npt.NDArray[np.float64]
NORMAL = msgspec.structs.replace(ARM, actuator="normal")
PLACES = np.linspace(0.0, 1.0, 6)


def value(series: Array) -> Callable[[float], float]:
    return lambda s: float(legendre.legval(2.0 * s - 1.0, series))


@pytest.mark.parametrize("arm", [ARM, NORMAL], ids=["transverse", "normal"])
def test_the_load_holds_the_shape(arm: Arm) -> None:
    found = equilibrium(arm, SETPOINT_2, "shape")
    angle = legendre.legint(np.array(SETPOINT_2), lbnd=-1.0) * 0.5
    tip_angle = float(legendre.legval(1.0, angle))
    by_shooting = rest(arm, value(found.load_n_per_m), tip_angle, PLACES)
    x = 2.0 * PLACES - 1.0
    np.testing.assert_allclose(by_shooting[:, 0], legendre.legval(x, angle), atol=1e-7)
    np.testing.assert_allclose(
        by_shooting[:, 1:3].T, legendre.legval(x, found.position_m.T), atol=1e-7
    )
    bend = arm.bending_stiffness_n_m2 * legendre.legval(x, np.array(SETPOINT_2))
    np.testing.assert_allclose(by_shooting[:, 3], bend, atol=1e-9)


@pytest.mark.parametrize("arm", [ARM, NORMAL], ids=["transverse", "normal"])
def test_an_arm_that_accelerates_keeps_its_shape_under_the_load_for_it(arm: Arm) -> None:
    """N' = rho A a - f b beyond that at rest, by the trapezoidal rule: no part of N along n, so no bending."""
    acceleration = np.zeros((2, 96))
    acceleration[:, :4] = [[0.02, 0.03, 0.01, -0.004], [-0.03, 0.02, 0.01, 0.005]]
    extra = inertia_load(arm, np.array(SETPOINT_2), acceleration)
    mass, s = arm.mass_per_length_kg_per_m, np.linspace(0.0, 1.0, 4001)
    angle = legendre.legval(2.0 * s - 1.0, legendre.legint(np.array(SETPOINT_2), lbnd=-1.0) * 0.5)
    ax, ay = (legendre.legval(2.0 * s - 1.0, one) for one in acceleration)
    load = legendre.legval(2.0 * s - 1.0, extra)
    turned = 0.0 * angle if arm.actuator == "transverse" else angle

    def beyond(f: npt.ArrayLike) -> Array:
        f = np.asarray(f, dtype=np.float64)
        pieces = 0.5 * (f[1:] + f[:-1]) * np.diff(s)
        return np.append(np.cumsum(pieces[::-1])[::-1], 0.0)

    nx = beyond(-load * np.sin(turned) - mass * ax)
    ny = beyond(load * np.cos(turned) - mass * ay)
    across: Array = -np.sin(angle) * nx + np.cos(angle) * ny
    size = float(np.max(np.abs(beyond(load))))
    assert size > 1e-3
    np.testing.assert_allclose(across, 0.0, atol=1e-6 * size)


def test_shapes_that_no_load_holds_are_refused_by_name() -> None:
    steep = (1.4 * np.array(SETPOINT_3)).tolist()
    with pytest.raises(UsageError, match=r"that shape: the arm turns by 1\d\d\.\d degrees"):
        equilibrium(ARM, steep, "that shape")
    with pytest.raises(UsageError, match="that shape: no load holds this shape"):
        equilibrium(NORMAL, [60.0, -90.0, 30.0], "that shape")
    soft = msgspec.structs.replace(ARM, radius_m=0.3)
    with pytest.raises(UsageError, match="that shape: no transverse load holds this shape"):
        equilibrium(soft, SETPOINT_3, "that shape")


def test_along_the_normal_any_angle_can_be_held() -> None:
    curl = [3.0, -4.5, 1.5]  # 3 rad in all
    found = equilibrium(NORMAL, curl, "curl")
    root = tip_to_root(NORMAL, value(found.load_n_per_m), 3.0, PLACES)[-1]
    assert root[2] == pytest.approx(0.0, abs=1e-6)
