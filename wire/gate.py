"""Who knocked at a process's links and was not let in: counted by what was wrong, and told to the launcher.

Beside the session of a process with certificates. Zenoh tells of failed handshakes in its log only, which it
writes to standard output, and of links with an identity that is not expected by its link events. Both come here
through one pipe, read by a thread that waits for nothing else.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import select
import sys
import threading
import time
from collections import Counter
from typing import Any

import zenoh

from wire.child import Child
from wire.placement import step_back
from wire.run_config import LinkConfig, TlsConfig
from wire.session import open_session

LOG = "off,zenoh_link_tls::unicast=debug"
"""What Zenoh logs, where the environment (RUST_LOG) does not say otherwise: a line a handshake."""
TOLD_EVERY_S = 0.25
MOST_KINDS = 32
"""Different things that are counted by name; what comes after them is counted together."""
PIPE_BYTES = 1 << 20
"""Lines that do not fit are lost, and with them their count: Zenoh never waits for this process."""
ORPHAN_CLOSE_S = 0.3
"""So long a process whose launcher is dead waits for its session to be closed."""
LINK_S = 3.0
"""After its handshake a peer has a link within less (accept_timeout), or none."""
_LINK = "octarm link "
_END = "octarm end"
_COLOURS = re.compile(r"\x1b\[[0-9;]*m")
_FAILED = re.compile(r"zenoh_link_tls::unicast: (.*?)\. Hint: ")
"""A hint at the limit of open files follows, whatever was wrong."""
_ACCEPTED = re.compile(
    r"zenoh_link_tls::unicast: Accepted TLS connection on \S+: (\S+)\. Common Name: (.*)\.$"
)


def refusal(handshake: str) -> str:
    """What was wrong with a handshake, from what Zenoh's TLS says about it."""
    if "peer sent no certificates" in handshake:
        return "a peer without a certificate"
    if "UnknownIssuer" in handshake or "BadSignature" in handshake:
        return "a certificate of a foreign authority"
    if "invalid peer certificate" in handshake:
        why = handshake.partition(": ")[2].partition(":")[0]  # then come numbers, others each time
        return f"a certificate that is not valid ({why})"
    if "fatal alert" in handshake:
        return f"a peer that does not believe this process ({handshake.rpartition(': ')[2]})"
    return f"a connection without a TLS handshake ({handshake})"


class Gate:
    """The session of a process that others dial; with certificates also the book of those not let in."""

    def __init__(self, mode: str, links: LinkConfig, child: Child) -> None:
        """Open the session; see `wire.session.open_session` for `mode` and what it raises."""
        self._child = child
        self._book = None if links.tls is None else _Book(links.tls, child, links.fifo)
        try:
            self.session = open_session(mode, links.listen, links.connect, tls=links.tls)
        except BaseException:
            if self._book is not None:
                self._book.close()
            raise
        if self._book is not None:
            self._book.watch(self.session)

    def close(self) -> None:
        """Close the session and tell the rest.

        That waits for every handshake that is going on, two seconds for a connection that says nothing. Without
        its launcher a process has no time for that: the session is left to the end of the process.
        """
        if self._child.orphaned:
            closing = threading.Thread(target=self.session.close, name="closing", daemon=True)
            closing.start()
            closing.join(ORPHAN_CLOSE_S)
        else:
            self.session.close()
        if self._book is not None:
            self._book.close()


class _Book:
    """From before the session is opened until it is closed; standard output is Zenoh's meanwhile."""

    def __init__(self, config: TlsConfig, child: Child, fifo: int | None) -> None:
        self._config = config
        self._child = child
        self._fifo = fifo
        self._seen: Counter[str] = Counter()
        self._told: dict[str, int] = {}
        self._awaited: dict[str, tuple[str, float]] = {}
        """Peers whose handshake went well, by address: names, and until when they should have a link."""
        self._status = child.move_status()
        self._read, self._write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        with contextlib.suppress(OSError):  # the system allows less
            fcntl.fcntl(self._write, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        os.dup2(self._write, 1)
        zenoh.init_log_from_env_or(LOG)
        self._listener: Any = None
        self._closing = False
        self._thread = threading.Thread(target=self._attend, name="gate", daemon=True)
        self._thread.start()

    def watch(self, session: Any) -> None:
        """Look at every link of the session."""
        handler = zenoh.handlers.Callback(self._on_link, indirect=False)
        self._listener = session.info.declare_link_events_listener(handler, history=True)

    def close(self) -> None:
        """Tell the rest; standard output is the status pipe again. After the session is closed."""
        self._listener = None
        self._closing = True
        self._put(_END)  # a full pipe wakes the thread as well
        self._thread.join()
        os.dup2(self._status, 1)
        self._child.status_on(1)
        for descriptor in (self._status, self._read, self._write):
            os.close(descriptor)

    # -- Zenoh's threads --------------------------------------------------------------------------

    def _on_link(self, event: Any) -> None:
        if event.kind != zenoh.SampleKind.PUT:
            return
        link = event.link
        name = link.auth_identifier or "nobody"
        expected = self._config.peers.get(name)
        why = ""
        if expected is None:
            why = "who has no link here"
        elif expected != str(link.zid):
            why = "which is not its process of this run"
        address = str(link.dst).partition("/")[2]
        self._put(f"{_LINK}{json.dumps([address, name, why])}")

    def _put(self, line: str) -> None:
        try:
            os.write(self._write, line.encode() + b"\n")
        except BlockingIOError:
            return  # full of others' knocking

    # -- own thread -------------------------------------------------------------------------------

    def _attend(self) -> None:
        step_back(self._fifo)
        rest, ended = b"", False
        poll = select.poll()
        poll.register(self._read, select.POLLIN)
        while not ended:
            ended = self._closing  # then everything is in the pipe
            if not ended:  # whoever sets it later writes a line as well
                poll.poll(1000.0 * LINK_S if self._awaited else None)
                time.sleep(TOLD_EVERY_S)  # several at once
            with contextlib.suppress(BlockingIOError):
                *lines, rest = (rest + os.read(self._read, PIPE_BYTES)).split(b"\n")
                for raw in lines:
                    self._hear(_COLOURS.sub("", raw.decode(errors="replace")))
            self._give_up(time.monotonic())
            self._tell()

    def _hear(self, line: str) -> None:
        if line.startswith(_LINK):
            address, name, why = json.loads(line.removeprefix(_LINK))
            self._awaited.pop(address, None)
            if why:
                self._count(_certificate(name, address, why))
        elif found := _ACCEPTED.search(line):
            self._awaited[found[1]] = (found[2], time.monotonic() + LINK_S)
        elif found := _FAILED.search(line):
            self._count(refusal(found[1]))
        elif line != _END:  # asked for with RUST_LOG
            print(line, file=sys.stderr, flush=True)

    def _give_up(self, now: float) -> None:
        for address, (name, limit) in list(self._awaited.items()):
            if now > limit:
                del self._awaited[address]
                self._count(_certificate(name, address, "which got no link"))

    def _count(self, what: str) -> None:
        if what not in self._seen and len(self._seen) >= MOST_KINDS:
            what = "others"
        self._seen[what] += 1

    def _tell(self) -> None:
        for what, count in self._seen.items():
            if self._told.get(what) != count:
                self._told[what] = count
                self._child.status("refused", what=what, count=count)


def _certificate(name: str, address: str, why: str) -> str:
    return f"the certificate of {name} from {address.rpartition(':')[0]}, {why}"
