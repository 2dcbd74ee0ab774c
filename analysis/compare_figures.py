"""The figures of two runs side by side, with their ratio.

Beside the comparison of the channels in `octarm diff`: most are `analysis.summary`'s; wall-clock fields, which
are never the same, are here as percentiles.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.recording import Recording
from analysis.summary import summary_of
from wire.channels import label
from wire.errors import UsageError

Array = npt.NDArray[np.float64]

_FIGURES: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    ("tip error at the end", "m", ("tip_error_m", "final")),
    ("tip error, rms", "m", ("tip_error_rms_m",)),
    ("estimation error at the end", "", ("estimation_error", "final")),
    ("shape estimation error at the end", "m", ("shape_estimation_error_m", "final")),
    ("command, rms", "N/m", ("command_n_per_m", "rms")),
    ("difference to central", "", ("max_difference_to_central",)),
    ("neighbour messages", "", ("neighbour_messages",)),
    ("rejected messages", "", ("rejected_messages",)),
    ("sweep p50", "ms", ("sweep_ms", "p50")),
    ("sweep p99", "ms", ("sweep_ms", "p99")),
    ("start-up", "s", ("start_up_s",)),
)
"""Name, unit and where in the summary."""


def figures(
    one: Recording, other: Recording, progress: Callable[[str], None]
) -> list[dict[str, Any]]:
    """The figures of both runs with their ratio; null where a recording does not hold one."""
    columns = [_figures_of(recording, progress) for recording in (one, other)]
    return [
        {"figure": name, "unit": unit, "a": a, "b": b, "ratio": _ratio(a, b)}
        for (name, unit, a), (_, _, b) in zip(*columns, strict=True)
    ]


def _figures_of(
    recording: Recording, progress: Callable[[str], None]
) -> list[tuple[str, str, float | None]]:
    summary: dict[str, Any] = {}
    try:
        summary = summary_of(recording)
    except (
        UsageError
    ) as error:  # no tick is complete, or a channel is missing: the rest is compared
        progress(f"no figures: {error}")
    out: list[tuple[str, str, float | None]] = [("ticks", "", recording.ticks)]
    for name, unit, keys in _FIGURES:
        value: Any = summary
        for key in keys:
            value = (value or {}).get(key)
        out.append((name, unit, value))
    late = _values(recording, "/plant/pace", "late")
    out.append(("late ticks", "", int(np.count_nonzero(late > 0.0)) if late.size else None))
    for name, values in (
        ("node, measurement to command", _spans_ms(recording)),
        (
            "the arm's own integration",
            1e-6 * _values(recording, "/sweep/timing", "advance_wall_ns"),
        ),
    ):
        known = values[np.isfinite(values)]
        for share in (50, 99):
            figure = float(np.percentile(known, share)) if known.size else None
            out.append((f"{name}, p{share}", "ms", figure))
    return out


def _spans_ms(recording: Recording) -> Array:
    """From the arrival of its measurement to its command, every node and tick, wall clock."""
    topics = [f"/node/{label(i, recording.nodes)}/timing" for i in range(recording.nodes)]
    return (
        np.concatenate(
            [
                _values(recording, topic, "command_sent_wall_ns")
                - _values(recording, topic, "measurement_received_wall_ns")
                for topic in topics
            ]
        )
        * 1e-6
    )


def _values(recording: Recording, topic: str, field: str) -> Array:
    """The field's values, none if it is not in the recording."""
    table = recording.tables.get(topic)
    if table is None or field not in table.columns:
        return np.zeros(0)
    return table.numbers(field)


def _ratio(a: float | None, b: float | None) -> float | None:
    return b / a if a and b is not None else None
