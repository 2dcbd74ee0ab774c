"""One node's sweep mathematics against plain matrix products."""

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from node.row import Batch
from node.scheduling import Sectors
from node.sweep import Array, NodeSweep, Numbers, payload
from wire.errors import OctarmError, UsageError
from wire.factors import INPUTS, OUTPUTS, NodeFactors, SweepFactors
from wire.reference import Leg, Reference

BEND = 0.07
ROUNDING = 1e-15
"""A state is held as its deviation from the reference, of about its own size here."""
SO_FAR = [0.3, 0.2, -0.1]
"""Angle and place that come with a forward sum."""


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
    made = {key: random.standard_normal(shape) for key, shape in shapes.items()}
    made["in_offset"] = np.concatenate([made["out_offset"], made["out_offset"][[1, 3]]])
    return SweepFactors(**made)


def random_node(seed: int, sizes: list[tuple[int, int, int, int]]) -> NodeFactors:
    """Node 3 of 5; the root if its forward sum is empty, the tip if its backward sum is."""
    random = np.random.default_rng(seed + 1000)
    return NodeFactors(
        index=0 if sizes[0][0] == 0 else 3,
        nodes=4 if sizes[0][2] == 0 else 5,
        bend_m=BEND,
        initial_estimate=random.standard_normal((len(sizes), 4)),
        initial_command=random.standard_normal(len(sizes)),
        setpoints=tuple(random_factors(seed + i, *size) for i, size in enumerate(sizes)),
    )


def factor_input(sweep: NodeSweep, y: Numbers) -> Array:
    """The input in the order of the factors: estimate, command, measurement."""
    return np.concatenate([sweep.estimate, [sweep.command], y])


def reference_input(wanted: Array) -> Array:
    """The input of a node that is where the reference has it."""
    return np.concatenate([wanted[:5], wanted[[1, 3]]])


def tick_output(sweep: NodeSweep, y: Numbers, c: Numbers, d: Numbers) -> Array:
    """One tick, all of it at once; the output (a copy)."""
    sweep.input(y)
    sweep.forward(c)
    sweep.backward(d)
    return sweep.output().copy()


@pytest.mark.parametrize("sizes", [(3, 4, 2, 5), (0, 3, 3, 0), (2, 0, 0, 4)])
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
        state = [*sweep.estimate, sweep.command]
        z = factor_input(sweep, y) - f.in_offset
        x = sweep.input(y.tolist() if as_list else y)
        np.testing.assert_array_equal(x, [*state, *y])
        c_sent: Numbers = np.append(c, SO_FAR) if sizes[0] else c
        d_sent: Numbers = np.append(d, 0.0) if sizes[2] else d
        if as_list:
            c_sent, d_sent = list(c_sent), list(d_sent)
        sums = f.V @ d + f.R @ z
        np.testing.assert_allclose(
            sweep.backward(d_sent)[: len(sums)], sums, rtol=1e-13, atol=1e-13
        )
        sums = f.W @ c + f.Q @ z
        np.testing.assert_allclose(sweep.forward(c_sent)[: len(sums)], sums, rtol=1e-13, atol=1e-13)
        out = sweep.output().copy()
        np.testing.assert_allclose(
            out, f.D @ z + f.P @ c + f.U @ d + f.out_offset, rtol=1e-13, atol=1e-13
        )
        sweep.accept(out)
        np.testing.assert_array_equal(sweep.estimate, out[:4])
        assert sweep.command == out[4]


@pytest.mark.parametrize("sizes", [(3, 4, 2, 5), (0, 3, 3, 0), (2, 0, 0, 4)])
def test_the_order_of_the_three_changes_no_bit(sizes: tuple[int, int, int, int]) -> None:
    results = set()
    for order in permutations(("y", "c", "d")):
        node = random_node(20, [sizes])
        sweep = NodeSweep(node)
        random = np.random.default_rng(21)
        got = b""
        for _ in range(4):
            y = random.standard_normal(2)
            c = np.append(random.standard_normal(sizes[0]), SO_FAR if sizes[0] else [])
            d = np.append(random.standard_normal(sizes[2]), 0.0 if sizes[2] else [])
            for what in order:
                if what == "y":
                    sweep.input(y)
                elif what == "c" and not sweep.first:
                    sweep.take_forward(payload(c))
                elif what == "d" and not sweep.last:
                    sweep.take_backward(payload(d))
            if not sweep.last:
                got += sweep.forward_sum().tobytes()
            if not sweep.first:
                got += sweep.backward_sum().tobytes()
            out = 0.1 * sweep.output()
            got += out.tobytes()
            sweep.accept(out)
        results.add(got)
    assert len(results) == 1


