"""One gain as a job: what is refused and why, and that the shipped gains are what is designed today.

One small program is solved for the refusals, and one gain of the shipped artefact is designed again.
"""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from deploy.grid import make_grid
from deploy.step import make_loop
from design import gain
from design.arm_file import ArmFile, Damping, read_arm_file
from design.command import assemble, jobs, longest_first
from design.gain import GainDesign, Options, design_gain
from design.gain_problem import gain_problem
from design.hinf import HinfResult
from design.moment_lpi import solve_hinf
from design.setpoint_entry import setpoint_entry
from design.verify import Achieved
from wire.artefact import GainsArtefact, read_artefact, write_artefact
from wire.errors import GainsRefusedError, UsageError

ROOT = Path(__file__).resolve().parents[2]
SMALL = Options(counts=(1,))
FIGURES = Achieved(
    gamma=0.1, gamma_by_grid=(0.1, 0.1), open_loop_gamma=1.2, optimum_gamma=0.08, decay_per_s=0.01
)


@pytest.fixture(scope="module")
def straight() -> ArmFile:
    return read_arm_file(ROOT / "tests" / "straight_arm.toml")


@pytest.fixture(scope="module")
def shipped() -> GainsArtefact:
    return read_artefact(ROOT / "examples" / "default.gains.json")


@pytest.fixture(scope="module")
def solved(straight: ArmFile) -> HinfResult:
    """The straight arm's observer, solved once."""
    problem = gain_problem(straight, straight.design_setpoints()[0], "observer")
    return solve_hinf(problem, counts=(1,))


