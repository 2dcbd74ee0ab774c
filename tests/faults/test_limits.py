"""Too few files or processes: refused before the start, named during it, not missed after it."""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from fault_runs import in_slow_motion

from chaos.aftermath import Expected
from wire.limits import SESSION_FILES

if TYPE_CHECKING:
    from conftest import Cli, Start

FOUR = ("--nodes", "4", "--no-plot")
NOBODY = 54_321
"""A user with no other process."""


def _limit_files(pid: int, files: int) -> None:
    resource.prlimit(pid, resource.RLIMIT_NOFILE, (files, files))


def _within(files: int) -> tuple[str, ...]:
    return ("prlimit", f"--nofile={files}", "--")


@pytest.mark.parametrize(("files", "nodes", "needed"), [(20, 4, 44), (12, 4, 44), (60, 50, 90)])
def test_too_few_files_are_refused_before_the_start(
    start: Start, files: int, nodes: int, needed: int
) -> None:
    cli = start.run("--nodes", str(nodes), "--ticks", "20", within=_within(files))
    said = (
        rf"--nodes {nodes}: the limit of open files is {files}, a run of {nodes} node processes needs "
        rf"{needed}; raise it with `ulimit -n {needed}` or use fewer nodes",
    )
    cli.ends(Expected((2,), said=said, recording=False))


def test_what_is_said_to_be_needed_is_enough(start: Start) -> None:
    cli = start.run("--nodes", "50", "--ticks", "20", "--no-plot", within=_within(90))
    cli.ends(Expected(ticks=20))


def test_a_soft_limit_is_raised(start: Start) -> None:
    cli = start.run(*FOUR, "--ticks", "20", within=("prlimit", "--nofile=20:1024", "--"))
    cli.ends(Expected(ticks=20))


@pytest.mark.parametrize("name", ["plant", "node2"])
def test_files_that_run_out_during_the_start_are_named(start: Start, name: str) -> None:
    """While node 3 is awaited, by its left neighbour too: its user would start it then."""
    cli = start.run(*FOUR, "--ticks", "20", "--by-hand", "3", "--start-timeout", "20")
    cli.wait_for("node 3 is yours")
    pid = _pid(cli, f"octarm-{name}")
    _wait_for_files(pid)
    _limit_files(pid, 3)
    who = name.replace("node", "node ")
    said = (
        rf"start-up failed: {who}: Too many open files: the limit of open files is 3; raise it",
    )
    cli.ends(Expected((2,), said=said, recording=False))


def _pid(cli: Cli, name: str) -> int:
    limit = time.monotonic() + 20
    while (pid := cli.processes().get(name)) is None:
        assert time.monotonic() < limit
        time.sleep(0.02)
    return pid


def _wait_for_files(pid: int) -> None:
    """Until a process has the session and the links that it can have: no new files for half a second."""
    limit, seen, since = time.monotonic() + 20, -1, time.monotonic()
    while seen < SESSION_FILES or time.monotonic() < since + 0.5:
        assert time.monotonic() < limit
        if (now := len(os.listdir(f"/proc/{pid}/fd"))) != seen:
            seen, since = now, time.monotonic()
        time.sleep(0.02)


def test_files_that_run_out_during_the_run_are_not_missed(start: Start) -> None:
    """Everything that a process needs in a run it has opened before."""
    cli = start.run(*FOUR, "--ticks", "600")
    with in_slow_motion(cli):
        cli.wait_for_records()
        for name, pid in cli.processes().items():
            if name != "launcher":
                _limit_files(pid, 3)
    cli.ends(Expected(ticks=600))


def test_files_of_the_launcher_that_run_out_during_the_run(start: Start) -> None:
    """No more than it has: it gives back enough of them before it reads the recording."""
    cli = start.run(*FOUR, "--ticks", "600")
    with in_slow_motion(cli):
        cli.wait_for_records()
        pid = cli.popen.pid
        _limit_files(pid, 1 + max(int(file.name) for file in Path(f"/proc/{pid}/fd").iterdir()))
    cli.ends(Expected(ticks=600))


@pytest.mark.parametrize("processes", [1, 3, 5, 9])
def test_too_few_processes_are_told(start: Start, processes: int) -> None:
    """Whoever it is that gets no process or thread: the run does not begin, and nothing is left."""
    if os.getuid() != 0:
        pytest.skip(
            "the limit counts all processes of a user: needs one that has none, and so root"
        )
    # It may read what root may, but not start more processes than it may.
    capability = ("--inh-caps=-all,+dac_override", "--ambient-caps=-all,+dac_override")
    nobody = ("setpriv", f"--reuid={NOBODY}", "--clear-groups", *capability)
    probe = subprocess.run(
        [*nobody, "env", sys.executable, "-c", "import launcher, os; os.nice(0)"],
        cwd=Path(__file__).parents[2],
        capture_output=True,
        check=False,
    )
    if probe.returncode:
        pytest.skip(f"no other user can run this: {probe.stderr.decode()[-200:]}")
    cli = start.run(
        *FOUR,
        "--ticks",
        "20",
        "--out",
        "out",
        within=(*nobody, "prlimit", f"--nproc={processes}", "--"),
    )
    os.chown(cli.sockets, NOBODY, -1)
    said = f"Resource temporarily unavailable: the limit of processes and threads is {processes}; raise it"
    os.chown(cli.work, NOBODY, -1)
    cli.ends(Expected((2,), said=(said,), recording=False))
