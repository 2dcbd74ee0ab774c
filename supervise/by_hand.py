"""Nodes that the user starts: their configuration as a file, and what to type where.

Between the plan and the progress view; the conductor only waits for such a node like for any other.
"""

from __future__ import annotations

from supervise.hosts import Host
from supervise.plan import Plan
from wire.config_json import dumps
from wire.run_config import NodeConfig


def offer(plan: Plan, config: NodeConfig) -> str:
    """Write a node's configuration into the run's directory; returns the line that says how to start it."""
    host = plan.host_of(config.index)
    path = plan.directory / f"node-{config.index}.json"
    path.touch(0o666 if config.links.tls is None else 0o600)  # who has it could be the node
    path.write_text(dumps(config) + "\n")
    where = "" if host.local else f" on {host.name}"
    command = host.hand_command(str(path) if host.local else path.name)
    return f"node {config.index} is yours to start{where}: {command}"


def explain(plan: Plan, host: Host) -> str:
    """How the configurations get to another host, before its commands."""
    return (
        f"host {host.name}: copy {plan.directory}/node-*.json of its nodes into {host.directory} there, "
        "or give one on standard input with - in place of its name"
    )
