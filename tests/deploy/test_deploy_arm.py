"""The arm behind the stability check: exact sampling, the loop against a plain simulation."""

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from deploy_artefacts import ARM, CURVED, STRAIGHT, make_artefact
from scipy.linalg import expm

from deploy import deploy
from deploy.arm import ArmModes, make_arm_modes, sample
from deploy.grid import SegmentGrid, make_grid
from deploy.model import make_model
from deploy.stability import arm_loop, spectral_radius
from deploy.step import make_loop, make_step

Array = npt.NDArray[np.float64]


@pytest.mark.parametrize(
    ("drag", "retardation"), [(0.0, 0.0), (0.02, 0.0), (3.0, 0.0), (0.02, 0.8)]
)
def test_sampling_is_the_matrix_exponential(drag: float, retardation: float) -> None:
    frequency = np.array([0.05, 1.5, 40.0])  # overdamped, and the critical one, at drag 3
    load = np.array([[1.0], [2.0], [-1.0]])
    damping = drag + retardation * frequency**2
    modes = ArmModes(frequency, damping, load, np.ones((1, 3)), 2.0 * np.ones((1, 3)))
    transition, force, sense = sample(modes, 0.3)
    for i, w in enumerate(frequency):
        held = np.array([[-damping[i], -w, load[i, 0]], [w, 0.0, 0.0], [0.0, 0.0, 0.0]])
        exact = expm(0.3 * held)
        pair = np.ix_([i, 3 + i], [i, 3 + i])
        np.testing.assert_allclose(transition[pair], exact[:2, :2], atol=1e-12)
        np.testing.assert_allclose(force[[i, 3 + i], 0], exact[:2, 2], atol=1e-12)
    assert np.count_nonzero(transition) <= 12
    np.testing.assert_array_equal(sense, [[1.0, 1.0, 1.0, 2.0, 2.0, 2.0]])


@pytest.mark.parametrize("shape", [STRAIGHT, CURVED])
def test_loop_map_has_the_growth_of_a_plain_simulation(shape: list[float]) -> None:
    """Arm in SI by the matrix exponential, nodes by the dense step: same eigenvalues."""
    n, h, parts = 3, 0.05, 4
    artefact = make_artefact([shape])
    deployment = deploy(artefact, n, h)
    faces = np.linspace(0.0, ARM.length_m, parts * n + 1)
    arm = make_model(ARM, shape, SegmentGrid(faces))
    fine = parts * n
    load = np.zeros((fine, n))
    for j, s in enumerate(faces[1:]):
        for i in range(n):
            commands = np.zeros(n + 1)
            commands[i + 1] = 1.0
            commands[0] = commands[1]
            load[j, i] = np.interp(s, deployment.faces_m, commands)
    held = np.zeros((4 * fine + n, 4 * fine + n))
    held[: 4 * fine] = np.hstack([arm.A, arm.B @ load])
    exact = expm(h * held)[: 4 * fine]
    measure = np.zeros((n, 2, fine, 4))
    for i in range(n):
        measure[i, 0, parts * (i + 1) - 1, 1] = 1.0
        measure[i, 1, parts * i, 3] = 1.0
    M = deployment.dense[0].M.reshape(n, 5, n, 7)
    state = M[:, :, :, :5].reshape(5 * n, 5 * n)
    from_y = M[:, :, :, 5:].reshape(5 * n, 2 * n) @ measure.reshape(2 * n, 4 * fine)
    to_arm = np.zeros((4 * fine, n, 5))
    to_arm[:, :, 4] = exact[:, 4 * fine :]
    loop = np.block([[exact[:, : 4 * fine], to_arm.reshape(4 * fine, 5 * n)], [from_y, state]])
    plain = np.sort(np.abs(np.linalg.eigvals(loop)))[::-1]

    grid = make_grid(ARM.length_m, n, "equispaced")
    step = make_step(make_loop(ARM, artefact.setpoints[0], grid), h)
    checked = arm_loop(step, make_arm_modes(ARM, shape, grid), h)
    ours = np.sort(np.abs(np.linalg.eigvals(checked)))[::-1]
    np.testing.assert_allclose(ours[:40], plain[:40], rtol=1e-7)
    assert deployment.spectral_radius[0].arm == pytest.approx(plain[0], rel=1e-9)


def test_the_check_sees_what_the_model_does_not() -> None:
    """At a long tick model and model agree, but the real arm's high modes grow."""
    grid = make_grid(ARM.length_m, 10, "equispaced")
    loop = make_loop(ARM, make_artefact().setpoints[0], grid)
    radius = spectral_radius(make_step(loop, 0.6), make_arm_modes(ARM, STRAIGHT, grid), 0.6)
    assert radius.observer_error < 1.0
    assert radius.controlled_state < 1.0
    assert radius.arm > 1.0
    assert not radius.stable


def test_the_creep_of_overdamped_modes_is_sampled_without_overflow() -> None:
    """Far above critical the strain relaxes as exp(-t / tau), the velocity has gone at once."""
    w, tau, h = np.array([300.0]), 0.5, 0.1
    one = np.ones((1, 1))
    transition, force, _ = sample(ArmModes(w, tau * w**2, one, one, one), h)
    assert transition[1, 1] == pytest.approx(np.exp(-h / tau), rel=1e-3)
    assert abs(transition[0, 0]) < 1e-4
    assert force[1, 0] == pytest.approx((1.0 - np.exp(-h / tau)) / w[0], rel=1e-3)


def test_modes_of_an_arm_with_kelvin_voigt_damping_and_normal_actuators() -> None:
    """The same eigenvalues and the same response as the model in its own coordinates."""
    arm = msgspec.structs.replace(ARM, kelvin_voigt_s=0.3, actuator="normal")
    grid = make_grid(ARM.length_m, 9, "equispaced")
    modes = make_arm_modes(arm, CURVED, grid)
    fine = SegmentGrid(np.linspace(0.0, ARM.length_m, 4 * 9 + 1))
    model = make_model(arm, CURVED, fine)
    w, d = modes.frequency_rad_per_s, modes.damping_per_s
    roots = np.concatenate([np.roots([1.0, b, a * a]) for a, b in zip(w, d, strict=True)])
    found = np.linalg.eigvals(model.A)
    np.testing.assert_allclose(np.sort(found.real), np.sort(roots.real), rtol=1e-6, atol=1e-8)
    # static response y = -C A^-1 B u to one command, by the modes: w b = load u, a = 0
    hat = np.interp(fine.faces_m, grid.faces_m, np.eye(10)[4])[1:]
    state = -np.linalg.solve(model.A, model.B @ hat)
    np.testing.assert_allclose(
        modes.sense_b @ (modes.load[:, 3] / w),
        state.reshape(9, 4, 4)[:, [3, 0], [1, 3]].ravel(),
        atol=1e-9 * np.abs(state).max(),
    )


def test_many_segments_are_divided_less() -> None:
    sizes = [
        len(make_arm_modes(ARM, STRAIGHT, make_grid(1.0, n, "equispaced")).frequency_rad_per_s)
        for n in (3, 40, 160)
    ]
    assert sizes == [2 * 3 * 4, 2 * 40 * 2, 2 * 160]
