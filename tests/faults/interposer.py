"""A man in the middle of the chain: between a node that is started by hand and its left neighbour, or the
plant.

The node of a real run gets an endpoint of this process in place of its neighbour's, and this process links to
the neighbour in the node's place. Every control message passes through one function, which may lose, delay,
repeat, reorder or change it; everything else (telemetry, the order to stop, liveliness) is handed on as it is.
"""

from __future__ import annotations

import heapq
import struct
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wire import session as zsession
from wire.config_json import dumps, loads
from wire.keys import Keys
from wire.messages import run_tag
from wire.run_config import NodeConfig

if TYPE_CHECKING:
    from conftest import Cli, Start

TICK_AT, TICK = 13, struct.Struct(">Q")
"""Where a control message has its tick, for a reader that shares no code with the decoder."""
Passed = Sequence[tuple[float, bytes]]
"""What is handed on for a message: bytes, and after how many seconds."""
Change = Callable[[str, int, bytes], Passed]
"""Name of the flow ("forward", "backward", "measurement", "command"), tick, message."""


def tick_of(raw: bytes) -> int:
    """The tick of a control message."""
    return int(TICK.unpack_from(raw, TICK_AT)[0])


def unchanged(_name: str, _tick: int, raw: bytes) -> Passed:
    """Hand on as it came."""
    return ((0.0, raw),)


class Interposer:
    """The links of one node started by hand, all through this process. Close it at the end."""

    def __init__(self, start: Start, cli: Cli, node: int, change: Change, *, plant: bool) -> None:
        """`cli` must have said that the node is to be started by hand.

        plant: stand between node and plant; else between node and left neighbour.
        """
        (path,) = cli.work.glob(f"**/node-{node}.json")
        config = loads(NodeConfig, path.read_text(), str(path))
        self._keys = Keys(run_tag(config.run_id))
        self._index = node
        self._left = config.left
        self.change = change
        self.seen: dict[str, int] = {}
        """Messages of each flow that came."""
        self._keep: list[Any] = []
        self._tokens: dict[tuple[int, str], Any] = {}
        self._later: list[tuple[float, int, Callable[[], None]]] = []
        self._numbers = 0
        self._changed = threading.Condition()
        self._closed = False
        self._thread = threading.Thread(target=self._deliver_later)
        self._thread.start()
        to_plant, *to_left = config.links.connect
        own = f"unixsock-stream/{cli.sockets}/between"
        beyond = to_plant if plant else to_left[0]
        self._sockets = [Path(f"{cli.sockets}/between"), Path(f"{cli.sockets}/between.lock")]
        near = zsession.open_session("router" if plant else "peer", [own], [])
        far = zsession.open_session("peer", [], [beyond])
        self._sessions = [near, far]
        if plant:
            self._between_node_and_plant(near, far)
        else:
            self._between_neighbours(near, far)
        connect = (own, *to_left) if plant else (to_plant, own)
        links = replace(config.links, connect=connect)
        path.write_text(dumps(replace(config, links=links)) + "\n")
        self.node = start.node(str(path))

    def close(self) -> None:
        """Unlink both sides."""
        with self._changed:
            self._closed = True
            self._changed.notify()
        self._thread.join()
        self._keep.clear()
        self._tokens.clear()
        for session in self._sessions:
            session.close()
        for path in self._sockets:
            path.unlink(missing_ok=True)

    # -- what is handed on ------------------------------------------------------------------------

    def _between_neighbours(self, near: Any, far: Any) -> None:
        keys, node = self._keys, self._index
        self._hand_on("forward", keys.forward(node), far, near)
        self._hand_on("backward", keys.backward(node - 1), near, far)
        self._hand_token_on(keys.ready(node), near, far)
        self._hand_token_on(keys.ready(self._left), far, near)

    def _between_node_and_plant(self, near: Any, far: Any) -> None:
        keys, node = self._keys, self._index
        self._hand_on("measurement", keys.measurement(node), far, near)
        self._hand_on("command", keys.command(node), near, far)
        self._hand_token_on(keys.ready(node), near, far)
        for key, source, sink in ((keys.telemetry(node), near, far), (keys.stop, far, near)):
            publisher = zsession.control_publisher(sink, key)
            self._keep += [
                publisher,
                source.declare_subscriber(key, zsession.direct(publisher.put)),
            ]

    def _hand_on(self, name: str, key: str, source: Any, sink: Any) -> None:
        publisher = zsession.control_publisher(sink, key)

        def receive(raw: bytes) -> None:
            self.seen[name] = self.seen.get(name, 0) + 1
            for delay_s, message in self.change(name, tick_of(raw), raw):
                if delay_s <= 0.0:
                    publisher.put(message)
                else:
                    self._at(time.monotonic() + delay_s, partial(publisher.put, message))

        self._keep += [publisher, source.declare_subscriber(key, zsession.direct(receive))]

    def _hand_token_on(self, key: str, source: Any, sink: Any) -> None:
        name = (id(sink), key)

        def notice(present: bool) -> None:
            if present:
                self._tokens[name] = sink.liveliness().declare_token(key)
            elif (token := self._tokens.pop(name, None)) is not None:
                token.undeclare()

        self._keep.append(zsession.watch_token(source, key, notice))

    # -- what is handed on later --------------------------------------------------------------------

    def _at(self, instant: float, act: Callable[[], None]) -> None:
        with self._changed:
            self._numbers += 1
            heapq.heappush(self._later, (instant, self._numbers, act))
            self._changed.notify()

    def _deliver_later(self) -> None:
        while True:
            with self._changed:
                if self._closed:
                    return
                left = self._later[0][0] - time.monotonic() if self._later else None
                if left is None or left > 0.0:
                    self._changed.wait(left)
                    continue
                _, _, act = heapq.heappop(self._later)
            act()
