"""The process that all nodes of a run on one machine are forked from: modules are loaded once, not
n times.

The launcher writes one node configuration a line to its standard input; each becomes a child
process. Births and deaths go to the launcher as status lines. On another machine than the launcher's the
two pipes come from a start command, ssh for example, and are all that binds the two.
"""

from __future__ import annotations

import gc
import os
import signal
import sys
import time
import traceback

# Everything a node needs is loaded here, before the first fork.
from node.process import NodeProcess
from wire.child import Child, Deadline, die_with_parent, name_process, send_status
from wire.errors import ExitCode, OctarmError
from wire.run_config import NodeConfig, loads

GRACE_S = 1.0
"""Between the request to end and the end by force, when the zygote itself has to stop its nodes."""


SILENCE_S = 30.0
"""A remote launcher writes an empty line more often than this (supervise.far); without one it is lost,
though nobody has closed the pipe."""


def serve(parent: int | None) -> int:
    """Fork a node a line until the launcher says stop or is gone; returns the exit code.

    `parent` is the launcher's process; None: it is on another machine.
    """
    if parent is not None:
        die_with_parent(parent)
    name_process("octarm-zygote")
    child = Child("zygote", control=0, status=1, directory=None)
    signal.signal(signal.SIGCHLD, lambda _number, _frame: None)
    child.install(reads_control=True)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    alive: dict[int, int] = {}
    # What is loaded here stays as it is: a collection in a node would touch, and so copy, every page of it.
    gc.collect()
    gc.freeze()
    child.status("up")
    silence = Deadline(SILENCE_S)
    while not child.stopping:
        lines = child.wait_lines(None if parent is not None else silence.left)
        if lines:
            silence = Deadline(SILENCE_S)
        elif parent is None and silence.passed:
            break
        for line in lines:
            if line and not child.stopping:
                _birth(line, child, alive)
        _reap(child, alive)
    _end(child, alive)
    return 0


def _birth(line: bytes, child: Child, alive: dict[int, int]) -> None:
    try:
        config = loads(NodeConfig, line, "node configuration")
    except OctarmError as error:
        child.status("failed", code="configuration", message=str(error))
        return
    own = os.getpid()
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            code = run_node(config, own)
        finally:
            os._exit(code)
    alive[pid] = config.index
    child.status("born", node=config.index, pid=pid)


def run_node(config: NodeConfig, parent: int) -> int:
    """The life of a forked node: never returns into the zygote's loop."""
    name = f"node {config.index}"
    try:
        signal.set_wakeup_fd(-1)
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        die_with_parent(parent)
        name_process(f"octarm-node{config.index}")
        child = Child(name, control=0, status=1, directory=config.links.directory)
        child.install(reads_control=False)
        try:
            return int(NodeProcess(config, child, supervised=True).run())
        finally:
            child.leave(list(config.links.listen))
    except OctarmError as error:
        send_status(1, name, "failed", code="configuration", message=f"{name}: {error}")
        return int(error.exit_code)
    except Exception as error:
        traceback.print_exc()
        send_status(1, name, "failed", code="internal", message=f"{name}: {error}")
        return int(ExitCode.INTERNAL)
    finally:
        sys.stderr.flush()


def _reap(child: Child, alive: dict[int, int]) -> None:
    while alive:
        pid, status = os.waitpid(-1, os.WNOHANG)
        if pid == 0:
            return
        index = alive.pop(pid)
        child.status("died", node=index, pid=pid, code=os.waitstatus_to_exitcode(status))


def _end(child: Child, alive: dict[int, int]) -> None:
    """Ask the nodes to end, then make them."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        for pid in list(alive):
            os.kill(pid, number)  # own children, not yet waited for: the number cannot be another's
        limit = time.monotonic() + GRACE_S
        while alive and time.monotonic() < limit:
            child.wait_lines(0.05)
            _reap(child, alive)
