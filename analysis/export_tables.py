"""A recording as plain tables and arrays, for pandas, polars, R and MATLAB.

First step of the export: `analysis.recording` in, numpy out; the files are `analysis.export_files`'. Nothing is
computed (but where a segment's centre is): a number is the one that was recorded, NaN what was not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from analysis.events import read_events
from analysis.recording import Recording
from analysis.table import Column
from wire.channels import (
    ANNOUNCED,
    ARM_SO_FAR,
    COMMAND,
    DEGRADED,
    MEASUREMENT,
    SCHEDULE,
    SHAPE,
    SHAPE_POINTS,
    STATE,
    label,
    plant_channels,
    timing_fields,
)
from wire.columns import SUM_UNIT, channel_name, description, unit
from wire.errors import UsageError
from wire.foxglove import EVENTS

Array = npt.NDArray[np.float64]

HEALTH = ("flags",)
"""Of each node, what /plant/health says of all of them."""
TIMING = timing_fields(1, 3)
"""All instants of a node: one in the middle has both neighbours."""
OF_NODES: tuple[tuple[str, tuple[str, ...]], ...] = (
    ("measurement", MEASUREMENT),
    ("estimate", STATE),
    ("truth", STATE),
    ("command", COMMAND),
    ("schedule", SCHEDULE),
    ("forward_sum", ARM_SO_FAR),
    ("backward_sum", ANNOUNCED),
    ("timing", TIMING),
    ("degraded", DEGRADED),
    ("health", HEALTH),
)
"""Channels of the table `nodes`, with their fields; the numbers of the sums themselves are in `sums`."""
OF_PLANT: tuple[tuple[str, str, tuple[str, ...]], ...] = tuple(
    (channel_name(channel.topic), channel.topic, channel.fields)
    for channel in plant_channels(2)
    if channel_name(channel.topic) not in ("truth", "shape", "health")
)
"""Channels of the table `plant`: name, topic, fields."""
DIRECTIONS = ("forward", "backward")
_INTEGER, _NUMBER, _TEXT = "int64", "double", "text"
_TICK, _TIME = "number of the tick, from 0", "time of the arm: tick times period"
_NODE = "number of the node, from the root"


@dataclass(frozen=True)
class ColumnInfo:
    """One column of the dictionary that goes with the data."""

    name: str
    type: str
    """int64, double or text."""
    unit: str
    description: str


_AT = (ColumnInfo("tick", _INTEGER, "", _TICK), ColumnInfo("time_s", _NUMBER, "s", _TIME))
_AT_NODE = (*_AT, ColumnInfo("node", _INTEGER, "", _NODE))


def _columns(channel: str, fields: Sequence[str], prefix: str) -> tuple[ColumnInfo, ...]:
    return tuple(
        ColumnInfo(f"{prefix}{name}", _NUMBER, unit(name), description(channel, name))
        for name in fields
    )


DICTIONARY: dict[str, tuple[ColumnInfo, ...]] = {
    "nodes": (
        *_AT_NODE,
        *(one for name, fields in OF_NODES for one in _columns(name, fields, f"{name}_")),
    ),
    "plant": (
        *_AT,
        *(one for name, _, fields in OF_PLANT for one in _columns(name, fields, f"{name}_")),
    ),
    "shape": (*_AT, *_columns("shape", SHAPE, "")),
    "sums": (
        *_AT_NODE,
        ColumnInfo(
            "direction", _TEXT, "", "forward: received from node - 1; backward: from node + 1"
        ),
        ColumnInfo("index", _INTEGER, "", "number of the value in the sum, from 0"),
        ColumnInfo("value", _NUMBER, SUM_UNIT, "the value, as the node received it"),
    ),
    "events": (
        *_AT,
        *(
            ColumnInfo(name, _TEXT, "", description("event", name))
            for name in ("level", "name", "message")
        ),
    ),
    "places": (
        ColumnInfo("node", _INTEGER, "", _NODE),
        ColumnInfo("process", _INTEGER, "", "node that the process which has it is called by"),
        ColumnInfo("inner_face_m", _NUMBER, "m", "arclength where the segment begins: curvature"),
        ColumnInfo("centre_m", _NUMBER, "m", "arclength of the segment's middle: strain"),
        ColumnInfo("outer_face_m", _NUMBER, "m", "arclength where it ends: velocities, command"),
        *(
            ColumnInfo(
                f"energy_weight_{end}", _NUMBER, text, "energy of a deviation x is this times x^2"
            )
            for end, text in (
                ("velocity_x_j_s2_per_m2", "J s^2/m^2"),
                ("velocity_y_j_s2_per_m2", "J s^2/m^2"),
                ("strain_j", "J"),
                ("curvature_j_m2", "J m^2"),
            )
        ),
    ),
}
"""Per table its columns, in order."""


@dataclass(frozen=True)
class Exported:
    """One recording, ready to be written; K ticks, n nodes."""

    recording: Recording

    @cached_property
    def ticks(self) -> int:
        """K: one more than the last tick of any channel, also where others have stopped before.

        Raises UsageError for a tick that the run cannot have.
        """
        last = -1
        for topic, table in self.recording.tables.items():
            if topic == EVENTS.topic or not table.rows or "tick" not in table.columns:
                continue
            ticks = table.ticks
            if int(ticks.min()) < 0 or int(ticks.max()) >= self.recording.configuration.ticks:
                raise UsageError(
                    f"recording {self.recording.path}: {topic} has the ticks {ticks.min()} to "
                    f"{ticks.max()}, expected 0 to {self.recording.configuration.ticks - 1}; it was "
                    "edited"
                )
            last = max(last, int(ticks.max()))
        return last + 1

    @property
    def nodes(self) -> int:
        """The number of nodes n."""
        return self.recording.nodes

    @cached_property
    def time_s(self) -> Array:
        """Time of each tick, (K,)."""
        return np.arange(self.ticks, dtype=np.float64) * self.recording.tick_s

    def of_nodes(self, channel: str, fields: Sequence[str]) -> Array:
        """Fields of a channel at all nodes, (K, n, fields); NaN where there is no message or no field."""
        if channel == "health":
            names = [f"node_{label(i, self.nodes)}" for i in range(self.nodes)]
            return self._values("/plant/health", names)[:, :, None]
        root = "/plant/truth/{}" if channel == "truth" else f"/node/{{}}/{channel}"
        topics = [root.format(label(i, self.nodes)) for i in range(self.nodes)]
        return np.stack([self._values(topic, fields) for topic in topics], axis=1)

    def of_plant(self, topic: str, fields: Sequence[str]) -> Array:
        """Fields of a channel of the plant, (K, fields)."""
        return self._values(topic, fields)

    def sums(self, direction: str) -> Array:
        """The numbers of the sums that the nodes received, (K, n, widest); NaN beyond a sum's end."""
        letter = direction_letter(direction)
        width = 0
        for i in range(self.nodes):
            width = max(width, self.width(direction, i))
        return self.of_nodes(f"{direction}_sum", [f"{letter}{i}" for i in range(width)])

    def width(self, direction: str, node: int) -> int:
        """How many numbers a node receives in a sum; 0 from where there is no neighbour."""
        topic = f"/node/{label(node, self.nodes)}/{direction}_sum"
        table = self.recording.tables.get(topic)
        letter = direction_letter(direction)
        names = () if table is None else table.columns
        return sum(name[:1] == letter and name[1:].isdigit() for name in names)

    def _values(self, topic: str, fields: Sequence[str]) -> Array:
        out = np.full((self.ticks, len(fields)), np.nan)
        table = self.recording.tables.get(topic)
        if table is not None:
            there = [i for i, name in enumerate(fields) if name in table.columns]
            out[:, there] = table.by_tick([fields[i] for i in there], self.ticks)
        return out

    def table(self, name: str) -> dict[str, Column]:
        """A table of `DICTIONARY` as columns of equal length; NaN in numbers that were not recorded."""
        columns: Sequence[Column] = {
            "nodes": self._nodes,
            "plant": self._plant,
            "shape": self._shape,
            "sums": self._sums,
            "events": self._events,
            "places": self._places,
        }[name]()
        return dict(zip((info.name for info in DICTIONARY[name]), columns, strict=True))

    def _nodes(self) -> list[Column]:
        k, n = self.ticks, self.nodes
        out: list[Column] = [
            np.repeat(np.arange(k), n),
            np.repeat(self.time_s, n),
            np.tile(np.arange(n), k),
        ]
        for channel, fields in OF_NODES:
            values = self.of_nodes(channel, fields).reshape(k * n, len(fields))
            out += list(values.T)
        return out

    def _plant(self) -> list[Column]:
        blocks = [self.of_plant(topic, fields) for _, topic, fields in OF_PLANT]
        return [np.arange(self.ticks), self.time_s, *np.concatenate(blocks, axis=1).T]

    def _shape(self) -> list[Column]:
        return [np.arange(self.ticks), self.time_s, *self.of_plant("/plant/shape", SHAPE).T]

    def _sums(self) -> list[Column]:
        """Tick by tick, node by node, forward before backward; what was not received has no rows."""
        blocks = [self.sums(direction) for direction in DIRECTIONS]
        width = max(block.shape[2] for block in blocks)
        values = np.full((self.ticks, self.nodes, 2, width), np.nan)
        kept = np.zeros(values.shape, dtype=np.bool_)
        for number, (direction, block) in enumerate(zip(DIRECTIONS, blocks, strict=True)):
            values[:, :, number, : block.shape[2]] = block
            for node in range(self.nodes):
                own = self.width(direction, node)
                arrived = np.asarray(np.isfinite(block[:, node]).any(axis=1))
                kept[:, node, number, :own] = arrived[:, None]
        tick, node_of, which, index = np.nonzero(kept)
        names = np.array(DIRECTIONS, dtype=object)
        return [tick, self.time_s[tick], node_of, names[which], index, values[kept]]

    def _events(self) -> list[Column]:
        story = read_events(self.recording.tables.get(EVENTS.topic))
        texts = [[getattr(e, name) for e in story] for name in ("level", "name", "message")]
        return [
            np.array([e.tick for e in story], dtype=np.int64),
            np.array([e.time_s for e in story], dtype=np.float64),
            *(np.array(column, dtype=object) for column in texts),
        ]

    def _places(self) -> list[Column]:
        run = self.recording.configuration
        faces = np.asarray(run.faces_m)
        node = np.arange(self.nodes)
        return [
            node,
            node - node % run.segments_per_process,
            faces[:-1],
            0.5 * (faces[:-1] + faces[1:]),
            faces[1:],
            *self.recording.energy_weights.T,
        ]

    def arrays(self) -> dict[str, Column]:
        """Everything in its natural shape, for npz and mat: (K, n, fields), (K, fields), and without the last
        axis where there is one field. For each array NAME_fields has the names of its fields.
        """
        out: dict[str, Column] = {"tick": np.arange(self.ticks), "time_s": self.time_s}
        blocks = [(_ARRAY_NAMES.get(c, c), f, self.of_nodes(c, f)) for c, f in OF_NODES]
        blocks += [(name, f, self.of_plant(topic, f)) for name, topic, f in OF_PLANT]
        for name, fields, values in blocks:
            out[name] = values if len(fields) > 1 else values[..., 0]
            out[f"{name}_fields"] = np.array(fields, dtype=object)
        out |= {f"{direction}_sum": self.sums(direction) for direction in DIRECTIONS}
        shape = self.of_plant("/plant/shape", SHAPE)
        out["shape_m"] = shape.reshape(self.ticks, SHAPE_POINTS, 2)
        out["faces_m"] = np.asarray(self.recording.configuration.faces_m)
        out["energy_weights"] = self.recording.energy_weights
        out |= {f"event_{name}": column for name, column in self.table("events").items()}
        return out


_ARRAY_NAMES = {"forward_sum": "arm_so_far", "backward_sum": "announced"}
"""The sums' own numbers have the channels' names; what travels with them has these."""


def direction_letter(direction: str) -> str:
    """The letter that the numbers of a sum begin with."""
    return {"forward": "c", "backward": "d"}[direction]
