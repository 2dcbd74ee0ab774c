"""How every process opens its one Zenoh session: explicit links, no scouting, one runtime thread.

Between the process loops (node, plant, recorder) and Zenoh. The topology is a chain: a node listens
for its right neighbour and dials its left one and its segment of the plant. The plant's session is
a router inside the plant process: it hands the telemetry of the nodes on to the recorder, its
client, without Python touching it, and never forwards between two nodes.
"""

from __future__ import annotations

import ctypes
import json
import os
import re
import socket
from collections.abc import Callable, Sequence
from threading import get_ident
from typing import Any

import zenoh

from wire.errors import OctarmError

RUNTIME_NODE = (
    "(rx:(handover:app),acc:(handover:app),tx:(handover:app),net:(handover:app),"
    "app:(worker_threads:1))"
)
"""One runtime thread: one wake-up a message instead of four."""

RUNTIME_PLANT = (
    "(rx:(handover:app),acc:(handover:app),tx:(worker_threads:1),net:(handover:app),"
    "app:(worker_threads:1))"
)
"""A sending thread of its own: forwarding waits in the receiving thread for room in a send queue,
which nobody would empty if both were one."""

LEASE_MS = 10_000
"""A process that dies is noticed at once, its sockets close. The lease only bounds a frozen one,
and in lock-step the tick deadline is shorter; a loaded machine must not lose a link for a late
keep-alive."""

CLIENT_OPEN_MS = 250


def _config(
    mode: str, listen: Sequence[str], connect: Sequence[str], lease_ms: int
) -> dict[str, Any]:
    return {
        "mode": mode,
        "listen": {"endpoints": list(listen), "exit_on_failure": True},
        "connect": {
            "endpoints": list(connect),
            # A client's open waits for its router: in short pieces, so that signals are heard.
            "timeout_ms": CLIENT_OPEN_MS if mode == "client" else -1,
            "exit_on_failure": mode == "client",
            "retry": {"period_init_ms": 10, "period_max_ms": 50, "period_increase_factor": 1.5},
        },
        "open": {"return_conditions": {"connect_scouted": False, "declares": True}},
        "scouting": {"delay": 0, "multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "routing": {"router": {"peers_failover_brokering": False}},
        "timestamping": {"enabled": False},
        "transport": {
            "unicast": {
                "lowlatency": False,
                "qos": {"enabled": True},
                "compression": {"enabled": False},
                "max_links": 1,
                "max_sessions": 10_000,
                "open_timeout": 2000,
                "accept_timeout": 2000,
            },
            "shared_memory": {"enabled": False},
            "link": {
                "protocols": ["tcp", "unixsock-stream"],
                "tx": {
                    "lease": lease_ms,
                    "keep_alive": 4,
                    "queue": {
                        # Batches per priority: a burst waits here, not in the caller.
                        "size": {
                            "control": 2,
                            "real_time": 16,
                            "interactive_high": 1,
                            "interactive_low": 1,
                            "data_high": 1,
                            "data": 4,
                            "data_low": 16,
                            "background": 1,
                        },
                        "batching": {"enabled": True, "time_limit": 1},
                        "congestion_control": {
                            "drop": {"wait_before_drop": 50_000},
                            "block": {"wait_before_close": 2_000_000},
                        },
                    },
                },
            },
        },
    }


def open_session(
    mode: str, listen: Sequence[str], connect: Sequence[str], *, lease_ms: int = LEASE_MS
) -> Any:
    """Open the process's Zenoh session; `mode` is "peer" (node), "router" (plant) or "client"
    (recorder). After `lease_ms` without a word the other end takes this process for dead.

    Sets ZENOH_RUNTIME, which the library reads once a process, so it must be the first call into
    it. Raises OctarmError if this host does not let it listen there.
    """
    os.environ["ZENOH_RUNTIME"] = RUNTIME_PLANT if mode == "router" else RUNTIME_NODE
    text = json.dumps(_config(mode, listen, connect, lease_ms))
    try:
        return zenoh.open(zenoh.Config.from_json5(text))
    except zenoh.ZError as error:
        if not listen:
            raise
        raise OctarmError(
            f"cannot listen on {', '.join(listen)} of {socket.gethostname()}: {_reason(str(error))}; "
            "free the port or choose another, and check that the address is this host's"
        ) from None


def _reason(text: str) -> str:
    """The system's words in an error of Zenoh, which also names places in its source."""
    found = re.search(r"([A-Z][\w ,'-]*) \(os error", text)
    return found[1] if found else text.partition(" at /")[0]


def open_client(connect: Sequence[str], give_up: Callable[[], bool]) -> Any | None:
    """Open a client's session as soon as its router is there; None if `give_up` says so before."""
    while not give_up():
        try:
            return open_session("client", (), connect)
        except zenoh.ZError:
            continue  # not there yet; the attempt itself took CLIENT_OPEN_MS
    return None


def direct(function: Callable[[bytes], None]) -> Any:
    """A subscriber's handler that calls `function(payload)` on Zenoh's receiving thread.

    The thread keeps its Python thread state after the first call: creating and destroying it would
    cost more than the message itself.
    """
    seen: set[int] = set()
    attach = ctypes.pythonapi.PyGILState_Ensure

    def call(sample: Any) -> None:
        thread = get_ident()
        if thread not in seen:
            seen.add(thread)
            attach()
        function(bytes(sample.payload))

    return zenoh.handlers.Callback(call, indirect=False)


def observe(function: Callable[[Any], None]) -> Any:
    """A handler for rare events (matching, liveliness), called with Zenoh's own object."""
    return zenoh.handlers.Callback(function, indirect=False)


def queue(capacity: int) -> Any:
    """A handler that stores samples without Python until they are asked for."""
    return zenoh.handlers.FifoChannel(capacity)


def newest(capacity: int) -> Any:
    """The same, but only so many: the oldest makes room."""
    return zenoh.handlers.RingChannel(capacity)


def control_publisher(session: Any, key: str) -> Any:
    """A publisher for the control path: first in every queue, never dropped."""
    return session.declare_publisher(
        key,
        express=True,
        congestion_control=zenoh.CongestionControl.BLOCK,
        priority=zenoh.Priority.REAL_TIME,
    )


def telemetry_publisher(session: Any, key: str) -> Any:
    """A publisher for records: after everything else; dropped rather than hold the control path
    up."""
    return session.declare_publisher(
        key,
        express=False,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=zenoh.Priority.DATA_LOW,
    )


def matched(publisher: Any) -> bool:
    """Whether a subscriber for this publisher is reachable, that is: the link to it is up."""
    return bool(publisher.matching_status.matching)


def watch_tokens(session: Any, key: str, present: set[int], wake: Callable[[], None]) -> Any:
    """Keep `present` the numbers that liveliness tokens of this key end in; returns what must be kept alive.

    `wake` is called, on Zenoh's thread, when one appears or vanishes.
    """

    def notice(sample: Any) -> None:
        index = int(str(sample.key_expr).rsplit("/", 1)[1])
        if is_put(sample):
            present.add(index)
        else:
            present.discard(index)
        wake()

    return session.liveliness().declare_subscriber(key, observe(notice), history=True)


def is_put(sample: Any) -> bool:
    """Whether a liveliness sample says that a token appeared (else it vanished)."""
    return bool(sample.kind == zenoh.SampleKind.PUT)
