"""Faults put into the real processes of a run, one function a kind.

Second step of a case: `chaos.trial` calls them at the instants of the plan. Each says in words what it did, or
None if what it was meant for is not there (yet). What should happen next is the matter of `chaos.expect`.
"""

from __future__ import annotations

import contextlib
import os
import resource
import shutil
import signal
import time
from collections.abc import Callable

from chaos.draw import LAUNCHER, Fault
from chaos.processes import living
from chaos.scene import Hit, Scene
from chaos.strangers import first_word, flood, garbage, hog

CYCLE_S = 0.04
"""Of a process that is slowed down: so long from one stop to the next."""


# -- signals --------------------------------------------------------------------------------------


def kill(scene: Scene, fault: Fault) -> str | None:
    """SIGKILL."""
    return _send(scene, fault, signal.SIGKILL)


def interrupt(scene: Scene, fault: Fault) -> str | None:
    """SIGINT, as Ctrl-C sends it."""
    return _send(scene, fault, signal.SIGINT)


def terminate(scene: Scene, fault: Fault) -> str | None:
    """SIGTERM."""
    return _send(scene, fault, signal.SIGTERM)


def _send(scene: Scene, fault: Fault, number: signal.Signals) -> str | None:
    grip = scene.grip(fault)
    if grip is None:
        return None
    with contextlib.suppress(ProcessLookupError):
        signal.pidfd_send_signal(grip.descriptor, number)
        return f"{number.name} to pid {grip.pid}"
    return None


def freeze(scene: Scene, fault: Fault) -> str | None:
    """SIGSTOP for ever; a launcher is killed after a while, as by a user who sees that it hangs."""
    grip = scene.grip(fault)
    if grip is None or not grip.signal(signal.SIGSTOP):
        return None
    scene.frozen.add(grip.pid)
    if fault.target == LAUNCHER:
        scene.later(fault.for_s, lambda: _let(grip.signal(signal.SIGKILL)))
    return f"SIGSTOP to pid {grip.pid}"


def pause(scene: Scene, fault: Fault) -> str | None:
    """SIGSTOP, and SIGCONT after a while."""
    grip = scene.grip(fault)
    if grip is None or not grip.signal(signal.SIGSTOP):
        return None
    scene.later(fault.for_s, lambda: scene.wake(grip))
    return f"SIGSTOP to pid {grip.pid}, SIGCONT {fault.for_s:g} s later"


def slow(scene: Scene, fault: Fault) -> str | None:
    """Stopped for a share of every cycle, as on a machine that is much too small."""
    grip = scene.grip(fault)
    if grip is None or grip.ended:
        return None
    limit = time.monotonic() + fault.for_s

    def turn() -> None:
        if grip.signal(signal.SIGSTOP):
            scene.later(fault.amount * CYCLE_S, lambda: scene.wake(grip))
            if time.monotonic() + CYCLE_S < limit:
                scene.later(CYCLE_S, turn)

    turn()
    return f"pid {grip.pid} stopped {fault.amount:.0%} of the time for {fault.for_s:g} s"


def _let(_: object) -> None:
    """Nothing more is to be done."""


# -- limits and files -----------------------------------------------------------------------------


def disk(scene: Scene, fault: Fault) -> str | None:
    """The recorder's files may grow by so many bytes and no more, as on a full disk or by a quota."""
    process, directory = scene.find(fault.target), scene.directory()
    if process is None or directory is None:
        return None
    file = directory / "recording.mcap"
    with contextlib.suppress(OSError):
        size = file.stat().st_size if file.exists() else 0
        limit = size + int(fault.amount)
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (limit, limit))
        return f"files of pid {process.pid} limited to {limit} bytes"
    return None


def descriptors(scene: Scene, fault: Fault) -> str | None:
    """The process may open so many more files, sockets included, and no more."""
    process = scene.find(fault.target, fault.node)
    if process is None:
        return None
    with contextlib.suppress(OSError, ValueError):
        used = max(int(name) for name in os.listdir(f"/proc/{process.pid}/fd"))
        _, hard = resource.prlimit(process.pid, resource.RLIMIT_NOFILE)
        most = used + 1 + int(fault.amount)
        resource.prlimit(process.pid, resource.RLIMIT_NOFILE, (most, hard))
        return f"pid {process.pid} may have descriptors below {most}"
    return None


def sockets_gone(scene: Scene, _fault: Fault) -> str | None:
    """The directory of the sockets is removed."""
    found = list(scene.sockets.glob("octarm-*"))
    for directory in found:
        shutil.rmtree(directory, ignore_errors=True)
    return f"{found[0].name} removed" if found else None


def directory_gone(scene: Scene, _fault: Fault) -> str | None:
    """The run's directory is removed, with recording and log."""
    directory = scene.directory()
    if directory is None:
        return None
    shutil.rmtree(directory, ignore_errors=True)
    return f"{directory.name} removed"


INJECTORS: dict[str, Callable[[Scene, Fault], str | None]] = {
    "kill": kill,
    "freeze": freeze,
    "pause": pause,
    "slow": slow,
    "interrupt": interrupt,
    "terminate": terminate,
    "garbage": garbage,
    "flood": flood,
    "disk": disk,
    "descriptors": descriptors,
    "sockets gone": sockets_gone,
    "directory gone": directory_gone,
    "hog": hog,
}
"""By kind; those that are there before a run are chaos.prepare's."""


def inject(scene: Scene, fault: Fault, *, begun: bool) -> Hit | None:
    """Put a fault into the run; None if what it is meant for is not there."""
    alone = len(living(scene.mark)) <= 1
    helpers = len(scene.helpers)
    at = time.monotonic()
    what = INJECTORS[fault.kind](scene, fault)
    if what is None:
        return None
    hit = Hit(fault, at, what, alone, begun)
    if fault.kind == "garbage":
        helper = scene.helpers[helpers]
        hit.confirm = lambda: first_word(helper)
    return hit
