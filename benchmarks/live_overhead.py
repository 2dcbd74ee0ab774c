"""What the live page costs a run: the same run without it, with it and nobody there, and watched, in turn.

    python benchmarks/live_overhead.py                     # readers of the stream that draw nothing
    python benchmarks/live_overhead.py --browser           # and a headless Chromium that draws
    python benchmarks/live_overhead.py --case lockstep-10 --rounds 5 --readers 1 --readers 8

Every round runs each way once, in another order; a figure is the median of the rounds. Sweep durations, ticks a
second and late ticks are those of the recording, without the first ticks. A watched run counts only if the
watcher got frames until its end.
"""

from __future__ import annotations

import argparse
import json
import platform
import random
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

from live_page import address, events  # noqa: E402

from analysis.recording import read_recording  # noqa: E402

SETTLE = 0.1
"""Share of a run's ticks that is left out: pages open, caches fill."""
CASES = {
    "lockstep-10": ("--nodes", "10", "--ticks", "3000"),
    "lockstep-50": ("--nodes", "50", "--ticks", "800"),
    "fifo-250Hz-10": (
        *("--nodes", "10", "--ticks", "2500", "--realtime", "--tick", "0.004", "--sched", "fifo"),
        *("--hold-ticks", "1000"),
    ),
}
FLAGS = ("--no-sandbox", "--disable-gpu", "--disable-background-networking", "--disable-sync")


@dataclass(frozen=True)
class Figures:
    """Of one run."""

    p50_ms: float
    p99_ms: float
    ticks_per_s: float
    late: int


def run_once(case: Sequence[str], *, live: bool, watchers: Sequence[Sequence[str]]) -> Figures:
    """One run of the command line; `watchers` are the words after this program's name, the port follows."""
    with tempfile.TemporaryDirectory(prefix="octarm-live-") as temporary:
        out = Path(temporary) / "run"
        command = [sys.executable, str(ROOT / "launcher.py"), "run", *case]
        command += ["--no-plot", "--json", "--out", str(out), *(["--live"] if live else [])]
        with subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        ) as run:
            assert run.stderr is not None
            said = ""
            while live and address(said) is None:
                line = run.stderr.readline()
                if not line:
                    raise SystemExit(f"the run did not begin:\n{said}")
                said += line
            own = [sys.executable, __file__]
            watching = [
                subprocess.Popen(
                    [*own, *words, str(address(said))], stdout=subprocess.PIPE, text=True
                )
                for words in watchers
            ]
            said += run.stderr.read()
        if run.returncode not in (0, 3):
            raise SystemExit(f"exit code {run.returncode}:\n{said}")
        recording = read_recording(out / "recording.mcap")
        for watcher in watching:
            told, _ = watcher.communicate(timeout=30)
            last = int(told or -1)
            if last < 0.9 * recording.ticks:
                raise SystemExit(f"a watcher saw tick {last} last, of {recording.ticks}")
    first = int(SETTLE * recording.ticks)
    sweeps = recording.sweep_durations_ms[first:]
    sweeps = sweeps[np.isfinite(sweeps)]
    began = recording.table("/sweep/timing").by_tick(("started_wall_ns",), recording.ticks)[:, 0]
    span_s = 1e-9 * float(began[-1] - began[first])
    return Figures(
        p50_ms=float(np.percentile(sweeps, 50)),
        p99_ms=float(np.percentile(sweeps, 99)),
        ticks_per_s=(recording.ticks - 1 - first) / span_s,
        late=int(recording.late[first:].sum()),
    )


def read_stream(port: int) -> int:
    """Read frames until the run is over; the last tick."""
    last = -1
    for kind, content in events(port):
        if kind == "frame":
            last = content["tick"]
    return last


def browse(port: int) -> int:
    """Show the page in a headless Chromium until the run is over; the last tick on it."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright, tempfile.TemporaryDirectory() as profile:
        context = playwright.chromium.launch_persistent_context(
            profile,
            executable_path=shutil.which("chromium"),
            headless=True,
            args=list(FLAGS),
            viewport={"width": 1280, "height": 800},
        )
        page = context.new_page()
        page.goto(f"http://127.0.0.1:{port}/")
        page.wait_for_selector("body.finished, body.lost", timeout=120_000)
        text = page.inner_text("#tick")
        context.close()
        return int(text) if text.isdigit() else -1


def measure(
    cases: Sequence[str], ways: dict[str, tuple[bool, list[list[str]]]], rounds: int
) -> dict[str, dict[str, list[Figures]]]:
    """Figures of every round by case and way."""

    def run(case: str, way: str) -> Figures:
        live, watchers = ways[way]
        figures = run_once(CASES[case], live=live, watchers=watchers)
        time.sleep(0.5)
        return figures

    return in_turn(cases, list(ways), rounds, run)


def in_turn(
    cases: Sequence[str], ways: Sequence[str], rounds: int, run: Callable[[str, str], Figures]
) -> dict[str, dict[str, list[Figures]]]:
    """Figures of every round by case and way; every round runs each way once, in another order."""
    order = random.Random(1)
    found: dict[str, dict[str, list[Figures]]] = {c: {way: [] for way in ways} for c in cases}
    for number in range(rounds):
        for case in cases:
            for way in order.sample(ways, len(ways)):
                found[case][way].append(run(case, way))
                print(f"round {number + 1}, {case}, {way}: {found[case][way][-1]}", file=sys.stderr)
    return found


def medians(runs: Sequence[Figures]) -> list[float]:
    """Of each figure over the rounds, in the order of `Figures`."""
    return [
        statistics.median(getattr(run, field.name) for run in runs) for field in fields(Figures)
    ]


def table(found: dict[str, dict[str, list[Figures]]]) -> str:
    """Rows of Markdown: medians over the rounds."""
    lines = [
        "| run | live page | sweep p50 | sweep p99 | ticks/s | late ticks |",
        "|---|---|---|---|---|---|",
    ]
    for case, ways in found.items():
        for way, runs in ways.items():
            p50, p99, rate, late = medians(runs)
            figures = f"{p50:.3g} ms | {p99:.3g} ms | {rate:.4g} | {late:g}"
            lines.append(f"| {case} | {way} | {figures} |")
    return "\n".join(lines)


def as_json(found: dict[str, dict[str, list[Figures]]]) -> str:
    """The figures of every run by case and way, and the machine."""
    plain = {c: {w: [vars(r) for r in runs] for w, runs in f.items()} for c, f in found.items()}
    return json.dumps({"machine": platform.platform(), "runs": plain})


def main() -> None:
    """Measure and print, or be a watcher of the measurement."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--case", action="append", choices=list(CASES), help="default: all")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--readers", type=int, action="append", help="default: 1 and 4")
    parser.add_argument("--browser", action="store_true", help="also watch with Chromium")
    parser.add_argument("--json", action="store_true", help="print every run's figures instead")
    parser.add_argument("--read", type=int, metavar="PORT", help=argparse.SUPPRESS)
    parser.add_argument("--browse", type=int, metavar="PORT", help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.read is not None or given.browse is not None:
        print(read_stream(given.read) if given.browse is None else browse(given.browse))
        return
    ways: dict[str, tuple[bool, list[list[str]]]] = {"none": (False, []), "nobody": (True, [])}
    for count in given.readers or [1, 4]:
        ways[f"{count} reader{'s' if count > 1 else ''}"] = (True, [["--read"]] * count)
    if given.browser:
        ways["Chromium"] = (True, [["--browse"]])
    found = measure(given.case or list(CASES), ways, given.rounds)
    print(as_json(found) if given.json else table(found))


if __name__ == "__main__":
    main()
