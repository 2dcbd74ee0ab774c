"""How long a message takes from one process to the next on this machine: two processes, a Zenoh session each.

First step of the study of growth, whose simulated links draw from these samples. A ping-pong through
`wire.session` as nodes use it, over a unix socket; half a round trip is a hop.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Event
from time import perf_counter_ns, process_time_ns
from typing import Any

import numpy as np
import numpy.typing as npt

from wire.errors import OctarmError, UsageError
from wire.placement import place
from wire.session import control_publisher, direct, matched, open_session

Array = npt.NDArray[np.float64]

SAMPLES = 5000
BENCH_SAMPLES = 1001
WARM_UP = 500
BYTES = 200
"""About a message of the shipped gains."""
LINK_S = 10.0
LONGEST_S = 30.0
_THERE, _BACK = "octarm/hop/there", "octarm/hop/back"


@dataclass(frozen=True, eq=False)
class Hop:
    """Samples of the time from put to the receiver's call, us."""

    same_core_us: Array
    """Both processes on one core."""
    other_core_us: Array
    """Each on its own; where there is only one core, the same as above."""
    cpu_us: float
    """Processor time of a message, sender and receiver together: what a core cannot do otherwise meanwhile."""
    source: str


def hop_of_file(path: Path) -> Hop:
    """From JSON {"hop_us": [samples], "cpu_us": number}; without cpu_us a hop is all processor time.

    Or from the bench.json of `octarm bench`, see `_of_bench`. UsageError if the file cannot be read or does not
    hold positive numbers.
    """
    try:
        found = json.loads(path.read_text())
        if "rows" in found:
            found = _of_bench(found["rows"])
        samples = np.asarray(found["hop_us"], dtype=np.float64)
        cpu = found.get("cpu_us")
        cpu = None if cpu is None else float(cpu)
    except OSError as error:
        raise UsageError(f"--latency {path}: {error.strerror or error}") from None
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise UsageError(
            f'--latency {path}: expected JSON {{"hop_us": [microseconds, ...]}} or a bench.json: {error}'
        ) from None
    if samples.ndim != 1 or not samples.size or not (np.isfinite(samples) & (samples > 0.0)).all():
        raise UsageError(f"--latency {path}: hop_us: expected a list of positive numbers, in us")
    if cpu is None:
        cpu = float(np.median(samples))
    if not 0.0 < cpu < np.inf:
        raise UsageError(f"--latency {path}: cpu_us: expected a positive number, got {cpu!r}")
    return Hop(samples, samples, cpu, str(path))


def _of_bench(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Hops and processor time of the longest chain of real nodes in a benchmark.

    A hop is the chain's time over its links, its distribution that of the chain's percentiles; the processor
    time of a tick is shared by its 2 (n - 1) sums, n measurements and n commands. KeyError without such a
    chain.
    """
    chains = [row for row in rows if row["pattern"] == "neighbour" and row.get("chain_us")]
    if not chains:
        raise KeyError("rows: no neighbour row with chain_us")
    row = max(chains, key=lambda one: int(one["nodes"]))
    links = int(row["nodes"]) - 1
    chain = row["chain_us"]
    shares = np.linspace(0.0, 1.0, BENCH_SAMPLES)
    known = [0.0, 0.5, 0.95, 0.99, 0.999, 1.0]
    at = [chain["p50"], *(chain[name] for name in ("p50", "p95", "p99", "p99_9", "max"))]
    messages = 2 * links + 2 * (links + 1)
    return {
        "hop_us": np.interp(shares, known, np.array(at) / links).tolist(),
        "cpu_us": row["cpu_us_per_tick"] / messages,
    }


def measure_hop(samples: int = SAMPLES) -> Hop:
    """Measure here, in about a second; OctarmError if two processes do not get into touch."""
    cores = sorted(os.sched_getaffinity(0))
    same, cpu = _ping_pong(cores[0], cores[0], samples)
    other = _ping_pong(cores[0], cores[1], samples)[0] if len(cores) > 1 else same
    return Hop(same, other, cpu, "measured")


def _ping_pong(near: int, far: int, samples: int) -> tuple[Array, float]:
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory(prefix="octarm-hop-") as directory:
        endpoint = f"unixsock-stream/{directory}/hop"
        pipes = [context.Pipe() for _ in range(2)]
        processes = [
            context.Process(target=_near, args=(endpoint, near, samples, pipes[0][1]), daemon=True),
            context.Process(target=_far, args=(endpoint, far, pipes[1][1]), daemon=True),
        ]
        try:
            for one in processes:
                one.start()
            for _, theirs in pipes:
                theirs.close()
            for own, _ in pipes:
                _answer_of(own)  # linked
            pipes[0][0].send("go")
            found, near_ns = _answer_of(pipes[0][0])
            pipes[1][0].send("stop")
            far_ns = _answer_of(pipes[1][0])
        except (EOFError, ConnectionError):
            raise OctarmError(
                "hop: a process ended early; see `octarm doctor`, or give --latency FILE"
            ) from None
        finally:
            for one in processes:
                if one.is_alive():
                    one.join(1.0)
                if one.is_alive():
                    one.terminate()
    total = 2 * (samples + WARM_UP)
    return found, (near_ns + far_ns) / (1e3 * total)


def _answer_of(pipe: Connection) -> Any:
    if not pipe.poll(LINK_S + LONGEST_S):
        raise OctarmError(
            "hop: two processes exchanged nothing; see `octarm doctor`, or give --latency FILE"
        )
    return pipe.recv()


def _near(endpoint: str, core: int, samples: int, pipe: Connection) -> None:
    """Send, wait for the answer, send again; give the halves of the round trips, us, and the processor time."""
    place(core, None, lambda _: None)
    session = open_session("peer", [endpoint], [])
    there = control_publisher(session, _THERE)
    total, message = samples + WARM_UP, bytes(BYTES)
    instants: list[int] = []
    done = Event()

    def again(_: bytes) -> None:
        instants.append(perf_counter_ns())
        if len(instants) > total:
            done.set()
        else:
            there.put(message)

    subscriber = session.declare_subscriber(_BACK, direct(again))
    _linked(there, pipe)
    pipe.recv()
    began = process_time_ns()
    there.put(message)
    done.wait(LONGEST_S)
    used = process_time_ns() - began
    if done.is_set():
        pipe.send((np.diff(instants)[WARM_UP:] / 2e3, used))
    del subscriber
    session.close()


def _far(endpoint: str, core: int, pipe: Connection) -> None:
    """Answer until the other side is done; give the processor time."""
    place(core, None, lambda _: None)
    session = open_session("peer", [], [endpoint])
    back = control_publisher(session, _BACK)
    began = 0

    def answer(raw: bytes) -> None:
        nonlocal began
        began = began or process_time_ns()
        back.put(raw)

    subscriber = session.declare_subscriber(_THERE, direct(answer))
    _linked(back, pipe)
    pipe.recv()
    pipe.send(process_time_ns() - began)
    del subscriber
    session.close()


def _linked(publisher: Any, pipe: Connection) -> None:
    """Tell the other end of the pipe once the publisher's subscriber is there."""
    wait, end = Event(), perf_counter_ns() + int(1e9 * LINK_S)
    while not matched(publisher):
        if perf_counter_ns() > end:
            raise OctarmError(f"hop: no link within {LINK_S:g} s")
        wait.wait(0.01)
    pipe.send("linked")
