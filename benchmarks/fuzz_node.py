"""A million mutated messages to a running node and its plant: none accepted, none ends the run.

Starts `octarm run` in real time, lets it run alone, floods it at one rate after the other, then sends the rest;
prints late ticks and sweep durations of each phase and checks every final counter. By hand:
`python benchmarks/fuzz_node.py --messages 1000000 --rates 1000 2000 5000 10000 --rate 5000`.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from time import monotonic, sleep

import numpy as np
from intruder import Intruder, Mutant, Mutator, Sent, Victim, intruding

from analysis.recording import Recording, read_recording

ROOT = Path(__file__).resolve().parents[1]
NODE = 1
PATIENCE_S = 60.0


@dataclass(frozen=True)
class Phase:
    """A time of the run, on the monotonic clock, and what was sent in it."""

    name: str
    began_s: float
    ended_s: float
    messages: int


def main() -> int:
    """Run it; 0 if all that was sent was refused by name, and the run ended as it was asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--messages", type=int, default=1_000_000, help="in all")
    parser.add_argument("--nodes", type=int, default=4)
    parser.add_argument("--period", default="0.02", help="of a tick, s")
    parser.add_argument("--sched", default="other", choices=["other", "fifo"])
    parser.add_argument("--transport", default="unix", choices=["unix", "tcp"])
    parser.add_argument("--alone", type=float, default=20.0, help="seconds without the intruder")
    parser.add_argument("--rates", type=int, nargs="*", default=[], help="messages/s, 10 s each")
    parser.add_argument(
        "--rate", type=float, help="of all the others; default: as fast as they are taken"
    )
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        command = [
            *(sys.executable, str(ROOT / "launcher.py"), "run", "--nodes", str(chosen.nodes)),
            *(
                "--ticks",
                "10000000",
                "--realtime",
                "--period",
                chosen.period,
                "--hold-ticks",
                "100000",
            ),
            *("--sched", chosen.sched, "--transport", chosen.transport),
            *("--no-plot", "--quiet", "--out", f"{directory}/run"),
        ]
        recording = Path(directory) / "run" / "recording.mcap"
        run = subprocess.Popen(
            command, cwd=directory, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        try:
            phases, sent = attack(recording, chosen)
        finally:
            run.send_signal(signal.SIGINT)
            _, said = run.communicate(timeout=PATIENCE_S)
        return report(read_recording(recording), phases, sent, run.returncode, said)


def attack(recording: Path, chosen: argparse.Namespace) -> tuple[list[Phase], tuple[Sent, Sent]]:
    """Everything that is done to the run; when, and what was sent to node and plant."""
    limit = monotonic() + PATIENCE_S
    while not recording.exists() or recording.stat().st_size < 100_000:
        if monotonic() > limit:
            raise TimeoutError("the run does not begin")
        sleep(0.1)
    victim = Victim.of(recording, NODE)
    mutator = Mutator(victim, chosen.seed)
    mutants = list(mutator.make(chosen.messages))
    print(
        f"{len(mutants)} mutants made, {mutator.whole} came out whole and are not sent", flush=True
    )
    sleep(2.0)
    phases: list[Phase] = []
    began = monotonic()
    sleep(chosen.alone)
    phases.append(Phase("alone", began, monotonic(), 0))
    with intruding(victim) as intruder:
        for rate in chosen.rates:
            piece, mutants = mutants[: 10 * rate], mutants[10 * rate :]
            phases.append(phase(intruder, piece, float(rate)))
            sleep(1.0)
        phases.append(phase(intruder, mutants, chosen.rate))
        sleep(3.0)
        return phases, (intruder.node, intruder.plant)


def phase(intruder: Intruder, mutants: list[Mutant], rate: float | None) -> Phase:
    """Send some; tells how fast they went."""
    began = monotonic()
    seconds = intruder.send(mutants, rate)
    return Phase(f"{len(mutants) / seconds:.0f} messages/s", began, monotonic(), len(mutants))


def report(
    recording: Recording, phases: list[Phase], sent: tuple[Sent, Sent], code: int, said: str
) -> int:
    """Print what happened; 0 if all is well."""
    fields = ("due_wall_ns", "duration_wall_ns")
    due, took = recording.table("/sweep/timing").by_tick(fields, recording.ticks).T
    due_s = (due + float(recording.facts["epoch_ns"])) * 1e-9
    took_ms = np.where(took > 0.0, took * 1e-6, np.nan)
    print(
        f"{'phase':<22} {'messages':>9} {'ticks':>6} {'late':>5} {'sweep p50':>10} {'p99 [ms]':>9} {'max':>7}"
    )
    for one in phases:
        inside = (due_s >= one.began_s) & (due_s < one.ended_s)
        swept = took_ms[inside & np.isfinite(took_ms)]
        p50, p99, worst = np.percentile(swept, (50, 99, 100)) if swept.size else (np.nan,) * 3
        print(
            f"{one.name:<22} {one.messages:>9} {inside.sum():>6} {int(recording.late[inside].sum()):>5} "
            f"{p50:>10.2f} {p99:>9.2f} {worst:>7.1f}"
        )
    well = code == 130 and recording.unfinished is None
    state = "whole" if well else "not whole"
    print(f"the run ended with exit code {code} (interrupted: 130), its recording is {state}")
    for told, name in zip(sent, (f"node/{NODE:02d}", "plant"), strict=True):
        counters = recording.process_counters(name)
        refused = {
            k.removeprefix("rejected_"): n for k, n in counters.items() if k.startswith("rejected_")
        }
        wrong = told.agrees(counters)
        well = well and not wrong and refused["messages"] == sum(told.by_reason.values())
        print(f"{name}: sent {sum(told.by_reason.values())}, refused {json.dumps(refused)} {wrong}")
    if not well:
        print(said)
    return 0 if well else 1


if __name__ == "__main__":
    sys.exit(main())
