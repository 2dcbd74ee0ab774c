"""Whole deployments: chains of nodes against the dense matrix, refusals, reports."""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest
from deploy_artefacts import ARM, CURVED, STRAIGHT, gains, make_artefact
from numpy.polynomial import legendre

from deploy import Deployment, deploy
from deploy.equilibrium import equilibrium
from deploy.feedforward import holding_commands
from deploy.grid import make_grid
from node.sweep import NodeSweep
from wire.errors import UsageError

Array = npt.NDArray[np.float64]
TICK = 0.02


def run_chain(sweeps: Sequence[NodeSweep], measurements: Array) -> Array:
    """One tick of all nodes, messages handed over as lists; returns the outputs (n, 5)."""
    for sweep, y in zip(sweeps, measurements, strict=True):
        sweep.input(y)
    c: list[float] = []
    for sweep in sweeps:
        c = sweep.forward(c).tolist()
    d: list[float] = []
    for sweep in reversed(sweeps):
        d = sweep.backward(d).tolist()
    assert c == []
    assert d == []
    return np.stack([sweep.output() for sweep in sweeps])


def scales(deployment: Deployment) -> Array:
    """Typical sizes of outputs (n, 5): unit energy per node, and the force that goes with it."""
    sizes = 1.0 / np.sqrt(deployment.energy_weights)
    return np.hstack([sizes, sizes[:, 1:2]])


@pytest.mark.parametrize("spacing", ["equispaced", "chebyshev"])
@pytest.mark.parametrize("n", [2, 3, 10, 20, 50])
def test_nodes_equal_the_central_computer_for_many_ticks(n: int, spacing: str) -> None:
    deployment = deploy(make_artefact(), n, TICK, spacing)
    assert deployment.check < 1e-12
    random = np.random.default_rng(n)
    size = scales(deployment)
    for setpoint, dense in enumerate(deployment.dense):
        sweeps = [NodeSweep(node, setpoint) for node in deployment.nodes]
        state = np.hstack(
            [
                np.stack([node.initial_estimate[setpoint] for node in deployment.nodes]),
                np.stack([node.initial_command[setpoint] for node in deployment.nodes])[:, None],
            ]
        )
        for _ in range(4):
            y = dense.in_offset.reshape(n, 7)[:, 5:]
            y = y + random.standard_normal((n, 2)) * size[:, [1, 3]]
            state = dense(np.hstack([state, y]))
            out = run_chain(sweeps, y)
            np.testing.assert_allclose(out / size, state / size, rtol=0.0, atol=1e-11)
            for sweep, one in zip(sweeps, out, strict=True):
                sweep.accept(one)


def test_zero_deviation_stays() -> None:
    """At the setpoint, with its feed-forward and its measurements, nothing moves."""
    deployment = deploy(make_artefact(), 9, TICK)
    for setpoint, dense in enumerate(deployment.dense):
        np.testing.assert_array_equal(
            dense(dense.in_offset.reshape(9, 7)), dense.out_offset.reshape(9, 5)
        )
        sweeps = [NodeSweep(node, setpoint) for node in deployment.nodes]
        out = run_chain(sweeps, dense.in_offset.reshape(9, 7)[:, 5:])
        np.testing.assert_array_equal(out, dense.out_offset.reshape(9, 5))


def test_offsets_are_the_setpoint_where_each_node_holds_it() -> None:
    artefact = make_artefact()
    faces = [0.0, 0.3, 0.45, 0.9, 1.25]
    deployment = deploy(artefact, 4, TICK, faces)
    np.testing.assert_array_equal(deployment.faces_m, faces)
    grid = make_grid(ARM.length_m, 4, faces)
    for i, node in enumerate(deployment.nodes):
        inner = faces[i]
        for setpoint, factors in zip(artefact.setpoints, node.setpoints, strict=True):
            # what n commands hold is nearly the setpoint (how nearly: test_held.py)
            curvature = float(
                legendre.legval(2.0 * inner / ARM.length_m - 1.0, setpoint.curvature_per_m)
            )
            force = float(
                holding_commands(equilibrium(ARM, setpoint.curvature_per_m, "").load_n_per_m, grid)[
                    i
                ]
            )
            np.testing.assert_allclose(factors.in_offset[[3, 6]], curvature, atol=0.03)
            np.testing.assert_allclose(factors.in_offset[4], force, atol=3e-3)
            np.testing.assert_array_equal(factors.in_offset[[0, 1, 5]], 0.0)
            np.testing.assert_array_equal(factors.in_offset[:5], factors.out_offset)
        for setpoint_index, factors in enumerate(node.setpoints):
            np.testing.assert_array_equal(
                node.initial_estimate[setpoint_index], factors.out_offset[:4]
            )
            assert node.initial_command[setpoint_index] == factors.out_offset[4]


