"""The process that all nodes of a run on one machine are forked from: modules are loaded once, not
n times.

The launcher writes one node configuration a line to its standard input; each becomes a child
process. Births and deaths go to the launcher as status lines. On another machine than the launcher's the
two pipes come from a start command, ssh for example, and are all that binds the two.
"""

from __future__ import annotations

# Everything a node needs is loaded here, before the first fork.
from node.process import NodeProcess
from wire.child import Child, Deadline, die_with_parent, name_process
from wire.forking import Nursery, life
from wire.run_config import NodeConfig

SILENCE_S = 30.0
"""A remote launcher writes an empty line more often than this (supervise.far); without one it is lost,
though nobody has closed the pipe."""


def serve(parent: int | None, *, directory: str | None = None) -> int:
    """Fork a node a line until the launcher says stop or is gone; returns the exit code.

    `parent` is the launcher's process; None: it is on another machine. `directory`: private to the nodes that
    are forked here, removed if the launcher dies.
    """
    if parent is not None:
        die_with_parent(parent, directory)
    name_process("octarm-zygote")
    child = Child("zygote", control=0, status=1, directory=directory)
    nursery = Nursery(child)
    silence = Deadline(SILENCE_S)
    while not child.stopping:
        lines = child.wait_lines(None if parent is not None else silence.left)
        if lines:
            silence = Deadline(SILENCE_S)
        elif parent is None and silence.passed:
            break
        for line in lines:
            if line and not child.stopping:
                nursery.birth(line, NodeConfig, "node configuration", run_node)
        nursery.reap()
    nursery.end()
    child.leave([])
    return 0


def run_node(config: NodeConfig, parent: int) -> int:
    """The life of a forked node; returns the exit code."""
    name = f"node {config.index}"

    def run() -> int:
        child = Child(name, control=0, status=1, directory=config.links.directory)
        child.install(reads_control=False)
        try:
            return int(NodeProcess(config, child, supervised=True).run())
        finally:
            child.leave(list(config.links.listen))

    return life(name, f"octarm-node{config.index}", parent, run)
