"""The arm as a picture in the recording: one foxglove.SceneUpdate for every so many ticks, from their rows.

Between the merged ticks and the file. Everything in it is in other channels too, as exact numbers.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from wire.channels import columns_of, plant_channels
from wire.foxglove import scene_every, scene_update
from wire.joints import Joints
from wire.messages import PLANT
from wire.run_config import RecorderConfig

Row = Sequence[float]


class SceneDrawer:
    """Scenes of one run."""

    def __init__(self, config: RecorderConfig) -> None:
        run = config.run
        channels = plant_channels(run.nodes)
        self._shape = columns_of(channels, "/plant/shape")
        self._reference = columns_of(channels, "/plant/tip", "reference_x_m", "reference_y_m")
        self._joints = Joints(config.forward_widths, config.tip)
        self._every = scene_every(run.tick_s)

    def draw(self, tick: int, log_time_ns: int, rows: Mapping[int, Row]) -> dict[str, Any] | None:
        """The scene of a tick; None if it has none, or the plant's row is missing."""
        plant = rows.get(PLANT)
        if tick % self._every or plant is None:
            return None
        shape = plant[self._shape]
        points = list(zip(shape[::2], shape[1::2], strict=True))
        x, y = plant[self._reference]
        return scene_update(log_time_ns, points, self._joints.points(tick, rows), (x, y))
