"""Numbers that are not finite: refused if they came so, the end of the node if it has computed them.

For `node.block`, which looks at one total first and asks here only if that is not finite.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

import numpy as np

from node.sweep import Array, NodeSweep, Payload
from wire.messages import F8, Reason, RejectedError

_OUTPUT = ("velocity_x", "velocity_y", "strain", "curvature", "command")


class NotFiniteError(Exception):
    """A number that this node computed is not finite; the text names node, tick and field."""


def explain(tick: int, numbers: Array, field: str, came: Payload, sweep: NodeSweep) -> None:
    """A total is not finite: refuse what came, or fail for what was made of it; or it only overflowed."""
    check_finite(field, came)
    wrong = np.flatnonzero(~np.isfinite(numbers))
    if wrong.size:
        at = int(wrong[0])
        name = _OUTPUT[at] if field.startswith("estimate") else f"{field}[{at}]"
        raise NotFiniteError(
            f"tick {tick}: node {sweep.index} computed {name} = {float(numbers[at])}"
        )


def check_finite(field: str, values: Payload) -> None:
    """RejectedError if one of the doubles that came is not finite."""
    numbers = np.frombuffer(values, F8).tolist()
    if not isfinite(sum(numbers)):
        refuse_not_finite(field, numbers)


def refuse_not_finite(field: str, values: Sequence[float]) -> None:
    """RejectedError with the first number that is not finite; none if only their sum overflowed."""
    for at, value in enumerate(values):
        if not isfinite(value):
            raise RejectedError(Reason.NOT_FINITE, f"{field}[{at}] is {value}")
