"""The command line of octarm: one verb a function; what a verb does lives in the rooms.

Results go to standard output (with --json nothing but one JSON object), everything else to standard
error. Exit codes: wire.errors.ExitCode.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import tempfile
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NoReturn

import tyro

from supervise.shipped import DEFAULT_ARM, DEFAULT_GAINS, SUITE
from wire.errors import ExitCode, OctarmError, UsageError

if TYPE_CHECKING:
    from deploy import Deployment
    from wire.artefact import Certificate

Flag = tyro.conf.FlagCreatePairsOff[bool]
Ints = Annotated[tuple[int, ...], tyro.conf.UseAppendAction]
Settings = Annotated[
    tuple[str, ...], tyro.conf.UseAppendAction, tyro.conf.arg(name="set", metavar="NAME=VALUE")
]
Span = Annotated[tuple[str, float, float] | None, tyro.conf.arg(metavar="NAME LOW HIGH")]


def run(
    *,
    gains: Path = DEFAULT_GAINS,
    nodes: int = 10,
    ticks: int = 1200,
    tick: float = 0.1,
    seed: int = 1,
    setpoint: str = "1",
    initial: str = "chapter",
    disturbance: str = "chapter",
    disturbance_amplitude: float = 1.0,
    noise_velocity: float = 1e-4,
    noise_curvature: float = 1e-3,
    plant_cells: int | None = None,
    spacing: str = "equispaced",
    out: Path | None = None,
    json: Flag = False,
    no_plot: Flag = False,
    quiet: Flag = False,
    transport: Literal["unix", "tcp"] = "unix",
    base_port: int | None = None,
    socket_dir: Path | None = None,
    start_timeout: float = 20.0,
    deadline: float = 10.0,
    by_hand: Ints = (),
    no_pin: Flag = False,
) -> int:
    """Run the arm: one process a segment, a plant and a recorder; leaves a recording and a plot.

    Args:
        gains: Gains artefact, made by `octarm design`.
        nodes: Number of segments, each a process of its own; at least 2.
        ticks: Number of ticks.
        tick: Period of a tick in seconds of simulated time.
        seed: Of the sensors' noise; two runs with one seed give the same numbers.
        setpoint: Name of the equilibrium shape in the gains artefact.
        initial: Shape at the start, at rest: setpoint, straight, or chapter (the chapter's
            deviation added to the setpoint).
        disturbance: Load that nobody commanded: none, chapter, sine, gust or step.
        disturbance_amplitude: In N/m; for chapter a factor without unit.
        noise_velocity: Standard deviation of the velocity sensors in m/s.
        noise_curvature: Standard deviation of the curvature sensors in 1/m.
        plant_cells: Cells of the emulated arm's own grid; default max(40, 4 nodes).
        spacing: Where the segments end: equispaced or chebyshev.
        out: Directory for recording, plot and log, made if missing; default runs/<run id>.
        json: Print one JSON object instead of the table.
        no_plot: Make no plot.
        quiet: No progress.
        transport: How processes meet: unix sockets or loopback TCP.
        base_port: First of as many ports as there are nodes (tcp); default: free ones.
        socket_dir: Empty directory for the sockets (unix); default: a private one.
        start_timeout: Seconds until every link must be up.
        deadline: Longest wait within a tick, in seconds, before the run is stopped.
        by_hand: A node that you start yourself; may be given several times.
        no_pin: Leave the nodes' cores to the scheduler.
    """
    from supervise.execute import execute
    from supervise.plan import RunOptions

    options = RunOptions(
        gains=gains,
        nodes=nodes,
        ticks=ticks,
        tick_s=tick,
        seed=seed,
        setpoint=setpoint,
        initial=initial,
        disturbance=disturbance,
        disturbance_amplitude=disturbance_amplitude,
        noise_velocity=noise_velocity,
        noise_curvature=noise_curvature,
        plant_cells=plant_cells,
        spacing=spacing,
        out=out,
        transport=transport,
        base_port=base_port,
        socket_dir=socket_dir,
        start_timeout_s=start_timeout,
        deadline_s=deadline,
        by_hand=by_hand,
        pin=not no_pin,
    )
    result = execute(options, quiet=quiet or json, plot=not no_plot)
    outcome = result.outcome
    if json:
        _print_json(result.summary)
    else:
        _print_summary(result.summary)
    if outcome.message:
        print(f"octarm run: {outcome.message}", file=sys.stderr)
        if result.recording.exists():
            print(f"octarm run: recording kept: {result.recording}", file=sys.stderr)
    return int(outcome.exit_code)


def design(
    *,
    arm: Path = DEFAULT_ARM,
    out: Path | None = None,
    solver: str = "CLARABEL",
    time_limit: float = 300.0,
    force: Flag = False,
    json: Flag = False,
    quiet: Flag = False,
) -> int:
    """Design observer and controller for every setpoint of an arm; leaves a gains artefact.

    Args:
        arm: Arm file (TOML): material, geometry, damping, setpoints, weights.
        out: Gains artefact to write, default <name of the arm file>.gains.json in this folder; nothing
            is written unless every gain is certified.
        solver: Semidefinite solver, by its name in CVXPY.
        time_limit: Seconds for one semidefinite program.
        force: Write over an existing file.
        json: Print one JSON object instead of the table.
        quiet: No progress.
    """
    out = out or Path(f"{arm.stem}.gains.json")
    if out.exists() and not force:
        raise UsageError(f"--out {out}: it exists already; give another name or --force")
    if not time_limit > 0.0:
        raise UsageError(f"--time-limit: expected a positive number of seconds, got {time_limit!r}")
    from design.command import Options, run_design

    silent = quiet or json
    artefact, digest = run_design(
        arm,
        out,
        Options(solver=solver, time_limit_s=time_limit),
        lambda text: None if silent else print(text, file=sys.stderr, flush=True),
    )
    rows = [
        {"setpoint": s.name, "role": role, **_gammas(getattr(s, f"{role}_certificate"))}
        for s in artefact.setpoints
        for role in ("observer", "controller")
    ]
    if json:
        _print_json({"artefact": str(out), "sha256": digest, "gains": rows})
    else:
        print(
            f"{'setpoint':<10} {'gain':<11} {'certified':>9} {'achieved':>9} {'optimum':>8} "
            f"{'open loop':>9} {'decay [1/s]':>11} {'gain norm':>9} {'seconds':>8}"
        )
        for row in rows:
            print(
                f"{row['setpoint']:<10} {row['role']:<11} {row['certified_gamma']:>9.4f} "
                f"{row['achieved_gamma']:>9.4f} {row['optimum_gamma']:>8.4f} "
                f"{row['open_loop_gamma']:>9.4f} {row['decay_per_s']:>11.4f} "
                f"{row['gain_norm']:>9.2f} {row['seconds']:>8.1f}"
            )
        print(f"{out}, SHA-256 {digest[:16]}")
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
    from analysis.solve_table import answer_table, suite_table
    from design.solve_command import Choices, finite, prepare
    from design.solve_suite import read_suite
    from supervise.solving import solve_in_child
    from supervise.suite import run_suite

    def tell(text: str) -> None:
        if not (quiet or json):
            print(text, file=sys.stderr, flush=True)

    choices = Choices(task, bisect, settings, degree, time_limit, solver, dump_problem)
    if suite:
        if file is not None or choices != Choices(time_limit_s=time_limit, solver=solver):
            raise UsageError(
                "--suite: takes --only, --time-limit and --solver, no file or other choice"
            )
        table = run_suite(read_suite(SUITE, only), SUITE.parent, choices, solve_in_child, tell)
        _print_json(finite(table)) if json else print(suite_table(table), end="")
        refused, interrupted = not table["ok"], table["interrupted"]
    else:
        if file is None or only:
            raise UsageError(
                "--only: is for --suite" if only else "FILE: expected a problem file, or --suite"
            )
        answer = solve_in_child(prepare(file, choices), tell)
        _print_json(finite(answer.facts)) if json else print(answer_table(answer.facts), end="")
        refused, interrupted = answer.facts["status"] != "certified", answer.interrupted
    if interrupted:
        raise KeyboardInterrupt
    return int(ExitCode.GAINS_REFUSED if refused else ExitCode.OK)


def deploy(
    *,
    gains: Path = DEFAULT_GAINS,
    nodes: int = 10,
    tick: float = 0.1,
    spacing: str = "equispaced",
    out: Path | None = None,
    json: Flag = False,
) -> int:
    """Put the gains on n segments and show what each node gets: ranks, message sizes, stability.

    Args:
        gains: Gains artefact, made by `octarm design`.
        nodes: Number of segments; at least 2.
        tick: Period of a tick in seconds.
        spacing: Where the segments end: equispaced or chebyshev.
        out: File for every node's matrices as JSON, for other targets; must not exist.
        json: Print one JSON object instead of the table.
    """
    from deploy import deploy as deploy_gains
    from supervise.factors_file import factors_json, facts
    from wire.artefact import read_artefact

    if out is not None and out.exists():
        raise UsageError(f"--out {out}: it exists already; nothing is written over")
    deployment = deploy_gains(read_artefact(gains), nodes, tick, spacing)
    table = facts(deployment)
    if out is not None:
        try:
            out.write_text(factors_json(deployment) + "\n")
        except OSError as error:
            raise UsageError(f"--out {out}: {error.strerror or error}") from None
        table["factors"] = str(out)
    if json:
        _print_json(table)
    else:
        _print_deployment(table, deployment)
    return int(ExitCode.OK)


def doctor(*, json: Flag = False) -> int:
    """Check this installation: versions, sockets, ports, memory, a one-second exchange over Zenoh.

    Args:
        json: Print one JSON object instead of the table.
    """
    from supervise.doctor import examine

    checks = examine()
    well = all(check.ok for check in checks)
    if json:
        listed = [vars(check) for check in checks]
        _print_json({"ok": well, "checks": listed})
    else:
        width = max(len(check.name) for check in checks)
        for check in checks:
            print(f"{'ok  ' if check.ok else 'FAIL'} {check.name:<{width}}  {check.found}")
            if not check.ok:
                print(f"     {'':<{width}}  {check.remedy}")
    return int(ExitCode.OK if well else ExitCode.INTERNAL)


VERBS: dict[str, Callable[..., int]] = {
    "run": run,
    "design": design,
    "solve": solve,
    "deploy": deploy,
    "doctor": doctor,
}


def main() -> NoReturn:
    """Entry point, see `octarm --help`."""
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        code: int = tyro.extras.subcommand_cli_from_dict(
            VERBS, prog="octarm", description="A soft arm, one process a segment."
        )
    except OctarmError as error:
        print(f"octarm: {error}", file=sys.stderr)
        code = int(error.exit_code)
    except KeyboardInterrupt:
        print("octarm: interrupted", file=sys.stderr)
        code = int(ExitCode.INTERRUPTED)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # nobody reads the output any more
        code = int(ExitCode.OK)
    except Exception as error:
        code = int(ExitCode.INTERNAL)
        print(f"octarm: internal error: {error!r}; {_save_traceback()}", file=sys.stderr)
    sys.exit(code)


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt


def _save_traceback() -> str:
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="octarm-error-", suffix=".txt", delete=False
        ) as file:
            traceback.print_exc(file=file)
    except OSError:
        return "its traceback could not be saved"
    return f"the traceback is in {file.name}"


def _print_json(value: dict[str, Any]) -> None:
    print(json.dumps(value, allow_nan=False))


def _print_summary(summary: dict[str, Any]) -> None:
    if "ticks" not in summary:
        return  # nothing was recorded
    from analysis.render import render

    print(render(summary))
    print(f"{summary['ticks_per_s']:.0f} ticks/s, {summary['run_s']:.1f} s wall clock")
    if summary["plot"]:
        print(f"plot {summary['plot']}")


def _gammas(certificate: Certificate) -> dict[str, Any]:
    names = ("certified_gamma", "achieved_gamma", "open_loop_gamma", "optimum_gamma")
    return {
        name: getattr(certificate, name) for name in (*names, "decay_per_s", "gain_norm", "seconds")
    }


def _print_deployment(table: dict[str, Any], deployment: Deployment) -> None:
    print(
        f"{table['nodes']} nodes, tick {table['tick_s']:g} s, "
        f"{table['messages_per_tick']} neighbour messages a tick, "
        f"sweeps equal the dense step to {deployment.check:.1e}"
    )
    print(f"{'setpoint':<12} {'forward':>8} {'backward':>9} {'bytes':>12} {'radius':>9}")
    for row in table["setpoints"]:
        low, high = row["bytes_per_message"]
        print(
            f"{row['name']:<12} {row['rank_forward']:>8} {row['rank_backward']:>9} "
            f"{f'{low}-{high}':>12} {row['spectral_radius']:>9.6f}"
        )


if __name__ == "__main__":
    main()
