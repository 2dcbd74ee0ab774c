"""The observer of section 4.1: grid, gains, error dynamics, schedule, truncation."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from analysis.study.simulate import simulate
from chapter.constants import CORRECTED, PRINTED, Constants
from chapter.observer_beside import TICK_S, lpi_injection
from chapter.observer_cases import (
    lmi_origin,
    lpi_origin,
    noise_to_nothing,
    run_facts,
    setpoint_gains,
    straight_runs,
)
from chapter.observer_findings import axial_residual_n_per_m, growth_with_gains_per_s
from chapter.observer_grid import INITIAL, GridError, disturbance, grid_error, propagate
from chapter.observer_schedule import (
    chapter_outputs,
    chapter_ticks,
    estimated_shape,
    observe,
    setpoint_chords,
    shipped_ticks,
)
from chapter.observer_straight import (
    Origin,
    below_after_s,
    energy_system,
    first_mode_rate_per_s,
    fitted_rate_per_s,
    grid_lmi,
    run,
    slowest_rate_per_s,
    unit_s,
)
from chapter.observer_truncation import (
    ARM,
    bands,
    exact_growth_per_s,
    growth_per_s,
    leaves_after_s,
    stretched,
    truncation_error,
)
from chapter.pde import SETPOINTS, STRAIGHT
from deploy.deployment import offsets
from deploy.grid import make_grid
from plant.differences import differences
from plant.disturbance import DisturbanceSpec
from plant.initial import initial_shape
from plant.model import ArmPlant, PlantParameters
from plant.truncated import TruncatedModel, first_order
from supervise.shipped import DEFAULT_GAINS
from wire.artefact import GainsArtefact, read_artefact
from wire.run_config import NoiseConfig

FACTS = Path(__file__).resolve().parents[2] / "docs" / "chapter" / "facts.json"


@pytest.fixture(scope="module")
def artefact() -> GainsArtefact:
    return read_artefact(DEFAULT_GAINS)


@pytest.mark.parametrize("setpoint", SETPOINTS, ids=lambda one: one.name)
def test_the_grid_matrices_are_the_linearised_truncated_model(setpoint: object) -> None:
    """(5), corrected, by differences: against the products of (2) with the setpoint's exact derivatives."""
    one = next(s for s in SETPOINTS if s is setpoint)
    s = np.arange(1, 11) / 10
    dw = np.array([one.w.deriv(j)(s) if j else one.w(s) for j in range(5)])
    model = TruncatedModel(
        CORRECTED.axial_n, CORRECTED.bending_n_m2, CORRECTED.mass_kg_m, differences(10, 1.0)
    )
    wanted = first_order(model.linear(np.zeros((5, 10)), dw))
    found = grid_error(one, CORRECTED).A
    np.testing.assert_allclose(found, wanted, atol=1e-14 * np.abs(wanted).max())


def test_the_initial_condition_and_its_regulated_output() -> None:
    """z tends to w_sss(0) = -16 with the grid's first order; the sum of the fourth differences to 2/3 of it."""
    assert (INITIAL(0.0), INITIAL.deriv()(0.0), INITIAL.deriv(2)(1.0)) == (0.0, 0.0, 0.0)
    assert INITIAL.deriv(3)(1.0) == pytest.approx(8.0)
    roots, sums = [], []
    for cells in (10, 40, 80, 160):
        model = grid_error(STRAIGHT, CORRECTED, cells=cells)
        start = model.initial()
        assert model.tip @ start == pytest.approx(-1.0 / 3.0)
        roots.append(float(model.root @ start) + 16.0)
        sums.append(float(model.mean[2] @ start) + 32.0 / 3.0)
    for errors in (roots, sums):
        assert abs(errors[-1]) < 0.2
        assert math.log2(errors[1] / errors[2]) == pytest.approx(1.0, abs=0.1)


