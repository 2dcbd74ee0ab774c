"""Where and how urgently a process runs: its core, and the real-time class SCHED_FIFO.

Called by node and plant (and by the processes of `octarm bench`) before the Zenoh session is opened,
because threads inherit both.
"""

from __future__ import annotations

import os
from collections.abc import Callable

FIFO_PRIORITY = 10
"""Above every ordinary process, below the kernel's own threads that must not wait."""


def place(cpu: int | None, fifo_priority: int | None, note: Callable[[str], None]) -> None:
    """Pin this process to a core and make it SCHED_FIFO, each unless None.

    What the system does not permit is left as it is; `note` gets one sentence about it.
    """
    if cpu is not None:
        try:
            os.sched_setaffinity(0, {cpu})
        except OSError as error:  # a container may have taken the core away since
            note(f"not pinned to core {cpu}: {error.strerror or error}")
    if fifo_priority is not None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(fifo_priority))
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            note(
                f"not SCHED_FIFO {fifo_priority} but the ordinary scheduler: {reason}; it needs "
                "CAP_SYS_NICE or a limit (ulimit -r)"
            )
