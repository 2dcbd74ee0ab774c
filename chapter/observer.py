"""Section 4.1: the gain-scheduled observer, Fig. 4 and 5, large epsilon; on the chapter's grid, beside (1).

Puts together `chapter.observer_cases` (error dynamics on the chapter's grid), `chapter.observer_beside` (exact
arm, scheduled gains), `chapter.observer_findings` (what (2) and (5) do) and the prose.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from numpy.polynomial import Polynomial

from chapter import observer_figures as figures
from chapter.constants import CORRECTED, PRINTED
from chapter.lpi_gains import EPSILONS
from chapter.observer_beside import observed_facts, scheduled
from chapter.observer_cases import (
    EPSILON,
    UNITS,
    grid_epsilons,
    initial_facts,
    lpi_facts,
    lpi_origin,
    noise_to_nothing,
    run_facts,
    setpoint_gains,
    straight_runs,
    times_below,
)
from chapter.observer_findings import motions, truncation_facts
from chapter.observer_grid import CELLS, INITIAL
from chapter.observer_schedule import Observed
from chapter.observer_straight import ErrorRun, Origin, run
from chapter.observer_text import claims, text
from chapter.part import Part, Tell
from chapter.pde import SETPOINTS
from supervise.shipped import DEFAULT_GAINS
from wire.artefact import read_artefact

Array = npt.NDArray[np.float64]

STARTS = {
    "chapter's": INITIAL,
    "uniform load": Polynomial([0.0, 0.0, 6.0, -4.0, 1.0]) / 9.0,
    "tip load": Polynomial([0.0, 0.0, 0.5, -1.0 / 6.0]),
    "S-shaped": Polynomial([0.0, 0.0, 0.9, -1.2]),
}
"""w of the arm at rest in m; the estimate is straight."""


def part(tell: Tell) -> Part:
    """Run the experiments (a minute on a 2-core x86-64) and write them up."""
    tell("observer: error dynamics (15) on the chapter's grid")
    straight = {one.name: straight_runs(one) for one in (PRINTED, CORRECTED)}
    starts = {
        name: run(PRINTED, lpi_origin(PRINTED, EPSILON, drag=True), units=UNITS, initial=w)
        for name, w in STARTS.items()
    }
    tell("observer: large epsilon")
    lmi, lmi_facts = grid_epsilons()
    lpi = {
        value: run(CORRECTED, lpi_origin(CORRECTED, value, drag=True), units=UNITS, load=0.0)
        for value in EPSILONS
    }
    tell("observer: scheduled gains beside the exact arm")
    artefact = read_artefact(DEFAULT_GAINS)
    beside = scheduled(artefact)
    tell("observer: the truncated model (2) and (5) at the setpoints")
    truncated = truncation_facts(artefact)
    facts: dict[str, Any] = {
        "initial": initial_facts(),
        "straight": {
            name: {one.origin.name: run_facts(constants, one) for one in straight[name]}
            for name, constants in (("printed", PRINTED), ("corrected", CORRECTED))
        },
        "starts": {name: times_below(one.times_s, one.tip_m) for name, one in starts.items()},
        "noise_to_nothing": noise_to_nothing(),
        "at_setpoints": {one.name: setpoint_gains(one) for one in SETPOINTS},
        "epsilon": {
            "grid (16)": lmi_facts,
            "arm (18)": {f"{value:g}": lpi_facts(value, one) for value, one in lpi.items()},
        },
        "scheduled": {
            start: {origin: observed_facts(one) for origin, one in some.items()}
            for start, some in beside.items()
        },
        "truncation": truncated,
    }
    drawings = {
        "observer-output.png": figures.output(
            {"printed rho": straight["printed"], "rho A": straight["corrected"]}
        ),
        "observer-shapes.png": _shapes(straight["printed"][2], beside["setpoint 2"]["(18)"]),
        "observer-initial.png": figures.initial(
            starts,
            {
                name: beside[name]["(18)"]
                for name in ("chapter", "straight", "setpoint 2", "setpoint 3")
            },
            [one.name for one in artefact.setpoints],
        ),
        "observer-origins.png": figures.origins(beside["chapter"]),
        "observer-epsilon.png": figures.epsilon(lmi, lpi),
        "observer-truncation.png": figures.truncation(
            {
                name: {int(cells): rate for cells, rate in one["growth_per_s"].items()}
                for name, one in truncated["setpoints"].items()
            },
            {name: one["bound_per_s"] for name, one in truncated["setpoints"].items()},
            motions(),
        ),
    }
    return Part(
        key="observer",
        title="The observer of section 4.1",
        section="4.1",
        text=text(facts),
        claims=claims(facts),
        figures=drawings,
        facts=facts,
    )


def _shapes(one: ErrorRun, exact: Observed) -> Figure:
    """The arm is what an observer without correction, which stays at zero, is in error by."""
    alone = run(PRINTED, Origin("", None, one.origin.drag_per_s), units=UNITS)
    times = (0.0, 250.0, 500.0, 1000.0, 2000.0)
    rows = [int(np.searchsorted(one.times_s, t)) for t in times]
    w = slice(2 * CELLS, 3 * CELLS)

    def whole(values: Array) -> Array:
        return np.concatenate([np.zeros((len(values), 1)), values], axis=1)

    arm = -alone.states[rows][:, w]
    estimate = one.states[rows][:, w] + arm
    points = np.linspace(0.0, 1.0, CELLS + 1)
    return figures.shapes(
        points, whole(arm), whole(estimate), times, exact, (0.0, 5.0, 10.0, 40.0, 80.0)
    )
