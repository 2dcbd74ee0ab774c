"""Zenoh's TCP links without SO_LINGER, so that closing one holds nobody up.

Zenoh gives every TCP and TLS socket a linger time of ten seconds. Whoever closes such a socket while data waits
for a peer that reads nothing any more (frozen, or its host cut off) stands still for as long, and in Zenoh that
is the thread that serves all links: when a silent peer's lease was over the plant answered no node for ten
seconds. The library has no setting for it. Here the option is taken off each link's socket when the link comes
up: the kernel then sends or drops what is left on its own.
"""

from __future__ import annotations

import os
import socket
import stat
import struct
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

import zenoh

MOST = 4096
"""Descriptors that are looked at when they have run out."""
_OFF = struct.pack("ii", 0, 0)
_FAMILIES = (socket.AF_INET, socket.AF_INET6)


def end_lingering() -> int:
    """Take SO_LINGER off all of this process's TCP sockets; returns of how many."""
    ended = 0
    for descriptor in _descriptors():
        with suppress(OSError):  # it is closed
            if stat.S_ISSOCK(os.fstat(descriptor).st_mode):
                ended += _end(descriptor)
    return ended


def _descriptors() -> Iterable[int]:
    """Those that are open; all that may be if none is left to look with."""
    try:
        return [int(name) for name in os.listdir("/proc/self/fd")]
    except OSError:
        return range(MOST)


def _end(descriptor: int) -> bool:
    one = socket.socket(fileno=descriptor)
    try:
        lingers = one.family in _FAMILIES and one.type == socket.SOCK_STREAM
        if lingers:
            one.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, _OFF)
        return lingers
    finally:
        one.detach()  # it is Zenoh's


def watch_links(session: Any) -> Any:
    """Do it for every link of a session from now on; returns what must be kept alive."""

    def on_link(event: Any) -> None:
        if event.kind == zenoh.SampleKind.PUT and not str(event.link.dst).startswith("unix"):
            end_lingering()

    handler = zenoh.handlers.Callback(on_link, indirect=False)
    return session.info.declare_link_events_listener(handler, history=True)
