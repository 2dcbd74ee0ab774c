"""What `--keys` makes of a run: who each process is, whom it has links with, and what they may say.

Between the options and the plan; nothing is started here. Paths only: no key leaves its host.
"""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from supervise.hosts import Host, this_machine
from supervise.keys import AUTHORITY, Holder, certificate_path, check_keys, key_path
from supervise.options import RunOptions
from wire.access import (
    LIVE,
    PLANT,
    RECORDER,
    Message,
    Token,
    access_control,
    names,
    node_name,
    peers_of,
    table,
)
from wire.credentials import check_private
from wire.keys import Keys
from wire.messages import run_tag
from wire.run_config import TlsConfig


def holders(
    firsts: Sequence[int], plant_address: str | None, hosts: Sequence[Host]
) -> list[Holder]:
    """All processes that may need a certificate, with the addresses that they are dialled at."""
    return [
        Holder(PLANT, () if plant_address is None else (plant_address,)),
        Holder(RECORDER),
        Holder(LIVE),
        *(holder for host in hosts for holder in nodes_of(host, firsts)),
    ]


def nodes_of(host: Host, firsts: Sequence[int]) -> list[Holder]:
    """The node processes on a host, if processes begin with these segments."""
    return [Holder(node_name(i), (host.address,)) for i in host.indices if i in firsts]


@dataclass(frozen=True)
class Secured:
    """The identities of one run."""

    keys: Path
    """As the user gave it."""
    hosts: tuple[Host, ...]
    said: tuple[Message | Token, ...]
    identities: dict[str, str] = field(repr=False)

    def directory(self, host: Host | None) -> Path:
        """Where the keys of a host's nodes are, or those of plant, recorder and live page."""
        own = self.keys if host is None or host.keys is None else Path(host.keys)
        return own.absolute() if host is None or host.local else own

    def tls(self, name: str, node: int | None = None) -> TlsConfig:
        """The part of a process's configuration."""
        host = next((h for h in self.hosts if node is not None and node in h.indices), None)
        directory = self.directory(host)
        return TlsConfig(
            name=name,
            identity=self.identities[name],
            authority=str(certificate_path(directory, AUTHORITY)),
            certificate=str(certificate_path(directory, name)),
            private_key=str(key_path(directory, name)),
            peers={peer: self.identities[peer] for peer in peers_of(name, self.said)},
            access=access_control(name, self.said, self.identities),
        )


def secure(options: RunOptions, keys: Path, run_id: str) -> Secured:
    """The identities of a run with these keys.

    Raises UsageError if one of this machine's processes could not use its key or certificate. Those of other
    hosts are looked at there, by the process itself.
    """
    firsts = range(0, options.nodes, options.segments_per_process)
    said = table(Keys(run_tag(run_id)), firsts, options.nodes, live=options.live)
    placed = options.placed_on
    secured = Secured(
        keys=keys,
        hosts=(this_machine(options.nodes),) if placed is None else placed.hosts,
        said=tuple(said),
        identities={name: _identity() for name in names(firsts, live=options.live)},
    )
    plant, recorder, shown = holders((), None if placed is None else placed.plant_address, ())
    _check(secured, None, [plant, recorder, *([shown] if options.live else [])])
    for host in secured.hosts:
        if host.local:
            _check(secured, host, nodes_of(host, firsts))
    return secured


def _check(secured: Secured, host: Host | None, own: Sequence[Holder]) -> None:
    directory = secured.directory(host)
    check_keys(directory, own)
    for holder in own:
        check_private(str(key_path(directory, holder.name)))


def _identity() -> str:
    """A Zenoh number: 128 bits that cannot be guessed; it has no leading zero."""
    return f"{secrets.randbelow(15) + 1:x}{secrets.token_hex(16)[1:]}"
