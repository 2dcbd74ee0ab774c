"""`octarm study robustness`: the deployed loop around an arm that is not the one it was designed for.

From a gains artefact, through `analysis.study.simulate` (the nonlinear run) and `analysis.study.loop` (the same
loop linearised where it comes to rest), to one row a case: stable or not, where the tip ends, how fast, what is
lost.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from analysis.metrics import time_below
from analysis.study.figures import grouped_bars
from analysis.study.loop import (
    GROWTH_PER_S,
    Case,
    Rest,
    chosen_setpoints,
    closed_loop,
    decay_per_s,
    design_weights,
    find_rest,
    linear_arm,
    loop_channel,
    radius,
)
from analysis.study.simulate import Simulation, simulate
from analysis.study.workers import call_all
from deploy import Deployment, deploy
from wire.artefact import Arm, GainsArtefact
from wire.errors import UsageError

Array = npt.NDArray[np.float64]

CHANGE = 0.2
"""By which E, rho and the drag are off."""
SETTLED = 0.05
"""The tip has settled when its distance from where it comes to rest is this share of the first one."""
ELSEWHERE = 0.5
"""A run whose tip, in the last `LATE` of its time, is this share of the first distance away from where the
linear loop says that it rests, has gone elsewhere."""
LATE = 0.1
_CHUNK = 3
_PROPERTIES = {
    "E": "youngs_modulus_pa",
    "rho": "density_kg_per_m3",
    "drag": "drag_per_s",
}


def cases(arm: Arm, nodes: int) -> list[Case]:
    """Nominal; material off by `CHANGE` up and down; each sensor, each actuator dead; 1 and 2 ticks late."""
    out = [Case()]
    for name, key in _PROPERTIES.items():
        for sign in (1.0, -1.0):
            changed = {key: getattr(arm, key) * (1.0 + sign * CHANGE)}
            out.append(
                Case(f"{name} {sign * CHANGE:+.0%}", msgspec.structs.replace(arm, **changed))
            )
    out += [Case("one dead sensor", dead_sensors=(i,)) for i in range(nodes)]
    out += [Case("one dead actuator", dead_actuators=(i,)) for i in range(nodes)]
    return out + [Case(f"{d} tick{'s' * (d > 1)} late", delay_ticks=d) for d in (1, 2)]


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
    """Evaluate all cases at some setpoints, by default all of the artefact.

    Returns {"nodes", "tick_s", "ticks", "change", "rows", "each_node"}: a row a case, of dead sensors and
    actuators the worst node's; all nodes' in "each_node". The keys of a row: `_evaluate`. Raises UsageError for
    a setpoint that does not exist or a deployment that is refused.
    """
    names = chosen_setpoints(artefact, setpoints)
    if ticks < 10:
        raise UsageError(f"robustness: expected at least 10 ticks, got {ticks}")
    design_weights(artefact)
    deploy(artefact, nodes, tick_s)  # refused here, not in a worker
    every = cases(artefact.arm, nodes)
    chunks = [
        (artefact, name, every[first : first + _CHUNK], nodes, tick_s, ticks, plant_cells)
        for name in names
        for first in range(0, len(every), _CHUNK)
    ]

    def done(count: int) -> None:
        progress(f"robustness: {min(count * _CHUNK, len(every) * len(names))} cases done")

    found = [row for rows in call_all(_evaluate, chunks, jobs, done) for row in rows]
    reported: list[dict[str, Any]] = []
    for name in names:
        mine = [row for row in found if row["setpoint"] == name]
        _compare(mine)
        reported += [
            max((row for row in mine if row["case"] == case), key=_badness)
            for case in dict.fromkeys(row["case"] for row in mine)
        ]
    return {
        "nodes": nodes,
        "tick_s": tick_s,
        "ticks": ticks,
        "change": CHANGE,
        "rows": reported,
        "each_node": [row for row in found if row["node"] is not None],
    }


def _badness(row: dict[str, Any]) -> tuple[bool, float]:
    return not row["stable"], math.inf if row["tip_error_m"] is None else row["tip_error_m"]


def _compare(rows: list[dict[str, Any]]) -> None:
    """Add how much larger each norm is than the nominal one's, in per cent (None where there is none)."""
    nominal = rows[0]["norm"]
    for row in rows:
        both = nominal is not None and row["norm"] is not None
        row["norm_change_percent"] = 100.0 * (row["norm"] / nominal - 1.0) if both else None


