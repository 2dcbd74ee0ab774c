"""The wall clock is stepped by an hour, forward and back, in the middle of a run: nothing changes."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from fault_runs import in_slow_motion

from analysis.compare import first_difference
from chaos.aftermath import Expected

if TYPE_CHECKING:
    from conftest import Cli, Start

SOURCE = Path(__file__).with_name("wall_clock.c")
HOUR_S = 3600.0


@pytest.fixture(scope="module")
def shim(tmp_path_factory: pytest.TempPathFactory) -> Path:
    compiler = shutil.which("cc") or shutil.which("gcc")
    if compiler is None:
        pytest.skip("no C compiler to make the shim of the wall clock with")
    library = tmp_path_factory.mktemp("shim") / "wall_clock.so"
    command = [compiler, "-shared", "-fPIC", "-Wall", "-Werror", "-o", str(library), str(SOURCE)]
    subprocess.run([*command, "-ldl"], check=True)
    return library


class Clock:
    """The wall clock of a run's processes."""

    def __init__(self, shim: Path, directory: Path) -> None:
        self.shim = shim
        self.directory = directory
        self.within = ("env", f"LD_PRELOAD={shim}", f"STEP_DIR={directory}")

    def step(self, way: str) -> None:
        (self.directory / way).touch()

    def step_home(self) -> None:
        for way in ("forward", "back"):
            (self.directory / way).unlink(missing_ok=True)

    def off_s(self) -> float:
        """How far a process that starts now is off, as it says itself."""
        code = "import time; print(time.time())"
        done = subprocess.run(
            [*self.within, sys.executable, "-c", code], capture_output=True, text=True, check=True
        )
        return float(done.stdout) - time.time()

    def loaded_by(self, cli: Cli) -> None:
        """Every process of the run has the shim, and so this clock."""
        found = cli.processes()
        assert len(found) >= 8
        for pid in found.values():
            assert str(self.shim) in Path(f"/proc/{pid}/maps").read_text()


@pytest.fixture
def clock(shim: Path, tmp_path: Path) -> Clock:
    directory = tmp_path / "clock"
    directory.mkdir()
    return Clock(shim, directory)


def _step_both_ways(clock: Clock, cli: Cli) -> None:
    clock.loaded_by(cli)
    assert abs(clock.off_s()) < 60.0
    for way, off_s in (("forward", HOUR_S), ("back", -HOUR_S)):
        clock.step(way)
        assert abs(clock.off_s() - off_s) < 60.0
        time.sleep(0.5)
        clock.step_home()


def test_steps_of_the_wall_clock_change_no_number(start: Start, clock: Clock) -> None:
    same = ("--nodes", "4", "--ticks", "600", "--no-plot")
    plain = start.run(*same)
    plain.ends(Expected(ticks=600))
    stepped = start.run(*same, within=clock.within)
    with in_slow_motion(stepped):
        stepped.wait_for_records()
        _step_both_ways(clock, stepped)
        assert stepped.popen.poll() is None
    stepped.ends(Expected(events=(r"finished: all 600 ticks",), ticks=600))
    assert first_difference(plain.recorded(), stepped.recorded()) is None


def test_steps_of_the_wall_clock_hold_no_tick_up(start: Start, clock: Clock) -> None:
    cli = start.run(
        *("--nodes", "4", "--ticks", "250", "--tick", "0.02", "--realtime"),
        *("--hold-ticks", "1000", "--no-plot"),
        within=clock.within,
    )
    cli.wait_for_records()
    _step_both_ways(clock, cli)
    over_ns = time.monotonic_ns()
    cli.ends(Expected((0, 3), (r"finished: all 250 ticks",)))
    recording = cli.recorded()
    assert recording.table("/plant/pace").rows == 250
    due = recording.table("/sweep/timing").numbers("due_wall_ns")
    assert due[-1] + int(recording.facts["epoch_ns"]) > over_ns  # the steps were in its middle
    np.testing.assert_allclose(np.diff(due), 0.02e9, atol=0.5)
    assert np.diff(np.flatnonzero(~recording.late)).max() < 25  # half a second, on a busy machine


@pytest.mark.every
def test_a_run_that_starts_an_hour_late_is_the_same(start: Start, clock: Clock) -> None:
    """What the processes were told of the time before and after they were started does not agree."""
    cli = start.run("--nodes", "4", "--ticks", "100", "--by-hand", "3", within=clock.within)
    cli.wait_for("node 3 is yours")
    clock.step("forward")
    node = start.node(str(next(cli.work.glob("runs/*/node-3.json"))))
    cli.ends(Expected(ticks=100))
    assert node.finish() == 0
    seen = (clock.directory / "seen").read_text().split("\n")[:-1]
    assert seen  # somebody of the run was given the wrong time
    assert all(line.endswith("+3600") for line in seen)
