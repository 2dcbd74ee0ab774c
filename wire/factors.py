"""What one node needs to take part in the sweeps: made by `deploy`, sent at start-up, run by
`node`.

Numbers are float64 arrays in SI units for the deviation from a setpoint; the sums c and d have no
unit of their own. Plain form (for msgpack, a dictionary): an array is [shape..., bytes of
little-endian float64].
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from wire.errors import UsageError

Array = npt.NDArray[np.float64]

INPUTS = 7
"""Numbers of a node's input: estimate (v_x, v_y, e, k), command, measurement (v_y, k)."""
OUTPUTS = 5
"""Numbers of a node's output: estimate (v_x, v_y, e, k), command."""
STATES = 4
"""Numbers of a node's estimate."""
FORWARD_EXTRA = 3
"""Numbers behind a forward sum: turn from the reference and end (x, y) of the estimated arm so far."""
BACKWARD_EXTRA = 1
"""Numbers behind a backward sum: the setpoint whose factors are used from the next tick on."""


@dataclass(frozen=True, eq=False)
class SweepFactors:
    """One node's matrices at one setpoint (theory, section 5).

    c_next = W c + Q (in - in_offset),   d_previous = V d + R (in - in_offset),
    out = D (in - in_offset) + P c + U d + out_offset,
    in = (v_x, v_y, e, k, u, y_v, y_k), out = (v_x, v_y, e, k, u): m/s, m/s, 1, 1/m, N/m, m/s, 1/m.
    c comes from the root's side, d from the tip's side. UsageError if the shapes do not fit
    together.
    """

    D: Array
    P: Array
    Q: Array
    W: Array
    U: Array
    R: Array
    V: Array
    in_offset: Array
    out_offset: Array

    def __post_init__(self) -> None:
        c_next, c = _shape(self.W, "W")
        d_previous, d = _shape(self.V, "V")
        expected = {
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
        for key, shape in expected.items():
            value = getattr(self, key)
            if value.shape != shape or value.dtype != np.float64:
                raise UsageError(
                    f"sweep factor {key}: expected float64 of shape {shape}, got {value.dtype} of "
                    f"shape {value.shape}; deploy the gains again"
                )

    @property
    def forward_received(self) -> int:
        """Numbers received from the root's side a tick (0 at the root node)."""
        return int(self.W.shape[1])

    @property
    def forward_sent(self) -> int:
        """Numbers sent to the tip's side a tick (0 at the tip node)."""
        return int(self.W.shape[0])

    @property
    def backward_received(self) -> int:
        """Numbers received from the tip's side a tick (0 at the tip node)."""
        return int(self.V.shape[1])

    @property
    def backward_sent(self) -> int:
        """Numbers sent to the root's side a tick (0 at the root node)."""
        return int(self.V.shape[0])

    def to_plain(self) -> dict[str, Any]:
        """As a dictionary of lists and bytes."""
        return {field.name: _pack(getattr(self, field.name)) for field in fields(self)}

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> SweepFactors:
        """From `to_plain`; UsageError names what is missing or damaged."""
        return cls(**{field.name: _unpack(plain, field.name) for field in fields(cls)})


@dataclass(frozen=True, eq=False)
class NodeFactors:
    """One node's factors at all setpoints, and where it starts.

    `initial_estimate` (setpoints, 4) and `initial_command` (setpoints,) are xh(0) and u(0),
    absolute, when the run starts at that setpoint: the estimate starts at the setpoint, the command
    at its feed-forward. The sums of all setpoints have the same lengths. `bend_m`: length
    of the stretch that its curvature bends, from the centre before to its own.
    UsageError if something does not fit.
    """

    index: int
    nodes: int
    bend_m: float
    initial_estimate: Array
    initial_command: Array
    setpoints: tuple[SweepFactors, ...]

    def __post_init__(self) -> None:
        count = len(self.setpoints)
        if count == 0:
            raise UsageError(f"factors of node {self.index}: no setpoint; deploy the gains again")
        first = self.setpoints[0]
        for key, shape in (("initial_estimate", (count, STATES)), ("initial_command", (count,))):
            got = getattr(self, key).shape
            if got != shape:
                raise UsageError(
                    f"factors of node {self.index}, {key}: expected shape {shape}, got {got}; "
                    "deploy the gains again"
                )
        if not 0 <= self.index < self.nodes:
            raise UsageError(
                f"factors of node {self.index}: there are {self.nodes} nodes; deploy the gains again"
            )
        if not (math.isfinite(self.bend_m) and self.bend_m > 0.0):
            raise UsageError(
                f"factors of node {self.index}, bend_m: expected a positive length, got "
                f"{self.bend_m!r}; deploy the gains again"
            )
        if any((f.W.shape, f.V.shape) != (first.W.shape, first.V.shape) for f in self.setpoints):
            raise UsageError(
                f"factors of node {self.index}: the sums of its setpoints differ in length; deploy "
                "the gains again"
            )

    @property
    def forward_received(self) -> int:
        """Numbers in the message from the root's side (0 at the root node)."""
        return self.setpoints[0].forward_received + FORWARD_EXTRA if self.index > 0 else 0

    @property
    def backward_received(self) -> int:
        """Numbers in the message from the tip's side (0 at the tip node)."""
        last = self.index == self.nodes - 1
        return 0 if last else self.setpoints[0].backward_received + BACKWARD_EXTRA

    def to_plain(self) -> dict[str, Any]:
        """As a dictionary of numbers, lists and bytes."""
        return {
            "index": self.index,
            "nodes": self.nodes,
            "bend_m": self.bend_m,
            "initial_estimate": _pack(self.initial_estimate),
            "initial_command": _pack(self.initial_command),
            "setpoints": [factors.to_plain() for factors in self.setpoints],
        }

    @classmethod
    def from_plain(cls, plain: Mapping[str, Any]) -> NodeFactors:
        """From `to_plain`; UsageError names what is missing or damaged."""
        try:
            index, nodes, setpoints = plain["index"], plain["nodes"], plain["setpoints"]
            bend = plain["bend_m"]
        except (KeyError, TypeError) as error:
            raise UsageError(
                f"factors of a node: {error} is missing; deploy the gains again"
            ) from None
        if type(index) is not int or type(nodes) is not int or type(setpoints) is not list:
            raise UsageError(
                "factors of a node: expected whole numbers index and nodes and a list of setpoints; "
                "deploy the gains again"
            )
        if type(bend) is not float:
            raise UsageError("factors of a node, bend_m: expected a number; deploy the gains again")
        return cls(
            index=index,
            nodes=nodes,
            bend_m=bend,
            initial_estimate=_unpack(plain, "initial_estimate"),
            initial_command=_unpack(plain, "initial_command"),
            setpoints=tuple(SweepFactors.from_plain(factors) for factors in setpoints),
        )


def _shape(array: Array, key: str) -> tuple[int, int]:
    if array.ndim != 2:
        raise UsageError(
            f"sweep factor {key}: expected a matrix, got shape {array.shape}; deploy again"
        )
    return int(array.shape[0]), int(array.shape[1])


def _pack(array: Array) -> list[Any]:
    return [*array.shape, np.ascontiguousarray(array, dtype="<f8").tobytes()]


def _unpack(plain: Mapping[str, Any], key: str) -> Array:
    try:
        *shape, raw = plain[key]
        array = np.frombuffer(raw, dtype="<f8").reshape(shape).astype(np.float64)
    except (KeyError, TypeError, ValueError, OverflowError, MemoryError) as error:
        raise UsageError(
            f"factor {key}: expected [shape..., float64 bytes], got none ({error}); "
            "deploy the gains again"
        ) from None
    if not np.all(np.isfinite(array)):
        raise UsageError(f"factor {key}: a number in it is not finite; deploy the gains again")
    return array