def _evaluate(
    artefact: GainsArtefact,
    name: str,
    some: Sequence[Case],
    nodes: int,
    tick_s: float,
    ticks: int,
    plant_cells: int | None,
) -> list[dict[str, Any]]:
    """Rows of some cases at one setpoint; runs in a process of its own.

    "decay_per_s": of the sampled loop linearised around the exact arm where it rests; "linear_decay_per_s": of
    the same around the design's linear arm on a finer grid; "rest_error_m": distance of the tip from the
    setpoint's at rest; "tip_error_m": at the end of the nonlinear run; "settling_s"; "norm": H-infinity, see
    `loop_channel`; "stable", and "why" not. None stands for what does not exist.
    """
    deployment = deploy(artefact, nodes, tick_s)
    return [_row(artefact, deployment, name, case, ticks, plant_cells) for case in some]


def _row(
    artefact: GainsArtefact,
    deployment: Deployment,
    name: str,
    case: Case,
    ticks: int,
    plant_cells: int | None,
) -> dict[str, Any]:
    index = artefact.setpoint_index(name)
    setpoint, step = artefact.setpoints[index], deployment.dense[index]
    arm = case.plant_arm or artefact.arm
    found = simulate(
        artefact,
        setpoint=name,
        ticks=ticks,
        plant_arm=case.plant_arm,
        plant_cells=plant_cells,
        delay_ticks=case.delay_ticks,
        dead_sensors=case.dead_sensors,
        dead_actuators=case.dead_actuators,
        deployment=deployment,
    )
    place = (deployment, step, setpoint, artefact.arm, case, plant_cells)
    rest = find_rest(*place)
    if rest is None and found.diverged_at is None:
        nodes_end = np.concatenate(
            [found.estimates[-1], found.commands_n_per_m[-1][:, None]], axis=1
        ).ravel()
        rest = find_rest(*place, guess=(found.plant_state, nodes_end))
    linear = closed_loop(linear_arm(arm, setpoint, deployment), step, case)
    decay = norm = offset = None
    if rest is not None:
        decay = decay_per_s(radius(closed_loop(rest.arm, step, case)), deployment.tick_s)
        offset = float(np.hypot(*(rest.tip_m - np.asarray(setpoint.tip_m))))
        noise, effort = design_weights(artefact)
        value = loop_channel(
            rest.arm, step, case, deployment, artefact.arm, noise, effort
        ).hinf_norm()
        norm = value if math.isfinite(value) else None
    why = verdict(found, rest, decay)
    return {
        "setpoint": name,
        "case": case.name,
        "node": next(iter((*case.dead_sensors, *case.dead_actuators)), None),
        "stable": why == "",
        "why": why,
        "decay_per_s": decay,
        "linear_decay_per_s": decay_per_s(radius(linear), deployment.tick_s),
        "rest_error_m": offset,
        "tip_error_m": float(found.tip_error_m[-1]) if found.diverged_at is None else None,
        "settling_s": settling(found, rest),
        "norm": norm,
    }


def distance_from_rest(found: Simulation, rest: Rest) -> Array:
    """(K,) distance of the tip from where the loop comes to rest, in m."""
    return np.asarray(np.linalg.norm(found.tip_m - rest.tip_m, axis=1))


def settling(found: Simulation, rest: Rest | None) -> float | None:
    """From when on the tip stays within `SETTLED` of its first distance, from where it rests, in s."""
    if rest is None or found.diverged_at is not None:
        return None
    away = distance_from_rest(found, rest)
    return time_below(found.times_s, away, SETTLED * float(away[0]))


