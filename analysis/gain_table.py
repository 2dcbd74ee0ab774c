"""What `octarm design` shows at its end: one row a gain, from the certificates of the artefact.

Takes the artefact that was written, gives rows for --json and text for a person.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from wire.artefact import GainsArtefact

FIGURES = (
    "certified_gamma",
    "achieved_gamma",
    "open_loop_gamma",
    "optimum_gamma",
    "decay_per_s",
    "gain_norm",
    "seconds",
)
"""Names of a certificate's numbers, also the keys of the rows."""


def gain_rows(artefact: GainsArtefact) -> list[dict[str, Any]]:
    """Per setpoint and gain: `setpoint`, `role` (observer, controller) and the `FIGURES`."""
    return [
        {"setpoint": setpoint.name, "role": role}
        | {name: getattr(getattr(setpoint, f"{role}_certificate"), name) for name in FIGURES}
        for setpoint in artefact.setpoints
        for role in ("observer", "controller")
    ]


def gain_table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows of `gain_rows` as a table."""
    lines = [
        f"{'setpoint':<10} {'gain':<11} {'certified':>9} {'achieved':>9} {'optimum':>8} "
        f"{'open loop':>9} {'decay [1/s]':>11} {'gain norm':>9} {'seconds':>8}"
    ]
    lines += [
        f"{row['setpoint']:<10} {row['role']:<11} {row['certified_gamma']:>9.4f} "
        f"{row['achieved_gamma']:>9.4f} {row['optimum_gamma']:>8.4f} "
        f"{row['open_loop_gamma']:>9.4f} {row['decay_per_s']:>11.4f} "
        f"{row['gain_norm']:>9.2f} {row['seconds']:>8.1f}"
        for row in rows
    ]
    return "\n".join(lines)
