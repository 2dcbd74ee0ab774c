"""A chain of segments with random matrices, small enough that many ticks stay finite."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from node.scheduling import Sectors
from node.sweep import NodeSweep
from wire.factors import NodeFactors, SweepFactors
from wire.reference import Leg, Reference

Array = npt.NDArray[np.float64]
FORWARD, BACKWARD = 3, 2
"""Numbers of the sums, without what the scheduling adds."""
BEND = 0.1
FADE = 0.8
SECTORS = Sectors((0, 1), (0.9,), 0.05)
"""Which the moving reference of `sweep` passes through, from setpoint 0 to 1 and back."""


def factors(index: int, nodes: int, setpoints: int = 1, size: float = 3.0) -> NodeFactors:
    """Random factors with sums of three numbers forward and two backward; none at the ends."""
    rng = np.random.default_rng([5, index])
    c, c_next = FORWARD * (index > 0), FORWARD * (index < nodes - 1)
    d, d_previous = BACKWARD * (index < nodes - 1), BACKWARD * (index > 0)
    shapes = {
        "D": (5, 7),
        "P": (5, c),
        "Q": (c_next, 7),
        "W": (c_next, c),
        "U": (5, d),
        "R": (d_previous, 7),
        "V": (d_previous, d),
        "out_offset": (5,),
    }

    def at_setpoint() -> SweepFactors:
        made = {k: size * rng.normal(size=shape) for k, shape in shapes.items()}
        made["in_offset"] = np.concatenate([made["out_offset"], made["out_offset"][[1, 3]]])
        return SweepFactors(**made)

    start = rng.normal(size=(setpoints, 4)), rng.normal(size=setpoints)
    all_of_them = tuple(at_setpoint() for _ in range(setpoints))
    return NodeFactors(index, nodes, BEND, *start, all_of_them)


def reference(index: int, nodes: int) -> Reference:
    """Small motions around a chord that turns up and down again, for a tick of 0.1 s."""
    rng = np.random.default_rng([6, index])
    up = 0.02 * rng.normal(size=(4, 7, 3))
    up[0, 5:, :2] = [[0.75 / nodes, -0.25 / nodes], [0.75 / nodes, 0.25 / nodes]]
    down = up.copy()
    down[0, 5:, 1] *= -1.0
    return Reference(0.1, [Leg(0.3, 1.0, up), Leg(1.6, 1.0, down)], held=4)


def sweep(index: int, nodes: int) -> NodeSweep:
    """A segment of a chain whose gains change, twice, while its reference moves."""
    return NodeSweep(
        factors(index, nodes, setpoints=2, size=0.2),
        reference=reference(index, nodes),
        sectors=SECTORS,
        fade=FADE,
    )


def measurements(tick: int, nodes: int) -> Array:
    """y(tick), (nodes, 2)."""
    return np.random.default_rng([7, tick]).normal(scale=0.1, size=(nodes, 2))


def tick_by_hand(sweeps: Sequence[NodeSweep], y: Array) -> Array:
    """One tick of a whole chain, straight through: the commands of the next tick."""
    for one, own in zip(sweeps, y, strict=True):
        one.input(own)
    c = np.zeros(0)
    for one in sweeps:
        c = one.forward(c)
    d = np.zeros(0)
    for one in reversed(sweeps):
        d = one.backward(d)
    for one in sweeps:
        one.accept(one.output())
    return np.array([one.command for one in sweeps])