def verdict(found: Simulation, rest: Rest | None, decay: float | None) -> str:
    """Why the loop counts as unstable; empty if it is stable.

    Stable needs all of it: a place of rest, a linearised loop that does not grow there, and a nonlinear run
    from the chapter's initial shape that stays finite and ends near that place.
    """
    if found.diverged_at is not None:
        return f"not finite from tick {found.diverged_at}"
    if rest is None or decay is None:
        return "no place of rest"
    if decay < -GROWTH_PER_S:
        return f"grows, twofold in {math.log(2.0) / -decay:.0f} s"
    away = distance_from_rest(found, rest)
    late = away[-max(1, int(LATE * len(away))) :]
    if not np.max(late) < ELSEWHERE * max(float(away[0]), 1e-3):
        return "goes elsewhere"
    return ""


_COLUMNS = (
    ("", "setpoint", "<8"),
    ("", "case", "<26"),
    ("", "stable", "<6"),
    ("decay", "[1/s]", ">8"),
    ("linear", "[1/s]", ">8"),
    ("tip error", "rest [mm]", ">9"),
    ("", "end [mm]", ">9"),
    ("settles", "[s]", ">7"),
    ("H-inf", "norm", ">7"),
    ("against", "nominal", ">7"),
)


def _line(cells: Sequence[str]) -> str:
    widths = (form for _, _, form in _COLUMNS)
    return " ".join(f"{cell:{form}}" for cell, form in zip(cells, widths, strict=True)).rstrip()


def table(facts: dict[str, Any]) -> str:
    """One line a case; below, why the unstable ones are."""
    lines = [_line([column[k] for column in _COLUMNS]) for k in (0, 1)]
    lines.append("─" * len(lines[1]))
    before = None
    for row in facts["rows"]:
        if before not in (None, row["setpoint"]):
            lines.append("")
        before = row["setpoint"]
        change = number(row["norm_change_percent"], "+.0f")
        lines.append(
            _line(
                [
                    row["setpoint"],
                    row["case"] + (f", node {row['node']}" if row["node"] is not None else ""),
                    "yes" if row["stable"] else "no",
                    number(row["decay_per_s"], ".4f"),
                    number(row["linear_decay_per_s"], ".4f"),
                    number(row["rest_error_m"], ".2f", 1e3),
                    number(row["tip_error_m"], ".2f", 1e3),
                    number(row["settling_s"], ".1f"),
                    number(row["norm"], ".4f"),
                    change if change == "-" else f"{change} %",
                ]
            )
        )
    lines.append("")
    lines += [
        f"setpoint {row['setpoint']}, {row['case']}: not stable, {row['why']}"
        for row in facts["rows"]
        if not row["stable"]
    ]
    lines.append(
        f"{facts['nodes']} nodes, tick {facts['tick_s']:g} s, {facts['ticks']} ticks from the chapter's "
        "initial shape with its\ndisturbance and sensor noise; of dead sensors and actuators the worst node"
    )
    return "\n".join(lines) + "\n"


def number(value: float | None, form: str, factor: float = 1.0) -> str:
    """A figure of a table, a dash where there is none."""
    return "-" if value is None else format(factor * value, form)


def plot(facts: dict[str, Any], path: Path) -> None:
    """Bars of the tip's error at rest and of the norm, a group a case, a colour a setpoint."""
    rows = facts["rows"]
    names = list(dict.fromkeys(row["case"] for row in rows))
    setpoints = list(dict.fromkeys(row["setpoint"] for row in rows))
    by = {(row["setpoint"], row["case"]): row for row in rows}
    grouped_bars(
        path,
        names,
        [f"setpoint {name}" for name in setpoints],
        [
            (label, [[_or_nan(by[s, c][key], factor) for c in names] for s in setpoints])
            for label, key, factor in (
                ("tip error at rest [mm]", "rest_error_m", 1e3),
                ("settling time, 5 % [s]", "settling_s", 1.0),
                ("H-infinity norm of the loop", "norm", 1.0),
            )
        ],
        missing=[[not by[s, c]["stable"] for c in names] for s in setpoints],
    )


def _or_nan(value: float | None, factor: float) -> float:
    return math.nan if value is None else factor * value
