"""One status line of a child, checked: what the launcher acts on is of the right type, the rest is only logged.

Between the pipe of a process (`supervise.children`, `supervise.far`) and `supervise.conductor`. A child writes
whole lines, but a library that prints may put anything between them.
"""

from __future__ import annotations

import json
from typing import Any

LONGEST = 1 << 16
"""Bytes of a line, sixteen times what a child writes: more without an end is no status."""
LARGEST = 2**53
"""Ticks beyond it there are none, nor processes."""
_FIELDS: dict[str, dict[str, type]] = {
    "waiting": {"missing": list},
    "failed": {"message": str},
    "stopped": {"tick": int},
    "born": {"node": int, "pid": int},
    "died": {"node": int, "code": int},
    "listening": {"url": str},
    "note": {"text": str},
    "progress": {"tick": int},
    "closed": {"ticks_lost": int, "ticks_recorded": int},
}
"""What an event's fields must be, as far as the launcher reads them."""
_OF_PLANT: dict[str, type] = {"cause": str, "text": str}
_OF_NODE: dict[str, type] = {"missing": list}


def status_of(line: bytes) -> dict[str, Any] | None:
    """The status in a line; None if it is none."""
    if len(line) > LONGEST:
        return None
    try:
        status = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(status, dict):
        return None
    name, event = status.get("from"), status.get("event")
    if not (isinstance(name, str) and isinstance(event, str)):
        return None
    wanted = dict(_FIELDS.get(event, {}))
    if event == "stopped":
        wanted |= _OF_PLANT if name == "plant" else _OF_NODE
    if not all(type(status.get(key)) is kind for key, kind in wanted.items()):
        return None
    if any(type(status[key]) is int and abs(status[key]) > LARGEST for key in wanted):
        return None
    if "missing" in wanted and not all(isinstance(one, str) for one in status["missing"]):
        return None
    number = name.removeprefix("node ")
    if number != name and not (number.isascii() and number.isdecimal() and len(number) < 9):
        return None
    return status
