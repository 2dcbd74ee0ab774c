"""`octarm design` from arm file to artefact: it reproduces the shipped gains, and writes nothing it refuses.

The whole design runs once for the module (about a minute).
"""

from __future__ import annotations

import dataclasses
import json
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import pytest

import launcher
from deploy.grid import make_grid
from deploy.step import make_loop
from design import command
from design.arm_file import ArmFile, Damping, read_arm_file
from design.command import Options, design_artefact, run_design
from design.verify import Achieved, verify_controller
from wire.artefact import (
    Certificate,
    GainsArtefact,
    Setpoint,
    digest,
    read_artefact,
    write_artefact,
)
from wire.errors import GainsRefusedError, UsageError

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"
ARM_FILE = EXAMPLES / "chapter_arm.toml"
SHIPPED = EXAMPLES / "default.gains.json"
ROLES = ("observer", "controller")


@dataclass(frozen=True)
class Run:
    artefact: GainsArtefact
    sha: str
    path: Path
    told: list[str]
    cpu_s: float


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Run:
    path = tmp_path_factory.mktemp("design") / "new" / "arm.gains.json"
    told: list[str] = []
    start = time.process_time()
    artefact, sha = run_design(ARM_FILE, path, progress=told.append)
    return Run(artefact, sha, path, told, time.process_time() - start)


@pytest.fixture(scope="module")
def shipped() -> GainsArtefact:
    return read_artefact(SHIPPED)


@pytest.fixture
def straight() -> ArmFile:
    """The straight setpoint alone: enough for what goes wrong."""
    file = read_arm_file(ARM_FILE)
    return msgspec.structs.replace(file, setpoints=file.setpoints[:1])


def certificates(artefact: GainsArtefact) -> list[Certificate]:
    return [getattr(s, f"{role}_certificate") for s in artefact.setpoints for role in ROLES]


# The main job


def test_what_is_returned_was_written(run: Run) -> None:
    assert read_artefact(run.path) == run.artefact
    assert run.sha == digest(run.artefact)
    assert list(run.path.parent.iterdir()) == [run.path]


def test_certificates(run: Run) -> None:
    for certificate in certificates(run.artefact):
        assert certificate.outcome == "certified"
        assert certificate.solver_status == "optimal"
        assert certificate.achieved_gamma <= certificate.certified_gamma * 1.001 <= 0.16
        assert certificate.optimum_gamma <= certificate.achieved_gamma
        assert certificate.achieved_gamma < 0.15 * certificate.open_loop_gamma
        assert certificate.decay_per_s > 0.005
        assert certificate.smallest_eigenvalue_p > 0.05
        assert certificate.largest_eigenvalue_lpi <= 1e-6
        assert certificate.equality_residual <= 1e-6
        assert certificate.gain_norm < 30.0


def test_design_takes_its_time_budget(run: Run) -> None:
    """In processor time, so that a busy machine does not fail it; a gain of a curved arm costs most."""
    assert run.cpu_s < 4 * 90.0


def test_shipped_figures_are_reproduced(run: Run, shipped: GainsArtefact) -> None:
    assert [s.name for s in run.artefact.setpoints] == [s.name for s in shipped.setpoints]
    assert run.artefact.arm == shipped.arm
    assert run.artefact.weights == shipped.weights
    for got, expected in zip(certificates(run.artefact), certificates(shipped), strict=True):
        for key in ("certified_gamma", "achieved_gamma", "open_loop_gamma", "optimum_gamma"):
            assert getattr(got, key) == pytest.approx(getattr(expected, key), rel=1e-3), key
        assert got.decay_per_s == pytest.approx(expected.decay_per_s, rel=1e-2)
        assert got.gain_norm == pytest.approx(expected.gain_norm, rel=1e-2)
        assert got.gram_sizes == expected.gram_sizes
        assert got.equalities == expected.equalities


def test_shipped_gains_are_reproduced(run: Run, shipped: GainsArtefact) -> None:
    """The matrices that segments run. Another processor's linear algebra moves them by up to 1e-4."""
    grid = make_grid(shipped.arm.length_m, 20, "equispaced")
    for got, expected in zip(run.artefact.setpoints, shipped.setpoints, strict=True):
        new, old = make_loop(run.artefact.arm, got, grid), make_loop(shipped.arm, expected, grid)
        for key in ("L", "K"):
            difference = np.linalg.norm(getattr(new, key) - getattr(old, key))
            assert difference <= 2e-3 * np.linalg.norm(getattr(old, key)), (got.name, key)
        for role in ROLES:
            ranks = [
                (len(getattr(s, role).n1b.coefficients), len(getattr(s, role).n2b.coefficients))
                for s in (got, expected)
            ]
            assert ranks[0] == ranks[1]


