"""What `octarm design` shows at its end: one row a gain.

Takes the certificates, gives rows for --json and text for a person. The verdict compares with what the design
is to reach; a gain that is certified runs, whatever the verdict.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from wire.artefact import Certificate

FIGURES = (
    "certified_gamma",
    "achieved_gamma",
    "open_loop_gamma",
    "optimum_gamma",
    "decay_per_s",
    "open_loop_decay_per_s",
    "gain_norm",
    "seconds",
)
"""Names of a certificate's numbers, also the keys of the rows."""
CERTIFIED_TARGET = 1.3
"""Certified gamma over the optimum, at most."""
ACHIEVED_TARGET = 1.15
DECAY_TARGET = {"observer": 1.0, "controller": 2.0}
"""Decay of the closed loop over that of the open loop, at least."""
ROUNDING = 1e-6
"""Of a ratio: an observer that cannot reach some mode leaves its decay as it is."""
_HEAD = (
    f"{'':<22} gamma                             gamma / optimum             decay [1/s]\n"
    f"{'setpoint':<10} {'gain':<11} {'certified':>9} {'achieved':>8} {'optimum':>7} {'open':>6} "
    f"{'certified':>11} {'achieved':>8} {'gain norm':>9} {'closed':>8} {'open':>6} {'seconds':>8}  "
    "targets missed"
)


def gain_rows(gains: Iterable[tuple[str, str, Certificate]]) -> list[dict[str, Any]]:
    """A row for every gain, given as setpoint, role and certificate: these names, the `FIGURES`, the verdict.

    `certified_ratio` and `achieved_ratio` are to the optimum, `decay_ratio` is to the open loop's (None if that
    is unknown or no decay). `targets_missed` names those of certified, achieved, decay that miss their targets.
    """
    return [
        {"setpoint": setpoint, "role": role, **_row(certificate, DECAY_TARGET[role])}
        for setpoint, role, certificate in gains
    ]


def _row(certificate: Certificate, decay_target: float) -> dict[str, Any]:
    figures = {name: getattr(certificate, name) for name in FIGURES}
    certified = _ratio(certificate.certified_gamma, certificate.optimum_gamma)
    achieved = _ratio(certificate.achieved_gamma, certificate.optimum_gamma)
    decay = _ratio(certificate.decay_per_s, certificate.open_loop_decay_per_s)
    missed = {
        "certified": certified is not None and certified > CERTIFIED_TARGET,
        "achieved": achieved is not None and achieved > ACHIEVED_TARGET,
        "decay": decay is not None and decay < decay_target - ROUNDING,
    }
    return figures | {
        "certified_ratio": certified,
        "achieved_ratio": achieved,
        "decay_ratio": decay,
        "targets_missed": [name for name, yes in missed.items() if yes],
    }


def _ratio(value: float, base: float | None) -> float | None:
    return value / base if base is not None and base > 0.0 else None


def gain_table(rows: Sequence[dict[str, Any]]) -> str:
    """The rows of `gain_rows` as a table, and below it what the targets are."""
    lines = [_HEAD]
    lines += [
        f"{row['setpoint']:<10} {row['role']:<11} {row['certified_gamma']:>9.4f} "
        f"{row['achieved_gamma']:>8.4f} {row['optimum_gamma']:>7.4f} {row['open_loop_gamma']:>6.4g} "
        f"{_shown(row['certified_ratio'], '.3f'):>11} {_shown(row['achieved_ratio'], '.3f'):>8} "
        f"{row['gain_norm']:>9.2f} {row['decay_per_s']:>8.4f} "
        f"{_shown(row['open_loop_decay_per_s'], '.4f'):>6} {row['seconds']:>8.1f}  "
        f"{', '.join(row['targets_missed']) or '-'}"
        for row in rows
    ]
    lines.append(
        f"targets: certified <= {CERTIFIED_TARGET:g} optimum, achieved <= {ACHIEVED_TARGET:g} optimum, decay "
        f">= {DECAY_TARGET['observer']:g} (observer) or {DECAY_TARGET['controller']:g} (controller) times open"
    )
    return "\n".join(lines)


def _shown(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)
