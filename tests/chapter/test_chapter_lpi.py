"""The feasible form of (18) for the chapter's outputs, and what the printed forms do instead."""

from __future__ import annotations

import math

import numpy as np
import pytest

from chapter.constants import CORRECTED, PRINTED
from chapter.lpi_check import error_channel
from chapter.lpi_find import own_systems, sequences
from chapter.lpi_gains import (
    COUNT,
    EPSILONS,
    NOISE,
    chapter_grid,
    chapter_pie,
    chapter_setpoint,
    gain_of,
    observer_gains,
    on_grid,
    recheck,
)
from chapter.lpi_matrices import observer, random_plant, state_feedback
from chapter.lpi_own import BEAM, RIGHTS, UNIT, OwnProgram, own_pie
from chapter.lpi_solve import (
    Weights,
    coordinates,
    form_eigenvalue,
    observer_problem,
    solve,
)
from chapter.lpi_tables import feedback, settling, storage_needed
from chapter.lpi_why import beam_mode, beam_roots, least_condition, packet
from chapter.pde import SETPOINTS, STRAIGHT
from design import legendre
from design.semidefinite import ACCEPTED

CASES = [(name, epsilon) for name in ("1", "2", "3") for epsilon in EPSILONS]


@pytest.mark.parametrize(("name", "epsilon"), CASES)
def test_the_stored_gains_satisfy_the_inequality(name: str, epsilon: float) -> None:
    gains = observer_gains(name, CORRECTED, epsilon)
    again = recheck(gains)  # rebuilt by composition on functions f, nothing of the solver's
    assert again.outcome == "certified"
    assert again.eigenvalue <= 1e-6
    assert again.smallest_p > 0.5
    assert gains.certified_decay == pytest.approx(0.5 * epsilon / again.largest_p, rel=1e-6)


@pytest.mark.parametrize(("name", "epsilon"), [(name, EPSILONS[1]) for name in ("1", "2", "3")])
def test_finite_differences_keep_what_is_certified(name: str, epsilon: float) -> None:
    """Exact angles and differences on a grid share no code with the design."""
    gains = observer_gains(name, CORRECTED, epsilon)
    arm = chapter_grid(name, 40)
    loop = error_channel(arm, on_grid(arm, gains.energy), np.array(NOISE), arm.C1)
    norm = loop.hinf_norm()
    assert norm <= 1.01 * gains.gamma  # 40 cells: 1 % off
    assert norm == pytest.approx(gains.achieved, rel=0.03)
    assert gains.optimum <= 1.001 * gains.achieved
    assert gains.achieved <= gains.gamma * (1.0 + 1e-3)
    assert loop.decay() >= gains.certified_decay


def test_a_wrong_sign_is_found_out() -> None:
    """The same check refuses gains of the other sign, so it can fail."""
    gains = observer_gains("1", CORRECTED, EPSILONS[1])
    arm = chapter_grid("1", 40)
    loop = error_channel(arm, -on_grid(arm, gains.energy), np.array(NOISE), arm.C1)
    assert math.isinf(loop.hinf_norm())


def test_si_gains_are_the_nondimensional_ones_in_other_units() -> None:
    """Displacement injections by quadrature along the exact angle; printed rho only stretches time."""
    gains, printed = (observer_gains("2", c, EPSILONS[1]) for c in (CORRECTED, PRINTED))
    s = np.linspace(0.0, 1.0, 2001)
    strain, curvature = gains.energy_si(s)[2:]
    angle = legendre.basis(s, chapter_setpoint("2").angle.size) @ chapter_setpoint("2").angle

    def primitive(f: np.ndarray) -> np.ndarray:
        steps = 0.5 * (f[..., 1:] + f[..., :-1]) * (s[1] - s[0])
        return np.concatenate([np.zeros((*f.shape[:-1], 1)), np.cumsum(steps, axis=-1)], axis=-1)

    turn = primitive(curvature)
    u = primitive(strain * np.cos(angle) - turn * np.sin(angle))
    w = primitive(strain * np.sin(angle) + turn * np.cos(angle))
    chapter = gains.chapter_si(s)
    for found, want in ((chapter[0], u), (chapter[2], w)):
        assert np.abs(found - want).max() < 5e-3 * np.abs(want).max()  # frames are 2e-3 off
    ratio = printed.time_s / gains.time_s
    assert ratio == pytest.approx(math.sqrt(1100.0 / 2.159845), rel=1e-6)
    assert printed.chapter_si(s)[0] == pytest.approx(chapter[0] / ratio)
    assert printed.chapter_si(s)[3] == pytest.approx(chapter[3] / ratio**2)


