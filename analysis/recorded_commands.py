"""The commands that were in force, from those that the nodes have told: what the plant did without one.

From the rows of a recording to `Recording.commands`; what the plant does is in plant/exchange.py.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


def in_force(
    told: Array, late: Flags, on_time: Flags, alive: Flags, rest: Array, fade: float
) -> Array:
    """(K, n) loads in N/m: in late ticks and of a node that was late the last one, of one that was dead the
    last one faded into what holds the setpoint. A NaN of a node that was on time stays: its row was lost.

    told: (K, n), NaN where there is none. late: (K,) ticks without a sweep. on_time, alive: (K, n), of each
    node. rest: (K, n), what holds the setpoint of each tick. fade: what is left of a difference after a tick.
    """
    commands = told.copy()
    for k in 1 + np.flatnonzero(~np.isfinite(commands[1:]).all(axis=1)):
        unknown = ~np.isfinite(commands[k]) & (late[k] | ~on_time[k])
        before = commands[k - 1]
        faded = np.where(alive[k], before, rest[k] + fade * (before - rest[k]))
        commands[k, unknown] = (before if late[k] else faded)[unknown]
    return commands
