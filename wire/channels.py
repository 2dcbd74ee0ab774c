"""The channels of a recording: one table of topics, fields and units, read by recorder and analysis
alike.

Messages are flat JSON objects with a JSON Schema, so that Foxglove, PlotJuggler and others can plot
them. Every message begins with `tick` and `time_s` = tick * period; the log time is the same in
nanoseconds. All instants and durations of the wall clock are in channels whose last part is
`timing`; they are nanoseconds since the `epoch_ns` of the metadata, on the monotonic clock that the
processes of a machine share; a node on another machine counts from its own first measurement.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntFlag
from typing import Any

from wire.columns import channel_name, description, unit

FORMAT_VERSION = 5
READABLE = (3, 4, 5)
"""Versions that this octarm reads; others are refused by name."""
DEGRADED_SINCE = 5
"""The version that has the channels of `before_version_5`."""
NODES_ATTACHMENT = "nodes.json"
"""Attached since version 4: a JSON list of the configurations (wire.run_config.NodeConfig) that the node
processes got, with matrices and references bit for bit."""
LOSS_S = 0.5
"""A run that is killed loses no more of its recording than this, or the tick that it was in.

Rows wait `BATCH_NS` at most with their sender and `FLUSH_S` in the recorder; the rest is for the way."""
BATCH_TICKS = 32
"""Rows in a batch at most."""
BATCH_NS = 150_000_000
"""Rows do not wait longer than this for a batch to fill, while ticks go on."""
FLUSH_S = 0.2
"""The recorder hands over to the operating system what it has every so often."""
SHAPE_POINTS = 33
"""Points along the arm in /plant/shape, equally spaced in arclength, root and tip included."""
METADATA = "octarm"
SUMMARY = "summary"
REFUSED = "refused_peers"
"""In the summary of a run to which somebody came who was not let in: a JSON list of by, what and count."""

MEASUREMENT = ("velocity_y_m_per_s", "curvature_per_m")
STATE = ("velocity_x_m_per_s", "velocity_y_m_per_s", "strain", "curvature_per_m")
COMMAND = ("force_n_per_m",)
SCHEDULE = ("setpoint", "bump_n_per_m")
ARM_SO_FAR = ("turn_rad", "x_m", "y_m")
"""Last numbers of a forward sum: the estimated arm from the root to the receiver, its turn from the reference
and where it ends."""
ANNOUNCED = ("setpoint",)
"""Last number of a backward sum: the setpoint whose gains are in use from the next tick on."""
TIP = ("x_m", "y_m", "error_m", "reference_x_m", "reference_y_m")
ENERGY = ("kinetic_j", "axial_j", "bending_j")
REGULATED = ("mean_velocity_y_m_per_s", "mean_curvature_per_m")
SHAPE = tuple(f"{axis}{i:02d}_m" for i in range(SHAPE_POINTS) for axis in "xy")
PACE = ("late",)
"""1 if in real time the sweep before was not finished at this tick's begin, so that this tick has none and the
commands are held; else 0."""
DEGRADED = ("flags",)
"""How a node's tick was other than it should be, since version 5: a sum of `Degraded`, 0 if all was well."""
GUARD = ("passive", "load_potential_j")
"""Since version 5: 1 if the arm is passive (static loads only, whatever the nodes say), else 0; and the
potential of the loads in force: with kinetic, axial and bending energy it makes what only damping can take."""
SWEEP_TIMING = ("due_wall_ns", "started_wall_ns", "duration_wall_ns", "advance_wall_ns")
"""When the tick should begin (in lock-step: when it did); its first measurement sent; from there to the last
command received by the plant (0: not within this tick; a late tick has it of the sweep that ended in it); and
the arm's own integration."""
COMMAND_AT = len(MEASUREMENT) + len(STATE)
"""Where a node's telemetry row has its command, after measurement and estimate;"""
SETPOINT_AT = COMMAND_AT + len(COMMAND)
"""the setpoint whose gains it uses;"""
SUMS_AT = SETPOINT_AT + len(SCHEDULE)
"""and the sums that it received."""
LATE_AT = -len(SWEEP_TIMING) - len(PACE)
"""Where the plant's row says whether the tick had no sweep."""
EVENT = ("timestamp", "level", "name", "message", "file", "line")
"""Fields of foxglove.Log."""


class Degraded(IntFlag):
    """What was other than it should be in a node's tick."""

    FORWARD_BRIDGED = 1
    """The forward sum did not come in time: the last one was used, faded."""
    BACKWARD_BRIDGED = 2
    """The same of the backward sum."""
    HELD = 4
    """The tick was given up before it was complete: its command was not sent, the last one is held."""
    PARTIAL = 8
    """The forward sum that came does not reach back to the root: a sum before it was bridged."""
    MEASUREMENT_HELD = 16
    """The measurement did not come: the last one was used."""
    JOINED = 32
    """The node replaces a dead one and begins in this tick."""


class Health(IntFlag):
    """Three things that the plant knows of a node in a tick, each by itself."""

    ALIVE = 1
    """Its process is there: its token is."""
    ON_TIME = 2
    """Its command came before the next tick was due."""
    VALID = 4
    """Nothing that it sent was refused, other than for being late."""


