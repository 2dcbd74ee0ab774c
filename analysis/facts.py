"""A value of a recording's metadata: MCAP has texts only, octarm writes what is more than a word as JSON.

Read by all that show what a recording says of itself: info, diff and export.
"""

from __future__ import annotations

import json
from typing import Any


def fact(text: str | None) -> Any:
    """JSON objects and lists as their values, other text as it is: a name like 7 stays a name."""
    if text is None or text[:1] not in ("{", "["):
        return text
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text
