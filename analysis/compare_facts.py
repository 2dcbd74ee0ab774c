"""What two recordings say about themselves: configuration, gains, versions, machine, key by key.

Beside `analysis.compare`, which has the values of the channels. A difference of configuration counts: the runs
are not the same. One of versions or machine does not; it is shown because it may explain why numbers differ.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from analysis.facts import fact
from analysis.recording import Recording

OWN = ("run_id", "artefact_path", "segments_per_process", "pace")
"""Parts of the configuration that name a run, or say how it was done, and nothing about its numbers."""
_NOT_ABOUT = ("run", "run_id", "artefact_sha256", "seed", "started_at", "epoch_ns")
"""Metadata that is in the configuration as well, or is each run's own."""


@dataclass(frozen=True)
class FactDifference:
    """One key whose value is not the same; None where a recording does not have it."""

    key: str
    """Nested keys and places in lists: noise.curvature_per_m, faces_m[3]."""
    a: Any
    b: Any
    counts: bool
    """Whether the runs are different because of it."""
    within: bool = False
    """Numbers that are no further apart than the tolerance."""


def configuration_differences(
    one: Recording, other: Recording, tolerance: float = 0.0
) -> list[FactDifference]:
    """The parts of the run configuration that differ, in its own order.

    Numbers with a fraction are the same if they are no further apart than `tolerance` times the largest
    magnitude of their part of the configuration.
    """
    out = []
    for field in dataclasses.fields(one.configuration):
        a, b = (_plain(getattr(r.configuration, field.name)) for r in (one, other))
        largest = max((abs(v) for v in _floats((a, b))), default=0.0)
        for key, x, y in _different(field.name, a, b):
            near = (
                isinstance(x, float)
                and isinstance(y, float)
                and abs(x - y) <= tolerance * largest
                and tolerance > 0.0
            )
            counts = field.name not in OWN and not near
            out.append(FactDifference(key, x, y, counts, near))
    return out


def about_differences(one: Recording, other: Recording) -> list[FactDifference]:
    """The other metadata that differs: format, versions, machine, hosts, and what later versions add.

    Texts that are JSON are taken apart. None of these counts.
    """
    out = []
    for name in {**one.facts, **other.facts}:
        if name in _NOT_ABOUT:
            continue
        a, b = (fact(r.facts.get(name)) for r in (one, other))
        out += [FactDifference(key, x, y, counts=False) for key, x, y in _different(name, a, b)]
    return out


def _plain(value: Any) -> Any:
    """Data classes as dictionaries and tuples as lists, all the way down."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    if isinstance(value, dict):
        return {key: _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    return value


def _floats(value: Any) -> Iterator[float]:
    if isinstance(value, float):
        yield value
    elif isinstance(value, Mapping):
        for inner in value.values():
            yield from _floats(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _floats(inner)


def _different(key: str, a: Any, b: Any) -> Iterator[tuple[str, Any, Any]]:
    """Keys and both values of what differs; lists of different lengths differ as a whole."""
    if isinstance(a, dict) and isinstance(b, dict):
        for name in {**a, **b}:
            yield from _different(f"{key}.{name}", a.get(name), b.get(name))
    elif isinstance(a, list) and isinstance(b, list) and len(a) == len(b):
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            yield from _different(f"{key}[{i}]", x, y)
    elif type(a) is not type(b) or repr(a) != repr(b):  # -0.0 is not 0.0
        yield key, a, b
