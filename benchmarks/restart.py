"""How long an arm in real time is without a node that is killed, and what that does to its tip.

    python benchmarks/restart.py                       # 100 Hz and 250 Hz, ten nodes, at least 30 kills each
    python benchmarks/restart.py --rate 100 --kills 9 --sched other

Without --restart each kill is the end of a run: the time is from the kill to the first passive tick's begin.
With --restart nodes 0, 5 and 9 are killed in turn, nine kills a run, 2 s apart: the time is from the kill to
the begin of the first tick in which the plant waits for the new process again. Instants are those of the
recording, on the clock that kills. The tip is compared, tick by tick, with that of the same run in lock-step
without a kill.
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from conftest import Cli  # noqa: E402

from analysis.recording import Recording, read_recording  # noqa: E402
from chaos.aftermath import event_lines  # noqa: E402

Array = npt.NDArray[np.float64]
NODES = 10
KILLED = (0, 5, 9)
EVERY_S = 2.0
HOLD_S = 0.1
"""So long ticks may be late in a row: what is measured is death, not the machine's other work."""


@dataclass
class Measured:
    """Of the kills of one way to run."""

    times_s: list[float] = field(default_factory=list)
    tips_mm: list[float] = field(default_factory=list)
    late: int = 0
    codes: list[int] = field(default_factory=list)


def arguments(rate: int, sched: str) -> list[str]:
    """The command line of a run that is not paced."""
    return [
        *(str(ROOT / "launcher.py"), "run", "--nodes", str(NODES), "--tick", str(1.0 / rate)),
        *("--no-plot", "--sched", sched, "--seed", "5"),
    ]


def realtime(rate: int) -> list[str]:
    """What paces it."""
    return ["--realtime", "--hold-ticks", str(round(HOLD_S * rate))]


def run_and_kill(
    command: Sequence[str], nodes: Sequence[int], first_s: float
) -> tuple[int, Recording | None, list[tuple[int, int]]]:
    """One run in which these nodes are killed; exit code, recording, and (node, instant) of each kill."""
    work = Path(tempfile.mkdtemp(prefix="octarm-restart-"))
    cli = Cli(work, list(command))
    kills: list[tuple[int, int]] = []
    try:
        cli.wait_for("tick ")
        time.sleep(first_s)
        for node in nodes:
            pid = cli.processes().get(f"octarm-node{node}")
            if pid is None:
                break
            kills.append((node, time.monotonic_ns()))
            os.kill(pid, signal.SIGKILL)
            time.sleep(EVERY_S if len(nodes) > 1 else 0.0)
        code = cli.finish()
        found = next(work.glob("**/recording.mcap"), None)
        return code, None if found is None else read_recording(found), kills
    finally:
        cli.close()
        shutil.rmtree(work, ignore_errors=True)


def begins_ns(recording: Recording) -> dict[int, int]:
    """When each tick began, on the monotonic clock."""
    table = recording.table("/sweep/timing")
    instants = table.numbers("started_wall_ns") + int(recording.facts["epoch_ns"])
    return dict(zip(table.ticks.tolist(), instants.astype(np.int64).tolist(), strict=True))


def tips(recording: Recording) -> dict[int, Array]:
    """Where the tip is at each tick, m."""
    table = recording.table("/plant/tip")
    places = np.stack([table.numbers("x_m"), table.numbers("y_m")], axis=1)
    return dict(zip(table.ticks.tolist(), places, strict=True))


def tip_apart_mm(recording: Recording, twin: Recording, first: int, last: int) -> float:
    """The largest distance between the tips of two runs in these ticks."""
    one, other = tips(recording), tips(twin)
    both = [k for k in one if k in other and first <= k <= last]
    return max((1e3 * float(np.linalg.norm(one[k] - other[k])) for k in both), default=0.0)


def without_restart(rate: int, sched: str, kills: int, twin: Recording) -> Measured:
    """A run for each kill."""
    out = Measured()
    for i in range(kills):
        command = [*arguments(rate, sched), *realtime(rate), "--ticks", str(30 * rate)]
        code, recording, done = run_and_kill(command, [KILLED[i % 3]], 0.5 + 0.013 * i)
        out.codes.append(code)
        if recording is None or not done:
            continue
        guard = recording.table("/plant/guard")
        passive = guard.ticks[guard.numbers("passive") > 0.0]
        if not passive.size:
            continue
        begins = begins_ns(recording)
        first = int(passive[0])
        out.times_s.append((begins[first] - done[0][1]) * 1e-9)
        out.tips_mm.append(tip_apart_mm(recording, twin, first - 1, first + 20))
    return out


def with_restart(rate: int, sched: str, kills: int, twin: Recording) -> Measured:
    """Nine kills a run."""
    out = Measured()
    while len(out.times_s) < kills and len(out.codes) < 2 * kills:
        nodes = [KILLED[i % 3] for i in range(9)]
        ticks = round((1.5 + EVERY_S * 9 + 2.0) * rate)
        command = [
            *(*arguments(rate, sched), *realtime(rate), "--ticks", str(ticks), "--restart"),
        ]
        code, recording, done = run_and_kill(command, nodes, 0.5)
        out.codes.append(code)
        if recording is None:
            continue
        out.late += int(np.sum(recording.table("/plant/pace").numbers("late")))
        begins = begins_ns(recording)
        back = [
            (int(one[1]), int(one[2]))
            for line in event_lines(recording)
            if (one := re.match(r"node_back: node (\d+) works again from tick (\d+)", line))
        ]
        for node, at_ns in done:
            after = [k for i, k in back if i == node and begins.get(k, 0) > at_ns]
            if not after:
                print(f"  node {node}: not back", file=sys.stderr)
                continue
            out.times_s.append((begins[after[0]] - at_ns) * 1e-9)
            first = next(k for k in sorted(begins) if begins[k] > at_ns)
            out.tips_mm.append(tip_apart_mm(recording, twin, first, first + round(EVERY_S * rate)))
    return out


def line(rate: int, name: str, one: Measured) -> str:
    """One line of the table."""
    times = 1e3 * np.array(one.times_s)
    codes = ", ".join(f"{one.codes.count(c)} x {c}" for c in sorted(set(one.codes)))
    if not times.size:
        return f"| {rate} | {name} | 0 | - | - | - | - | {codes} |"
    return (
        f"| {rate} | {name} | {times.size} | {np.median(times):.1f} | {np.percentile(times, 90):.1f} | "
        f"{times.max():.1f} | {max(one.tips_mm):.2f} | {codes} |"
    )


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rate", type=int, action="append", help="ticks a second")
    parser.add_argument("--kills", type=int, default=30)
    parser.add_argument("--sched", choices=("fifo", "other"), default="fifo")
    options = parser.parse_args()
    print(
        "| rate (Hz) | way | kills | median (ms) | 90 % (ms) | longest (ms) | tip (mm) | exit codes |"
    )
    print("|---|---|---|---|---|---|---|---|")
    for rate in options.rate or (100, 250):
        ticks = 24 * rate
        _, twin, _ = run_and_kill([*arguments(rate, "other"), "--ticks", str(ticks)], [], 0.0)
        assert twin is not None
        for name, measure in (("passive", without_restart), ("replaced", with_restart)):
            print(line(rate, name, measure(rate, options.sched, options.kills, twin)), flush=True)


if __name__ == "__main__":
    main()
