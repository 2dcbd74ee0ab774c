"""One node's sweep mathematics against plain matrix products."""

import numpy as np
import pytest

from node.sweep import NodeSweep
from wire.errors import OctarmError, UsageError
from wire.factors import INPUTS, OUTPUTS, NodeFactors, SweepFactors


def random_factors(seed: int, c: int, c_next: int, d: int, d_previous: int) -> SweepFactors:
    random = np.random.default_rng(seed)
    shapes = {
        "D": (OUTPUTS, INPUTS),
        "P": (OUTPUTS, c),
        "Q": (c_next, INPUTS),
        "W": (c_next, c),
        "U": (OUTPUTS, d),
        "R": (d_previous, INPUTS),
        "V": (d_previous, d),
        "in_offset": (INPUTS,),
        "out_offset": (OUTPUTS,),
    }
    return SweepFactors(**{key: random.standard_normal(shape) for key, shape in shapes.items()})


def random_node(seed: int, sizes: list[tuple[int, int, int, int]]) -> NodeFactors:
    random = np.random.default_rng(seed + 1000)
    return NodeFactors(
        index=3,
        initial_estimate=random.standard_normal((len(sizes), 4)),
        initial_command=random.standard_normal(len(sizes)),
        setpoints=tuple(random_factors(seed + i, *size) for i, size in enumerate(sizes)),
    )


@pytest.mark.parametrize("sizes", [(3, 4, 2, 5), (0, 3, 3, 0), (2, 0, 0, 4), (0, 0, 0, 0)])
@pytest.mark.parametrize("as_list", [False, True])
def test_products_are_those_of_the_matrices(
    sizes: tuple[int, int, int, int], as_list: bool
) -> None:
    node = random_node(5, [sizes])
    f = node.setpoints[0]
    sweep = NodeSweep(node)
    random = np.random.default_rng(6)
    for _ in range(3):
        y = random.standard_normal(2)
        c = random.standard_normal(sizes[0])
        d = random.standard_normal(sizes[2])
        expected_in = np.concatenate([sweep.estimate, [sweep.command], y])
        z = expected_in - f.in_offset
        x = sweep.input(y.tolist() if as_list else y)
        np.testing.assert_array_equal(x, expected_in)
        c_sent, d_sent = (c.tolist(), d.tolist()) if as_list else (c, d)
        np.testing.assert_allclose(
            sweep.backward(x, d_sent), f.V @ d + f.R @ z, rtol=1e-13, atol=1e-13
        )
        np.testing.assert_allclose(
            sweep.forward(x, c_sent), f.W @ c + f.Q @ z, rtol=1e-13, atol=1e-13
        )
        out = sweep.output(x, c_sent, d_sent)
        np.testing.assert_allclose(
            out, f.D @ z + f.P @ c + f.U @ d + f.out_offset, rtol=1e-13, atol=1e-13
        )
        sweep.accept(out)
        np.testing.assert_array_equal(sweep.estimate, out[:4])
        assert sweep.command == out[4]


def test_products_use_their_own_arguments_only() -> None:
    """Nothing that an earlier call left in the buffers gets into a later one."""
    node = random_node(12, [(2, 2, 3, 3)])
    f = node.setpoints[0]
    sweep = NodeSweep(node)
    x = sweep.input([0.3, -0.2]).copy()
    sweep.forward(2.0 * x, [5.0, 6.0])
    sweep.backward(3.0 * x, [7.0, 8.0, 9.0])
    c, d = np.array([0.1, 0.2]), np.array([0.3, 0.4, 0.5])
    z = x - f.in_offset
    expected = f.D @ z + f.P @ c + f.U @ d + f.out_offset
    np.testing.assert_allclose(sweep.output(x, c, d), expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_array_equal(sweep.estimate, node.initial_estimate[0])


def test_starts_at_the_setpoint_it_is_told() -> None:
    node = random_node(7, [(1, 1, 1, 1), (2, 3, 4, 5)])
    sweep = NodeSweep(node, setpoint=1)
    np.testing.assert_array_equal(sweep.estimate, node.initial_estimate[1])
    assert sweep.command == node.initial_command[1]
    assert (sweep.forward_received, sweep.backward_received) == (2, 4)


def test_selecting_a_setpoint_changes_the_factors_and_keeps_the_state() -> None:
    node = random_node(8, [(1, 1, 1, 1), (2, 3, 4, 5)])
    sweep = NodeSweep(node)
    before = sweep.estimate.copy()
    sweep.select(1)
    assert sweep.setpoint == 1
    np.testing.assert_array_equal(sweep.estimate, before)
    x = sweep.input([0.1, 0.2])
    f = node.setpoints[1]
    expected = f.W @ [1.0, 2.0] + f.Q @ (x - f.in_offset)
    np.testing.assert_allclose(sweep.forward(x, [1.0, 2.0]), expected, rtol=1e-13)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_a_sum_of_the_wrong_length_is_refused(count: int) -> None:
    sweep = NodeSweep(random_node(9, [(2, 2, 2, 2)]))
    x = sweep.input([0.0, 0.0])
    with pytest.raises(OctarmError, match=rf"node 3: forward sum of {count} numbers.* needs 2"):
        sweep.forward(x, [0.0] * count)
    with pytest.raises(OctarmError, match=rf"node 3: backward sum of {count} numbers.* needs 2"):
        sweep.backward(x, [0.0] * count)
    with pytest.raises(OctarmError, match="forward sum"):
        sweep.output(x, [0.0] * count, [0.0] * 2)


@pytest.mark.parametrize("setpoint", [-1, 2])
def test_a_setpoint_that_does_not_exist_is_refused(setpoint: int) -> None:
    with pytest.raises(UsageError, match=rf"setpoint {setpoint} does not exist.* 2 \(0 \.\. 1\)"):
        NodeSweep(random_node(10, [(1, 1, 1, 1), (1, 1, 1, 1)]), setpoint)


def test_nothing_is_allocated_between_ticks() -> None:
    sweep = NodeSweep(random_node(11, [(2, 3, 4, 5)]))
    x = sweep.input([1.0, 2.0])
    c_next, d_previous = sweep.forward(x, [1.0, 2.0]), sweep.backward(x, [1.0] * 4)
    assert sweep.input([0.0, 0.0]) is x
    assert sweep.forward(x, [0.0, 0.0]) is c_next
    assert sweep.backward(x, [0.0] * 4) is d_previous
