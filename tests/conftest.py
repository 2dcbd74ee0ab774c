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
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from closed_form import write_gains

ROOT = Path(__file__).resolve().parents[1]
MARK = "OCTARM_TEST_RUN"
PATIENCE_S = 60.0
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
        environment = {**os.environ, MARK: self.mark, "TMPDIR": str(self.sockets)}
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
        found: dict[str, int] = {}
        wanted = f"{MARK}={self.mark}".encode()
        for directory in Path("/proc").iterdir():
            if not directory.name.isdigit():
                continue
            with contextlib.suppress(OSError):
                if wanted not in (directory / "environ").read_bytes().split(b"\0"):
                    continue
                state = (directory / "stat").read_text().rpartition(")")[2].split()[0]
                if state not in "ZX":
                    name = (directory / "comm").read_text().strip()
                    name = "launcher" if int(directory.name) == self.popen.pid else name
                    found[name] = int(directory.name)
        return found

    def wait_for(self, text: str) -> None:
        """Read standard error until a line begins with the text."""
        assert self.popen.stderr is not None
        descriptor = self.popen.stderr.fileno()
        limit = time.monotonic() + PATIENCE_S
        with selectors.DefaultSelector() as selector:
            selector.register(descriptor, selectors.EVENT_READ)
            while not any(line.startswith(text) for line in self.err.splitlines()):
                assert time.monotonic() < limit, f"no line {text!r} in:\n{self.err}"
                if selector.select(1.0):
                    data = os.read(descriptor, 65536)
                    assert data, f"ended without a line {text!r}:\n{self.err}"
                    self.err += data.decode()

    def wait_for_records(self) -> None:
        """Wait for the first tick, then until the recorder has written twice: whole ticks are on the disk."""
        self.wait_for("tick ")
        self._wait_for_writes(2)

    def wait_for_ticks(self) -> None:
        """The same of a run that prints nothing."""
        limit = time.monotonic() + PATIENCE_S
        while not list(self.work.glob("**/recording.mcap")):
            assert time.monotonic() < limit, "no recording"
            time.sleep(0.02)
        self._wait_for_writes(2)

    def _wait_for_writes(self, times: int) -> None:
        limit = time.monotonic() + PATIENCE_S
        for _ in range(times):
            size = self.recording().stat().st_size
            while self.recording().stat().st_size == size:
                assert time.monotonic() < limit, "the recorder writes nothing"
                time.sleep(0.02)

    def finish(self) -> int:
        """Wait for the end; returns the exit code."""
        out, err = self.popen.communicate(timeout=PATIENCE_S)
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

    def close(self) -> None:
        for pid in self.processes().values():
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
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
