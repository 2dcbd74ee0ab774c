"""What the page of `chapter.lpi` reports: all its computations, some minutes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from chapter.constants import CORRECTED
from chapter.lpi_gains import EPSILONS, ChapterGains, observer_gains, recheck
from chapter.lpi_matrices import Compared, observer, random_plant, state_feedback
from chapter.lpi_own import BEAM, RIGHTS, UNIT, OwnPIE, OwnProgram, Tried, own_pie
from chapter.lpi_tables import (
    Feedback,
    Row,
    epsilon_rows,
    feedback,
    noise_rows,
    open_loop_settling,
    storage_needed,
)
from chapter.lpi_why import (
    Along,
    Packet,
    along,
    beam_roots,
    least_condition,
    legendre_sequence,
    packet,
    root_sequence,
)
from chapter.part import Tell
from chapter.pde import SETPOINTS, STRAIGHT
from design.operators import PIOperator, Shape
from design.semidefinite import ACCEPTED

EPSILON = 1e-3
"""Of the programs that are tried."""
NUMBERS = (2, 4, 8, 16, 32, 64, 128)
MODES = 6
WAVE_NUMBERS = (300.0, 1000.0, 3000.0, 10000.0)
RESIDUALS = (1e-1, 3e-2, 1e-2)
SEEDS = range(12)
EFFORTS = (0.1, 0.3, 1.0)
STORAGE_CELLS = (15, 30, 60)


@dataclass(frozen=True)
class Found:
    """Everything that the page reports."""

    null: dict[str, Along]
    root: dict[str, Along]
    conditions: list[tuple[float, float, float]]
    packets: dict[str, list[Packet]]
    solved: dict[str, list[Tried]]
    relaxed: list[Tried]
    matrices: dict[str, list[Compared]]
    gains: list[ChapterGains]
    rechecked: float
    """Largest eigenvalue of the stored gains' forms, recomputed."""
    again: float
    """Largest relative difference of a stored gamma of setpoint 1 from one solved for now."""
    rows: list[Row]
    noises: list[Row]
    settling: float
    storage: list[tuple[int, float, float]]
    controllers: list[Feedback]


def with_a_solution(pie: OwnPIE) -> OwnPIE:
    """x_t = -x + B w, z = mean of x: the norm is one. What the programs are tried on first."""
    mean = pie.C1 @ pie.T
    return replace(pie, A=pie.T * -1.0, C1=mean, C2=mean * 0.0)


def own_systems() -> dict[str, OwnPIE]:
    """The straight beam and setpoint 1, printed and corrected, and a system that has a solution."""
    beam = own_pie(STRAIGHT, "corrected", UNIT, BEAM)
    return {
        "x_t = -x + w": with_a_solution(beam),
        "straight beam": beam,
        "setpoint 1, corrected": own_pie(SETPOINTS[0], "corrected"),
        "setpoint 1, printed": own_pie(SETPOINTS[0], "printed"),
    }


def sequences(pie: OwnPIE, numbers: tuple[int, ...] = NUMBERS) -> tuple[Along, Along]:
    """P = I, Z = 0 along the weakly null sequence and along that at the root (in w)."""
    n = pie.states
    P = PIOperator.identity(Shape(0, n))
    Z = PIOperator.zeros(Shape(0, n), Shape(2 * n, 0))
    return (
        along(pie, P, Z, numbers, legendre_sequence(n, numbers)),
        along(pie, P, Z, numbers, root_sequence(n, numbers, n - 2)),
    )


def find(tell: Tell) -> Found:
    """All computations (some minutes)."""
    systems = own_systems()
    own = {name: pie for name, pie in systems.items() if not name.startswith("x_t")}
    tell("lpi: why (18) has no solution: sequences, modes, wave packets")
    values = {name: sequences(pie) for name, pie in own.items()}
    conditions = [
        (float(beam_roots(m)[-1] ** 4), least_condition(m, "none"), least_condition(m))
        for m in range(1, MODES + 1)
    ]
    packets = {
        form: [packet(SETPOINTS[0], form, k) for k in WAVE_NUMBERS]
        for form in ("printed", "corrected")
    }
    tell("lpi: (18) and (22) as semidefinite programs")
    solved = {}
    for name, pie in systems.items():
        program = OwnProgram(pie, 0, 0, "state")
        solved[name] = [program.solve(right, EPSILON) for right in RIGHTS]
    generic = OwnProgram(systems["straight beam"], 0)
    solved["straight beam, generic rows"] = [generic.solve(right, EPSILON) for right in RIGHTS]
    relaxed = [generic.solve("0", 0.0, residual) for residual in RESIDUALS]
    tell("lpi: (18) and (21) on matrices")
    tried = {
        "(18) as printed, without -eps I": [observer(random_plant(k)) for k in SEEDS],
        "(18) with T on the other side": [
            observer(random_plant(k), "T on the other side") for k in SEEDS
        ],
        "(21) as printed": [state_feedback(random_plant(k), "printed") for k in SEEDS],
        "(21) as derived": [state_feedback(random_plant(k), "derived") for k in SEEDS],
    }
    tell("lpi: the stored gains, checked again")
    gains = [observer_gains(s.name, CORRECTED, e) for s in SETPOINTS for e in EPSILONS]
    rechecked = max(recheck(g).eigenvalue for g in gains)
    rows = epsilon_rows(lambda line: tell(f"lpi: {line}"))
    fresh = {r.epsilon: r.gamma for r in rows if r.decay_required == 0.0}
    again = max(
        abs(fresh[g.epsilon] / g.gamma - 1.0)
        for g in gains
        if g.setpoint == "1" and g.epsilon in fresh
    )
    return Found(
        null={name: v[0] for name, v in values.items()},
        root={name: v[1] for name, v in values.items()},
        conditions=conditions,
        packets=packets,
        solved=solved,
        relaxed=relaxed,
        matrices=tried,
        gains=gains,
        rechecked=rechecked,
        again=again,
        rows=rows,
        noises=noise_rows(lambda line: tell(f"lpi: {line}")),
        settling=open_loop_settling(),
        storage=storage_needed(observer_gains("1", CORRECTED, 1.0).energy, STORAGE_CELLS),
        controllers=[feedback(effort) for effort in EFFORTS],
    )


def kept(compared: Sequence[Compared]) -> tuple[int, int]:
    """(promises that hold, programs that were solved)."""
    done = [c for c in compared if c.status in ACCEPTED]
    return sum(c.kept for c in done), len(done)