def test_the_column_for_the_root_shear_is_not_free() -> None:
    """A tenth more of L2 leaves <x, .> N_y(0): the finer the functions, the larger the form."""
    gains = observer_gains("1", CORRECTED, EPSILONS[1])
    posed = observer_problem(chapter_pie("1"))
    P = gains.storage.operator(coordinates(posed, COUNT))
    weights = Weights(NOISE, gains.epsilon)
    wrong = gain_of(gains.energy * np.array([1.0, 1.1])[:, None])
    right = gain_of(gains.energy)
    bounds = [form_eigenvalue(posed, weights, P, wrong, gains.gamma, n) for n in (8, 16, 32)]
    assert bounds[1] > 1.5 * bounds[0] > 1.0
    assert bounds[2] > 1.5 * bounds[1]
    kept = [form_eigenvalue(posed, weights, P, right, gains.gamma, n) for n in (8, 16, 32)]
    assert max(kept) <= 1e-6


def test_a_fresh_solution_is_certified() -> None:
    """With two polynomials a state: weaker than what is stored, and certified as well."""
    found = solve(observer_problem(chapter_pie("1")), Weights(NOISE, 1e-3), 2)
    assert found.outcome == "certified"
    stored = observer_gains("1", CORRECTED, 1e-3)
    assert stored.gamma < found.gamma < 2.0 * stored.gamma


def test_no_bounded_storage_covers_the_root_force() -> None:
    """int |N_y(0)|^2 dt from |x0| = 1 grows with the grid, that of the means does not."""
    energy = observer_gains("1", CORRECTED, EPSILONS[1]).energy
    (_, coarse, means), (_, fine, finer_means) = storage_needed(energy, (15, 30))
    assert fine > 3.0 * coarse
    assert finer_means == pytest.approx(means, rel=0.01)


def test_a_larger_epsilon_is_no_faster_observer() -> None:
    arm = chapter_grid("1", 30)
    times = []
    for epsilon in EPSILONS:
        L = on_grid(arm, observer_gains("1", CORRECTED, epsilon).energy)
        times.append(settling(arm, arm.A + L @ arm.outputs))
    assert settling(arm, arm.A) > 3.0 * max(times)
    assert times == sorted(times)
    assert times[-1] > 1.1 * times[0]
    promised = [observer_gains("1", CORRECTED, e).certified_decay for e in EPSILONS]
    assert promised == sorted(promised)


def test_own_operators_against_integration() -> None:
    """T f has the boundary values of the chapter and the fourth derivative f; A f is (5) on it."""
    pie = own_pie(SETPOINTS[0], "corrected")
    rng = np.random.default_rng(7)
    f = rng.normal(size=(4, 5))
    x = (pie.T.discretise(5, 9) @ f.ravel()).reshape(4, 9)
    series = [np.polynomial.Legendre(legendre.to_plain(row), domain=[0.0, 1.0]) for row in x]
    s = np.linspace(0.0, 1.0, 7)
    for one, row in zip(series, f, strict=True):
        assert [one(0.0), one.deriv(1)(0.0), one.deriv(2)(1.0), one.deriv(3)(1.0)] == pytest.approx(
            [0.0] * 4, abs=1e-9
        )
        assert one.deriv(4)(s) == pytest.approx(legendre.basis(s, 5) @ row, abs=1e-8)
    outputs = pie.C2.discretise(5) @ f.ravel()
    assert outputs[:4] == pytest.approx([one(1.0) for one in series])
    assert outputs[4:] == pytest.approx([one.deriv(3)(1.0) - one.deriv(3)(0.0) for one in series])
    rate = (pie.A.discretise(5, 20) @ f.ravel()).reshape(4, 20)
    w = SETPOINTS[0].w
    u_tt = (
        6400.0 * series[0].deriv(2)(s)
        + (6400.0 * w.deriv(2)(s) + w.deriv(4)(s)) * series[2].deriv(1)(s)
        + (6400.0 * w.deriv(1)(s) + w.deriv(3)(s)) * series[2].deriv(2)(s)
        + w.deriv(2)(s) * series[2].deriv(3)(s)
        + w.deriv(1)(s) * series[2].deriv(4)(s)
    )
    assert legendre.basis(s, 20) @ rate[1] == pytest.approx(u_tt, rel=1e-8)


