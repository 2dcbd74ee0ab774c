"""The verbs of the command line that work on paper: design gains, solve any PDE, study a closed loop.

Part of launcher.py in a file of its own; what a verb does lives in `design`, `analysis` and `supervise`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import tyro

from supervise.entry import show_json, teller
from supervise.shipped import DEFAULT_ARM, DEFAULT_GAINS
from wire.errors import ExitCode

Flag = tyro.conf.FlagCreatePairsOff[bool]
Ints = Annotated[tuple[int, ...], tyro.conf.UseAppendAction]
Texts = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]
Settings = Annotated[
    tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="set", metavar="NAME=VALUE")
]
Span = Annotated[tuple[str, float, float] | None, tyro.conf.arg(metavar="NAME LOW HIGH")]


def design(
    *,
    arm: Path = DEFAULT_ARM,
    out: Path | None = None,
    only: tuple[str, ...] = (),
    jobs: int | None = None,
    solver: str = "CLARABEL",
    time_limit: float = 300.0,
    fresh: Flag = False,
    force: Flag = False,
    json: Flag = False,
    quiet: Flag = False,
) -> int:
    """Design observer and controller for every setpoint of an arm; leaves a gains artefact.

    Args:
        arm: Arm file (TOML): material, geometry, damping, setpoints, weights.
        out: Gains artefact to write, default <name of the arm file>.gains.json in this folder; written
            when every gain is certified. Until then finished gains are kept in <out>.parts, for the
            next design.
        only: Gains to design and keep for the next design, without writing an artefact: SETPOINT or
            SETPOINT:ROLE (observer, controller).
        jobs: Gains worked on at once, each in a process of its own; default: one a processor.
        solver: Semidefinite solver, by its name in CVXPY.
        time_limit: Seconds for one semidefinite program; a gain takes a few.
        fresh: Design every gain, whatever is kept in <out>.parts.
        force: Write over an existing file.
        json: Print one JSON object instead of the table.
        quiet: No progress.
    """
    from analysis.gain_table import gain_rows, gain_table
    from design.gain import Options
    from supervise.designing import Request, run_design

    out = out or Path(f"{arm.stem}.gains.json")
    options = Options(solver=solver, time_limit_s=time_limit)
    request = Request(arm, out, options, jobs, fresh=fresh, force=force, only=only)
    done = run_design(request, teller(silent=quiet or json))
    rows = gain_rows((j.setpoint, j.role, g.certificate) for j, g in done.gains.items())
    written = done.sha256 is not None
    if json:
        file = {"artefact": str(out) if written else None, "sha256": done.sha256}
        show_json(file | {"parts": None if written else str(done.parts), "gains": rows})
    else:
        print(gain_table(rows))
        print(f"{out}, SHA-256 {done.sha256[:16]}" if done.sha256 else f"kept in {done.parts}")
    return int(ExitCode.OK)


def solve(
    file: Annotated[Path | None, tyro.conf.Positional] = None,
    *,
    task: Literal["stability", "gain", "observer", "controller", "norm", "h2", "h2-observer"]
    | None = None,
    bisect: Span = None,
    settings: Settings = (),
    degree: int | None = None,
    time_limit: float = 120.0,
    solver: str = "CLARABEL",
    dump_problem: Path | None = None,
    suite: Flag = False,
    only: tuple[str, ...] = (),
    json: Flag = False,
    quiet: Flag = False,
) -> int:
    """Solve any linear 1-D PDE problem: stability, gain, observer, state feedback, norm; certified.

    Args:
        file: Problem file (TOML): states, equations, boundary conditions, inputs and outputs.
        task: What is asked; default: the file's task, or the one that is about all that it gives.
        bisect: Look for the limit of stability in a parameter; default: the file's bisect.
        settings: Another value for a parameter of the file; may be given several times.
        degree: Polynomial degree of the certificate; default: raised while that pays.
        time_limit: Seconds for the whole answer; with --suite for every row.
        solver: Semidefinite solver, by its name in CVXPY.
        dump_problem: Directory for the semidefinite programs (SDPA sparse format), made if missing.
        suite: Solve the reference problems instead of a file and compare with what is true.
        only: Rows of the suite, by their ids.
        json: Print one JSON object instead of the table.
        quiet: No progress.
    """
    from design.solve_command import Choices
    from supervise.asking import ask_file, ask_suite

    choices = Choices(task, bisect, settings, degree, time_limit, solver, dump_problem)
    found = (ask_suite if suite else ask_file)(file, only, choices, teller(silent=quiet or json))
    show_json(found.facts) if json else print(found.table, end="")
    if found.interrupted:
        raise KeyboardInterrupt
    return int(ExitCode.OK if found.well else ExitCode.GAINS_REFUSED)


def study(
    name: tyro.conf.Positional[Literal["robustness", "baselines", "convergence", "growth"]],
    *,
    gains: Path = DEFAULT_GAINS,
    setpoint: Texts = (),
    nodes: Ints = (),
    tick: float | None = None,
    ticks: int | None = None,
    spacing: Texts = (),
    latency: Path | None = None,
    jobs: int | None = None,
    out: Path | None = None,
    force: Flag = False,
    json: Flag = False,
    quiet: Flag = False,
) -> int:
    """Study the closed loop on the exact arm: robustness, other controllers, refinement; and how a chain grows.

    Args:
        name: What to study.
        gains: Gains artefact, made by `octarm design`.
        setpoint: By its name; may be given several times; default: the study's own choice.
        nodes: Number of segments; may be given several times where several are compared.
        tick: Period of a tick in seconds.
        ticks: Number of ticks of a simulation.
        spacing: Where the segments end; may be given several times where several are compared.
        latency: JSON file with measured hops, {"hop_us": [...]}, for growth; default: it measures.
        jobs: Processes at once; default: one a processor.
        out: Directory for the facts (JSON) and the plot (PNG), made if missing.
        force: Write over existing files.
        json: Print one JSON object instead of the table.
        quiet: No progress.
    """
    from supervise.studying import run_study

    choices = {
        "setpoint": setpoint,
        "nodes": nodes,
        "tick": None if tick is None else (tick,),
        "ticks": None if ticks is None else (ticks,),
        "spacing": spacing,
        "latency": None if latency is None else (latency,),
        "jobs": None if jobs is None else (jobs,),
    }
    done = run_study(name, gains, choices, out, teller(silent=quiet or json), force=force)
    show_json(done.facts) if json else print(
        "\n".join([done.table.rstrip(), *map(str, done.files)])
    )
    return int(ExitCode.OK)
