"""`octarm study baselines`: our feedback against others on the same arm, disturbance, noise and initial shape.

From a gains artefact to one row a feedback. The observer is ours throughout, so that it is the feedback that is
compared; but hinfsyn's output feedback brings its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from analysis.metrics import control_effort
from analysis.study.feedbacks import Feedback, make_feedbacks, state_norm
from analysis.study.figures import curves
from analysis.study.loop import (
    Case,
    chosen_setpoints,
    closed_loop,
    decay_per_s,
    design_weights,
    find_rest,
    loop_channel,
    radius,
)
from analysis.study.robustness import number, settling, verdict
from analysis.study.simulate import simulate
from analysis.study.workers import call_all
from deploy import deploy
from wire.artefact import GainsArtefact

FINER = 4
"""Cells of the fine grid per segment."""


def run(
    artefact: GainsArtefact,
    progress: Callable[[str], None],
    *,
    setpoints: Sequence[str] = (),
    nodes: int = 10,
    tick_s: float = 0.1,
    ticks: int = 1200,
    plant_cells: int | None = None,
    jobs: int | None = None,
) -> dict[str, Any]:
    """Compare at some setpoints, by default all of the artefact.

    Returns {"nodes", "tick_s", "ticks", "optimum", "hinfsyn_gamma", "rows"}; the keys of a row: `_row`; the two
    before it: per setpoint, see `make_feedbacks`. Raises UsageError for a setpoint that does not
    exist or packages that are not installed, OctarmError if they fail.
    """
    names = chosen_setpoints(artefact, setpoints)
    deployment = deploy(artefact, nodes, tick_s)
    rows: list[dict[str, Any]] = []
    optimum, hinfsyn = {}, {}
    for name in names:
        setpoint = artefact.setpoints[artefact.setpoint_index(name)]
        progress(f"baselines: setpoint {name}, gains by python-control")
        optimum[name], hinfsyn[name], feedbacks = make_feedbacks(artefact, setpoint, deployment)
        progress(f"baselines: setpoint {name}, {len(feedbacks)} runs")
        arguments = [(artefact, name, one, nodes, tick_s, ticks, plant_cells) for one in feedbacks]
        rows += call_all(_row, arguments, jobs)
    return {
        "nodes": nodes,
        "tick_s": tick_s,
        "ticks": ticks,
        "optimum": optimum,
        "hinfsyn_gamma": hinfsyn,
        "rows": rows,
    }


def _row(
    artefact: GainsArtefact,
    name: str,
    one: Feedback,
    nodes: int,
    tick_s: float,
    ticks: int,
    plant_cells: int | None,
) -> dict[str, Any]:
    """One feedback at one setpoint; runs in a process of its own.

    "gamma", "fine_gamma": of the state feedback if it is one ("of_state"), None if infinite, `state_norm`;
    "loop_gamma": of the whole sampled loop around the exact arm, `loop_channel`; "decay_per_s", "settling_s",
    "tip_error_m", "rest_error_m", "stable", "why": as in the study of robustness; "rms_n_per_m",
    "peak_n_per_m": of the command beyond the holding load; "messages", "feedback_messages", "numbers";
    "tip_course_mm": about 300 samples over the run.
    """
    deployment = deploy(artefact, nodes, tick_s)
    setpoint = artefact.setpoints[artefact.setpoint_index(name)]
    noise, effort = design_weights(artefact)
    found = simulate(
        artefact,
        setpoint=name,
        ticks=ticks,
        step=one.step,
        plant_cells=plant_cells,
        deployment=deployment,
    )
    rest = find_rest(deployment, one.step, setpoint, artefact.arm, Case(), plant_cells)
    decay = loop_gamma = rest_error = None
    if rest is not None:
        decay = decay_per_s(radius(closed_loop(rest.arm, one.step, Case())), tick_s)
        channel = loop_channel(rest.arm, one.step, Case(), deployment, artefact.arm, noise, effort)
        loop_gamma = _finite(channel.hinf_norm())
        rest_error = float(np.hypot(*(rest.tip_m - np.asarray(setpoint.tip_m))))
    gamma = fine_gamma = None
    if one.gain is not None:
        gamma, fine_gamma = (
            _finite(state_norm(artefact.arm, setpoint, deployment.faces_m, one.gain, effort, finer))
            for finer in (1, FINER)
        )
    spent = control_effort(
        found.commands_n_per_m - found.equilibrium[:, 4], deployment.faces_m, tick_s
    )
    why = verdict(found, rest, decay)
    return {
        "setpoint": name,
        "feedback": one.name,
        "of_state": one.gain is not None,
        "gamma": gamma,
        "fine_gamma": fine_gamma,
        "loop_gamma": loop_gamma,
        "decay_per_s": decay,
        "settling_s": settling(found, rest),
        "rest_error_m": rest_error,
        "tip_error_m": float(found.tip_error_m[-1]) if found.diverged_at is None else None,
        "rms_n_per_m": spent.rms_n_per_m,
        "peak_n_per_m": spent.peak_n_per_m,
        "messages": one.messages,
        "feedback_messages": one.feedback_messages,
        "numbers": one.numbers,
        "stable": why == "",
        "why": why,
        "tip_course_mm": [
            round(1e3 * float(v), 2) for v in found.tip_error_m[:: max(1, ticks // 300)]
        ],
    }


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


_COLUMNS = (
    ("", "setpoint", "<8"),
    ("", "feedback", "<16"),
    ("", "stable", "<6"),
    ("gamma", "nodes", ">7"),
    ("", "fine", ">7"),
    ("", "loop", ">7"),
    ("settles", "[s]", ">7"),
    ("tip error", "end [mm]", ">9"),
    ("effort [mN/m]", "rms", ">13"),
    ("", "peak", ">6"),
    ("messages", "a tick", ">8"),
    ("numbers", "in each", ">7"),
)


def _line(cells: Sequence[str]) -> str:
    forms = (form for _, _, form in _COLUMNS)
    return " ".join(f"{cell:{form}}" for cell, form in zip(cells, forms, strict=True)).rstrip()


def _norm(row: dict[str, Any], key: str) -> str:
    """Of a state feedback that is not stable the norm is infinite; other rows have none."""
    return "inf" if row["of_state"] and row[key] is None else number(row[key], ".4f")


def table(facts: dict[str, Any]) -> str:
    """One line a feedback; below, what the columns are and why unstable rows are."""
    lines = [_line([column[k] for column in _COLUMNS]) for k in (0, 1)]
    lines.append("─" * len(lines[1]))
    before = None
    for row in facts["rows"]:
        if before not in (None, row["setpoint"]):
            lines.append("")
        before = row["setpoint"]
        lines.append(
            _line(
                [
                    row["setpoint"],
                    row["feedback"],
                    "yes" if row["stable"] else "no",
                    *(_norm(row, key) for key in ("gamma", "fine_gamma")),
                    number(row["loop_gamma"], ".4f"),
                    number(row["settling_s"], ".1f"),
                    number(row["tip_error_m"], ".2f", 1e3),
                    number(row["rms_n_per_m"], ".2f", 1e3),
                    number(row["peak_n_per_m"], ".1f", 1e3),
                    str(row["messages"]),
                    row["numbers"],
                ]
            )
        )
    lines.append("")
    lines += [
        f"setpoint {row['setpoint']}, {row['feedback']}: not stable, {row['why']}"
        for row in facts["rows"]
        if not row["stable"]
    ]
    lines += [
        f"setpoint {name}, nodes' grid: least gamma of any state feedback {facts['optimum'][name]:.4f}, of "
        f"hinfsyn's output feedback {facts['hinfsyn_gamma'][name]:.4f}"
        for name in facts["optimum"]
    ]
    lines += [
        "gamma: of the state feedback on the nodes' grid and on a finer one; of the whole sampled loop,",
        "observer included, around the exact arm. Effort: beyond the holding load. Messages: with the",
        f"observer's {2 * (facts['nodes'] - 1)}, which carry our feedback too. {facts['nodes']} nodes, tick "
        f"{facts['tick_s']:g} s, {facts['ticks']} ticks from the chapter's initial shape.",
    ]
    return "\n".join(lines) + "\n"


def plot(facts: dict[str, Any], path: Path) -> None:
    """The tip's error over time, a panel a setpoint, a line a feedback."""
    setpoints = list(dict.fromkeys(row["setpoint"] for row in facts["rows"]))
    step_s = facts["tick_s"] * max(1, facts["ticks"] // 300)
    curves(
        path,
        [
            (
                f"setpoint {name}: tip error [mm]",
                {
                    row["feedback"]: row["tip_course_mm"]
                    for row in facts["rows"]
                    if row["setpoint"] == name
                },
            )
            for name in setpoints
        ],
        step_s,
    )
