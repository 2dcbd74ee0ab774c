"""What the kernel says about the processes of a group: time on a processor, memory."""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

PROC = Path("/proc")


def cpu_ns(pids: Iterable[int]) -> int:
    """Time on a processor of all threads of the processes so far, ns."""
    total = 0
    for pid in pids:
        with suppress(OSError):
            for task in (PROC / str(pid) / "task").iterdir():
                with suppress(OSError):
                    total += int((task / "schedstat").read_text().split()[0])
    return total


@dataclass(frozen=True)
class Memory:
    """Of one process, kB: its proportional share, and what it shares with nobody."""

    pss_kb: int
    private_kb: int


def memory_of(pid: int) -> Memory | None:
    """From the kernel's summary of the process's mappings; None if it is gone."""
    try:
        lines = (PROC / str(pid) / "smaps_rollup").read_text().splitlines()
    except OSError:
        return None
    sizes = {
        key: int(rest.split()[0])
        for key, _, rest in (line.partition(":") for line in lines[1:])
        if rest.strip()
    }
    return Memory(sizes["Pss"], sizes["Private_Clean"] + sizes["Private_Dirty"])
