"""What the plant tells the recorder: one row a tick, in batches that are sent between two ticks.

Beside the plant's process; `wire.channels.plant_channels` names the numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from time import monotonic_ns
from typing import Any

import numpy as np
import numpy.typing as npt

from plant.model import ArmPlant
from wire.channels import (
    BATCH_NS,
    GUARD,
    PACE,
    SHAPE_POINTS,
    SWEEP_TIMING,
    WELL,
    columns_of,
    plant_channels,
    width,
)
from wire.counters import Flow
from wire.messages import PLANT, encode_batch
from wire.reference import Reference

Array = npt.NDArray[np.float64]


class PlantRecord:
    """Rows of the emulated arm's exact state, collected and sent as telemetry."""

    def __init__(
        self, plant: ArmPlant, faces_m: Array, reference: Reference, run: int, batch: int
    ) -> None:
        self._plant = plant
        self._reference = reference
        self._run = run
        self._shape_at = np.linspace(0.0, plant.parameters.arm.length_m, SHAPE_POINTS)
        self._regulated = _regulated_weights(faces_m)
        channels = plant_channels(plant.parameters.segments)
        self._rows = np.empty((batch, width(channels)))
        self._well = np.full(plant.parameters.segments, float(WELL))
        self._health_at = columns_of(channels, "/plant/health")
        self._guard_at = columns_of(channels, "/plant/guard")
        self._filled = 0
        self._began_ns = 0
        self._publisher: Any = None
        self.flow = Flow()

    def send_on(self, publisher: Any) -> None:
        """Where batches go."""
        self._publisher = publisher

    def state(self, tick: int) -> Array:
        """Everything about the arm at the start of a tick, in the order of `plant_channels`."""
        truth, tip = self._plant.truth(), self._plant.tip()
        *wanted, wanted_v, wanted_k = self._reference.at(tick).tolist()
        error = float(np.hypot(*(tip - wanted)))
        means = [
            float(self._regulated[0] @ truth[:, 1]) - wanted_v,
            float(self._regulated[1] @ truth[:, 3]) - wanted_k,
        ]
        shape = self._plant.shape_at(self._shape_at)
        energy = self._plant.energy()
        rest = np.zeros(len(GUARD) + len(PACE))
        parts = (
            truth.ravel(),
            tip,
            [error],
            wanted,
            energy,
            means,
            shape.ravel(),
            self._well,
            rest,
        )
        return np.concatenate(parts)

    def mark_health(self, state: Array, health: Sequence[int]) -> None:
        """What the plant knows of each segment's node, as wire.channels.Health, when the tick ends."""
        state[self._health_at] = health

    def mark_guard(self, state: Array, load_potential_j: float, *, passive: bool) -> None:
        """What is in force on the arm in the tick."""
        state[self._guard_at] = float(passive), load_potential_j

    def mark_late(self, state: Array) -> None:
        """The tick has no sweep."""
        state[-len(PACE) :] = 1.0

    def add(self, tick: int, state: Array, timing: tuple[int, int, int, int]) -> None:
        """One tick is done; `timing` as in wire.channels.SWEEP_TIMING."""
        if self._filled == 0:
            self._began_ns = monotonic_ns()
        row = self._rows[self._filled]
        row[: -len(SWEEP_TIMING)], row[-len(SWEEP_TIMING) :] = state, timing
        self._filled += 1
        if self._filled == len(self._rows) or monotonic_ns() - self._began_ns > BATCH_NS:
            self.flush(tick + 1)

    def flush(self, next_tick: int) -> None:
        """Send what has been collected."""
        if self._filled and self._publisher is not None:
            rows = self._rows[: self._filled]
            raw = encode_batch(self._run, next_tick - self._filled, PLANT, rows)
            self._publisher.put(raw)
            self.flow.add(raw)
            self.flow.settle()
            self._filled = 0


def _regulated_weights(faces: Array) -> Array:
    """Row weights (2, n) of the means over the arm of v_y (outer faces) and of the curvature (inner
    faces)."""
    middle = 0.5 * (faces[1:] + faces[:-1])
    outer = np.diff(np.append(middle, faces[-1]))
    inner = np.diff(np.concatenate(([faces[0]], middle)))
    return np.asarray(np.stack([outer, inner]) / (faces[-1] - faces[0]))