def test_products_use_their_own_arguments_only() -> None:
    """Nothing that an earlier call left in the buffers gets into a later one."""
    node = random_node(12, [(2, 2, 3, 3)])
    f = node.setpoints[0]
    sweep = NodeSweep(node)
    sweep.input([70.0, -30.0])
    sweep.forward([5.0, 6.0, *SO_FAR])
    sweep.backward([7.0, 8.0, 9.0, 0.0])
    sweep.output()
    c, d = np.array([0.1, 0.2]), np.array([0.3, 0.4, 0.5])
    z = factor_input(sweep, [0.3, -0.2]) - f.in_offset
    expected = f.D @ z + f.P @ c + f.U @ d + f.out_offset
    out = tick_output(sweep, [0.3, -0.2], np.append(c, SO_FAR), np.append(d, 0.0))
    np.testing.assert_allclose(out, expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(sweep.estimate, node.initial_estimate[0], rtol=ROUNDING)


def test_what_a_tick_knows_is_in_its_row() -> None:
    sweep = NodeSweep(random_node(23, [(2, 3, 4, 5)]))
    state = sweep.state
    c, d = [1.0, 2.0, *SO_FAR], [3.0, 4.0, 5.0, 6.0, 0.0]
    out = tick_output(sweep, [0.3, -0.2], c, d)
    row = sweep.row.now(sweep.reference)
    np.testing.assert_array_equal(row[:-5], [0.3, -0.2, *state, 0.0, 0.0, *c, *d])
    sweep.accept(out)
    np.testing.assert_allclose(sweep.state, out, rtol=1e-15, atol=1e-15)


def test_a_batch_keeps_rows_as_they_were_with_absolute_states() -> None:
    node = random_node(24, [(2, 3, 4, 5)])
    coefficients = np.random.default_rng(17).standard_normal((4, 7, 3))
    for reference in (None, Reference(0.1, [Leg(0.0, 0.3, coefficients)])):
        sweep = NodeSweep(node, reference=reference)
        batch = Batch(sweep.row, 4)
        for rounds in range(2):
            states = []
            for _ in range(3):
                tick_output(sweep, [0.1, 0.2], [0.1, 0.2, *SO_FAR], [0.3, 0.4, 0.5, 0.6, 0.0])
                states.append(sweep.state)
                batch.keep(sweep.reference)
                sweep.accept(0.1 * sweep.output())
            rows = batch.take()
            assert rows.shape == (3, 9 + 5 + 5 + 4 + 1), rounds
            np.testing.assert_array_equal(rows[:, 2:7], states)


def test_sums_are_written_where_they_are_sent_from() -> None:
    sweep = NodeSweep(random_node(25, [(2, 3, 4, 5)]))
    assert (sweep.forward_sent, sweep.backward_sent) == (3 + 3, 5 + 1)
    forward, backward = np.zeros(6), np.zeros(6)
    sweep.send_from(forward, backward)
    sweep.input([0.3, -0.2])
    assert sweep.forward([1.0, 2.0, *SO_FAR]) is forward
    assert sweep.backward([3.0, 4.0, 5.0, 6.0, 0.0]) is backward
    assert forward.all()
    assert backward[:-1].all()


def test_starts_at_the_setpoint_it_is_told() -> None:
    node = random_node(7, [(2, 3, 4, 5), (2, 3, 4, 5)])
    sweep = NodeSweep(node, setpoint=1)
    np.testing.assert_allclose(sweep.estimate, node.initial_estimate[1], rtol=ROUNDING)
    assert sweep.command == pytest.approx(node.initial_command[1], rel=ROUNDING)
    assert (sweep.forward_received, sweep.backward_received) == (2 + 3, 4 + 1)


def test_selecting_a_setpoint_changes_the_factors_and_keeps_the_state() -> None:
    node = random_node(8, [(2, 3, 4, 5), (2, 3, 4, 5)])
    sweep = NodeSweep(node)
    before = sweep.estimate.copy()
    sweep.select(1)
    assert sweep.setpoint == 1
    np.testing.assert_array_equal(sweep.estimate, before)
    sweep.input([0.1, 0.2])
    f = node.setpoints[1]
    reference = reference_input(node.setpoints[0].out_offset)  # it stays where the run rests
    expected = f.W @ [1.0, 2.0] + f.Q @ (factor_input(sweep, [0.1, 0.2]) - reference)
    np.testing.assert_allclose(sweep.forward([1.0, 2.0, *SO_FAR])[:3], expected, rtol=1e-13)


@pytest.mark.parametrize("count", [0, 2, 6])
def test_a_sum_of_the_wrong_length_is_refused(count: int) -> None:
    sweep = NodeSweep(random_node(9, [(2, 2, 2, 2)]))
    sweep.input([0.0, 0.0])
    with pytest.raises(OctarmError, match=rf"node 3: forward sum of {count} numbers, expected 5"):
        sweep.forward([0.0] * count)
    with pytest.raises(OctarmError, match=rf"node 3: backward sum of {count} numbers, expected 3"):
        sweep.backward([0.0] * count)


@pytest.mark.parametrize("setpoint", [-1, 2])
def test_a_setpoint_that_does_not_exist_is_refused(setpoint: int) -> None:
    with pytest.raises(UsageError, match=rf"setpoint {setpoint} does not exist.* 2 \(0 \.\. 1\)"):
        NodeSweep(random_node(10, [(1, 1, 1, 1), (1, 1, 1, 1)]), setpoint)


def test_nothing_is_allocated_between_ticks() -> None:
    sweep = NodeSweep(random_node(11, [(2, 3, 4, 5)]))
    c_next = sweep.forward([1.0, 2.0, *SO_FAR])
    d_previous = sweep.backward([1.0, 1.0, 1.0, 1.0, 0.0])
    row = sweep.row
    for _ in range(4):
        sweep.input([0.0, 0.0])
        assert sweep.forward([0.0] * 5) is c_next
        assert sweep.backward([0.0] * 5) is d_previous
        sweep.accept(sweep.output())
        assert sweep.row is row


def test_a_change_of_gains_is_announced_then_taken_and_leaves_no_jump() -> None:
    """The command's deviation from the reference is held over the change; the difference is faded out."""
    node = random_node(13, [(2, 3, 4, 5), (2, 3, 4, 5)])
    fade = 0.75
    sweep = NodeSweep(node, fade=fade)
    reference = node.setpoints[0].out_offset[4]
    random = np.random.default_rng(14)
    commands, raw, bumps, used = [], [], [], []
    for tick, announced in enumerate([0, 1, 1, 1, 1]):
        y = random.standard_normal(2)
        c, d = [*random.standard_normal(2), *SO_FAR], [*random.standard_normal(4), float(announced)]
        used.append(sweep.setpoint)
        f = node.setpoints[sweep.setpoint]
        z = factor_input(sweep, y) - reference_input(node.setpoints[0].out_offset)
        raw.append(float((f.D @ z + f.P @ c[:2] + f.U @ d[:4])[4]) + reference)
        sweep.input(y)
        sweep.forward(c)
        assert sweep.backward(d)[-1] == announced
        sweep.accept(sweep.output())
        assert sweep.next_setpoint == announced
        commands.append(sweep.command)
        bumps.append(sweep.bump)
        assert sweep.tick == tick + 1
    assert used == [0, 0, 1, 1, 1]
    assert bumps[:2] == [0.0, 0.0]
    assert commands[2] == pytest.approx(commands[1], rel=1e-13)
    assert bumps[2] == pytest.approx(commands[1] - raw[2], rel=1e-13)
    assert bumps[3:] == pytest.approx([bumps[2] * fade, bumps[2] * fade**2], rel=1e-13)
    np.testing.assert_allclose(commands, np.add(raw, bumps), rtol=1e-12)


def test_the_tip_decides_by_its_estimate_and_says_so_a_tick_later() -> None:
    node = random_node(15, [(2, 0, 0, 4), (2, 0, 0, 4)])
    sweep = NodeSweep(node, sectors=Sectors((0, 1), (0.5,), 0.1))
    before = [0.0, 1.0, 0.2]  # angle 0.2 rad without this segment
    beyond = [1.2, 1.0, 1.0]
    announced = []
    for so_far in (before, beyond, beyond, beyond):
        sweep.estimate[2:] = 0.0
        sweep.input([0.0, 0.0])
        sweep.forward([0.1, 0.2, *so_far])
        announced.append(sweep.backward([])[-1])
        sweep.accept(sweep.output())
    assert announced == [0.0, 0.0, 1.0, 1.0]
    assert sweep.setpoint == 1


def test_the_reference_of_this_tick_goes_in_and_that_of_the_next_comes_out() -> None:
    node = random_node(16, [(2, 3, 4, 5)])
    coefficients = np.random.default_rng(17).standard_normal((4, 7, 3))
    reference = Reference(0.1, [Leg(0.1, 0.3, coefficients)])
    sweep = NodeSweep(node, reference=reference)
    f = node.setpoints[0]
    for tick in range(6):
        x, estimate = factor_input(sweep, [0.4, -0.6]), sweep.estimate.copy()
        now, then = reference.at(tick)[:5], reference.at(tick + 1)[:5]
        z = x - reference_input(now)
        expected = f.D @ z + f.P @ [0.1, 0.2] + f.U @ [1.0, 2.0, 3.0, 4.0] + then
        c, d = [0.1, 0.2, *SO_FAR], [1.0, 2.0, 3.0, 4.0, 0.0]
        out = tick_output(sweep, [0.4, -0.6], c, d)
        np.testing.assert_allclose(out, expected, rtol=1e-12, atol=1e-12)
        turn = SO_FAR[0] + BEND * (estimate[3] - now[3])
        chord = complex(*reference.at(tick)[5:]) * (1.0 + estimate[2]) / (1.0 + now[2])
        end = complex(*SO_FAR[1:]) + chord * np.exp(1j * turn)
        sent = sweep.forward([0.1, 0.2, *SO_FAR])[-3:]
        np.testing.assert_allclose(sent, [turn, end.real, end.imag], rtol=1e-12, atol=1e-12)
        sweep.accept(out * 0.1)


@given(before=st.integers(0, 5), ahead=st.integers(1, 8))
def test_over_ticks_without_a_sweep_the_deviation_is_kept_and_the_command_held(
    before: int, ahead: int
) -> None:
    node = random_node(19, [(2, 3, 4, 5)])
    coefficients = np.random.default_rng(17).standard_normal((4, 7, 3))
    reference = Reference(0.1, [Leg(0.1, 0.6, coefficients)])
    sweep = NodeSweep(node, reference=reference)
    c, d = [0.1, 0.2, *SO_FAR], [1.0, 2.0, 3.0, 4.0, 0.0]
    for _ in range(before):
        sweep.accept(0.1 * tick_output(sweep, [0.4, -0.6], c, d))
    deviation, command = sweep.estimate - reference.at(before)[:4], sweep.command
    then = before + ahead
    sweep.skip_to(then)
    assert sweep.tick == then
    np.testing.assert_allclose(sweep.estimate - reference.at(then)[:4], deviation, atol=1e-12)
    assert sweep.command == pytest.approx(command, rel=0.0, abs=10.0 * ROUNDING)
    f = node.setpoints[0]
    z = factor_input(sweep, [0.4, -0.6]) - reference_input(reference.at(then))
    expected = f.D @ z + f.P @ c[:2] + f.U @ d[:4] + reference.at(then + 1)[:5]
    np.testing.assert_allclose(
        tick_output(sweep, [0.4, -0.6], c, d), expected, rtol=1e-12, atol=1e-12
    )


def test_a_reference_of_another_shape_is_refused() -> None:
    node = random_node(18, [(2, 3, 4, 5)])
    short = Reference(0.1, [Leg(0.0, 0.0, np.zeros((4, 5, 1)))])
    with pytest.raises(UsageError, match="node 3: expected a reference of 7 numbers, got 5"):
        NodeSweep(node, reference=short)
