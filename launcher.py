"""The command line of octarm: one verb a function; what a verb does lives in the rooms.

What goes where, and the exit codes: supervise.entry, wire.errors.ExitCode.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Literal, NoReturn

if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
    # Ctrl-C while all that follows is loaded is no traceback; supervise.entry takes over from there.
    signal.signal(signal.SIGINT, signal.SIG_DFL)

import tyro

from chaos.verbs import chaos
from chapter.verbs import chapter
from supervise.design_verbs import design, solve, study
from supervise.entry import serve, show_json, teller
from supervise.key_verbs import keys
from supervise.options import RunOptions
from supervise.recording_verbs import animate, diff, export, info, plot, recover, replay
from supervise.shipped import DEFAULT_GAINS
from wire.errors import ExitCode, UsageError

Flag = tyro.conf.FlagCreatePairsOff[bool]
Ints = Annotated[tuple[int, ...], tyro.conf.UseAppendAction]
Texts = Annotated[tuple[str, ...], tyro.conf.UseAppendAction]


def run(
    *,
    gains: Path = RunOptions.gains,
    scenario: str = RunOptions.scenario,
    nodes: int = RunOptions.nodes,
    ticks: int | None = RunOptions.ticks,
    tick: float = RunOptions.tick_s,
    seed: int = RunOptions.seed,
    setpoint: str | None = RunOptions.setpoint,
    initial: str | None = RunOptions.initial,
    disturbance: str | None = RunOptions.disturbance,
    disturbance_amplitude: float | None = RunOptions.disturbance_amplitude,
    noise_velocity: float | None = RunOptions.noise_velocity,
    noise_curvature: float | None = RunOptions.noise_curvature,
    plant_cells: int | None = RunOptions.plant_cells,
    plant_model: str | None = RunOptions.plant_model,
    spacing: str = RunOptions.spacing,
    out: Path | None = None,
    json: Flag = False,
    no_plot: Flag = False,
    quiet: Flag = False,
    transport: Literal["unix", "tcp"] = "unix",
    base_port: int | None = RunOptions.base_port,
    socket_dir: Path | None = RunOptions.socket_dir,
    start_timeout: float = RunOptions.start_timeout_s,
    deadline: float = RunOptions.deadline_s,
    by_hand: Ints = RunOptions.by_hand,
    realtime: Flag = RunOptions.realtime,
    period: float | None = RunOptions.period_s,
    hold_ticks: int = RunOptions.hold_ticks,
    restart: Flag = RunOptions.restart,
    segments_per_process: int = RunOptions.segments_per_process,
    sched: Literal["other", "fifo"] = "other",
    no_pin: Flag = False,
    hosts: Path | None = RunOptions.hosts,
    keys: Path | None = RunOptions.keys,
    live: Flag = RunOptions.live,
    live_port: int | None = RunOptions.live_port,
) -> int:
    """Run the arm: one process a segment, a plant and a recorder; leaves a recording and a plot.

    Args:
        gains: Gains artefact, made by `octarm design`.
        scenario: What happens: hold, reach, track or chapter, or a scenario file (TOML). Options given here
            win over what it says.
        nodes: Number of segments, each a process of its own; at least 2.
        ticks: Number of ticks; default: the scenario's duration.
        tick: Period of a tick in seconds of simulated time.
        seed: Of the sensors' noise; two runs with one seed give the same numbers.
        setpoint: Name of the equilibrium shape, in the gains artefact, that the arm starts at; default: the
            scenario's, as of all that follow.
        initial: Shape at the start, at rest: setpoint, straight, or chapter (the chapter's
            deviation added to the setpoint).
        disturbance: Load that nobody commanded: none, chapter, sine, gust or step.
        disturbance_amplitude: In N/m; for chapter a factor without unit.
        noise_velocity: Standard deviation of the velocity sensors in m/s.
        noise_curvature: Standard deviation of the curvature sensors in 1/m.
        plant_cells: Cells of the emulated arm's own grid; default max(40, 4 nodes) or the scenario's.
        plant_model: What moves the emulated arm: exact (default), or for reproduction of the source chapter,
            on its grid of 10 cells, quadratic (2) or linear (4), each also with -printed.
        spacing: Where the segments end: equispaced, chebyshev, or nodes + 1 boundaries in m from root to
            tip, separated by commas or in a file.
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
        realtime: Let the clock say when a tick begins, instead of as soon as the one before is done.
        period: Seconds between two ticks, wall clock, with --realtime; default: the tick.
        hold_ticks: So many ticks in a row may be late, with --realtime: for half of them the last commands
            are held, then the nodes bridge what does not come; after that the arm goes passive and the run
            ends with exit code 4.
        restart: Replace a node that dies, or with --realtime stays stuck, while the others go on controlling.
        segments_per_process: Several segments in one process hand their sums on in memory.
        sched: Scheduling of plant and nodes: other (ordinary) or fifo (real-time, where it is permitted).
        no_pin: Leave the nodes' cores to the scheduler.
        hosts: Hosts file (TOML): which nodes run on which machine, over TCP; see docs/hosts.md.
        keys: Directory made by `octarm keys`: processes meet over TCP with mutual TLS, and each says and hears
            only what is its own; see docs/security.md.
        live: Show the running arm on a web page of this machine, best with --realtime; see docs/live.md.
        live_port: Port of that page on 127.0.0.1; default: a free one.
    """
    from supervise.execute import execute

    options = RunOptions(
        gains=gains,
        scenario=scenario,
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
        plant_model=plant_model,
        spacing=spacing,
        out=out,
        transport=transport,
        base_port=base_port,
        socket_dir=socket_dir,
        start_timeout_s=start_timeout,
        deadline_s=deadline,
        by_hand=by_hand,
        pin=not no_pin,
        fifo=sched == "fifo",
        segments_per_process=segments_per_process,
        realtime=realtime,
        period_s=period,
        hold_ticks=hold_ticks,
        restart=restart,
        hosts=hosts,
        keys=keys,
        live=live,
        live_port=live_port,
    )
    result = execute(options, quiet=quiet or json, plot=not no_plot)
    outcome = result.outcome
    if json:
        show_json(result.summary)
    else:
        from analysis.render import report

        print(report(result.summary), end="")
    if outcome.message:
        print(f"octarm run: {outcome.message}", file=sys.stderr)
        if result.recording.exists():
            print(f"octarm run: recording kept: {result.recording}", file=sys.stderr)
    return int(outcome.exit_code)


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
        spacing: Where the segments end: equispaced, chebyshev, or nodes + 1 boundaries in m from root to
            tip, separated by commas or in a file.
        out: File for every node's matrices as JSON, for other targets; must not exist.
        json: Print one JSON object instead of the table.
    """
    from deploy import deploy as deploy_gains
    from supervise.factors_file import factors_json, facts, facts_table
    from supervise.spacing import parse_spacing
    from wire.artefact import read_artefact

    if out is not None and out.exists():
        raise UsageError(f"--out {out}: it exists already; nothing is written over")
    deployment = deploy_gains(read_artefact(gains), nodes, tick, parse_spacing(spacing, nodes))
    table = facts(deployment)
    if out is not None:
        try:
            out.write_text(factors_json(deployment) + "\n")
        except OSError as error:
            raise UsageError(f"--out {out}: {error.strerror or error}") from None
        table["factors"] = str(out)
    show_json(table) if json else print(facts_table(table))
    return int(ExitCode.OK)


