"""Growth of a loop in which a node is out, against the arm and the nodes themselves, tick by tick."""

from __future__ import annotations

from itertools import pairwise

import msgspec
import numpy as np
import pytest
from closed_form import ARM, artefact, constant

from deploy import SegmentGrid, deploy
from deploy.arm import make_arm_modes
from deploy.gaps import growth_per_s, refuse_growing_gaps
from deploy.step import make_loop, make_step
from node.sweep import NodeSweep
from plant.disturbance import DisturbanceSpec
from plant.initial import initial_shape
from plant.model import ArmPlant, PlantParameters
from wire.artefact import GainsArtefact, OperatorFactors
from wire.errors import UsageError

NODES, TICK_S = 4, 0.1
FACES_M = (0.0, 0.25, 0.5, 0.75, 1.0)
"""Coarse, so that the ones that grow do so soon."""


SMALL_J = 1e-4
"""Square root of an energy in J that bends the arm by a thousandth of its length or so."""


def with_feedback(gain_per_s: float, coupling: float = 0.01) -> GainsArtefact:
    """Gains whose command is so many 1/s times the estimated momentum: positive feeds the motion."""
    made = artefact(coupling=coupling)
    mass = ARM.mass_per_length_kg_per_m
    one = made.setpoints[0]
    controller = OperatorFactors(
        n0=constant((0.0, gain_per_s * mass, 0.0, 0.0)),
        n1a=one.controller.n1a,
        n1b=one.controller.n1b,
        n2a=one.controller.n2a,
        n2b=one.controller.n2b,
    )
    setpoints = [msgspec.structs.replace(s, controller=controller) for s in made.setpoints]
    return msgspec.structs.replace(made, setpoints=setpoints)


def predicted(gains: GainsArtefact, out: list[int]) -> float:
    grid = SegmentGrid(np.linspace(0.0, ARM.length_m, NODES + 1))
    setpoint = gains.setpoints[0]
    step = make_step(make_loop(gains.arm, setpoint, grid), TICK_S)
    modes = make_arm_modes(gains.arm, setpoint.curvature_per_m, grid)
    return growth_per_s(step, modes, TICK_S, out)


def simulated(gains: GainsArtefact, out: list[int], ticks: int) -> np.ndarray:
    """Amplitude of arm and estimates at every tick: the emulated arm around the straight setpoint, nodes that
    get no sums across the gap, no command where they are out."""
    deployment = deploy(gains, NODES, TICK_S, FACES_M)
    sweeps = [NodeSweep(one) for one in deployment.nodes]
    plant = ArmPlant(
        PlantParameters(
            arm=gains.arm,
            faces_m=FACES_M,
            tick_s=TICK_S,
            initial=initial_shape("setpoint", gains.setpoints[0], gains.arm.length_m),
            disturbance=DisturbanceSpec(name="none"),
            cells=40,
        )
    )
    push = 1e-9 * np.arange(1.0, NODES + 1)
    for k in range(5):
        plant.advance(push, k)
    here = [i for i in range(NODES) if i not in out]
    commands = np.array([sweeps[i].command if i in here else 0.0 for i in range(NODES)])
    weights = deployment.energy_weights
    amplitudes = []
    for k in range(ticks):
        measured = plant.measure()
        plant.advance(commands, 5 + k)
        for i in here:
            sweeps[i].input(measured[i])
        for a, b in pairwise([None, *range(NODES), None]):
            if b is not None and b in here:
                left = sweeps[a].forward_out if a is not None and a in here else None
                sweeps[b].forward(_or_reference(left, sweeps[b].forward_received))
        for a, b in pairwise([None, *reversed(range(NODES)), None]):
            if b is not None and b in here:
                right = sweeps[a].backward_out if a is not None and a in here else None
                sweeps[b].backward(_or_reference(right, sweeps[b].backward_received))
        for i in here:
            sweeps[i].accept(sweeps[i].output())
            commands[i] = sweeps[i].command
        states = np.array([sweeps[i].state[:4] if i in here else np.zeros(4) for i in range(NODES)])
        states[:, 2] = 0.0
        amplitudes.append(np.sqrt(np.sum(weights * states**2) + sum(plant.energy()) + 1e-300))
    return np.array(amplitudes)


def _or_reference(values: np.ndarray | None, numbers: int) -> np.ndarray:
    """A sum that did not come: the arm beyond is where the reference has it."""
    return np.zeros(numbers) if values is None else values


def rate(amplitudes: np.ndarray) -> float:
    """1/s, of the envelope in the second half, while the arm's motion is small."""
    small = amplitudes[: int(np.argmax(amplitudes > SMALL_J)) or len(amplitudes)]
    late = np.log(small[len(small) // 2 :])
    times = TICK_S * np.arange(len(late))
    return float(np.polyfit(times, late, 1)[0])


@pytest.mark.parametrize("gain_per_s", [0.5, 1.0])
@pytest.mark.parametrize("out", [[0], [1], [3], [1, 2]])
def test_growth_is_that_of_the_arm_with_its_nodes(
    monkeypatch: pytest.MonkeyPatch, gain_per_s: float, out: list[int]
) -> None:
    monkeypatch.setattr("deploy.stability.SpectralRadius.stable", True)  # the whole chain grows too
    gains = with_feedback(gain_per_s)
    wanted = predicted(gains, out)
    found = rate(simulated(gains, out, ticks=800))
    assert wanted > 0.0
    assert found == pytest.approx(wanted, rel=0.1, abs=2e-3)


@pytest.mark.parametrize("out", [[0], [1], [3], [1, 2]])
def test_what_decays_decays_at_least_as_fast(out: list[int]) -> None:
    """The slowest motion may hardly be in the start."""
    wanted = predicted(with_feedback(-0.3), out)
    assert wanted < 0.0
    assert rate(simulated(with_feedback(-0.3), out, ticks=1500)) < wanted + 2e-3


def test_gains_with_which_it_grows_are_refused() -> None:
    gains = with_feedback(1.0)
    deployment = deploy(artefact(), NODES, TICK_S, FACES_M)
    with pytest.raises(UsageError, match=r"--restart: at setpoint straight the loop would grow by"):
        refuse_growing_gaps(gains, deployment, ["straight"], 1)
    refuse_growing_gaps(artefact(), deployment, ["straight", "1"], 1)
