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

from wire.credentials import check_files
from wire.errors import OctarmError, UsageError
from wire.limits import check_session, refusal
from wire.linger import watch_links
from wire.run_config import TlsConfig

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

DROP_AFTER_US = 1000
"""So long a record waits for room in a full queue, once; those that follow are dropped at once, until there
is room again. It is what a frozen recorder costs whoever sends, so it must be short beside a tick. The
queue itself has 16 batches of 64 kB."""


SECURE_OPEN_MS = 1000
"""The same with TLS, whose handshake takes its time on a busy machine."""
HANDSHAKE_MS = 2_000
"""Somebody who connects and says nothing is hung up on after so long."""


_listeners: list[Any] = []
"""Of sessions with TCP links; they belong to them and live as long."""


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
                            "drop": {
                                "wait_before_drop": DROP_AFTER_US,
                                "max_wait_before_drop_fragments": DROP_AFTER_US,
                            },
                            "block": {"wait_before_close": 2_000_000},
                        },
                    },
                },
            },
        },
    }


def _secure(config: dict[str, Any], tls: TlsConfig) -> None:
    """Make a configuration speak mutual TLS only, to peers with the right name and number only."""
    link = config["transport"]["link"]
    link["protocols"] = ["tls"]
    link["tls"] = {
        "root_ca_certificate": tls.authority,
        "listen_certificate": tls.certificate,
        "listen_private_key": tls.private_key,
        "connect_certificate": tls.certificate,
        "connect_private_key": tls.private_key,
        "enable_mtls": True,
        "verify_name_on_connect": True,
    }
    endpoints = config["listen"]["endpoints"]
    config["listen"]["endpoints"] = [
        f"{endpoint}#tls_handshake_timeout_ms={HANDSHAKE_MS}" for endpoint in endpoints
    ]
    if config["mode"] == "client":
        # One that is given up would be counted at the other end, and make it wait.
        config["connect"]["timeout_ms"] = SECURE_OPEN_MS
    config["id"] = tls.identity
    config["access_control"] = tls.access


def open_session(
    mode: str,
    listen: Sequence[str],
    connect: Sequence[str],
    *,
    lease_ms: int = LEASE_MS,
    tls: TlsConfig | None = None,
) -> Any:
    """Open the process's Zenoh session; `mode` is "peer" (node), "router" (plant) or "client"
    (recorder). After `lease_ms` without a word the other end takes this process for dead. With `tls` only peers
    with a certificate of the run's authority get a link, and say only what they may.

    Sets ZENOH_RUNTIME, which the library reads once a process, so it must be the first call into
    it. Raises OctarmError if this host does not let it listen there, UsageError if it cannot read its keys.
    """
    os.environ["ZENOH_RUNTIME"] = RUNTIME_PLANT if mode == "router" else RUNTIME_NODE
    check_session()
    config = _config(mode, listen, connect, lease_ms)
    if tls is not None:
        check_files(tls)
        _secure(config, tls)
    try:
        session = _open(config)
    except zenoh.ZError as error:
        number, reason = _reason(str(error))
        if refused := refusal(OSError(number, reason)):
            raise UsageError(f"no session: {refused}") from None
        if tls is not None and "TLS" in str(error) and "os error" not in str(error):
            raise OctarmError(
                f"{tls.name} cannot use its key and certificate {tls.certificate} on "
                f"{socket.gethostname()}: {reason}"
            ) from None
        if not listen:
            raise
        raise OctarmError(
            f"cannot listen on {', '.join(listen)} of {socket.gethostname()}: {reason}; "
            "free the port or choose another, and check that the address is this host's"
        ) from None
    if not all(one.startswith("unix") for one in (*listen, *connect)):
        _listeners.append(watch_links(session))
    return session


def _open(config: dict[str, Any]) -> Any:
    """Open it; if files or threads run out meanwhile Zenoh panics, and the error says which."""
    try:
        return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))
    except Exception:
        raise
    except BaseException:  # a panic of native code is no Exception
        check_session()
        raise


def _reason(text: str) -> tuple[int, str]:
    """The system's number and words in an error of Zenoh, which also names places in its source."""
    found = re.search(r"([A-Z][\w ,'-]*) \(os error (\d+)", text)
    return (int(found[2]), found[1]) if found else (0, text.partition(" at /")[0])


def open_client(
    connect: Sequence[str], give_up: Callable[[], bool], tls: TlsConfig | None = None
) -> Any | None:
    """Open a client's session as soon as its router is there; None if `give_up` says so before."""
    while not give_up():
        try:
            return open_session("client", (), connect, tls=tls)
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
    """A publisher for the control path: first in every queue.

    A message waits for room a millisecond at most. More than the sixteen that a queue holds come together only
    where somebody has fallen behind, and then they are late in any case; but whoever waited for room in Zenoh's
    one thread, which is to make it, would wait until the link is closed.
    """
    return session.declare_publisher(
        key,
        express=True,
        congestion_control=zenoh.CongestionControl.DROP,
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


def watch_tokens(
    session: Any,
    key: str,
    present: set[int],
    wake: Callable[[], None],
    vanished: set[int] | None = None,
) -> Any:
    """Keep `present` the numbers that liveliness tokens of this key end in; returns what must be kept alive.

    `vanished` are those that were there and are not any more. `wake` is called, on Zenoh's thread, when one
    appears or vanishes.
    """
    gone = set() if vanished is None else vanished

    def notice(sample: Any) -> None:
        index = int(str(sample.key_expr).rsplit("/", 1)[1])
        if is_put(sample):
            present.add(index)
            gone.discard(index)
        else:
            present.discard(index)
            gone.add(index)
        wake()

    return session.liveliness().declare_subscriber(key, observe(notice), history=True)


def watch_token(session: Any, key: str, notice: Callable[[bool], None]) -> Any:
    """Call `notice`, on Zenoh's thread, when the liveliness token of this key appears or vanishes; returns what
    must be kept alive."""
    return session.liveliness().declare_subscriber(
        key, observe(lambda sample: notice(is_put(sample))), history=True
    )


def is_put(sample: Any) -> bool:
    """Whether a liveliness sample says that a token appeared (else it vanished)."""
    return bool(sample.kind == zenoh.SampleKind.PUT)
