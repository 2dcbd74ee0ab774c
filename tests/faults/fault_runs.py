"""What the tests of faults in the control path ask of recordings, and the bad messages that they inject."""

from __future__ import annotations

import contextlib
import math
import random
import struct
from collections.abc import Iterator
from typing import TYPE_CHECKING

import msgpack
import numpy as np
import numpy.typing as npt
from pulses import Pulses

from analysis.recording import Recording

if TYPE_CHECKING:
    from conftest import Cli

Array = npt.NDArray[np.float64]
FORWARD_BRIDGED, BACKWARD_BRIDGED, HELD, PARTIAL, MEASUREMENT_HELD, JOINED = (
    2**i for i in range(6)
)
ALIVE, ON_TIME, VALID = 1, 2, 4
SAFE_TICKS = 20
"""So long a passive arm is watched."""


def flags_of(recording: Recording) -> npt.NDArray[np.int64]:
    """What was degraded, (K, n); -1 where a node has no row."""
    flags = recording.of_nodes("degraded", ("flags",))[:, :, 0]
    return np.where(np.isfinite(flags), flags, -1.0).astype(np.int64)


def bridged_at(recording: Recording, node: int, flag: int) -> list[int]:
    """Ticks in which a node has a flag."""
    flags = flags_of(recording)[:, node]
    return np.flatnonzero((flags >= 0) & (flags & flag > 0)).tolist()


def rejected(recording: Recording, process: str) -> dict[str, int]:
    """How many messages a process refused, by reason."""
    counters = recording.process_counters(process)
    found = {name[9:]: count for name, count in counters.items() if name.startswith("rejected_")}
    found.pop("messages", None)
    return found


def estimates_apart(one: Recording, other: Recording) -> Array:
    """Energy norm of the difference of the estimates, by tick, over that of the other's largest deviation from
    where it ends; NaN in ticks that one of them lacks."""
    ticks = min(one.ticks, other.ticks)
    weights = np.sqrt(one.energy_weights)
    a, b = one.estimates[:ticks] * weights, other.estimates[:ticks] * weights
    scale = np.nanmax(np.linalg.norm((b - b[-1]).reshape(ticks, -1), axis=1))
    return np.asarray(np.linalg.norm((a - b).reshape(ticks, -1), axis=1) / scale)


def passive_from(recording: Recording) -> int:
    """The first tick in which the arm is passive; AssertionError if it never is, or is not until the end."""
    passive = recording.table("/plant/guard").numbers("passive") > 0.0
    assert passive.any(), "the arm was never passive"
    first = int(np.argmax(passive))
    assert passive[first:].all(), "it was passive, and then not any more"
    return int(recording.table("/plant/guard").ticks[first])


def bad_messages(good: bytes, *, announces: bool) -> list[tuple[str, bytes]]:
    """Everything that can be wrong with a control message, and the reason by which it must be refused.

    `good` is a real one; the bytes are changed at the places that the format's description names. announces:
    its last number is a setpoint.
    """

    def put(form: str, at: int, value: int) -> bytes:
        raw = bytearray(good)
        struct.pack_into(form, raw, at, value)
        return bytes(raw)

    tick, numbers = struct.unpack_from(">Q", good, 13)[0], (len(good) - 32) // 8
    run, sender = struct.unpack_from(">Q", good, 4)[0], struct.unpack_from(">i", good, 22)[0]

    def resized(count: int) -> bytes:
        return put(">H", 30, 8 * count)[:32] + (good[32:] + bytes(8))[: 8 * count]

    fields = msgpack.unpackb(good)
    noise = random.Random(3)
    found = [
        ("malformed", b""),
        ("malformed", good[:20]),
        ("malformed", good[:-1]),
        ("malformed", good + b"\0"),
        ("malformed", noise.randbytes(len(good))),
        ("malformed", msgpack.packb(fields[:6])),
        ("malformed", put(">B", 0, 0x96)),
        ("version", put(">B", 1, good[1] - 1)),
        ("version", put(">B", 1, good[1] + 1)),
        ("kind", put(">B", 2, 0x7F)),
        ("kind", put(">B", 2, 5)),
        ("run", put(">Q", 4, run ^ 1)),
        ("sender", put(">i", 22, sender + 7)),
        ("sender", put(">i", 22, -2)),
        ("setpoint", put(">H", 27, 999)),
        ("length", resized(numbers - 1)),
        ("length", resized(numbers + 1)),
        ("length", resized(0)),
        ("type", msgpack.packb([*fields[:6], [1.0] * numbers])),
        ("type", msgpack.packb([*fields[:6], None])),
        ("tick", put(">Q", 13, 2**60)),
        ("stale", put(">Q", 13, tick - 1)),
        ("early", put(">Q", 13, tick + 1000)),
    ]
    for value in (math.nan, math.inf, -math.inf):
        for i in range(numbers):
            raw = bytearray(good)
            struct.pack_into("<d", raw, 32 + 8 * i, value)
            reason = "setpoint" if announces and i == numbers - 1 else "not_finite"
            found.append((reason, bytes(raw)))
    if announces:
        for value in (-1.0, 0.5, 2.0, 1e300):
            raw = bytearray(good)
            struct.pack_into("<d", raw, len(raw) - 8, value)
            found.append(("setpoint", bytes(raw)))
    return found


def counts(reasons: list[str]) -> dict[str, int]:
    """How often each reason occurs."""
    return {reason: reasons.count(reason) for reason in sorted(set(reasons))}


def node_pid(cli: Cli, node: int) -> int:
    """The process of a node."""
    return cli.processes()[f"octarm-node{node}"]


# -- time ------------------------------------------------------------------------------------------


@contextlib.contextmanager
def in_slow_motion(cli: Cli, *, but: tuple[int, ...] = ()) -> Iterator[None]:
    """Inside, a run in lock-step is slow, however quick the machine is; what happens meanwhile meets it in its
    middle, and not after its end.

    The first node that is none of `but` runs for a thousandth of a second, in which a very quick machine does
    four ticks, and stands still for twenty: 200 ticks a second at most. On a slow machine the ticks themselves
    are longer than that. Lock-step waits, so that no number changes.
    """
    cli.wait_for_links()
    found = cli.processes()
    pids = (found.get(f"octarm-node{node}") for node in range(len(found)) if node not in but)
    pulses = Pulses(next(pid for pid in pids if pid is not None), 0.02, 0.001)
    try:
        yield
    finally:
        pulses.end()


def named(*nodes: int) -> str:
    """A regular expression: "node 2", or a list of nodes that has these in it, in order.

    On a busy machine others may be late at the same instant, and are named as well.
    """
    if len(nodes) == 1:
        return rf"nodes? (?:\d+, )*{nodes[0]}\b"
    return r"nodes (?:\d+, )*" + r", (?:\d+, )*".join(map(str, nodes)) + r"\b"