def test_error_dynamics_against_an_adaptive_solver() -> None:
    model = grid_error(STRAIGHT, CORRECTED)
    times = np.arange(0.0, 30.0, 0.02)
    found = propagate(model.A, -model.B, model.initial(), times, disturbance(times))

    def rates(t: float, e: np.ndarray) -> np.ndarray:
        return np.asarray(model.A @ e - model.B * disturbance(np.array(t)))

    wanted = solve_ivp(
        rates, (0.0, times[-1]), model.initial(), method="DOP853", rtol=1e-10, atol=1e-12
    ).y[:, -1]
    np.testing.assert_allclose(found[-1], wanted, atol=3e-6)


def test_the_energy_of_the_undamped_error_stays() -> None:
    model = grid_error(STRAIGHT, PRINTED)
    times = np.arange(0.0, 800.0, 1.0)
    states = propagate(model.A, -model.B, model.initial(), times, np.zeros(times.size))
    energy = np.linalg.norm(states @ model.energy.T, axis=1)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-9)


def _hamiltonian_touches(A: np.ndarray, B: np.ndarray, C: np.ndarray, gamma: float) -> bool:
    """Whether the H-infinity norm of C (s - A)^-1 B is at least gamma (bounded real lemma)."""
    matrix = np.block([[A, B @ B.T / gamma], [-C.T @ C / gamma, -A.T]])
    values = np.linalg.eigvals(matrix)
    return bool(np.min(np.abs(values.real) / np.abs(values)) < 1e-7)


def test_gains_of_16_keep_their_gamma_and_a_large_epsilon_costs() -> None:
    model = grid_error(STRAIGHT, CORRECTED)
    system = energy_system(model, CORRECTED, slice(20, 40))
    soft, hard = (grid_lmi(CORRECTED, epsilon)[0] for epsilon in (1.0, 10.0))
    assert soft is not None
    assert hard is not None
    for one in (soft, hard):
        assert one.achieved <= one.gamma * (1.0 + 1e-3)
        loop = system.A + one.gain @ system.outputs
        drive = np.hstack([system.B, one.gain * system.noise])
        z = system.outputs[1:]
        assert not _hamiltonian_touches(loop, drive, z, 1.01 * one.achieved)
        assert _hamiltonian_touches(loop, drive, z, 0.99 * one.achieved)
    assert hard.gamma > 1.4 * soft.gamma
    assert hard.decay > 2.0 * soft.decay
    assert np.linalg.norm(hard.gain) > 2.0 * np.linalg.norm(soft.gain)


def test_gamma_is_the_weight_of_the_noise_on_the_regulated_output() -> None:
    for one in noise_to_nothing().values():
        assert one["gamma"] == pytest.approx(one["weight_of_y2"], rel=0.01)


def test_no_reasonable_gain_for_5_at_a_setpoint() -> None:
    found = setpoint_gains(SETPOINTS[0])
    assert found == {"lmi_solved": False, "riccati_gain_above_1e6": True}


def _tip_times(origin: Origin) -> tuple[float | None, float | None]:
    one = run(PRINTED, origin, units=8.0)
    return below_after_s(one.times_s, one.tip_m, 0.1), below_after_s(one.times_s, one.tip_m, 0.01)


def test_the_error_converges_with_gains_and_not_without() -> None:
    """Fig. 4a with the printed rho: the tip's error, and the rates that eigenvalues predict."""
    assert _tip_times(Origin("none", None)) == (None, None)
    damped = lpi_origin(PRINTED, 1.0, drag=True)
    tenth, hundredth = _tip_times(damped)
    assert tenth is not None
    assert hundredth is not None
    assert tenth == pytest.approx(909.0, rel=0.02)
    assert hundredth == pytest.approx(2060.0, rel=0.02)
    assert fitted_rate_per_s(PRINTED, damped) == pytest.approx(
        slowest_rate_per_s(PRINTED, damped), rel=0.05
    )
    # a factor of ten every ln 10 / rate
    assert hundredth - tenth == pytest.approx(
        -math.log(10.0) / first_mode_rate_per_s(PRINTED, damped), rel=0.15
    )
    undamped = lpi_origin(PRINTED, 1.0, drag=False)
    assert 0.0 < slowest_rate_per_s(PRINTED, undamped) < 2e-4
    grid, _ = lmi_origin(PRINTED, 10.0)
    assert fitted_rate_per_s(PRINTED, grid) == pytest.approx(
        slowest_rate_per_s(PRINTED, grid), rel=1e-3
    )


