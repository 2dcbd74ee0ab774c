"""The process that the workers of a group are forked from, as the nodes of a run are from `node.zygote`.

The launcher writes one worker configuration a line to its standard input. When the launcher is gone it
ends its workers and removes the group's directory.
"""

from __future__ import annotations

from bench.configs import WorkerConfig
from bench.raw import run_raw
from bench.worker import Worker
from wire.child import Child, die_with_parent, name_process
from wire.errors import ExitCode
from wire.forking import Nursery, life


def serve(parent: int, directory: str | None) -> int:
    """Fork a worker a line until the launcher says stop or is gone; returns the exit code."""
    die_with_parent(parent)
    name_process("octarm-zygote")
    child = Child("zygote", control=0, status=1, directory=directory)
    nursery = Nursery(child)
    while not child.stopping:
        for line in child.wait_lines(None):
            if not child.stopping:
                nursery.birth(line, WorkerConfig, "worker configuration", _run_worker)
        nursery.reap()
    nursery.end()
    child.leave([])
    return 0


def _run_worker(config: WorkerConfig, parent: int) -> int:
    name = f"{config.role} {config.index}"

    def run() -> int:
        child = Child(name, control=0, status=1, directory=config.links.directory)
        if config.role == "raw":
            run_raw(config, child)
            return int(ExitCode.OK)
        child.install(reads_control=False)
        try:
            return int(Worker(config, child).run())
        finally:
            child.leave(list(config.links.listen))

    return life(name, f"octarm-bench{config.index}", parent, run)
