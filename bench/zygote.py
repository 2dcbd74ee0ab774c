"""The process that the workers of a group are forked from, as the nodes of a run are from `node.zygote`.

The launcher writes one worker configuration a line to its standard input. When the launcher is gone it
ends its workers and removes the group's directory.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import time
import traceback

from bench.configs import WorkerConfig
from bench.raw import run_raw
from bench.worker import Worker
from wire.child import Child, die_with_parent, name_process, send_status
from wire.errors import ExitCode, OctarmError
from wire.run_config import loads

GRACE_S = 1.0


def serve(parent: int, directory: str | None) -> int:
    """Fork a worker a line until the launcher says stop or is gone; returns the exit code."""
    die_with_parent(parent)
    name_process("octarm-zygote")
    child = Child("zygote", control=0, status=1, directory=directory)
    signal.signal(signal.SIGCHLD, lambda _number, _frame: None)
    child.install(reads_control=True)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    alive: dict[int, str] = {}
    gc.collect()
    gc.freeze()
    child.status("up")
    while not child.stopping:
        for line in child.wait_lines(None):
            if not child.stopping:
                _birth(line, child, alive)
        _reap(child, alive)
    _end(child, alive)
    child.leave([])
    return 0


def _birth(line: bytes, child: Child, alive: dict[int, str]) -> None:
    try:
        config = loads(WorkerConfig, line, "worker configuration")
    except OctarmError as error:
        child.status("failed", code="configuration", message=str(error))
        return
    own = os.getpid()
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            code = _run_worker(config, own)
        finally:
            os._exit(code)
    alive[pid] = f"{config.role} {config.index}"
    child.status("born", node=config.index, pid=pid)


def _run_worker(config: WorkerConfig, parent: int) -> int:
    name = f"{config.role} {config.index}"
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        die_with_parent(parent)
        name_process(f"octarm-bench{config.index}")
        child = Child(name, control=0, status=1, directory=config.links.directory)
        if config.role == "raw":
            run_raw(config, child)
            return int(ExitCode.OK)
        child.install(reads_control=False)
        try:
            return int(Worker(config, child).run())
        finally:
            child.leave(list(config.links.listen))
    except OctarmError as error:
        send_status(1, name, "failed", code="configuration", message=str(error))
        return int(error.exit_code)
    except Exception as error:
        traceback.print_exc()
        send_status(1, name, "failed", code="internal", message=f"{name}: {error!r}")
        return int(ExitCode.INTERNAL)
    finally:
        sys.stderr.flush()


def _reap(child: Child, alive: dict[int, str]) -> None:
    while alive:
        pid, status = os.waitpid(-1, os.WNOHANG)
        if pid == 0:
            return
        name = alive.pop(pid)
        child.status("died", who=name, pid=pid, code=os.waitstatus_to_exitcode(status))


def _end(child: Child, alive: dict[int, str]) -> None:
    """Ask the workers to end, then make them."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        for pid in list(alive):
            os.kill(pid, number)  # own children, not yet waited for: the number cannot be another's
        limit = time.monotonic() + GRACE_S
        while alive and time.monotonic() < limit:
            child.wait_lines(0.05)
            _reap(child, alive)
