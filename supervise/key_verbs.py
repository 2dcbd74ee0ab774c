"""The verb of the command line that makes keys; what it does lives in supervise.keys."""

from __future__ import annotations

from pathlib import Path

import tyro

from supervise.entry import show_json
from wire.errors import ExitCode, UsageError

Flag = tyro.conf.FlagCreatePairsOff[bool]
ENDS = ("pem", "key")


def keys(
    *,
    out: Path,
    nodes: int = 10,
    hosts: Path | None = None,
    days: int = 30,
    json: Flag = False,
) -> int:
    """Make a certificate authority for one arm, and a key and certificate for each process of its runs.

    Args:
        out: Directory for the keys, made if missing; nothing is written over.
        nodes: Number of segments.
        hosts: Hosts file (TOML) of the runs that the keys are for: each certificate is good for its host's
            address. Without one they are for runs on one machine.
        days: How long the certificates are valid.
        json: Print one JSON object instead of the list.
    """
    from supervise.hosts import read_hosts, this_machine
    from supervise.keys import AUTHORITY, make_keys
    from supervise.options import MOST_NODES
    from supervise.secured import holders, nodes_of

    if not 2 <= nodes <= MOST_NODES:
        raise UsageError(f"--nodes: expected 2..{MOST_NODES}, got {nodes}")
    placed = None if hosts is None else read_hosts(hosts, nodes)
    machines = (this_machine(nodes),) if placed is None else placed.hosts
    plant_address = None if placed is None else placed.plant_address
    everybody = holders(range(nodes), plant_address, machines)
    expires = make_keys(out, everybody, days)
    shares: dict[str, list[str]] = {}
    """Name of each other host, and whose files go there."""
    for host in machines:
        if not host.local:
            shares[host.name] = [holder.name for holder in nodes_of(host, range(nodes))]
    if json:
        show_json(
            {
                "directory": str(out),
                "authority": f"{AUTHORITY}.pem",
                "authority_key": f"{AUTHORITY}.key",
                "valid_until": expires.isoformat(),
                "certificates": {one.name: list(one.addresses) for one in everybody},
                "to_hosts": {
                    name: [f"{AUTHORITY}.pem", *(f"{one}.{end}" for one in own for end in ENDS)]
                    for name, own in shares.items()
                },
            }
        )
        return int(ExitCode.OK)
    print(f"{out}: {len(everybody)} certificates, valid until {expires:%Y-%m-%d %H:%M} UTC")
    for name, own in shares.items():
        print(f"to {name}: {AUTHORITY}.pem, and .pem and .key of {_span(own)}")
    here = [one.name for one in everybody if not any(one.name in own for own in shares.values())]
    print(f"here stay: {AUTHORITY}.pem, and .pem and .key of {_span(here)}")
    print(
        f"{AUTHORITY}.key makes certificates that every process believes: no run needs it; keep it offline, or "
        "delete it and make new keys when these expire"
    )
    return int(ExitCode.OK)


def _span(names: list[str]) -> str:
    """Names in short: consecutive nodes by the first and the last."""
    nodes = [name for name in names if name.startswith("node-")]
    others = [name for name in names if name not in nodes]
    if len(nodes) > 2:
        nodes = [f"{nodes[0]} to {nodes[-1]}"]
    return ", ".join([*others, *nodes])
