"""What the columns of a recording mean: unit and description of every field of every channel.

Beside `wire.channels`, which has the names and puts this into the schemas; read by the export (a dictionary of
columns goes with the data) and by the comparison of two recordings (differences with their unit).
"""

from __future__ import annotations

import re

UNITS = (
    ("_m_per_s", "m/s"),
    ("_n_per_m", "N/m"),
    ("_per_m", "1/m"),
    ("_wall_ns", "ns"),
    ("_rad", "rad"),
    ("_m", "m"),
    ("_s", "s"),
    ("_j", "J"),
)
"""Ends of names and what they say; the first that fits counts."""
SUM_UNIT = "sqrt(J)"
"""The running sums are scaled: roots of an energy."""
SUM_NUMBER = re.compile(r"[cd]\d+")

_STATE = {
    "velocity_x_m_per_s": "velocity along x at the segment's outer face",
    "velocity_y_m_per_s": "velocity along y at the segment's outer face",
    "strain": "axial strain at the segment's centre",
    "curvature_per_m": "curvature at the segment's inner face",
}
DESCRIPTIONS: dict[str, dict[str, str]] = {
    "measurement": {
        "velocity_y_m_per_s": "measured velocity along y at the segment's outer face, noise included",
        "curvature_per_m": "measured curvature at the segment's inner face, noise included",
    },
    "estimate": {field: f"estimated {text}" for field, text in _STATE.items()},
    "truth": {field: f"the emulated arm's {text}" for field, text in _STATE.items()},
    "command": {
        "force_n_per_m": "load per length at the segment's outer face, from this tick to the next"
    },
    "schedule": {
        "setpoint": "index of the setpoint whose gains the node uses",
        "bump_n_per_m": "part of the command that hides a change of gains and is faded out",
    },
    "forward_sum": {
        "turn_rad": "received: the estimated arm's turn up to this node, less the reference's",
        "x_m": "received: where the estimated arm up to this node ends, x",
        "y_m": "received: where the estimated arm up to this node ends, y",
    },
    "backward_sum": {"setpoint": "received: index of the setpoint of the next tick"},
    "timing": {
        "measurement_received_wall_ns": "instant at which the measurement arrived",
        "forward_received_wall_ns": "instant at which the forward sum arrived",
        "backward_received_wall_ns": "instant at which the backward sum arrived",
        "command_sent_wall_ns": "instant at which the command was sent",
    },
    "tip": {
        "x_m": "where the arm's tip is, x",
        "y_m": "where the arm's tip is, y",
        "error_m": "distance of the tip from the reference's",
        "reference_x_m": "where the reference has the tip, x",
        "reference_y_m": "where the reference has the tip, y",
    },
    "energy": {
        "kinetic_j": "kinetic energy of the whole arm",
        "axial_j": "energy of axial strain of the whole arm",
        "bending_j": "energy of bending of the whole arm",
    },
    "regulated": {
        "mean_velocity_y_m_per_s": "mean over the arm of the velocity along y, less the reference's",
        "mean_curvature_per_m": "mean over the arm of the curvature, less the reference's",
    },
    "degraded": {
        "flags": "sum of 1 forward sum bridged, 2 backward sum bridged, 4 command held, 8 forward sum not "
        "of the whole arm, 16 measurement held, 32 joined in this tick; 0: all well"
    },
    "guard": {
        "passive": "1: static loads only, whatever the nodes say; else 0",
        "load_potential_j": "potential of the loads in force, zero for the straight arm",
    },
    "pace": {"late": "1: the sweep before was not over when this tick was due; else 0"},
    "sweep_timing": {
        "due_wall_ns": "instant at which the tick was due",
        "started_wall_ns": "instant at which the first measurement was sent",
        "duration_wall_ns": "from there to the last command received; 0: not within this tick",
        "advance_wall_ns": "duration of the arm's own integration",
    },
    "event": {
        "level": "debug, info, warning, error or fatal",
        "name": "started, setpoint, late, node_gone, node_back, passive, telemetry_lost, disk_full, "
        "refused_peer, finished, interrupted or safety_stop",
        "message": "what happened, for a person",
    },
}
"""Per channel and field; a channel is called as in `channel_name`."""
_GENERAL = {
    "tick": "number of the tick, from 0",
    "time_s": "time of the arm: tick times period",
}


def channel_name(topic: str) -> str:
    """The channel without room and node: "/node/03/forward_sum" is "forward_sum", "/sweep/timing" is
    "sweep_timing"."""
    parts = [part for part in topic.split("/") if part and not part.isdigit()]
    if parts[0] in ("node", "plant") and len(parts) > 1:
        parts = parts[1:]
    return "_".join(parts)


def unit(field: str) -> str:
    """The unit that a field's name ends with; "" for what has none (counts, strain, texts)."""
    if SUM_NUMBER.fullmatch(field):
        return SUM_UNIT
    return next((text for end, text in UNITS if field.endswith(end)), "")


def description(channel: str, field: str) -> str:
    """What a field of a channel (by `channel_name`) is; KeyError if nobody has said it."""
    if field in _GENERAL:
        return _GENERAL[field]
    if SUM_NUMBER.fullmatch(field):
        return f"received: number {field[1:]} of the {channel.replace('_', ' ')}"
    if channel == "health":
        of = "what the plant knows of the node" if field == "flags" else f"of node {int(field[5:])}"
        return f"{of}: sum of 1 alive, 2 on time, 4 valid"
    if channel == "shape":
        axis, number = field[0], int(field[1:3])
        return f"{axis} of point {number} along the arm, root first, equally spaced in arclength"
    return DESCRIPTIONS[channel][field]
