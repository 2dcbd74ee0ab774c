"""Where and how urgently a process runs: its core, and real-time scheduling if that is asked for and allowed.

Called by node, plant and the benchmark's processes before they open their Zenoh session, whose threads
inherit it.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable

FIFO_PRIORITY = 10
"""Above everything ordinary, below the kernel's own threads."""
BEHIND = 5
"""By how much a thread steps back within SCHED_FIFO, see `step_back`."""
NICENESS = 10
"""The same under the ordinary scheduler."""


def place(cpu: int | None, fifo_priority: int | None, note: Callable[[str], None]) -> None:
    """Pin this process to a core and make it SCHED_FIFO; None leaves either as it is.

    What the system does not permit is said in one sentence to `note`, and the process goes on without.
    """
    if cpu is not None:
        try:
            os.sched_setaffinity(0, {cpu})
        except OSError as error:  # a container may have taken the core away since
            note(f"not pinned to core {cpu}: {error.strerror}")
    if fifo_priority is not None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(fifo_priority))
        except OSError as error:
            note(
                f"no real-time scheduling (SCHED_FIFO {fifo_priority}): {error.strerror}; run as root, "
                "or allow it with `ulimit -r` or CAP_SYS_NICE"
            )


def step_back(fifo_priority: int | None) -> None:
    """Let the calling thread wait for the process's other threads, which were started before.

    A node's main thread has the records and the checksums, Zenoh's thread has the ticks. Within SCHED_FIFO it
    keeps a priority of its own: it may hold the interpreter's lock, and must not wait for ordinary processes
    then.
    """
    if fifo_priority is not None and os.sched_getscheduler(0) == os.SCHED_FIFO:
        lower = max(1, fifo_priority - BEHIND)
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(lower))
    else:
        thread = threading.get_native_id()
        os.setpriority(
            os.PRIO_PROCESS, thread, min(19, os.getpriority(os.PRIO_PROCESS, 0) + NICENESS)
        )
