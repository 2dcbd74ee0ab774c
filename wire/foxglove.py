"""What Foxglove draws by itself: events as foxglove.Log, the arm as foxglove.SceneUpdate.

Names and meanings of the fields are Foxglove's; the schemas here state what octarm's messages have in them.
Every message also has `tick` and `time_s`, as all channels do, which viewers leave alone.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from wire.channels import EVENT, Channel, object_schema

FRAME = "arm"
"""Coordinate frame of the scene: x along the straight arm, y to its side, the root at 0."""
SCENE_PERIOD_S = 0.05
"""Scenes are recorded every so often of the arm's time, or every tick if that is longer."""
LEVEL_NAMES = ("unknown", "debug", "info", "warning", "error", "fatal")
"""In the order of foxglove.LogLevel's numbers."""
LEVELS = {name: LEVEL_NAMES.index(name) for name in ("info", "warning", "error")}
"""foxglove.LogLevel of the names that events have inside octarm."""
TRUE_ARM, ESTIMATED_ARM, REFERENCE_TIP = "true arm", "estimated arm", "reference of the tip"
_DIGITS = 5
"""Decimals of a metre in a scene: it is to be looked at; the numbers are in other channels."""
_NOWHERE = {"x": 0.0, "y": 0.0, "z": 0.0}
_POSE = {"position": _NOWHERE, "orientation": {**_NOWHERE, "w": 1.0}}
_EMPTY = ("arrows", "cubes", "spheres", "cylinders", "lines", "triangles", "texts", "models")
_COLOURS = {
    TRUE_ARM: (0.0, 0.447, 0.698),
    ESTIMATED_ARM: (0.835, 0.369, 0.0),
    REFERENCE_TIP: (0.0, 0.62, 0.451),
}
"""Of Okabe and Ito, as in the plots."""

Json = dict[str, Any]
Points = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class StandardChannel(Channel):
    """A channel with a schema of Foxglove's name."""

    name: str = ""
    properties: Mapping[str, Any] = field(default_factory=dict, hash=False)
    """JSON Schemas of the fields."""

    @property
    def schema_name(self) -> str:
        """The name that Foxglove knows."""
        return self.name

    def field_schemas(self) -> Json:
        """As they were given."""
        return dict(self.properties)


def _numbers(title: str, names: str) -> Json:
    return object_schema(title, {name: {"type": "number"} for name in names})


def _list(items: Json) -> Json:
    return {"type": "array", "items": items}


def _instant(title: str) -> Json:
    return object_schema(title, {"sec": {"type": "integer"}, "nsec": {"type": "integer"}})


def _scene_properties() -> Json:
    point, colour = _numbers("foxglove.Point3", "xyz"), _numbers("foxglove.Color", "rgba")
    vector = _numbers("foxglove.Vector3", "xyz")
    pose = object_schema(
        "foxglove.Pose",
        {"position": vector, "orientation": _numbers("foxglove.Quaternion", "xyzw")},
    )
    line = object_schema(
        "foxglove.LinePrimitive",
        {
            "type": {"type": "integer", "description": "0: points joined one after the other"},
            "pose": pose,
            "thickness": {"type": "number", "description": "m"},
            "scale_invariant": {"type": "boolean"},
            "points": _list(point),
            "color": colour,
            "colors": _list(colour),
            "indices": _list({"type": "integer"}),
        },
    )
    sphere = object_schema(
        "foxglove.SpherePrimitive", {"pose": pose, "size": vector, "color": colour}
    )
    entity = object_schema(
        "foxglove.SceneEntity",
        {
            "timestamp": _instant("time"),
            "frame_id": {"type": "string"},
            "id": {"type": "string"},
            "lifetime": _instant("duration"),
            "frame_locked": {"type": "boolean"},
            "metadata": _list({"type": "object"}),
            **{name: _list({"type": "object"}) for name in _EMPTY},
            "lines": _list(line),
            "spheres": _list(sphere),
        },
    )
    return {"deletions": _list({"type": "object"}), "entities": _list(entity)}


_LOG: Json = {
    "timestamp": _instant("time"),
    "level": {"type": "integer", "description": "2 info, 3 warning, 4 error"},
    "name": {"type": "string", "description": "what happened, one word"},
    "message": {"type": "string"},
    "file": {"type": "string"},
    "line": {"type": "integer"},
}
EVENTS = StandardChannel("/event", EVENT, "foxglove.Log", _LOG)
SCENE = StandardChannel(
    "/scene", ("deletions", "entities"), "foxglove.SceneUpdate", _scene_properties()
)


def _time(nanoseconds: int) -> Json:
    return {"sec": nanoseconds // 10**9, "nsec": nanoseconds % 10**9}


def log_message(log_time_ns: int, level: str, name: str, message: str) -> Json:
    """One event; KeyError for a level that is not in LEVELS."""
    return {
        "timestamp": _time(log_time_ns),
        "level": LEVELS[level],
        "name": name,
        "message": message,
        "file": "",
        "line": 0,
    }


def scene_every(tick_s: float) -> int:
    """Every how many ticks there is a scene."""
    return max(1, round(SCENE_PERIOD_S / tick_s))


def scene_update(
    log_time_ns: int,
    true_arm: Points,
    estimated_arm: Points | None,
    reference_tip: tuple[float, float],
) -> Json:
    """The arm at one instant: points (x, y) in m, of the arms from root to tip.

    An estimated arm that is not known (None) leaves the last one where it was.
    """
    entities = [_line(TRUE_ARM, log_time_ns, true_arm, 0.012)]
    if estimated_arm is not None:
        entities.append(_line(ESTIMATED_ARM, log_time_ns, estimated_arm, 0.006))
    sphere = {
        "pose": {"position": _point(*reference_tip), "orientation": _POSE["orientation"]},
        "size": {"x": 0.02, "y": 0.02, "z": 0.02},
        "color": _colour(REFERENCE_TIP),
    }
    entities.append({**_entity(REFERENCE_TIP, log_time_ns), "spheres": [sphere]})
    return {"deletions": [], "entities": entities}


def _entity(identity: str, log_time_ns: int) -> Json:
    return {
        "timestamp": _time(log_time_ns),
        "frame_id": FRAME,
        "id": identity,
        "lifetime": _time(0),
        "frame_locked": False,
        "metadata": [],
        **{name: [] for name in _EMPTY},
    }


def _line(identity: str, log_time_ns: int, points: Points, thickness_m: float) -> Json:
    line = {
        "type": 0,
        "pose": _POSE,
        "thickness": thickness_m,
        "scale_invariant": False,
        "points": [_point(x, y) for x, y in points],
        "color": _colour(identity),
        "colors": [],
        "indices": [],
    }
    return {**_entity(identity, log_time_ns), "lines": [line]}


def _point(x: float, y: float) -> Json:
    return {"x": round(x, _DIGITS), "y": round(y, _DIGITS), "z": 0.0}


def _colour(identity: str) -> Json:
    r, g, b = _COLOURS[identity]
    return {"r": r, "g": g, "b": b, "a": 1.0}