def doctor(*, json: Flag = False) -> int:
    """Check this installation: versions, sockets, ports, memory, a one-second exchange over Zenoh.

    Args:
        json: Print one JSON object instead of the table.
    """
    from supervise.doctor import examine, report

    checks = examine()
    well = all(check.ok for check in checks)
    if json:
        listed = [vars(check) for check in checks]
        show_json({"ok": well, "checks": listed})
    else:
        print(report(checks))
    return int(ExitCode.OK if well else ExitCode.INTERNAL)


def bench(
    *,
    nodes: Ints = (),
    pattern: Texts = (),
    ticks: int | None = None,
    repetitions: int | None = None,
    seed: int | None = None,
    sched: Literal["fifo", "other"] | None = None,
    no_pin: Flag = False,
    segments_per_process: int | None = None,
    rates: bool = True,
    rate_pattern: Texts = (),
    rate_ticks: int | None = None,
    quick: Flag = False,
    compare: Path | None = None,
    gains: Path = DEFAULT_GAINS,
    out: Path | None = None,
    json: Flag = False,
    quiet: Flag = False,
) -> int:
    """Measure the exchange of sums between neighbours beside other exchange patterns.

    Args:
        nodes: Number of nodes; may be given several times; default 5, 10, 20, 50, 100.
        pattern: neighbour (the nodes of a run), bare (the chain without mathematics), star, all-to-all or
            raw (the chain over unix sockets); may be given several times; default: all.
        ticks: In a burst; default 600.
        repetitions: Bursts of each pattern, in turn with the others'; default 3.
        seed: Of the noise on the measurements; default 1.
        sched: Scheduler of all processes: fifo (real time; default) or other.
        no_pin: Leave the nodes' cores to the scheduler.
        segments_per_process: Segments in one process; the other patterns have as many processes; default 1.
        rates: Look for the highest rate that is held with p99.9 below the period.
        rate_pattern: Whose rate; may be given several times; default neighbour.
        rate_ticks: In a trial of a rate; default 2000.
        quick: A first look: 5 and 10 nodes, short bursts; under half a minute.
        compare: bench.json of an earlier benchmark; prints new over old.
        gains: Gains artefact, made by `octarm design`.
        out: Directory for bench.json and bench.png, made if missing; default runs/bench-<date>.
        json: Print one JSON object instead of the tables.
        quiet: No progress.
    """
    from bench.execute import run_bench
    from bench.options import choose_options

    given = {
        "gains": gains,
        "nodes": nodes,
        "pattern": pattern,
        "ticks": ticks,
        "repetitions": repetitions,
        "seed": seed,
        "sched": sched,
        "pin": not no_pin,
        "segments_per_process": segments_per_process,
        "rates": rates,
        "rate_pattern": rate_pattern,
        "rate_ticks": rate_ticks,
        "compare": compare,
        "out": out,
    }
    done = run_bench(choose_options(given, quick=quick), teller(silent=quiet or json))
    show_json(done.facts) if json else print(
        "\n".join([done.table.rstrip(), *map(str, done.files)])
    )
    if done.message:
        print(f"octarm bench: {done.message}; what was finished is kept", file=sys.stderr)
    return int(done.exit_code)


VERBS: dict[str, Callable[..., int]] = {
    "run": run,
    "design": design,
    "solve": solve,
    "deploy": deploy,
    "info": info,
    "plot": plot,
    "animate": animate,
    "replay": replay,
    "diff": diff,
    "export": export,
    "recover": recover,
    "study": study,
    "bench": bench,
    "keys": keys,
    "doctor": doctor,
    "chaos": chaos,
    "chapter": chapter,
}


def main() -> NoReturn:
    """Entry point, see `octarm --help`."""
    serve(VERBS, "octarm", "A soft arm, one process a segment.")


if __name__ == "__main__":
    main()
