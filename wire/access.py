"""Who may publish what to whom: the one table of a run's messages between processes, and Zenoh's access control
made from it.

Between the keys of a run (wire.keys) and the session of each process with certificates (wire.session).
Processes are called as their certificates are. What is not in the table is denied, at both ends of a link.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

from wire.keys import Keys
from wire.messages import PLANT as PLANT_SENDER

PLANT, RECORDER, LIVE = "plant", "recorder", "live"


def node_name(first: int) -> str:
    """What the process whose first segment this is is called in its certificate."""
    return f"node-{first}"


@dataclass(frozen=True)
class Message:
    """A key that one process publishes and one that is linked to it has subscribed to."""

    sender: str
    receiver: str
    key: str
    subscribed: str = ""
    """What the receiver subscribes to, if that is more than the key."""

    @property
    def declared(self) -> str:
        """What the receiver's subscription says."""
        return self.subscribed or self.key


@dataclass(frozen=True)
class Token:
    """A liveliness token that one process holds, or hands on, and one that is linked to it watches."""

    sender: str
    receiver: str
    key: str
    watched: str
    """What the receiver watches."""


def table(
    keys: Keys, firsts: Sequence[int], nodes: int, *, live: bool
) -> Iterator[Message | Token]:
    """Everything that processes of a run say to each other, for `nodes` segments in processes with these first
    segments."""
    for first, after in pairwise([*firsts, nodes]):
        node, right = node_name(first), node_name(after)
        yield Message(PLANT, node, keys.measurement(first))
        yield Message(PLANT, node, keys.stop)
        yield Message(node, PLANT, keys.command(first))
        yield Message(node, PLANT, keys.telemetry(first), keys.all_telemetry)
        yield Token(node, PLANT, keys.ready(first), keys.all_ready)
        if after < nodes:
            yield Message(node, right, keys.forward(after))
            yield Message(right, node, keys.backward(after - 1))
            yield Message(node, right, keys.state(after, after - 1))
            yield Message(right, node, keys.state(first, after))
            yield Token(node, right, keys.ready(first), keys.ready(first))
            yield Token(right, node, keys.ready(after), keys.ready(after))
    for reader in (RECORDER, LIVE) if live else (RECORDER,):
        for sender in (PLANT_SENDER, *firsts):  # the plant's session hands on what the nodes send
            yield Message(PLANT, reader, keys.telemetry(sender), keys.all_telemetry)
    if live:
        for first in firsts:
            yield Token(PLANT, LIVE, keys.ready(first), keys.all_ready)


def names(firsts: Sequence[int], *, live: bool) -> list[str]:
    """The processes of a run, as their certificates have them."""
    return [PLANT, RECORDER, *((LIVE,) if live else ()), *map(node_name, firsts)]


def peers_of(process: str, said: Sequence[Message | Token]) -> list[str]:
    """Whom a process has links with."""
    others = {one.receiver for one in said if one.sender == process}
    return sorted(others | {one.sender for one in said if one.receiver == process})


def access_control(
    process: str, said: Sequence[Message | Token], identities: Mapping[str, str]
) -> dict[str, Any]:
    """Zenoh's `access_control` of one process: what each of its peers may send it and get from it.

    `identities` are the processes' Zenoh numbers of this run: a peer must have both the certificate and the
    number.
    """
    rules, policies = [], []
    peers = peers_of(process, said)
    for peer in peers:
        allowed: dict[tuple[str, str], set[str]] = {}
        for one in said:
            if (one.sender, one.receiver) == (process, peer):
                out, back = "egress", "ingress"
            elif (one.sender, one.receiver) == (peer, process):
                out, back = "ingress", "egress"
            else:
                continue
            if isinstance(one, Message):
                allowed.setdefault((out, "put"), set()).add(one.key)
                allowed.setdefault((back, "declare_subscriber"), set()).add(one.declared)
            else:
                allowed.setdefault((out, "liveliness_token"), set()).add(one.key)
                watch = (back, "declare_liveliness_subscriber")
                allowed.setdefault(watch, set()).add(one.watched)
        own = [
            {
                "id": f"{peer} {flow} {message}",
                "permission": "allow",
                "flows": [flow],
                "messages": [message],
                "key_exprs": sorted(expressions),
            }
            for (flow, message), expressions in sorted(allowed.items())
        ]
        rules += own
        policies.append({"rules": [rule["id"] for rule in own], "subjects": [peer]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [
            {"id": peer, "cert_common_names": [peer], "zids": [identities[peer]]} for peer in peers
        ],
        "policies": policies,
    }
