"""Deployment without dense matrices: the same maps and ranks as the dense one, and as a direct solve."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from deploy_artefacts import ARM, CURVED, STRAIGHT, gains, make_artefact

from deploy.deployment import deploy
from deploy.direct_tick import direct_tick
from deploy.feedforward import holding_commands
from deploy.grid import COMMAND_PLACES, MEASUREMENT_PLACES, STATE_PLACES, make_grid
from deploy.implicit_chain import one_way_sums
from deploy.model import make_model
from deploy.operators import operator_matrix
from deploy.semiseparable import NodeMatrices, multiply
from deploy.separable import REACH, SeparableGain, banded_model, separable_gain
from deploy.shorten import norm_bound, shorten
from deploy.structured import (
    MOST_HELD,
    projected,
    setpoint_offsets,
    structured_deploy,
    structured_step,
)
from supervise.shipped import DEFAULT_GAINS
from wire.artefact import GainsArtefact, read_artefact
from wire.errors import OctarmError, UsageError
from wire.factors import INPUTS, NodeFactors

Array = npt.NDArray[np.float64]

TICK_S = 0.1
SMALL = make_artefact()
VISCOUS = make_artefact(
    arm=msgspec.structs.replace(ARM, kelvin_voigt_s=0.01, actuator="normal"),
)
SHIPPED = read_artefact(DEFAULT_GAINS)


def dense(gain: SeparableGain) -> Array:
    _, n, _, inputs = gain.band.shape
    return np.stack([gain(e.reshape(n, inputs)).ravel() for e in np.eye(n * inputs)], axis=1)


def matrices(nodes: tuple[NodeFactors, ...], setpoint: int) -> list[NodeMatrices]:
    found = [node.setpoints[setpoint] for node in nodes]
    return [NodeMatrices(D=f.D, P=f.P, Q=f.Q, W=f.W, U=f.U, R=f.R, V=f.V) for f in found]


def relative(got: Array, expected: Array) -> float:
    size = np.max(np.abs(expected), axis=0)
    return float(np.max(np.abs(got - expected) / np.where(size > 0.0, size, 1.0)))


@pytest.mark.parametrize("spacing", ["equispaced", "chebyshev"])
@pytest.mark.parametrize("n", [2, 3, 12])
@pytest.mark.parametrize("artefact", [SMALL, VISCOUS, SHIPPED])
def test_bands_and_factors_are_the_dense_matrices(
    artefact: GainsArtefact, n: int, spacing: str
) -> None:
    grid = make_grid(artefact.arm.length_m, n, spacing)
    for one in artefact.setpoints:
        for factors, to, source in (
            (one.observer, STATE_PLACES, MEASUREMENT_PLACES),
            (one.controller, COMMAND_PLACES, STATE_PLACES),
        ):
            expected = operator_matrix(factors, grid, to, source)
            gain = separable_gain(factors, grid, to, source)
            size = np.max(np.abs(expected))
            assert np.max(np.abs(dense(gain) - expected)) < 1e-13 * size
            assert np.max(np.abs(dense(gain.transposed) - expected.T)) < 1e-13 * size
            assert gain.norm() == pytest.approx(np.linalg.norm(expected, 2), rel=1e-8)
        model = make_model(artefact.arm, one.curvature_per_m, grid)
        bands = banded_model(artefact.arm, one.curvature_per_m, grid)
        whole = np.zeros((n, 4, n, 4))
        for o in range(-REACH, REACH + 1):
            for i in range(max(0, -o), n - max(0, o)):
                whole[i, :, i + o] = bands.A[REACH + o, i]
        assert np.max(np.abs(whole.reshape(4 * n, 4 * n) - model.A)) < 1e-12 * np.max(
            np.abs(model.A)
        )
        loads = model.B.reshape(n, 4, n)[np.arange(n), :, np.arange(n)]
        np.testing.assert_allclose(bands.B[:, :, 0], loads, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize(
    ("artefact", "n", "spacing"),
    [
        (SHIPPED, 2, "equispaced"),
        (SHIPPED, 10, "equispaced"),
        (SHIPPED, 10, "chebyshev"),
        (SHIPPED, 40, "equispaced"),
        (SHIPPED, 100, "equispaced"),
        (SMALL, 40, "chebyshev"),
        (VISCOUS, 40, "equispaced"),
    ],
)
def test_it_is_what_deploy_gives(artefact: GainsArtefact, n: int, spacing: str) -> None:
    expected = deploy(artefact, n, TICK_S, spacing)
    found = structured_deploy(artefact, n, TICK_S, spacing)
    assert found.ranks_forward == expected.ranks_forward
    assert found.ranks_backward == expected.ranks_backward
    random = np.random.default_rng(3)
    for k in range(len(artefact.setpoints)):
        size = [max(np.abs(s.setpoints[k].D).max() for s in expected.nodes)]
        inputs = random.standard_normal((n, INPUTS)) / size[0]
        wanted = (expected.dense[k].M @ inputs.ravel()).reshape(n, -1)
        assert relative(multiply(matrices(found.nodes, k), inputs), wanted) < 1e-10
        for a, b in zip(found.nodes, expected.nodes, strict=True):
            np.testing.assert_array_equal(a.setpoints[k].in_offset, b.setpoints[k].in_offset)
            np.testing.assert_array_equal(a.setpoints[k].out_offset, b.setpoints[k].out_offset)
            assert a.bend_m == b.bend_m
            assert a.forward_received == b.forward_received
            assert a.backward_received == b.backward_received


@pytest.mark.parametrize("n", [10, 400])
def test_sums_are_a_direct_solve_and_do_not_grow(n: int) -> None:
    grid = make_grid(SHIPPED.arm.length_m, n, "equispaced")
    for one in SHIPPED.setpoints:
        step = structured_step(SHIPPED.arm, one, grid, TICK_S)
        inputs = np.random.default_rng(4).standard_normal((n, INPUTS))
        expected = direct_tick(step, inputs)
        sums = one_way_sums(step.chain)
        short = shorten(sums)
        assert relative(multiply(sums, inputs), expected) < 1e-10
        assert relative(multiply(short, inputs), expected) < 1e-10
        for m in short[:-1]:
            rows = np.hstack([m.W, m.Q])
            np.testing.assert_allclose(rows @ rows.T, np.eye(len(rows)), atol=1e-12)


def test_messages_keep_their_length() -> None:
    ranks = [
        (max(map(max, found.ranks_forward)), max(map(max, found.ranks_backward)))
        for found in (structured_deploy(SHIPPED, n, TICK_S) for n in (40, 300))
    ]
    assert ranks[0] == ranks[1]


def test_the_bound_is_that_of_the_dense_form() -> None:
    grid = make_grid(SMALL.arm.length_m, 8, "equispaced")
    step = structured_step(SMALL.arm, SMALL.setpoints[1], grid, TICK_S)
    sums = one_way_sums(step.chain)
    unit = np.eye(8 * INPUTS).reshape(-1, 8, INPUTS)
    whole = np.abs(np.stack([multiply(sums, one).ravel() for one in unit], axis=1))
    expected = np.sqrt(whole.sum(axis=0).max() * whole.sum(axis=1).max())
    assert norm_bound(sums) == pytest.approx(expected, rel=1e-12)


def test_commands_of_many_segments_are_the_projection() -> None:
    n = MOST_HELD + 10
    grid = make_grid(ARM.length_m, n, "chebyshev")
    one = SMALL.setpoints[1]
    in_offset, out_offset = setpoint_offsets(ARM, one, grid)
    series = np.array([0.3, -0.2, 0.1, 0.05])
    np.testing.assert_allclose(projected(series, grid), holding_commands(series, grid), rtol=1e-9)
    np.testing.assert_array_equal(in_offset[:, :5], out_offset)
    np.testing.assert_array_equal(in_offset[:, 5:], out_offset[:, [1, 3]])
    few = setpoint_offsets(ARM, one, make_grid(ARM.length_m, MOST_HELD, "chebyshev"))[1]
    here, there = (
        np.interp(0.4 * ARM.length_m, make_grid(ARM.length_m, m, "chebyshev").faces_m[:-1], k[:, 3])
        for m, k in ((n, out_offset), (MOST_HELD, few))
    )
    assert here == pytest.approx(there, rel=1e-3)


def test_a_tick_too_long_and_a_gain_too_strong_are_refused() -> None:
    with pytest.raises(UsageError, match="too long"):
        structured_deploy(SMALL, 10, 50.0)
    with pytest.raises(UsageError, match="positive"):
        structured_deploy(SMALL, 10, 0.0)
    artefact = make_artefact((STRAIGHT, CURVED), operators=[gains(8.0), gains(8.0)])
    grid = make_grid(ARM.length_m, 10, "equispaced")
    step = structured_step(ARM, artefact.setpoints[0], grid, 0.1)
    with pytest.raises(OctarmError, match="no fixed point"):
        direct_tick(replace(step, tick_s=1.0), np.ones((10, INPUTS)))