def test_shipped_equilibria_are_reproduced(run: Run, shipped: GainsArtefact) -> None:
    for got, expected in zip(run.artefact.setpoints, shipped.setpoints, strict=True):
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
    assert shipped.setpoints[1].tip_m[0] == pytest.approx(0.9645, abs=2e-3)  # theory, section 1


def test_progress_names_setpoint_and_gain(run: Run) -> None:
    for name in ("straight", "1"):
        for role in ROLES:
            lines = [t for t in run.told if t.startswith(f"setpoint {name}, {role}: ")]
            assert len(lines) >= 4
            assert "certified" in lines[-1]
            assert "achieved" in lines[-1]


# Designs that must fail


def refused(straight: ArmFile, monkeypatch: pytest.MonkeyPatch) -> str:
    """The message with which a design of the smallest kind is refused."""
    monkeypatch.setattr(command, "LEVEL", 1)
    with pytest.raises(GainsRefusedError) as error:
        design_artefact(straight, Options())
    return str(error.value)


def test_time_limit_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "LEVEL", 1)
    with pytest.raises(
        GainsRefusedError, match=r"setpoint straight, observer: the LPI is unreliable"
    ):
        run_design(ARM_FILE, tmp_path / "out.json", Options(time_limit_s=1e-4))
    assert list(tmp_path.iterdir()) == []


def test_existing_file_survives_a_refusal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command, "LEVEL", 1)
    path = tmp_path / "out.json"
    path.write_text("mine")
    with pytest.raises(GainsRefusedError):
        run_design(ARM_FILE, path, Options(time_limit_s=1e-4))
    assert path.read_text() == "mine"


def test_absurd_drag(straight: ArmFile, monkeypatch: pytest.MonkeyPatch) -> None:
    """The arm creeps over thousands of units of time: no solver's numbers are any good."""
    absurd = msgspec.structs.replace(straight, damping=Damping(first_mode_damping_ratio=1e3))
    message = refused(absurd, monkeypatch)
    assert message.startswith("setpoint straight, observer: ")
    assert "nothing was written" in message


def test_undamped_arm(straight: ArmFile, monkeypatch: pytest.MonkeyPatch) -> None:
    """The norm is bounded, but the axial motion, out of reach of force and sensor, never decays."""
    undamped = msgspec.structs.replace(straight, damping=Damping(drag_per_s=0.0))
    message = refused(undamped, monkeypatch)
    assert "the closed loop has norm inf and decay 0/s" in message


def test_gain_that_the_grids_disagree_with(
    straight: ArmFile, monkeypatch: pytest.MonkeyPatch
) -> None:
    def worse(arm: object, setpoint: Setpoint, effort: float) -> Achieved:
        figures = verify_controller(straight.arm(), setpoint, effort)
        return dataclasses.replace(figures, gamma=0.17)

    monkeypatch.setattr(command, "verify_controller", worse)
    message = refused(straight, monkeypatch)
    assert (
        "setpoint straight, controller: on finite differences the closed loop has norm 0.17"
        in message
    )