@pytest.mark.parametrize("constants", [PRINTED, CORRECTED], ids=["rho", "rho A"])
def test_fig_4_in_the_documentation_is_what_comes_out_today(constants: Constants) -> None:
    """How far the error decays and by when: the numbers beside the pictures."""
    written = json.loads(FACTS.read_text())["observer"]["numbers"]["straight"][constants.name]
    for one in straight_runs(constants):
        found = run_facts(constants, one)
        for output in ("tip", "z"):
            for key, value in written[one.origin.name][output].items():
                wanted = None if value is None else pytest.approx(value, rel=0.02)
                assert found[output][key] == wanted, (output, key)
        for at, value in written[one.origin.name]["tip_envelope_m"].items():
            assert found["tip_envelope_m"][at] == pytest.approx(value, rel=0.1)  # two digits
    assert written["no correction"]["tip"]["below_10_s"] is None
    assert written["(18), drag"]["tip"]["below_1_s"] < 3e3 / unit_s(PRINTED) * unit_s(constants)


def test_the_mass_sets_the_time_and_nothing_else() -> None:
    light, heavy = (
        run(one, lpi_origin(one, 1.0, drag=True), units=2.0, load=0.0)
        for one in (CORRECTED, PRINTED)
    )
    slower = unit_s(PRINTED) / unit_s(CORRECTED)
    assert slower == pytest.approx(math.sqrt(1.1e3 / 2.15984), rel=1e-5)
    late = np.interp(slower * light.times_s[::200], heavy.times_s, heavy.tip_m)
    np.testing.assert_allclose(late, light.tip_m[::200], atol=1e-4)


def test_5_grows_at_setpoints_as_its_leading_terms_say_and_1_does_not() -> None:
    """On 40 cells only the lower band is there; on grids that see k_2 the growth is another."""
    for setpoint in SETPOINTS[:2]:
        limit = bands(setpoint, CORRECTED)
        fine = growth_per_s(setpoint, CORRECTED, cells=40)
        assert 0.8 * limit.growth_per_s < fine < limit.growth_per_s
        assert exact_growth_per_s(setpoint, CORRECTED) < 1e-6
        assert growth_with_gains_per_s(setpoint) == pytest.approx(
            growth_per_s(setpoint, CORRECTED), rel=0.02
        )
    one = bands(SETPOINTS[0], CORRECTED)
    assert one.below_per_m * one.above_per_m == pytest.approx(6400.0)  # alpha^2
    # k_2 = 263/m is beyond what 80 cells carry, pi / step = 251/m
    assert growth_per_s(SETPOINTS[0], CORRECTED, cells=80) < one.growth_per_s
    assert growth_per_s(SETPOINTS[0], CORRECTED, cells=160) > 10.0 * one.growth_per_s


def test_2_leaves_from_the_chapters_initial_condition() -> None:
    """As the adaptive solver and the plant's own integrator find; a twentieth of it stays."""
    slow = leaves_after_s(PRINTED, "corrected", until_s=60.0)
    fast = leaves_after_s(CORRECTED, "corrected", until_s=60.0, load=0.0)
    assert slow == pytest.approx(7.88, abs=0.02)
    assert fast is not None
    faces = tuple(np.linspace(0.0, 1.0, 11).tolist())
    parameters = PlantParameters(ARM, faces, 1e-3, stretched(INITIAL), model="quadratic")
    plant = ArmPlant(parameters)
    ticks = 0
    while np.isfinite(plant.tip()).all() and ticks < 1000:
        plant.advance(np.zeros(10), ticks)
        ticks += 1
    assert 1e-3 * ticks == pytest.approx(fast, abs=0.02)
    assert leaves_after_s(CORRECTED, "corrected", amplitude=0.05, until_s=20.0, load=0.0) is None
    small, twice = truncation_error(0.005, ticks=60), truncation_error(0.01, ticks=60)
    assert small is not None
    assert twice is not None
    assert twice / small == pytest.approx(4.0, rel=0.1)  # third-order terms are missing
    assert axial_residual_n_per_m(SETPOINTS[0].w) == pytest.approx(1.23, abs=0.01)


