"""Checks of the installation: can this machine run the arm, and how fast do two sessions talk.

Called by `octarm doctor`; every check gives one line with what was found and, if it failed, what to
do.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import shutil
import socket
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from threading import Event
from time import monotonic

import psutil

from supervise.endpoints import HIGHEST_FREE_PORT, choose
from supervise.shipped import DEFAULT_GAINS
from wire.artefact import read_artefact
from wire.errors import OctarmError
from wire.session import control_publisher, direct, matched, open_session

PACKAGES = ("octarm", "numpy", "scipy", "eclipse-zenoh", "msgpack", "mcap", "msgspec", "cvxpy")
NEEDED_MB = 400
NEEDED_FILES = 256
LINK_S = 5.0
EXCHANGE_S = 1.0


@dataclass(frozen=True)
class Check:
    """One line of the report."""

    name: str
    ok: bool
    found: str
    remedy: str = ""


def examine() -> list[Check]:
    """All checks, in order; a check that breaks is a failed check."""
    out: list[Check] = []
    steps: list[tuple[str, Callable[[], Check], str]] = [
        ("python", _python, "install Python 3.11 or newer"),
        ("packages", _packages, "make .venv again: make clean test"),
        ("cores", _cores, "allow this process a core"),
        ("memory", _memory, "free some memory or use fewer nodes"),
        ("open files", _files, "raise the limit: ulimit -n 4096"),
        ("unix sockets", _unix, "set TMPDIR to a short, writable directory or use --transport tcp"),
        ("loopback ports", _ports, "use --transport unix, or check the loopback interface"),
        ("gains", _gains, "make gains with `octarm design`"),
        ("extras", _extras, "nothing needs them"),
        ("exchange", _exchange, "see the message; Zenoh could not link two sessions"),
    ]
    for name, step, remedy in steps:
        try:
            check = step()
        except (OSError, OctarmError, RuntimeError, metadata.PackageNotFoundError) as error:
            check = Check(name, ok=False, found=str(error))
        except Exception as error:
            check = Check(name, ok=False, found=repr(error))
        if not check.ok and not check.remedy:
            check = Check(name, ok=False, found=check.found, remedy=remedy)
        out.append(check)
    return out


def _python() -> Check:
    return Check("python", sys.version_info >= (3, 11), platform.python_version())


def _packages() -> Check:
    found = ", ".join(f"{name} {metadata.version(name)}" for name in PACKAGES)
    return Check("packages", ok=True, found=found)


def _cores() -> Check:
    allowed = len(os.sched_getaffinity(0))
    return Check("cores", allowed >= 1, f"{allowed} of {os.cpu_count()} may be used")


def _memory() -> Check:
    free = psutil.virtual_memory().available // 2**20
    return Check("memory", free >= NEEDED_MB, f"{free} MB available, a run needs {NEEDED_MB} MB")


def _files() -> Check:
    limit = psutil.Process().rlimit(psutil.RLIMIT_NOFILE)[0]
    enough = limit < 0 or limit >= NEEDED_FILES
    return Check("open files", enough, f"limit {limit}, a run needs {NEEDED_FILES}")


def _unix() -> Check:
    endpoints = choose(2, "unix", None, None)
    try:
        path = endpoints.plant.partition("/")[2]
        with socket.socket(socket.AF_UNIX) as probe:
            probe.bind(path)
        return Check("unix sockets", ok=True, found=f"in {tempfile.gettempdir()}")
    finally:
        endpoints.close()


def _ports() -> Check:
    endpoints = choose(2, "tcp", None, None)
    found = f"free ports below {HIGHEST_FREE_PORT}, for example {endpoints.plant.rsplit(':', 1)[1]}"
    return Check("loopback ports", ok=True, found=found)


def _gains() -> Check:
    artefact = read_artefact(DEFAULT_GAINS)
    names = ", ".join(s.name for s in artefact.setpoints)
    return Check("gains", ok=True, found=f"{_short(DEFAULT_GAINS)}, setpoints {names}")


def _short(path: Path) -> str:
    return os.path.relpath(path)


def _extras() -> Check:
    """What some verbs can use and nothing needs."""
    films = "MP4 films" if shutil.which("ffmpeg") else "no MP4 films (ffmpeg is not here)"
    tables = (
        "Parquet" if importlib.util.find_spec("pyarrow") else "no Parquet (pyarrow is not here)"
    )
    return Check("extras", ok=True, found=f"{films}, {tables}")


def _exchange() -> Check:
    """Two sessions of this process send one message to and fro for a second."""
    endpoints = choose(2, "unix", None, None)
    count = 0
    done = Event()
    try:
        near = open_session("peer", [endpoints.plant], [])
        far = open_session("peer", [], [endpoints.plant])
        there = control_publisher(near, "octarm/doctor/there")
        back = control_publisher(far, "octarm/doctor/back")
        end = monotonic() + LINK_S + EXCHANGE_S

        def answer(raw: bytes) -> None:
            back.put(raw)

        def count_and_send(raw: bytes) -> None:
            nonlocal count
            count += 1
            if monotonic() >= end:
                done.set()
            else:
                there.put(raw)

        subscribers = [
            far.declare_subscriber("octarm/doctor/there", direct(answer)),
            near.declare_subscriber("octarm/doctor/back", direct(count_and_send)),
        ]
        limit = monotonic() + LINK_S
        while not (matched(there) and matched(back)):
            if monotonic() > limit:
                raise RuntimeError(f"two sessions on {endpoints.plant} found no link in {LINK_S} s")
            done.wait(0.01)
        began = monotonic()
        end = began + EXCHANGE_S
        there.put(bytes(64))
        done.wait(EXCHANGE_S + LINK_S)
        seconds = monotonic() - began
        del subscribers
        near.close()
        far.close()
    finally:
        endpoints.close()
    ok = done.is_set() and count > 0
    half = 1e6 * seconds / max(1, 2 * count)
    return Check("exchange", ok, f"{count} round trips in {seconds:.2f} s, {half:.0f} us a message")


def report(checks: Sequence[Check]) -> str:
    """The checks as text: a line each, and below a failed one what to do."""
    width = max(len(check.name) for check in checks)
    lines = []
    for check in checks:
        lines.append(f"{'ok  ' if check.ok else 'FAIL'} {check.name:<{width}}  {check.found}")
        if not check.ok:
            lines.append(f"     {'':<{width}}  {check.remedy}")
    return "\n".join(lines)
