"""Facts to so many digits that they are the same on every machine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def significant(value: Any, digits: int) -> Any:
    """The same mappings and lists with floats rounded to that many significant digits."""
    if isinstance(value, bool | int | str):
        return value
    if isinstance(value, float):
        return float(f"{value:.{digits - 1}e}")
    if isinstance(value, Mapping):
        return {key: significant(v, digits) for key, v in value.items()}
    return [significant(v, digits) for v in value]


def gap(difference: float, floor: float = 1e-14) -> float:
    """A difference of two computations; below `floor` it is rounding, and given as that."""
    return max(difference, floor)