def test_the_program_finds_what_there_is_and_nothing_else() -> None:
    """x_t = -x + w has norm 1; only -eps I is impossible for it. The chapter's has no solution at all."""
    systems = own_systems()
    easy = OwnProgram(systems["x_t = -x + w"], 0, 0, "state")
    identity, energy, zero = (easy.solve(right, 1e-3) for right in RIGHTS)
    assert identity.status not in ACCEPTED
    for tried in (energy, zero):
        assert tried.gamma == pytest.approx(1.0, rel=1e-3)
        assert tried.eigenvalue <= 1e-9
    beam = OwnProgram(systems["straight beam"], 0, 0, "state")
    assert all(beam.solve(right, 1e-3).status not in ACCEPTED for right in RIGHTS)


def test_gamma_goes_as_one_over_the_residual() -> None:
    program = OwnProgram(own_pie(STRAIGHT, "corrected", UNIT, BEAM), 0, extra=2)
    loose, tight = (program.solve("0", 0.0, residual) for residual in (0.1, 0.01))
    assert tight.gamma == pytest.approx(10.0 * loose.gamma, rel=0.15)
    assert min(loose.eigenvalue, tight.eigenvalue) > 1e-2  # and (18) is violated all the same


def test_sequences_leave_no_room_for_epsilon_or_the_mean() -> None:
    for name, pie in own_systems().items():
        if name.startswith("x_t"):
            continue
        null, root = sequences(pie, (2, 4, 8, 16, 32))
        assert abs(null.form[-1]) < 1e-6
        assert null.bound[-1] < 1e-3 * null.bound[1]
        assert root.mean[-1] == pytest.approx(1.0)
        assert root.bound[-1] < 0.4 * root.bound[-2]  # falls as n^(-3/2)
        assert root.bound[-2] < 0.45 * root.bound[-3]


def test_beam_modes_need_an_unbounded_storage() -> None:
    """Modes by quadrature; the least cond(P) is omega^2, and grows with any output injection."""
    s, weights = legendre.gauss(60)
    roots = beam_roots(4)
    modes = np.array([beam_mode(beta, s) for beta in roots])
    assert (modes * weights) @ modes.T == pytest.approx(np.eye(4), abs=1e-9)
    assert roots[0] == pytest.approx(1.8751040687119611)
    for count in (1, 2, 3):
        assert least_condition(count, "none") == pytest.approx(roots[count - 1] ** 4, rel=1e-4)
    with_outputs = [least_condition(count) for count in (2, 3, 5)]
    assert with_outputs[0] < 1.01
    assert with_outputs[1] > 2.0
    assert with_outputs[2] > 500.0


@pytest.mark.parametrize("form", ["printed", "corrected"])
def test_packets_at_a_curved_setpoint_grow_unseen(form: str) -> None:
    packets = [packet(SETPOINTS[0], form, k) for k in (1e3, 4e3)]  # type: ignore[arg-type]
    for p in packets:
        assert p.form == pytest.approx(2.0 * p.growth, rel=0.1)
        assert p.outputs < 1e-12
    assert packets[1].growth > 12.0 * packets[0].growth
    assert packets[1].residual < 0.6 * packets[0].residual


def test_matrices_tell_the_printed_blocks_from_the_derived_ones() -> None:
    plants = [random_plant(seed) for seed in range(6)]
    assert all(observer(p).kept for p in plants)
    assert sum(observer(p, "T on the other side").kept for p in plants) <= 3
    derived = [state_feedback(p, "derived") for p in plants]
    assert all(c.kept and c.norm <= 1.2 * c.optimum for c in derived)
    assert sum(state_feedback(p, "printed").kept for p in plants) <= 2


def test_a_controller_for_a_uniform_load() -> None:
    found = feedback(0.3)
    assert found.outcome == "certified"
    assert found.optimum <= found.achieved <= found.gamma * (1.0 + 1e-3)
    assert found.gamma < 1.1 * found.optimum
    assert found.open_loop > 3.0 * found.gamma
