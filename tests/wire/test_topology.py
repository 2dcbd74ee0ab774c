"""Who can hear whom: neighbours directly, the recorder through the plant, nobody else, nothing
twice.

Sessions of one chain in this process, over real unix sockets, with the settings that a run has.
"""

from __future__ import annotations

import functools
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Lock
from typing import Any

import pytest
from waiting import until

from wire.keys import Keys
from wire.session import (
    control_publisher,
    direct,
    matched,
    open_session,
    queue,
    telemetry_publisher,
)

NODES = 4
KEYS = Keys(0xABC)
LIMIT_S = 20.0


class Chain:
    """A plant, four nodes and a recorder, each with its session and its subscriptions."""

    def __init__(self, directory: str) -> None:
        self.heard: Counter[tuple[str, bytes]] = Counter()
        self._lock = Lock()
        path = f"unixsock-stream/{directory}"
        plant = f"{path}/plant"
        self.plant = open_session("router", [plant], [])
        self.nodes = [
            open_session(
                "peer", [f"{path}/node{i}"], [plant, *([f"{path}/node{i - 1}"] if i else [])]
            )
            for i in range(NODES)
        ]
        self.recorder = open_session("client", [], [plant])
        self.keep: list[Any] = []
        for i, session in enumerate(self.nodes):
            for key in (KEYS.forward(i), KEYS.backward(i), KEYS.measurement(i), KEYS.stop):
                self.keep.append(session.declare_subscriber(key, direct(self._hear(f"node {i}"))))
            self.keep.append(
                self.plant.declare_subscriber(KEYS.command(i), direct(self._hear("plant")))
            )
        self.records = self.recorder.declare_subscriber(KEYS.all_telemetry, queue(1000))

    def _hear(self, who: str) -> Callable[[bytes], None]:
        def hear(raw: bytes) -> None:
            with self._lock:
                self.heard[who, raw] += 1

        return hear

    def close(self) -> None:
        self.keep.clear()
        del self.records
        for session in (*self.nodes, self.recorder, self.plant):
            session.close()


wait_until = functools.partial(until, seconds=LIMIT_S, every_s=0.002)


@pytest.fixture
def chain() -> Iterator[Chain]:
    with tempfile.TemporaryDirectory(prefix="ot-") as directory:
        chain = Chain(directory)
        try:
            yield chain
        finally:
            chain.close()
        assert list(Path(directory).iterdir()) == [], "a session left its socket behind"


def test_links_are_those_of_the_chain(chain: Chain) -> None:
    ids = [str(session.zid()) for session in chain.nodes]

    def peers(i: int) -> set[str]:
        return set(map(str, chain.nodes[i].info.peers_zid()))

    wanted = [{ids[j] for j in (i - 1, i + 1) if 0 <= j < NODES} for i in range(NODES)]
    wait_until(lambda: all(peers(i) == wanted[i] for i in range(NODES)))
    wait_until(lambda: len(chain.plant.info.peers_zid()) == NODES)
    plant = str(chain.plant.zid())
    for i, session in enumerate(chain.nodes):
        assert [str(z) for z in session.info.routers_zid()] == [plant]
        assert len(session.info.links()) == len(wanted[i]) + 1
    assert list(chain.recorder.info.peers_zid()) == []


def test_nobody_hears_what_is_not_meant_for_him_and_nothing_twice(chain: Chain) -> None:
    publishers: dict[tuple[int, int], Any] = {}
    for i, session in enumerate(chain.nodes):
        for j in range(NODES):
            if i != j:
                key = KEYS.forward(j) if j > i else KEYS.backward(j)
                publishers[i, j] = control_publisher(session, key)
    adjacent = {(i, j) for i, j in publishers if abs(i - j) == 1}
    commands = [control_publisher(s, KEYS.command(i)) for i, s in enumerate(chain.nodes)]
    wait_until(lambda: all(matched(publishers[pair]) for pair in adjacent))
    wait_until(lambda: all(map(matched, commands)))
    assert not any(matched(p) for pair, p in publishers.items() if pair not in adjacent)
    expected: Counter[tuple[str, bytes]] = Counter()
    for n in range(20):
        for (i, j), publisher in publishers.items():
            raw = f"sum {n} of {i} for {j}".encode()
            publisher.put(raw)
            if (i, j) in adjacent:
                expected[f"node {j}", raw] = 1
        for i, publisher in enumerate(commands):
            raw = f"command {n} of {i}".encode()
            publisher.put(raw)
            expected["plant", raw] = 1
    wait_until(lambda: sum(chain.heard.values()) >= sum(expected.values()))
    # What would be wrong has the same way to go as what is right: a last round shows that it is not
    # late.
    for pair in sorted(adjacent):
        publishers[pair].put(b"last")
        expected[f"node {pair[1]}", b"last"] += 1
    wait_until(lambda: sum(chain.heard.values()) >= sum(expected.values()))
    assert chain.heard == expected


def test_the_recorder_gets_every_record_once_through_the_plant(chain: Chain) -> None:
    """Bursts of batches of 8 kB at once from everybody: none is lost, none comes twice.

    All sessions of this test share one receiving thread, so the burst stays below what the plant's
    send queue holds (16 batches of 64 kB); between processes the queue is emptied meanwhile.
    """
    burst = 12
    sessions = [*chain.nodes, chain.plant]
    publishers = [
        telemetry_publisher(s, KEYS.telemetry(i if i < NODES else -1))
        for i, s in enumerate(sessions)
    ]
    wait_until(lambda: all(map(matched, publishers)))
    for n in range(burst):
        for i, publisher in enumerate(publishers):
            publisher.put(f"{i} {n} ".encode() + bytes(8000))
    got: Counter[tuple[int, int]] = Counter()

    def collect() -> bool:
        while (sample := chain.records.try_recv()) is not None:
            sender, n = bytes(sample.payload).split(b" ")[:2]
            got[int(sender), int(n)] += 1
        return sum(got.values()) >= burst * len(sessions)

    wait_until(collect)
    assert got == Counter({(i, n): 1 for i in range(len(sessions)) for n in range(burst)})
    assert chain.heard == Counter(), "a node heard another's records"


def test_the_stop_of_the_plant_reaches_every_node(chain: Chain) -> None:
    stop = control_publisher(chain.plant, KEYS.stop)
    wait_until(lambda: matched(stop) and len(chain.plant.info.peers_zid()) == NODES)
    measurements = [control_publisher(chain.plant, KEYS.measurement(i)) for i in range(NODES)]
    wait_until(lambda: all(map(matched, measurements)))
    stop.put(b"stop")
    wait_until(lambda: sum(chain.heard.values()) >= NODES)
    assert chain.heard == Counter({(f"node {i}", b"stop"): 1 for i in range(NODES)})


def test_runs_do_not_share_keys() -> None:
    one, other = Keys(1), Keys(2)
    assert one.root != other.root
    assert not one.measurement(3).startswith(other.root)
    keys = [
        f(i)
        for f in (one.measurement, one.forward, one.backward, one.command, one.telemetry)
        for i in range(5)
    ]
    assert len(set(keys)) == len(keys)
