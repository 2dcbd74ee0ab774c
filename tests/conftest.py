"""Runs of the real command line in processes of their own, each leaving nothing behind."""

from __future__ import annotations

import contextlib
import json
import os
import secrets
import selectors
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from closed_form import write_gains
from hypothesis import settings
from turns import turn
from waiting import until

from analysis.recording import Recording, read_recording
from chaos.aftermath import Expected, Remains, violations
from chaos.processes import end_all, living, marked
from chaos.trial import BEGUN
from wire.errors import OctarmError

ROOT = Path(__file__).resolve().parents[1]
PATIENCE_S = 120.0
"""Longer than anything that is waited for takes on a machine that is ten times busier than it should be."""
# `pytest tests/fuzz --hypothesis-profile=deep`: many examples, other ones in every run (docs/fuzzing.md)
settings.register_profile("deep", max_examples=20_000, deadline=None, print_blob=True)
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    # Started in the background of a shell: what the tests start would not hear Ctrl-C either.
    signal.signal(signal.SIGINT, signal.default_int_handler)


class Cli:
    """One `octarm` process. Everything it starts carries a mark in its environment."""

    def __init__(
        self,
        work: Path,
        arguments: list[str],
        within: Sequence[str] = (),
        stdin: Path | None = None,
    ) -> None:
        """`arguments` follow the interpreter's name, `within` are words before it."""
        self.mark = secrets.token_hex(8)
        self.work = work
        self.sockets = Path(tempfile.mkdtemp(prefix="ot-"))
        environment = {**os.environ, **marked(self.mark), "TMPDIR": str(self.sockets)}
        environment.pop("COLUMNS", None)
        source = subprocess.DEVNULL if stdin is None else stdin.open("rb")
        self.popen = subprocess.Popen(
            [*within, sys.executable, *arguments],
            cwd=work,
            env=environment,
            stdin=source,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        if not isinstance(source, int):
            source.close()
        self.out = ""
        self.err = ""

    def processes(self) -> dict[str, int]:
        """Name and number of every living process with this run's mark."""
        launcher = self.popen.pid
        return {"launcher" if p.pid == launcher else p.name: p.pid for p in living(self.mark)}

    def wait_for(self, text: str, times: int = 1) -> None:
        """Read standard error until so many lines begin with the text."""
        self._read_until(
            lambda: sum(line.startswith(text) for line in self.err.splitlines()) >= times, text
        )

    def wait_for_links(self) -> None:
        """Wait for the word that everybody is linked, which comes just before the first tick."""
        self._read_until(lambda: f"{BEGUN} " in self.err, BEGUN)

    def _read_until(self, true: Callable[[], bool], what: str) -> None:
        assert self.popen.stderr is not None
        descriptor = self.popen.stderr.fileno()
        limit = time.monotonic() + PATIENCE_S
        with selectors.DefaultSelector() as selector:
            selector.register(descriptor, selectors.EVENT_READ)
            while not true():
                assert time.monotonic() < limit, f"no line {what!r} in:\n{self.err}"
                if selector.select(1.0):
                    data = os.read(descriptor, 65536)
                    assert data, f"ended without a line {what!r}:\n{self.err}"
                    self.err += data.decode()

    def wait_for_records(self) -> None:
        """Wait for the first tick, then until the recorder has written twice: whole ticks are on the disk."""
        self.wait_for("tick ")
        self._wait_for_writes(2)

    def wait_for_ticks(self) -> None:
        """The same of a run that prints nothing: what is written first is not a tick, so the file is read."""
        until(
            lambda: self._recorded_ticks() > 0, PATIENCE_S, "no tick in the recording", every_s=0.05
        )
        self._wait_for_writes(1)

    def _recorded_ticks(self) -> int:
        if self.popen.poll() is not None:
            self.finish()
            pytest.fail(f"ended before its first tick was recorded:\n{self.err}")
        found = list(self.work.glob("**/recording.mcap"))
        try:
            return read_recording(found[0]).ticks if found else 0
        except OctarmError:
            return 0

    def wait_for_more(self) -> None:
        """Wait until the recorder has written twice more."""
        self._wait_for_writes(2)

    def _recorded_bytes(self) -> int:
        return self.recording().stat().st_size

    def _wait_for_writes(self, times: int) -> None:
        for _ in range(times):
            self._wait_for_a_write(PATIENCE_S / times)

    def _wait_for_a_write(self, seconds: float) -> None:
        before = self._recorded_bytes()
        until(
            lambda: self._recorded_bytes() != before,
            seconds,
            "the recorder writes nothing",
            every_s=0.02,
        )

    def finish(self, patience_s: float = PATIENCE_S) -> int:
        """Wait for the end; returns the exit code."""
        out, err = self.popen.communicate(timeout=patience_s)
        self.out += (out or b"").decode()
        self.err += err.decode()
        return self.popen.returncode

    def json(self) -> dict[str, Any]:
        """The one object on standard output."""
        value = json.loads(self.out)
        assert isinstance(value, dict)
        return value

    def recording(self) -> Path:
        (found,) = self.work.glob("**/recording.mcap")
        return found

    def gone(self, seconds: float = 3.0) -> dict[str, int]:
        """Processes that still live after so long: none, if all is well."""
        limit = time.monotonic() + seconds
        while (left := self.processes()) and time.monotonic() < limit:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.popen.wait(0.05)
        return left

    def remains(self) -> Remains:
        """What the run left, for the check after a fault (chaos.aftermath)."""
        code = self.popen.returncode
        return Remains(self.mark, self.sockets, self.work, code, self.out, self.err)

    def ends(self, expected: Expected) -> None:
        """Wait for the end and check everything that must be true after it."""
        self.finish()
        wrong = violations(self.remains(), expected)
        assert not wrong, "\n".join([*wrong, "standard error:", self.err])

    def recorded(self) -> Recording:
        """The recording, read."""
        return read_recording(self.recording())

    def close(self) -> None:
        end_all(self.mark)
        self.popen.wait(10)
        for pipe in (self.popen.stdout, self.popen.stderr):
            if pipe is not None:
                pipe.close()
        shutil.rmtree(self.sockets, ignore_errors=True)


class Start:
    """Starts command lines in directories of their own."""

    def __init__(self, work: Path, gains: Path) -> None:
        self.work = work
        self.gains = gains
        self.started: list[Cli] = []

    def __call__(self, *arguments: str | Path, within: Sequence[str] = ()) -> Cli:
        work = self.work / f"run{len(self.started)}"
        work.mkdir()
        cli = Cli(work, [str(ROOT / "launcher.py"), *map(str, arguments)], within)
        self.started.append(cli)
        return cli

    def node(self, configuration: str, stdin: Path | None = None) -> Cli:
        """`python -m node`, as a user would type it."""
        cli = Cli(ROOT, ["-m", "node", configuration], stdin=stdin)
        self.started.append(cli)
        return cli

    def run(self, *arguments: str | Path, within: Sequence[str] = ()) -> Cli:
        """`octarm run` with the test's gains, `within` a network namespace for example."""
        return self("run", "--gains", self.gains, *arguments, within=within)


@contextlib.contextmanager
def one_run(work: Path, gains: Path, *arguments: str) -> Iterator[Path]:
    """The recording of a run that has finished well, for several tests."""
    cli = Start(work, gains).run(*arguments, "--no-plot", "--quiet")
    try:
        assert cli.finish() == 0, cli.err
        yield cli.recording()
    finally:
        cli.close()


PROCESSES = ("bench", "chaos", "faults", "fuzz", "launcher", "live", "recorder", "security")
"""Folders of tests of real processes, many of them in real time."""
FAULTS = ("faults", "security")
"""Folders whose tests take seconds of real time each, many of them for every node, flow and way."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--every",
        action="store_true",
        help="every test and every variant, also of those that need much time (tests/conftest.py)",
    )


def pytest_configure(config: pytest.Config) -> None:
    for line in (
        "every: what others show as well, and slow: left out unless --every is given",
        "variants(*ids): without --every these parameters only",
        "alone: takes all cores; no test of real processes runs meanwhile (tests/turns.py)",
    ):
        config.addinivalue_line("markers", line)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what is for `--every`: always the same tests, so that a day is like the other.

    Of a test in `FAULTS` one variant stays unless it is marked; of one that is marked, those that it names. A
    variant that is asked for by its own name is not left out.
    """
    if config.getoption("--every") or any("[" in argument for argument in config.args):
        return
    several: dict[str, list[pytest.Item]] = {}
    for item in items:
        several.setdefault(item.nodeid.partition("[")[0], []).append(item)
    left_out = {id(item) for item in items if item.get_closest_marker("every")}
    for variants in several.values():
        variants.sort(key=lambda one: one.nodeid)
        kept = variants
        if marker := variants[0].get_closest_marker("variants"):
            # if there is none with such a name, all: a slip must not make a test vanish
            kept = [one for one in variants if one.callspec.id in marker.args] or variants  # type: ignore[attr-defined]
        elif variants[0].path.parent.name in FAULTS:
            kept = variants[:1]
        left_out |= {id(one) for one in variants if one not in kept}
    if left_out:
        config.hook.pytest_deselected(items=[item for item in items if id(item) in left_out])
        items[:] = [item for item in items if id(item) not in left_out]


@pytest.fixture(autouse=True)
def _turn(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[None]:
    """Tests of real processes give way to one that takes all cores."""
    alone = request.node.get_closest_marker("alone") is not None
    if not alone and request.path.parent.name not in PROCESSES:
        yield
        return
    base = tmp_path_factory.getbasetemp()
    with turn(base.parent if "PYTEST_XDIST_WORKER" in os.environ else base, alone=alone):
        yield


@pytest.fixture(scope="session")
def gains(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_gains(tmp_path_factory.mktemp("gains") / "test.gains.json")


@pytest.fixture
def start(tmp_path: Path, gains: Path) -> Iterator[Start]:
    starter = Start(tmp_path, gains)
    try:
        yield starter
    finally:
        for cli in starter.started:
            cli.close()
