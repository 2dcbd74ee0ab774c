"""Where and how urgently a process runs: its core, and real-time scheduling if that is asked for and allowed.

Called by node, plant and the benchmark's processes before they open their Zenoh session, whose threads
inherit it.
"""

from __future__ import annotations

import os
from collections.abc import Callable

FIFO_PRIORITY = 10
"""Above everything ordinary, below the kernel's own threads."""


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
