"""Section 4: the formula by real node processes, its rules against the exact integral, its transfers."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import ROOT, Cli, Start

from analysis.recording import read_recording
from analysis.replay_check import Verdict, check, story_of
from chapter.section4 import Rule, columns, exact, nodes, pairs, refinement, wave
from chapter.section4_deployed import agreement, staggered
from chapter.section4_loop import growth_per_s
from chapter.section4_run import MEASURED, look
from deploy.grid import COMMAND_PLACES, STATE_PLACES, make_grid
from deploy.operators import operator_matrix
from supervise.shipped import DEFAULT_GAINS
from wire.artefact import OperatorFactors, PolynomialMatrix, read_artefact

ROUNDING = 1e-13


@pytest.fixture(scope="module")
def controller() -> OperatorFactors:
    return read_artefact(DEFAULT_GAINS).setpoints[0].controller


def test_exact_integral_in_closed_form() -> None:
    """K x = 2 x + s int_0^s t x dt - int_s^1 x dt with x = t: 2 s + s^4 / 3 - (1 - s^2) / 2."""
    one, line = [[[1.0]]], [[[0.5, 0.5]]]  # Legendre series in 2 s - 1
    factors = OperatorFactors(
        PolynomialMatrix([[[2.0]]]),
        PolynomialMatrix(line),
        PolynomialMatrix(line),
        PolynomialMatrix([[[-1.0]]]),
        PolynomialMatrix(one),
    )
    s = np.array([0.0, 0.3, 1.0])
    found = exact(factors, 1.0, lambda t: t[:, None], s)[:, 0]
    assert found == pytest.approx(2.0 * s + s**4 / 3.0 - 0.5 * (1.0 - s**2), abs=1e-14)


@pytest.mark.parametrize("rule", Rule)
@pytest.mark.parametrize("count", [2, 3, 10])
def test_sweeps_are_the_double_sum(controller: OperatorFactors, rule: Rule, count: int) -> None:
    x = np.random.default_rng(6).standard_normal((count, 4))
    u, _, _, transfers = nodes(controller, 1.0, count, rule).sweep(x)
    direct = np.einsum("iajb,jb->ia", pairs(controller, 1.0, count, rule), x)
    assert np.abs(u - direct).max() < ROUNDING * np.abs(direct).max()
    assert transfers == 2 * (count - 1)


def test_orders(controller: OperatorFactors) -> None:
    found = refinement(controller, 1.0, (40, 80))
    orders = {rule: np.log2(a / b) for rule, (a, b) in found.items()}
    assert orders["display"] == pytest.approx(1.0, abs=0.05)
    assert orders["transfer"] == pytest.approx(1.0, abs=0.05)
    assert orders["midpoint"] == pytest.approx(2.0, abs=0.05)
    assert found["midpoint"][0] < 1e-4
    assert 1e-2 < found["display"][0] < found["transfer"][0]


def test_the_printed_formulas_differ_by_the_own_piece(controller: OperatorFactors) -> None:
    hold = nodes(controller, 1.0, 10, Rule.DISPLAY)
    x = wave(hold.places_m)
    first = hold.sweep(x)[0]
    last = nodes(controller, 1.0, 10, Rule.TRANSFER).sweep(x)[0]
    own = [0.1 * hold.K1a[i] @ hold.K1b[i] @ x[i] for i in range(10)]
    assert np.allclose(first - last, own, rtol=0.0, atol=1e-13 * np.abs(first).max())


@pytest.mark.parametrize("rule", [Rule.TRANSFER, Rule.MIDPOINT])
def test_real_nodes_run_the_formula(start: Start, rule: Rule) -> None:
    directory = start.work / str(rule)
    words = (str(DEFAULT_GAINS), str(directory), "5", "30", str(rule))
    cli = Cli(ROOT, ["-m", "chapter.section4_run", *words])
    start.started.append(cli)
    assert cli.finish() == 0, cli.err
    assert cli.gone() == {}
    path = directory / "recording.mcap"
    seen = look(path, rule)
    assert seen.ticks == 30
    assert np.abs(seen.commands).max() > 1e-3  # N/m: there is something to compare
    assert seen.error < ROUNDING
    assert seen.sums_error < ROUNDING
    assert seen.messages_per_tick == 2 * (5 - 1)
    # The other rule is another command: the comparison can fail.
    other = Rule.MIDPOINT if rule is Rule.TRANSFER else Rule.TRANSFER
    assert look(path, other).error > 0.05
    # The recording holds what the nodes were given: their mathematics again, bit for bit.
    assert check(story_of(read_recording(path))).verdict is Verdict.EQUAL


def test_the_deployed_command_is_the_formula(start: Start) -> None:
    words = ("--nodes", "5", "--ticks", "40", "--no-plot", "--quiet")
    cli = start("run", "--gains", DEFAULT_GAINS, *words)
    assert cli.finish() == 0, cli.err
    found = agreement(cli.recording())
    assert found.implicit < 1e-12  # K has norm 20 and states of 1e-2 to 10 in it
    assert found.explicit > 0.01
    assert found.messages_per_tick == 8


def test_staggered_rule_is_the_deployed_one(controller: OperatorFactors) -> None:
    grid = make_grid(1.0, 7, "chebyshev")
    wanted = operator_matrix(controller, grid, COMMAND_PLACES, STATE_PLACES)
    found = staggered(controller, grid.faces_m)
    assert np.abs(found - wanted).max() < 1e-12 * np.abs(wanted).max()


def test_without_observer_the_arm_does_not_rest() -> None:
    artefact = read_artefact(DEFAULT_GAINS)
    assert growth_per_s(artefact, 10, 10, Rule.MIDPOINT, 0.1) < 0.0
    assert growth_per_s(artefact, 10, 40, Rule.MIDPOINT, 0.1) > 0.02
    assert growth_per_s(artefact, 10, 40, Rule.MIDPOINT, None) > 0.0
    assert columns(artefact.setpoints[0].controller, MEASURED).n0.array.shape[:2] == (1, 2)
