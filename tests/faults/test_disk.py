"""Full disks and files that vanish: the arm goes on, the recording ends well."""

from __future__ import annotations

import functools
import re
import resource
import shutil
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from fault_runs import in_slow_motion

from chaos.aftermath import Expected, complaints, event_lines

if TYPE_CHECKING:
    from conftest import Cli, Start

TICKS = 1500
"""5 MB, 3 kB each."""
LONG = ("--nodes", "4", "--ticks", str(TICKS), "--no-plot", "--out", "out")
SHORT = ("--nodes", "4", "--ticks", "600", "--no-plot", "--out", "out")
"""To be kept slow until it has been hit."""
_IN_TMPFS = """
mkdir disk && mount -t tmpfs -o size=$1 none disk && shift || exit 99
cd disk && "$@"
code=$?
cd .. && cp -a disk kept && exit $code
"""
"""A disk of this size, alone in a mount namespace, whose content is copied out at the end."""


@functools.cache
def _no_mounts() -> str | None:
    """Why a file system cannot be mounted for a test, None if it can."""
    try:
        command = ["unshare", "-rm", "mount", "-t", "tmpfs", "none", "/mnt"]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=20)
    except OSError as error:
        return str(error)
    return done.stderr.strip() or None if done.returncode else None


def _on_disk(size: str) -> tuple[str, ...]:
    if reason := _no_mounts():
        pytest.skip(f"no disk of its own: {reason}")
    return ("unshare", "-rm", "sh", "-c", _IN_TMPFS, "sh", size)


def _limit(cli: Cli, more_bytes: int) -> None:
    """Let the recorder's files grow by so much and no more, as a quota would."""
    limit = cli.recording().stat().st_size + more_bytes
    resource.prlimit(cli.processes()["octarm-recorder"], resource.RLIMIT_FSIZE, (limit, limit))


FULL = Expected(
    codes=(3,),
    events=(
        r"disk_full: the recording ends before tick \d+: ",
        rf"finished: all {TICKS} ticks done",
    ),
    said=(
        r"(?m)^recorder: the recording ends before tick \d+: .*; the run goes on unrecorded$",
        r"(?m)^octarm run: .*recording.mcap: the disk was full, the recording ends before tick \d+$",
    ),
    ticks=50,
)


def _check_cut(cli: Cli) -> None:
    """The recording has every tick up to the one that it names, and the counters of the whole run."""
    recording = cli.recorded()
    (event,) = [line for line in event_lines(recording) if line.startswith("disk_full")]
    assert f"before tick {recording.ticks}: " in event
    assert np.isfinite(recording.estimates).all()
    assert recording.counter("measurement_messages") == 4 * TICKS
    assert recording.counter("disk_full_at") == recording.ticks


def test_disk_full_while_recording(start: Start) -> None:
    cli = start.run(*LONG, within=_on_disk("3m"))
    cli.ends(FULL)
    _check_cut(cli)


def test_file_size_limit_while_recording(start: Start) -> None:
    cli = start.run(*LONG)
    cli.wait_for_links()
    _limit(cli, 2_000_000)
    cli.ends(FULL)
    _check_cut(cli)


def test_disk_that_fails_without_warning(start: Start) -> None:
    """Not even the room that was reserved can be used: the file ends as if the recorder had been killed."""
    cli = start.run(*SHORT)
    with in_slow_motion(cli):
        cli.wait_for_records()
        _limit(cli, 10_000)
    said = (
        r"(?m)^recording .*recording.mcap: File too large: the run goes on unrecorded$",
        r"octarm run: recording .*: File too large: the rest of the run is not recorded",
    )
    cli.ends(Expected((3,), said=said, finished=False))


def test_disk_full_and_a_dead_node(start: Start) -> None:
    """The second fault is told in the room that was kept for the end, and has the exit code."""
    cli = start.run("--nodes", "4", "--ticks", "1000000", "--no-plot")
    cli.wait_for_records()
    _limit(cli, 2_000_000)
    cli.wait_for("recorder: the recording ends before tick")
    subprocess.run(["kill", "-9", str(cli.processes()["octarm-node1"])], check=True)
    events = (r"disk_full: ", r"safety_stop: .*node 1 was ended by SIGKILL")
    cli.ends(Expected((4,), events, (r"node 1 was ended by SIGKILL",)))


def test_disk_full_at_the_start(start: Start) -> None:
    cli = start.run(*LONG, within=_on_disk("1m"))
    said = (
        r"start-up failed: recording .*out/recording.mcap: No space left on device; make room, or",
    )
    cli.ends(Expected((2,), said=said, recording=False))
    assert complaints(cli.work) == ""


def test_file_size_limit_at_the_start(start: Start) -> None:
    cli = start.run(*LONG, within=("prlimit", "--fsize=100000", "--"))
    said = (
        r"recording .*: File too large, the limit is 100000 bytes; make room, or choose another",
    )
    cli.ends(Expected((2,), said=said, recording=False))


def test_directory_deleted_during_the_start(start: Start) -> None:
    """The launcher has made it, the recorder does not find it."""
    cli = start.run(*LONG)
    limit = time.monotonic() + 20.0
    while (
        "octarm-plant" not in cli.processes()
    ):  # the recorder is still being loaded, or has just begun
        assert time.monotonic() < limit
        time.sleep(0.005)
        if (cli.work / "out").exists():
            shutil.rmtree(cli.work / "out")
            break
    cli.finish()
    assert cli.popen.returncode == 2, cli.err
    assert re.search(r"^octarm: .*out/(recording.mcap|processes.log): No such file", cli.err, re.M)
    assert cli.gone() == {}


@pytest.mark.parametrize("remove", [Path.unlink, lambda file: shutil.rmtree(file.parent)])
def test_recording_deleted_during_the_run(start: Start, remove: Callable[[Path], None]) -> None:
    cli = start.run(*SHORT)
    with in_slow_motion(cli):
        cli.wait_for_records()
        remove(cli.recording())
        cli.wait_for("recording ")
    said = (
        r"(?m)^recording .*recording.mcap: it was deleted: the run goes on unrecorded$",
        r"octarm run: recording .*: it was deleted: the rest of the run is not recorded",
    )
    cli.ends(Expected((3,), said=said, recording=False))
    assert cli.err.count("unrecorded") == 1


def test_directory_moved_during_the_run(start: Start) -> None:
    cli = start.run(*SHORT)
    with in_slow_motion(cli):
        cli.wait_for_records()
        (cli.work / "out").rename(cli.work / "elsewhere")
    said = (r"out/recording.mcap is gone: it or its directory was moved or deleted",)
    cli.ends(Expected((3,), (r"finished: all 600",), said, ticks=600))


def test_plot_that_cannot_be_written(start: Start) -> None:
    cli = start.run("--nodes", "3", "--ticks", "600", "--out", "out")
    cli.wait_for_links()
    (cli.work / "out" / "plot.png").mkdir()
    cli.ends(Expected((3,), said=(r"octarm run: plot .*plot.png: Is a directory",), ticks=600))