@pytest.fixture
def quick(solved: HinfResult, monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither solved nor verified again, and the optimum is known."""
    monkeypatch.setattr(gain, "observer_optimum", lambda *_: FIGURES.optimum_gamma)
    monkeypatch.setattr(gain, "solve_hinf", lambda *_, **__: solved)
    monkeypatch.setattr(gain, "verify_observer", lambda *_: FIGURES)


def refusal(file: ArmFile, options: Options = SMALL) -> str:
    with pytest.raises(GainsRefusedError) as error:
        design_gain(file, 0, "observer", options)
    return str(error.value)


@pytest.mark.usefixtures("quick")
def test_a_job_gives_a_gain_that_can_be_sent_and_kept(
    straight: ArmFile, solved: HinfResult
) -> None:
    told: list[str] = []
    file, options = pickle.loads(pickle.dumps((straight, SMALL)))
    design = design_gain(file, 0, "observer", options, told.append)
    certificate = design.certificate
    assert certificate.certified_gamma == solved.gamma
    assert certificate.achieved_gamma == FIGURES.gamma
    assert certificate.optimum_gamma == FIGURES.optimum_gamma
    assert certificate.gram_sizes == list(solved.sizes)
    # the axial waves of an arm decay with half the drag, and nothing decays more slowly
    half_drag = 0.5 * straight.arm().drag_per_s
    assert certificate.open_loop_decay_per_s == pytest.approx(half_drag, rel=1e-6)
    assert all(line.startswith("setpoint straight, observer: ") for line in told)
    assert "certified" in told[-1] and "achieved 0.1000" in told[-1]
    assert pickle.loads(pickle.dumps(design)) == design
    assert msgspec.json.decode(msgspec.json.encode(design), type=GainDesign) == design


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("figures", "expected"),
    [
        ({"gamma": 0.17}, "the closed loop has norm 0.1700 and decay 0.01/s"),
        ({"gamma": float("nan")}, "norm nan"),
        ({"decay_per_s": 0.0}, "norm 0.1000 and decay 0/s"),
        ({"optimum_gamma": float("inf")}, "the best of all gains inf"),
        ({"open_loop_gamma": float("inf")}, "the open loop has norm inf"),
    ],
    ids=str,
)
def test_a_gain_that_the_grids_disagree_with(
    figures: dict[str, Any], expected: str, straight: ArmFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    worse = Achieved(**{**vars(FIGURES), **figures})
    monkeypatch.setattr(gain, "verify_observer", lambda *_: worse)
    message = refusal(straight)
    assert message.startswith("setpoint straight, observer: on finite differences ")
    assert expected in message


@pytest.mark.usefixtures("quick")
def test_a_gain_that_no_rank_certifies(straight: ArmFile, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []

    def positive(*_: object) -> float:
        tried.append(1)
        return 2e-6

    monkeypatch.setattr(gain, "lpi_eigenvalue", positive)
    assert refusal(straight).startswith(
        "setpoint straight, observer: with the gain put in, the LPI has the eigenvalue 2.0e-06"
    )
    assert len(tried) == len(gain.RANK_TOLERANCES)


@pytest.mark.usefixtures("quick")
def test_an_operator_that_cannot_be_inverted(
    straight: ArmFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    def singular(*_: object) -> None:
        raise ArithmeticError("P is singular")

    monkeypatch.setattr(gain, "solve_gain", singular)
    assert refusal(straight).startswith("setpoint straight, observer: P is singular")


def test_a_solver_that_has_no_time(straight: ArmFile) -> None:
    message = refusal(straight, Options(counts=(1,), time_limit_s=1e-4))
    assert message.startswith("setpoint straight, observer: the LPI is unreliable (solver CLARABEL")


def test_an_undamped_arm(straight: ArmFile) -> None:
    """The axial motion, out of reach of force and sensor, never decays: there is no certificate."""
    message = refusal(msgspec.structs.replace(straight, damping=Damping(drag_per_s=0.0)))
    assert message.startswith("setpoint straight, observer: the LPI is infeasible (solver CLARABEL")


def test_a_shape_that_no_load_holds(straight: ArmFile) -> None:
    (entry,) = straight.setpoints
    bent = msgspec.structs.replace(entry, name="bent", curvature_per_m=[5.0, -10.0, 5.0])
    with pytest.raises(UsageError, match="setpoint bent: the arm turns by 95"):
        design_gain(msgspec.structs.replace(straight, setpoints=[bent]), 0, "observer", SMALL)


# The shipped artefact


def test_a_shipped_gain_is_reproduced(shipped: GainsArtefact) -> None:
    """The observer of setpoint 1 from the example's arm file: its figures and the matrix that segments run.

    Another processor's linear algebra moves that matrix by up to 1e-4.
    """
    file = read_arm_file(ROOT / "examples" / "chapter_arm.toml")
    assert (file.arm(), file.setpoints[0].name) == (shipped.arm, "1")
    again = design_gain(file, 0, "observer", Options())
    setpoint = shipped.setpoints[shipped.setpoint_index("1")]
    got, expected = again.certificate, setpoint.observer_certificate
    for key in ("certified_gamma", "achieved_gamma", "open_loop_gamma", "optimum_gamma"):
        assert getattr(got, key) == pytest.approx(getattr(expected, key), rel=1e-3), key
    assert got.decay_per_s == pytest.approx(expected.decay_per_s, rel=1e-2)
    assert got.gain_norm == pytest.approx(expected.gain_norm, rel=1e-2)
    assert got.gram_sizes == expected.gram_sizes
    assert got.equalities == expected.equalities

    grid = make_grid(shipped.arm.length_m, 20, "equispaced")
    redesigned = msgspec.structs.replace(setpoint, observer=again.factors)
    new, old = (make_loop(shipped.arm, s, grid) for s in (redesigned, setpoint))
    assert np.linalg.norm(new.L - old.L) <= 2e-3 * np.linalg.norm(old.L)
    for sums in ("n1b", "n2b"):
        ours, theirs = getattr(again.factors, sums), getattr(setpoint.observer, sums)
        assert len(ours.coefficients) == len(theirs.coefficients)


def test_shipped_equilibria_are_reproduced(shipped: GainsArtefact) -> None:
    file = read_arm_file(ROOT / "examples" / "chapter_arm.toml")
    names = {setpoint.name for setpoint in shipped.setpoints}
    both = [setpoint for setpoint in file.design_setpoints() if setpoint.name in names]
    assert both
    for setpoint in both:
        got = setpoint_entry(shipped.arm, setpoint)
        expected = shipped.setpoints[shipped.setpoint_index(setpoint.name)]
        np.testing.assert_allclose(got.curvature_per_m, expected.curvature_per_m, atol=1e-9)
        np.testing.assert_allclose(got.tip_m, expected.tip_m, atol=1e-9)
        count = min(len(got.feedforward_n_per_m), len(expected.feedforward_n_per_m))
        scale = max(np.abs(expected.feedforward_n_per_m).max(), 1e-300)
        for load in (got.feedforward_n_per_m, expected.feedforward_n_per_m):
            np.testing.assert_allclose(load[count:], 0.0, atol=1e-9 * scale)
        np.testing.assert_allclose(
            got.feedforward_n_per_m[:count],
            expected.feedforward_n_per_m[:count],
            atol=1e-9 * scale,
        )


# All gains of an arm file


def test_every_gain_has_its_place(shipped: GainsArtefact) -> None:
    """An artefact put together from its own gains, in whatever order they come, is itself."""
    file = read_arm_file(ROOT / "examples" / "chapter_arm.toml")
    gains = {}
    for number, job in enumerate(reversed(longest_first(file, jobs(file)))):
        setpoint = shipped.setpoints[0]
        certificate = getattr(setpoint, f"{job.role}_certificate")
        numbered = msgspec.structs.replace(certificate, iterations=number)
        gains[job] = GainDesign(getattr(setpoint, job.role), numbered)
    artefact = assemble(file, gains)
    assert [s.name for s in artefact.setpoints] == [s.name for s in file.setpoints]
    for job, design in gains.items():
        setpoint = artefact.setpoints[job.index]
        assert setpoint.name == job.setpoint
        assert getattr(setpoint, job.role) == design.factors
        assert getattr(setpoint, f"{job.role}_certificate") == design.certificate
    assert artefact.arm == file.arm()
    assert set(artefact.versions) >= {"octarm", "cvxpy", "clarabel", "python"}


def test_a_shipped_file_is_as_it_would_be_written(tmp_path: Path, shipped: GainsArtefact) -> None:
    write_artefact(shipped, tmp_path / "again.json")
    original = ROOT / "examples" / "default.gains.json"
    assert (tmp_path / "again.json").read_bytes() == original.read_bytes()
