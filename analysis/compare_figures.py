"""The figures of two runs side by side, with their ratio.

Beside the comparison of the channels in `octarm diff`: most are `analysis.summary`'s; wall-clock fields, which
are never the same, are here as percentiles.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.recording import Recording
from analysis.summary import summary_of
from wire.channels import label

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


def figures(one: Recording, other: Recording) -> list[dict[str, Any]]:
    """The figures of both runs with their ratio; null where a recording does not hold one."""
    columns = [_figures_of(recording) for recording in (one, other)]
    return [
        {"figure": name, "unit": unit, "a": a, "b": b, "ratio": _ratio(a, b)}
        for (name, unit, a), (_, _, b) in zip(*columns, strict=True)
    ]


def _figures_of(recording: Recording) -> list[tuple[str, str, float | None]]:
    summary: dict[str, Any] = summary_of(recording) if recording.ticks else {}
    out: list[tuple[str, str, float | None]] = [("ticks", "", recording.ticks)]
    for name, unit, keys in _FIGURES:
        value: Any = summary
        for key in keys:
            value = (value or {}).get(key)
        out.append((name, unit, value))
    late = np.asarray(recording.table("/plant/pace").numbers("late")) if recording.ticks else None
    out.append(("late ticks", "", None if late is None else int(np.count_nonzero(late > 0.0))))
    for name, values in (
        ("node, measurement to command", _spans_ms(recording)),
        ("the arm's own integration", _advance_ms(recording)),
    ):
        known = values[np.isfinite(values)]
        for share in (50, 99):
            figure = float(np.percentile(known, share)) if known.size else None
            out.append((f"{name}, p{share}", "ms", figure))
    return out


def _spans_ms(recording: Recording) -> Array:
    """From the arrival of its measurement to its command, every node and tick, wall clock."""
    names = ("measurement_received_wall_ns", "command_sent_wall_ns")
    topics = [f"/node/{label(i, recording.nodes)}/timing" for i in range(recording.nodes)]
    instants = [recording.table(t).by_tick(names, recording.ticks) for t in topics]
    return np.concatenate([1e-6 * (one[:, 1] - one[:, 0]) for one in instants])


def _advance_ms(recording: Recording) -> Array:
    table = recording.table("/sweep/timing")
    return 1e-6 * table.by_tick(("advance_wall_ns",), recording.ticks)[:, 0]


def _ratio(a: float | None, b: float | None) -> float | None:
    return b / a if a and b is not None else None
