"""A run as the injectors of faults see it: its processes, directories, and what they have started themselves.

Between `chaos.trial`, which starts the run and knows the time, and `chaos.inject`, `chaos.strangers`.
"""

from __future__ import annotations

import ctypes
import os
import select
import signal
import socket
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from chaos.draw import LAUNCHER, NODE, Fault, RunDraw
from chaos.processes import Living, living

ROOT = Path(__file__).resolve().parent.parent
_PR_SET_PDEATHSIG = 1
_libc = ctypes.CDLL(None, use_errno=True)


@dataclass
class Hit:
    """A fault that was injected."""

    fault: Fault
    at: float
    """On the monotonic clock."""
    what: str
    alone: bool = False
    """Nothing but the launcher was there yet."""
    begun: bool = False
    """The first tick had been seen."""
    confirm: Callable[[], float | None] | None = None
    """When it really came, asked at the end; None: it did not."""


@dataclass
class Scene:
    """A run as the injectors need to see it."""

    run: RunDraw
    mark: str
    launcher: int
    sockets: Path
    work: Path
    later: Callable[[float, Callable[[], None]], None]
    """Call something after so many seconds."""
    frozen: set[int] = field(default_factory=set)
    """Processes that nobody may wake again."""
    helpers: list[subprocess.Popen[bytes]] = field(default_factory=list)
    connections: list[socket.socket] = field(default_factory=list)
    grips: list[Grip] = field(default_factory=list)

    def find(self, target: str, node: int = -1) -> Living | None:
        """The living process that is meant."""
        name = f"octarm-node{node}" if target == NODE else f"octarm-{target}"
        for process in living(self.mark):
            if process.pid == self.launcher if target == LAUNCHER else process.name == name:
                return process
        return None

    def grip(self, fault: Fault) -> Grip | None:
        """A hold of the fault's target, None if it is not there."""
        process = self.find(fault.target, fault.node)
        grip = None if process is None else Grip.of(process.pid)
        if grip is not None:
            self.grips.append(grip)
        return grip

    def directory(self) -> Path | None:
        """Where the run records."""
        return next(iter(sorted(self.work.glob("runs/*"))), None)

    def wake_all(self) -> None:
        """End every pause; what is frozen stays so."""
        for grip in self.grips:
            self.wake(grip)

    def wake(self, grip: Grip) -> None:
        """End a pause of a process that is not frozen."""
        if grip.pid not in self.frozen:
            grip.signal(signal.SIGCONT)

    def close(self) -> None:
        """End what was started for faults."""
        for helper in self.helpers:
            helper.kill()
            helper.wait()
            if helper.stdout is not None:
                helper.stdout.close()
        for connection in self.connections:
            connection.close()
        for grip in self.grips:
            os.close(grip.descriptor)
        self.helpers.clear()
        self.connections.clear()
        self.grips.clear()


@dataclass(frozen=True)
class Grip:
    """A process held by its pidfd: a signal never meets another that has its number."""

    pid: int
    descriptor: int

    @classmethod
    def of(cls, pid: int) -> Grip | None:
        """Hold this process; None if it is gone."""
        try:
            return cls(pid, os.pidfd_open(pid))
        except OSError:
            return None

    def signal(self, number: signal.Signals) -> bool:
        """Send a signal; whether there was anybody."""
        try:
            signal.pidfd_send_signal(self.descriptor, number)
        except ProcessLookupError:
            return False
        return not self.ended

    @property
    def ended(self) -> bool:
        """Whether the process has ended."""
        poll = select.poll()
        poll.register(self.descriptor, select.POLLIN)
        return bool(poll.poll(0))


def dies_with_parent(number: signal.Signals) -> Callable[[], None]:
    """To be called in a child between fork and exec: it gets this signal when its parent dies."""

    def ask() -> None:
        _libc.prctl(_PR_SET_PDEATHSIG, number, 0, 0, 0)

    return ask
