"""Part "lpi" of the chapter: 3.4.2, 3.5.2 and (22) as printed, why they fail, and what works instead."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

import numpy as np

from chapter.lpi_claims import claims
from chapter.lpi_figures import epsilon_figure, gains_figure, why_figure
from chapter.lpi_find import EPSILON, Found, find, kept
from chapter.lpi_gains import DRAG, EPSILONS
from chapter.lpi_text import text
from chapter.part import Part, Tell


def part(tell: Tell) -> Part:
    """Sections 3.4.2, 3.5.2 and the outputs (22)."""
    found = find(tell)
    tell("lpi: figures")
    main = [g for g in found.gains if math.isclose(g.epsilon, EPSILONS[1])]
    figures = {
        "lpi-why.png": why_figure(
            list(found.null.items()), list(found.root.items()), found.conditions, found.relaxed, EPSILON
        ),
        "lpi-epsilon.png": epsilon_figure(found.rows, 0.5 * DRAG, main[0].optimum),
        "lpi-gains.png": gains_figure(main),
    }  # fmt: skip
    return Part(
        key="lpi",
        title="Observer and controller inequalities",
        section="3.4.2, 3.5.2, (22)",
        text=text(found),
        claims=claims(found),
        figures=figures,
        facts=facts(found),
    )


def facts(found: Found) -> dict[str, Any]:
    """Numbers for facts.json."""
    names = (
        "setpoint", "epsilon", "outcome", "gamma", "achieved", "open_loop", "optimum", "root_force",
        "root_force_open_loop", "decay", "first_mode_decay", "certified_decay", "undamped_abscissa",
    )  # fmt: skip
    numbers: dict[str, Any] = _plain(
        {
            "weakly_null": {k: asdict(v) for k, v in found.null.items()},
            "at_the_root": {k: asdict(v) for k, v in found.root.items()},
            "least_condition": [
                {"omega_squared": a, "without_outputs": b, "with_outputs": c}
                for a, b, c in found.conditions
            ],
            "packets": {k: [asdict(p) for p in v] for k, v in found.packets.items()},
            "programs": {
                k: {t.right: {"status": t.status, "gamma": t.gamma} for t in v}
                for k, v in found.solved.items()
            },
            "relaxed": [
                {"residual": t.tolerance, "gamma": t.gamma, "violation": t.eigenvalue}
                for t in found.relaxed
            ],
            "matrices": {
                k: {"kept": kept(v)[0], "solved": kept(v)[1]} for k, v in found.matrices.items()
            },
            "gains": [{n: getattr(g, n) for n in names} for g in found.gains],
            "epsilon": [asdict(r) for r in found.rows],
            "noise": [asdict(r) for r in found.noises],
            "open_loop_settling": found.settling,
            "storage_needed": [
                {"cells": n, "root_force": a, "means": b} for n, a, b in found.storage
            ],
            "feedback": [
                {k: v for k, v in asdict(c).items() if k != "gains"} for c in found.controllers
            ],
        }
    )
    return numbers


def _plain(value: Any) -> Any:
    """Without NaN (None) and tuples, numbers to six digits: the last ones are the machine's."""
    if isinstance(value, dict):
        return {k: _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    if isinstance(value, float | np.floating):
        number = float(value)
        return float(f"{number:.6g}") if math.isfinite(number) else None
    return value