def test_gain_that_no_rank_certifies(straight: ArmFile, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = []

    def positive(*_: object) -> float:
        tried.append(1)
        return 2e-6

    monkeypatch.setattr(command, "lpi_eigenvalue", positive)
    message = refused(straight, monkeypatch)
    assert (
        "setpoint straight, observer: with the gain put in, the LPI has the eigenvalue 2.0e-06"
        in message
    )
    assert len(tried) == len(command.RANK_TOLERANCES)


# Refusals before the work starts


@pytest.fixture
def idle(monkeypatch: pytest.MonkeyPatch) -> None:
    """No test that uses it may start to solve."""

    def forbidden(*_: object) -> None:
        raise AssertionError("the design started")

    monkeypatch.setattr(command, "design_artefact", forbidden)


@pytest.mark.usefixtures("idle")
def test_output_that_cannot_be_written(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path, tmp_path / "file" / "out.json", tmp_path / "file" / "deep" / "out.json"):
        with pytest.raises(UsageError, match="--out"):
            run_design(ARM_FILE, out)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_output_that_became_unwritable(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shipped: GainsArtefact
) -> None:
    def full(*_: object) -> str:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(command, "design_artefact", lambda *_: shipped)
    monkeypatch.setattr(command, "write_artefact", full)
    with pytest.raises(UsageError, match=r"--out .*out\.json: No space left"):
        run_design(ARM_FILE, tmp_path / "out.json")


@pytest.mark.usefixtures("idle")
def test_unknown_solver(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"--solver ABACUS: .*CLARABEL"):
        run_design(ARM_FILE, tmp_path / "out.json", Options(solver="ABACUS"))


# The verb


def octarm(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], *arguments: str | Path
) -> tuple[object, str, str]:
    """`octarm design` in this process: exit code, standard output, standard error."""
    monkeypatch.setattr("sys.argv", ["octarm", "design", *map(str, arguments)])
    before = signal.getsignal(signal.SIGTERM)
    try:
        with pytest.raises(SystemExit) as end:
            launcher.main()
    finally:
        signal.signal(signal.SIGTERM, before)
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err
    return end.value.code, out, err


BAD = {
    "not TOML": ("this is no arm", "line 1"),
    "empty": ("", "missing required field"),
    "wrong unit": (ARM_FILE.read_text().replace("length_m = 1.0", "length_cm = 100.0"), "length_m"),
    "negative": (ARM_FILE.read_text().replace("5e3", "-5e3"), "youngs_modulus_pa"),
}


@pytest.mark.usefixtures("idle")
@pytest.mark.parametrize("case", BAD)
def test_bad_arm_file(
    case: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    text, culprit = BAD[case]
    bad = tmp_path / "bad.toml"
    bad.write_text(text)
    code, out, err = octarm(monkeypatch, capfd, "--arm", bad, "--out", tmp_path / "out.json")
    assert (code, out) == (2, "")
    assert "bad.toml" in err
    assert culprit in err
    assert list(tmp_path.iterdir()) == [bad]


def test_table(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    shipped: GainsArtefact,
) -> None:
    monkeypatch.setattr(command, "design_artefact", lambda *_: shipped)
    path = tmp_path / "out.json"
    code, out, _ = octarm(monkeypatch, capfd, "--out", path)
    assert code == 0
    assert read_artefact(path) == shipped
    head, *lines = out.splitlines()
    for column in ("certified", "achieved", "optimum", "open loop"):
        assert column in head
    for line, certificate in zip(lines, certificates(shipped), strict=False):
        for value in (certificate.certified_gamma, certificate.achieved_gamma):
            assert f"{value:.4f}" in line
    assert str(path) in lines[-1]

    code, out, err = octarm(monkeypatch, capfd, "--out", path)  # nothing is written over
    assert (code, out) == (2, "")
    assert "exists" in err
    code, _, _ = octarm(monkeypatch, capfd, "--out", path, "--force")
    assert code == 0


def test_json(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    shipped: GainsArtefact,
) -> None:
    monkeypatch.setattr(command, "design_artefact", lambda *_: shipped)
    path = tmp_path / "out.json"
    code, out, err = octarm(monkeypatch, capfd, "--out", path, "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert told["sha256"] == digest(shipped)
    assert [(g["setpoint"], g["role"]) for g in told["gains"]] == [
        (s.name, role) for s in shipped.setpoints for role in ROLES
    ]
    for gain, certificate in zip(told["gains"], certificates(shipped), strict=True):
        assert gain["certified_gamma"] == certificate.certified_gamma
        assert gain["open_loop_gamma"] == certificate.open_loop_gamma


def test_refused_gains_have_their_exit_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "LEVEL", 1)
    path = tmp_path / "out.json"
    code, out, err = octarm(monkeypatch, capfd, "--out", path, "--time-limit", "0.0001")
    assert (code, out) == (6, "")
    assert "octarm: setpoint straight, observer" in err
    assert "Gram matrices" in err  # progress
    assert list(tmp_path.iterdir()) == []


def test_shipped_file_is_as_it_would_be_written(tmp_path: Path, shipped: GainsArtefact) -> None:
    write_artefact(shipped, tmp_path / "again.json")
    assert (tmp_path / "again.json").read_bytes() == SHIPPED.read_bytes()
