"""A value of a recording's metadata: MCAP has texts only, octarm writes what is more than a word as JSON.

Read by all that show what a recording says of itself: info, diff and export.
"""

from __future__ import annotations

from typing import Any

import msgspec

_DEEPEST = 20


def fact(text: str | None) -> Any:
    """JSON objects and lists as their values, other text as it is: a name like 7 stays a name.

    Numbers that are not finite are no JSON; what is nested deeper than anything that is written stays text.
    """
    if text is None or text[:1] not in ("{", "["):
        return text
    try:
        value = msgspec.json.decode(text)
    except (ValueError, msgspec.DecodeError, RecursionError):
        return text
    return value if _shallow(value) else text


def _shallow(value: Any) -> bool:
    """Whether what shows the value may follow it down."""
    level = [value]
    for _ in range(_DEEPEST):
        level = [
            inner
            for one in level
            if isinstance(one, dict | list)
            for inner in (one.values() if isinstance(one, dict) else one)
        ]
        if not level:
            return True
    return False
