"""A stranger on the network of a run: a Zenoh peer that links up and publishes messages that are nearly right.

A process of its own (`python -m chaos.intruder JSON`), started by `chaos.inject`. It listens to the plant's
real measurements and sends messages on the keys of its target that differ from real ones in one respect each:
garbage that every receiver must refuse. It never sends a well-formed message with made-up numbers: keys on the
links, not the decoders, are the defence against that. Or it asks for everything, and then reads nothing. Prints
the instant of its first message, or of its last look, ns on the monotonic clock.
"""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import time
from collections import deque
from collections.abc import Callable
from random import Random
from typing import Any

import msgpack
import zenoh

from wire import session as zsession
from wire.keys import Keys
from wire.messages import F8, Kind, encode_numbers

EVERY_S = 0.004
KEPT = 50
"""Real messages to make others of."""
AWAY = 10**9
"""A tick that no run reaches."""
NESTED = b"\x91" * 2000
"""Lists in lists in lists."""

Mutation = Callable[[Random, list[Any]], bytes]
_pack: Callable[[object], bytes] = msgpack.Packer(autoreset=True).pack


def _field(place: int, value: Callable[[Random, Any], Any]) -> Mutation:
    def change(random: Random, fields: list[Any]) -> bytes:
        fields[place] = value(random, fields[place])
        return _pack(fields)

    return change


def _bytes(change: Callable[[Random, bytes], bytes]) -> Mutation:
    return lambda random, fields: change(random, _pack(fields))


MUTATIONS: dict[str, Mutation] = {
    "version": _field(0, lambda random, old: random.choice((0, old + 1, -1, "4", None))),
    "kind": _field(1, lambda random, _: random.choice((0, 99, -1, 1.5, "kind"))),
    "run": _field(2, lambda random, old: old ^ (1 << random.randrange(62))),
    "old tick": _field(3, lambda random, old: max(0, old - random.randint(1000, 100_000))),
    "tick far ahead": _field(3, lambda random, old: old + random.randint(10**6, 10**12)),
    "no tick": _field(3, lambda random, _: random.choice((-1, 2**63, 0.5, "0", None, []))),
    "sender": _field(4, lambda random, _: random.choice((-2, 999, 2**31 - 1, 0.0, None))),
    "setpoint": _field(5, lambda random, _: random.choice((1000, -1, 0x7FFF, "1", None))),
    "length": _field(6, lambda random, old: old[: 8 * random.randint(0, len(old) // 8 - 1)]),
    "longer": _field(6, lambda random, old: old + bytes(8 * random.randint(1, 50))),
    "type": _field(6, lambda random, _: random.choice((None, "text", 3.5, [1.0], {}))),
    "truncated": _bytes(lambda random, raw: raw[: random.randint(0, len(raw) - 1)]),
    "noise": _bytes(lambda random, _: random.randbytes(random.randint(1, 3000))),
    "nested": _bytes(lambda _random, _raw: NESTED),
}
"""What is wrong with a message, in one respect each. "old tick" and "tick far ahead" are well-formed."""


def not_finite(random: Random, kind: Kind, run: int, tick: int, sender: int, size: int) -> bytes:
    """A message that looks exactly like the one that is due, but for a number that is none."""
    values = [0.0] * size
    values[random.randrange(size)] = random.choice((math.nan, math.inf, -math.inf))
    return encode_numbers(kind, run, tick, sender, 0, values)


def keys_of(keys: Keys, node: int, last: int, firsts: list[int]) -> list[tuple[str, Kind, int]]:
    """Where to send, and which kind and sender a receiver there expects; node -1: the plant.

    `node` and `last` are the first and last segment of the process.
    """
    if node >= 0:
        return [
            (keys.measurement(node), Kind.MEASUREMENT, -1),
            (keys.forward(node), Kind.FORWARD_SUM, node - 1),
            (keys.backward(last), Kind.BACKWARD_SUM, last + 1),
            (keys.stop, Kind.STOP, -1),
        ]
    return [
        *[(keys.command(first), Kind.COMMAND, first) for first in firsts],
        (keys.telemetry(firsts[0]), Kind.TELEMETRY, firsts[0]),
        (keys.telemetry(-1), Kind.COUNTERS, -1),
        (keys.stop, Kind.STOP, -1),
    ]


def main(told: dict[str, Any]) -> None:
    """Link up, and bother the run for the time that was asked for."""
    random = Random(told["seed"])
    keys = Keys(told["run"])
    node: int = told["node"]
    firsts: list[int] = told["firsts"]
    session = zsession.open_session("peer", (), sorted({told["target"], told["plant"]}))
    if told["keys"]:  # it has none: knocking is all that it can do
        print(time.monotonic_ns(), flush=True)
        time.sleep(told["seconds"])
        session.close()
        return
    real: deque[bytes] = deque(maxlen=KEPT)
    listened = node if node >= 0 else firsts[0]
    listener = session.declare_subscriber(
        keys.measurement(listened),
        zsession.direct(real.append),
        allowed_origin=zenoh.Locality.REMOTE,  # not what it sends itself
    )
    if told["variant"] == "deaf":
        _sleep_on(session, keys, firsts)
    places = keys_of(keys, node, told["last"], firsts)
    publishers = {key: zsession.control_publisher(session, key) for key, _, _ in places}
    said = False
    end: float | None = None
    while end is None or time.monotonic() < end:
        time.sleep(EVERY_S)
        if not (real and any(map(zsession.matched, publishers.values()))):
            continue
        if end is None:
            end = time.monotonic() + told["seconds"]
        for key, raw in _messages(random, told["variant"], list(real), places):
            publishers[key].put(raw)
        if not said:
            said = True
            print(time.monotonic_ns(), flush=True)
    del listener
    publishers.clear()
    session.close()


def _sleep_on(session: Any, keys: Keys, firsts: list[int]) -> None:
    """Ask for everything that is said, wait until some of it has come, and read no more, for ever."""
    heard: deque[bytes] = deque(maxlen=1)
    everything = [keys.measurement(first) for first in firsts] + [keys.all_telemetry]
    listeners = [session.declare_subscriber(k, zsession.direct(heard.append)) for k in everything]
    while not heard:
        time.sleep(EVERY_S)
    print(time.monotonic_ns(), flush=True)
    os.kill(os.getpid(), signal.SIGSTOP)
    del listeners


def _messages(
    random: Random, variant: str, real: list[bytes], places: list[tuple[str, Kind, int]]
) -> list[tuple[str, bytes]]:
    """A few messages of a variant, with their keys."""
    key, kind, sender = random.choice(places)
    fields = msgpack.unpackb(real[-1])
    if variant == "replayed":  # what was really sent, again
        return [(places[0][0], random.choice(real))]
    if variant == "nan":
        if random.random() < 0.5:
            key, kind, sender = places[0]
        size = len(fields[6]) // F8.itemsize
        size = {Kind.MEASUREMENT: size, Kind.COMMAND: size // 2}.get(kind, random.randint(1, 40))
        return [
            (key, not_finite(random, kind, fields[2], fields[3] + ahead, sender, size))
            for ahead in (0, 1)
        ]
    if kind is not Kind.MEASUREMENT:
        # Whatever its length, its tick is far away: no number in it is ever taken for a real one.
        fields[1], fields[3], fields[4] = int(kind), AWAY, sender
    mutation = random.choice(tuple(MUTATIONS))
    return [(key, MUTATIONS[mutation](random, fields))]


if __name__ == "__main__":
    main(json.loads(sys.argv[1]))