def test_outputs_of_the_segments_are_derivatives_of_the_drawn_arm(artefact: GainsArtefact) -> None:
    """At setpoint 2; the chords are those of a fine arm, so the angle within a segment is of second order."""
    grid = make_grid(1.0, 10, "equispaced")
    setpoint = artefact.setpoints[1]
    rest = offsets(artefact.arm, setpoint, grid)[1][:, :4]
    chords = setpoint_chords(artefact, setpoint.name, grid)
    random = np.random.default_rng(3).standard_normal((10, 4)) * 1e-6
    moved = estimated_shape(rest + random, rest, chords, grid)
    still = estimated_shape(rest, rest, chords, grid)
    np.testing.assert_allclose(still[-1], setpoint.tip_m, atol=2e-4)
    found = chapter_outputs(setpoint, grid)[0] @ random.ravel()
    assert found == pytest.approx(moved[-1, 1] - still[-1, 1], rel=0.02)


def test_the_schedule_with_octarms_gains_is_octarms_simulation(artefact: GainsArtefact) -> None:
    """One sector: the study's simulation, which shares no line with it but the plant, to rounding."""
    grid = make_grid(1.0, 10, "equispaced")
    shape = initial_shape("straight", artefact.setpoints[0], 1.0)
    found = observe(
        artefact,
        shipped_ticks(artefact, grid, TICK_S),
        shape,
        tick_s=TICK_S,
        count=300,
        disturbance=DisturbanceSpec("chapter"),
        own_outputs=True,
    )
    assert set(found.setpoints.tolist()) == {0}
    wanted = simulate(
        artefact,
        setpoint="1",
        ticks=300,
        initial="straight",
        noise=NoiseConfig(),
        feedback=np.zeros((10, 40)),
    )
    np.testing.assert_allclose(found.truth, wanted.truth, atol=1e-11)
    np.testing.assert_allclose(found.estimates, wanted.estimates, atol=1e-9)


def test_the_scheduled_observer_finds_the_exact_arm_through_two_sectors(
    artefact: GainsArtefact,
) -> None:
    """Fig. 5: released from setpoint 2; the model alone does not find it."""
    grid = make_grid(1.0, 10, "equispaced")
    shape = initial_shape("setpoint", artefact.setpoints[1], 1.0)
    errors = {}
    for name, injection in (("(18)", lpi_injection(CORRECTED)), ("none", None)):
        found = observe(
            artefact,
            chapter_ticks(artefact, grid, TICK_S, injection),
            shape,
            tick_s=TICK_S,
            count=1200,
            disturbance=DisturbanceSpec("chapter"),
            own_outputs=False,
        )
        errors[name] = found.tip_error_m
        assert found.tip_error_m[0] == pytest.approx(0.5227, abs=1e-3)
        if injection is not None:
            assert set(found.setpoints.tolist()) == {0, 1}
    assert np.max(errors["(18)"][-200:]) < 0.07 * 0.5227
    assert np.max(errors["none"][-200:]) > 0.2 * 0.5227


def test_grid_error_has_the_outputs_of_the_chapter() -> None:
    model: GridError = grid_error(STRAIGHT, CORRECTED)
    assert model.outputs.shape == (2, 40)
    uniform = np.zeros(40)
    uniform[20:30] = 1.0
    assert model.outputs[0] @ uniform == 1.0
