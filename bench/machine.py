"""Facts of the machine, and what the kernel says about the processes of a group."""

from __future__ import annotations

import platform
import shutil
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil

PROC = Path("/proc")


def machine_facts() -> dict[str, Any]:
    """Processor, cores, kernel, versions, and which virtualisation if that can be told."""
    return {
        "cpu": _cpu_model(),
        "cores": psutil.cpu_count(),
        "memory_mb": psutil.virtual_memory().total // 2**20,
        "kernel": platform.release(),
        "architecture": platform.machine(),
        "virtualisation": _virtualisation(),
        "python": platform.python_version(),
        "versions": {n: _version(n) for n in ("octarm", "eclipse-zenoh", "numpy", "msgpack")},
    }


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "unknown"


def _cpu_lines(key: str) -> list[str]:
    with suppress(OSError):
        lines = (PROC / "cpuinfo").read_text().splitlines()
        return [
            v.strip() for k, _, v in (line.partition(":") for line in lines) if k.strip() == key
        ]
    return []


def _cpu_model() -> str:
    return next(iter(_cpu_lines("model name")), platform.processor() or "unknown")


def _virtualisation() -> str:
    """Machine and container as systemd-detect-virt names them; else whether the processor is a guest's."""
    found = [name for what in ("--vm", "--container") if (name := _detected(what)) != "none"]
    if all(found):
        return ", ".join(found) or "none"
    flags = next(iter(_cpu_lines("flags")), "").split()
    return "some hypervisor" if "hypervisor" in flags else "unknown"


def _detected(what: str) -> str:
    """What the tool says, "" without it."""
    if (tool := shutil.which("systemd-detect-virt")) is not None:
        with suppress(OSError, subprocess.SubprocessError):
            done = subprocess.run(
                [tool, what], capture_output=True, text=True, timeout=5, check=False
            )
            return done.stdout.strip()
    return ""


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
