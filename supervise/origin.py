"""Where numbers come from: the machine, the versions of what ran, and the revision of octarm's own code.

Written into recordings and benchmark results, so that they can be compared and made again.
"""

from __future__ import annotations

import platform
import shutil
import subprocess
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Any

import psutil

from supervise.children import PYTHON_ROOT

PACKAGES = ("octarm", "numpy", "eclipse-zenoh", "msgpack", "mcap", "msgspec")
_CPU_INFO = Path("/proc/cpuinfo")


def versions() -> dict[str, str]:
    """Of octarm, of the libraries that a run uses, and of Python."""
    return {name: _version(name) for name in PACKAGES} | {"python": platform.python_version()}


def machine_facts() -> dict[str, Any]:
    """Processor, cores, memory, kernel, and which virtualisation if that can be told."""
    return {
        "cpu": _cpu_model(),
        "cores": psutil.cpu_count(),
        "memory_mb": psutil.virtual_memory().total // 2**20,
        "kernel": platform.release(),
        "architecture": platform.machine(),
        "virtualisation": _virtualisation(),
    }


def git_revision(root: Path = PYTHON_ROOT) -> str | None:
    """The commit that octarm's code is of, with "-dirty" if files were changed since; None if it is no
    checkout of its own, or without git."""
    git = shutil.which("git")
    if git is None or not (root / ".git").exists():
        return None
    words = [git, "-C", str(root), "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    return _said(words) or None


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "unknown"


def _cpu_lines(key: str) -> list[str]:
    with suppress(OSError):
        lines = _CPU_INFO.read_text().splitlines()
        return [
            v.strip() for k, _, v in (line.partition(":") for line in lines) if k.strip() == key
        ]
    return []


def _cpu_model() -> str:
    return next(iter(_cpu_lines("model name")), platform.processor() or "unknown")


def _virtualisation() -> str:
    """Machine and container as systemd-detect-virt names them; else whether the processor is a guest's."""
    tool = shutil.which("systemd-detect-virt")
    answers = [_said([tool, what]) for what in ("--vm", "--container")] if tool else [""]
    found = [name for name in answers if name != "none"]
    if all(found):
        return ", ".join(found) or "none"
    flags = next(iter(_cpu_lines("flags")), "").split()
    return "some hypervisor" if "hypervisor" in flags else "unknown"


def _said(words: list[str]) -> str:
    """What a tool prints, "" if it cannot."""
    with suppress(OSError, subprocess.SubprocessError):
        done = subprocess.run(words, capture_output=True, text=True, timeout=5, check=False)
        return done.stdout.strip()
    return ""