WELL = int(Health.ALIVE | Health.ON_TIME | Health.VALID)


@dataclass(frozen=True)
class Channel:
    """One topic and its fields after `tick` and `time_s`."""

    topic: str
    fields: tuple[str, ...]

    @property
    def schema_name(self) -> str:
        """Name of the schema: the topic without node numbers."""
        parts = [p for p in self.topic.split("/") if p and not p.isdigit()]
        return "octarm." + ".".join(parts)

    @property
    def schema(self) -> bytes:
        """JSON Schema of a message."""
        properties = {"tick": self._field("tick", "integer"), "time_s": self._field("time_s")}
        schema = object_schema(self.schema_name, properties | self.field_schemas())
        return json.dumps(schema, separators=(",", ":")).encode()

    def field_schemas(self) -> dict[str, Any]:
        """JSON Schemas of the fields after `tick` and `time_s`."""
        return {field: self._field(field) for field in self.fields}

    def _field(self, name: str, kind: str = "number") -> dict[str, str]:
        of_unit = {"unit": text} if (text := unit(name)) else {}
        about = description(channel_name(self.topic), name)
        return {"type": kind, **of_unit, "description": about}


def object_schema(title: str, properties: dict[str, Any]) -> dict[str, Any]:
    """JSON Schema of an object that has all these properties."""
    return {
        "type": "object",
        "title": title,
        "properties": properties,
        "required": list(properties),
    }


def label(index: int, nodes: int) -> str:
    """A node's number as topics have it: zero-padded, at least two digits."""
    return f"{index:0{max(2, len(str(nodes - 1)))}d}"


def timing_fields(index: int, nodes: int) -> tuple[str, ...]:
    """Instants of one node's tick: what it does not receive is left out."""
    return (
        "measurement_received_wall_ns",
        *(("forward_received_wall_ns",) if index > 0 else ()),
        *(("backward_received_wall_ns",) if index < nodes - 1 else ()),
        "command_sent_wall_ns",
    )


def node_channels(index: int, nodes: int, forward: int, backward: int) -> list[Channel]:
    """A node's channels in the order of the numbers in its telemetry rows.

    `forward` and `backward` are the numbers of doubles in the sums that it receives, the angle and
    position of the arm so far and the announced setpoint included. A channel without numbers (no
    neighbour on that side) is left out.
    """
    root = f"/node/{label(index, nodes)}"
    channels = [
        Channel(f"{root}/measurement", MEASUREMENT),
        Channel(f"{root}/estimate", STATE),
        Channel(f"{root}/command", COMMAND),
        Channel(f"{root}/schedule", SCHEDULE),
    ]
    if index > 0:
        sums = tuple(f"c{i}" for i in range(forward - len(ARM_SO_FAR)))
        channels.append(Channel(f"{root}/forward_sum", (*sums, *ARM_SO_FAR)))
    if index < nodes - 1:
        sums = tuple(f"d{i}" for i in range(backward - len(ANNOUNCED)))
        channels.append(Channel(f"{root}/backward_sum", (*sums, *ANNOUNCED)))
    channels.append(Channel(f"{root}/timing", timing_fields(index, nodes)))
    channels.append(Channel(f"{root}/degraded", DEGRADED))
    return channels


def plant_channels(nodes: int) -> list[Channel]:
    """The plant's channels in the order of the numbers in its telemetry rows."""
    return [
        *(Channel(f"/plant/truth/{label(i, nodes)}", STATE) for i in range(nodes)),
        Channel("/plant/tip", TIP),
        Channel("/plant/energy", ENERGY),
        Channel("/plant/regulated", REGULATED),
        Channel("/plant/shape", SHAPE),
        Channel("/plant/health", tuple(f"node_{label(i, nodes)}" for i in range(nodes))),
        Channel("/plant/guard", GUARD),
        Channel("/plant/pace", PACE),
        Channel("/sweep/timing", SWEEP_TIMING),
    ]


def width(channels: Sequence[Channel]) -> int:
    """Numbers in a telemetry row with these channels."""
    return sum(len(channel.fields) for channel in channels)


def before_version_5(channel: Channel) -> list[float] | None:
    """What a channel that older recordings lack would have said; None for channels that they have."""
    name = channel_name(channel.topic)
    well = {"degraded": 0.0, "guard": 0.0, "health": float(WELL)}
    return [well[name]] * len(channel.fields) if name in well else None


def columns_of(channels: Sequence[Channel], topic: str, *fields: str) -> slice:
    """Where a telemetry row with these channels has the fields of a topic, all of them if none are named.

    The fields must stand side by side. KeyError if there is no such topic, ValueError for such fields.
    """
    at = 0
    for channel in channels:
        if channel.topic == topic:
            wanted = fields or channel.fields
            first = channel.fields.index(wanted[0])
            if channel.fields[first : first + len(wanted)] != wanted:
                raise ValueError(f"{topic}: {wanted} do not stand side by side in {channel.fields}")
            return slice(at + first, at + first + len(wanted))
        at += len(channel.fields)
    raise KeyError(topic)