def test_ranks_are_small_and_do_not_depend_on_the_number_of_nodes() -> None:
    largest = []
    for n in (10, 20, 40):
        for spacing in ("equispaced", "chebyshev"):
            one = deploy(make_artefact(), n, TICK, spacing)
            assert all(len(ranks) == n - 1 for ranks in (*one.ranks_forward, *one.ranks_backward))
            largest.append([max(ranks) for ranks in (*one.ranks_forward, *one.ranks_backward)])
    assert all(ranks == largest[0] for ranks in largest)
    assert max(largest[0]) <= 10


def test_setpoints_may_have_sums_of_different_length() -> None:
    artefact = make_artefact([STRAIGHT, CURVED], operators=[gains(rank=0), gains(rank=2)])
    deployment = deploy(artefact, 12, TICK)
    assert max(deployment.ranks_forward[0]) < max(deployment.ranks_forward[1])
    middle = deployment.nodes[5]
    longest = [
        max(ranks[4] for ranks in way)
        for way in (deployment.ranks_forward, deployment.ranks_backward)
    ]
    assert [f.forward_received for f in middle.setpoints] == [longest[0]] * 2
    assert [f.backward_sent for f in middle.setpoints] == [longest[1]] * 2
    shorter = deployment.ranks_forward[0][4]
    assert not middle.setpoints[0].W[:, shorter:].any()
    assert not middle.setpoints[0].P[:, shorter:].any()
    assert middle.forward_received == longest[0] + 3
    assert deployment.nodes[-1].backward_received == deployment.nodes[0].forward_received == 0


def test_neighbours_agree_on_the_length_of_every_sum() -> None:
    nodes = deploy(make_artefact(), 7, TICK, "chebyshev").nodes
    for setpoint in range(2):
        chain = [node.setpoints[setpoint] for node in nodes]
        assert chain[0].forward_received == chain[0].backward_sent == 0
        assert chain[-1].backward_received == chain[-1].forward_sent == 0
        for inner, outer in pairwise(chain):
            assert inner.forward_sent == outer.forward_received
            assert outer.backward_sent == inner.backward_received


def test_energy_weights_and_counts_are_reported() -> None:
    deployment = deploy(make_artefact(), 5, TICK)
    assert deployment.energy_weights.shape == (5, 4)
    assert deployment.messages_per_tick == 8
    assert deployment.setpoint_names == ("shape 0", "shape 1")
    assert [node.index for node in deployment.nodes] == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("tick", [0.0, -0.1, math.nan, math.inf, True])
def test_a_tick_must_be_a_positive_number(tick: float) -> None:
    with pytest.raises(UsageError, match="tick: expected a positive number of seconds"):
        deploy(make_artefact(), 3, tick)


def test_spacing_and_nodes_are_checked() -> None:
    with pytest.raises(UsageError, match="at least 2, got 1"):
        deploy(make_artefact(), 1, TICK)
    with pytest.raises(UsageError, match="expected 'equispaced', 'chebyshev'"):
        deploy(make_artefact(), 3, TICK, "even")
    with pytest.raises(UsageError, match=r"end at the arm's length 1\.25 m, got 0 to 1 m"):
        deploy(make_artefact(), 2, TICK, [0.0, 0.5, 1.0])


def test_too_long_a_tick_is_refused_and_the_longest_named() -> None:
    artefact = make_artefact()
    longest = deploy(artefact, 10, TICK).longest_stable_tick_s
    assert TICK < longest < 1.0
    with pytest.raises(UsageError, match=r"tick .* s is too long.*longest stable tick") as caught:
        deploy(artefact, 10, 1.1 * longest)
    named = float(str(caught.value).split(" grid is ")[1].split(" s")[0])
    assert named == pytest.approx(longest, rel=0.05)
    radius = deploy(artefact, 10, named * 0.99).spectral_radius
    assert all(one.stable for one in radius)


def test_gains_that_feed_the_arm_are_refused_at_any_tick() -> None:
    artefact = make_artefact([STRAIGHT], operators=[gains(size_per_s=-0.5)])
    with pytest.raises(UsageError, match=r"'shape 0'.*no tick makes these gains stable"):
        deploy(artefact, 4, TICK)


@pytest.mark.parametrize("nodes", [2, 5, 10])
@pytest.mark.parametrize("tick_s", [5.0, 1000.0])
def test_a_tick_in_which_the_gains_cannot_act_is_refused(nodes: int, tick_s: float) -> None:
    """The implicit step is stable at such ticks again, but it is not the designed loop any more."""
    with pytest.raises(UsageError, match=f"tick {tick_s:g} s is too long"):
        deploy(make_artefact(), nodes, tick_s)
