"""An intruder: a Zenoh peer that connects to the sockets of a run and publishes mutated messages of that run.

It knows all that a message says: the run's tag, who sends what to whom, how long it is. A mutant that comes out
whole (right header, a tick that can still come, finite numbers) is not sent: without keys it is a message like
any other, and whoever can open the run's private sockets is trusted (docs/fuzzing.md).
"""

from __future__ import annotations

import random
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import monotonic, sleep
from typing import Any, NamedTuple

import msgpack
import msgspec
import zenoh

from analysis.mcap_file import read_mcap
from node.configured import sweeps_of
from wire import session as zsession
from wire.channels import MEASUREMENT, METADATA, NODES_ATTACHMENT
from wire.config_json import loads
from wire.keys import Keys
from wire.messages import (
    HEADER_BYTES,
    LARGEST_TICK,
    PLANT,
    VERSION,
    Kind,
    Reason,
    RejectedError,
    Stop,
    decode_numbers,
    decode_stop,
    encode_numbers,
    encode_stop,
    run_tag,
)
from wire.run_config import NodeConfig, RunConfig

NOT_FINITE = (float("nan"), float("inf"), float("-inf"))
BURST_S = 0.005
"""A paced intruder sends what is due of its rate this often."""
LINK_S = 20.0
_TICK_AT = 13
"""Where a control message has its tick, eight bytes."""


class Target(NamedTuple):
    """One key of the run that somebody listens to."""

    key: str
    of_plant: bool
    """Who listens: the plant, or the node."""
    kind: Kind
    sender: int
    lengths: tuple[int, ...]
    """Doubles of such a message for each setpoint; none of the order to stop."""


@dataclass(frozen=True)
class Victim:
    """A run that goes on, as its recording and its sockets show it, and the node that is attacked."""

    run: RunConfig
    node: NodeConfig
    node_endpoint: str
    plant_endpoint: str
    targets: tuple[Target, ...]

    @property
    def reach(self) -> int:
        """Ticks beyond this one can never come."""
        return self.run.ticks + self.node.skip_ticks + 1

    @classmethod
    def of(cls, recording: Path, index: int) -> Victim:
        """From the beginning of the recording that is being written."""
        content = read_mcap(recording)
        run = loads(RunConfig, content.metadata[METADATA]["run"], "the run")
        texts = msgspec.json.decode(content.attachments[NODES_ATTACHMENT], type=list[msgspec.Raw])
        nodes = [loads(NodeConfig, bytes(text), "a node") for text in texts]
        node = next(one for one in nodes if one.index == index)
        keys, sweep = Keys(run_tag(run.run_id)), sweeps_of(node)
        first, last, setpoints = sweep[0], sweep[-1], sweep[0].setpoints

        def target(
            key: str, kind: Kind, sender: int, numbers: int, *, of_plant: bool = False
        ) -> Target:
            return Target(key, of_plant, kind, sender, (numbers,) * setpoints)

        targets = [
            target(keys.measurement(index), Kind.MEASUREMENT, PLANT, len(MEASUREMENT) * len(sweep)),
            target(keys.forward(index), Kind.FORWARD_SUM, index - 1, first.forward_received),
            target(
                keys.backward(node.last), Kind.BACKWARD_SUM, node.last + 1, last.backward_received
            ),
            Target(keys.stop, False, Kind.STOP, PLANT, ()),
            *(
                target(
                    keys.command(one.index),
                    Kind.COMMAND,
                    one.index,
                    len(one.segments),
                    of_plant=True,
                )
                for one in nodes
            ),
        ]
        return cls(run, node, node.links.listen[0], node.links.connect[0], tuple(targets))


class Mutant(NamedTuple):
    """What is sent to a target, and why it must be refused."""

    target: Target
    raw: bytes
    reason: Reason
    near: bool = False
    """Its tick is to be one that is just going on: then it may also come twice, or name a setpoint."""


class Mutator:
    """Makes mutants of a victim's messages, the same ones for the same seed."""

    def __init__(self, victim: Victim, seed: int) -> None:
        self._victim = victim
        self._random = random.Random(seed)
        self._tag = run_tag(victim.run.run_id)
        self.whole = 0
        """Mutants that came out whole, and so were not given."""
        self._ways: tuple[Callable[[Target], Mutant], ...] = (
            *(self._other_tick, self._not_finite, self._other_field, self._other_type),
            *(
                self._other_length,
                self._cut,
                self._flipped,
                self._flipped,
                self._noise,
                self._nested,
            ),
        )

    def make(self, count: int) -> Iterator[Mutant]:
        """So many."""
        targets, pick = self._victim.targets, self._random.choice
        while count:
            target = pick(targets)
            mutant = pick(self._ways)(target)
            refused = self._refusal(target, mutant.raw)
            if refused is None:
                self.whole += 1
                continue
            yield mutant
            count -= 1

    def _refusal(self, target: Target, raw: bytes) -> Reason | None:
        """Why the codec, and the tick, refuse a message; None if nothing does."""
        try:
            if target.kind is Kind.STOP:
                decode_stop(raw, self._tag)
                return None
            got = decode_numbers(raw, target.kind, self._tag, target.sender, target.lengths)
        except RejectedError as error:
            return error.reason
        if got.tick > self._victim.reach:
            return Reason.EARLY
        return Reason.STALE if got.tick == 0 else None

    # -- the message, and what may be wrong with it ---------------------------------------------------------

    def _good(
        self, target: Target, tick: int | None = None, values: Sequence[float] | None = None
    ) -> bytes:
        """A message as the run has it, of a tick that cannot come."""
        draw = self._random
        tick = self._victim.reach + 1 + draw.getrandbits(30) if tick is None else tick
        if target.kind is Kind.STOP:
            return encode_stop(self._tag, Stop(tick, "safety", "because I say so"))
        if values is None:
            values = [draw.gauss(0.0, 1.0) for _ in range(target.lengths[0])]
        return encode_numbers(target.kind, self._tag, tick, target.sender, 0, values)

    def _fields(self, target: Target) -> list[Any]:
        fields = msgpack.unpackb(self._good(target))
        assert isinstance(fields, list)
        return fields

    def _other_tick(self, target: Target) -> Mutant:
        draw = self._random
        beyond = draw.randrange(LARGEST_TICK + 1, 2**64)
        if target.kind is Kind.STOP:
            fields = self._fields(target)
            fields[3] = beyond
            return Mutant(target, msgpack.packb(fields), Reason.TICK)
        ahead = draw.randrange(self._victim.reach + 1, LARGEST_TICK)
        tick, reason = draw.choice(
            ((0, Reason.STALE), (ahead, Reason.EARLY), (beyond, Reason.TICK))
        )
        return Mutant(target, self._good(target, tick), reason)

    def _not_finite(self, target: Target) -> Mutant:
        if target.kind is Kind.STOP:
            return self._other_type(target)
        draw = self._random
        values = [draw.gauss(0.0, 1.0) for _ in range(target.lengths[0])]
        values[draw.randrange(len(values))] = draw.choice(NOT_FINITE)
        return Mutant(
            target, self._good(target, None, values), Reason.NOT_FINITE, draw.random() < 0.5
        )

    def _other_field(self, target: Target) -> Mutant:
        """One of the numbers in front of the payload is another."""
        draw = self._random
        fields = self._fields(target)
        kinds = [int(kind) for kind in Kind if kind is not target.kind]
        other: dict[int, tuple[Any, Reason]] = {
            0: (draw.choice([0, 1, VERSION - 1, VERSION + 1, 127, 2**32]), Reason.VERSION),
            1: (draw.choice([*kinds, 0, 99, 2**40]), Reason.KIND),
            2: (draw.getrandbits(63) ^ 1, Reason.RUN),
            3: (-1 - draw.getrandbits(40), Reason.TICK),
            4: (
                draw.choice([target.sender + 1, target.sender - 1, 2**40, -(2**40)]),
                Reason.SENDER,
            ),
        }
        if target.kind is not Kind.STOP:  # whose setpoint means nothing
            other[5] = (draw.choice([len(target.lengths), -1, 2**16, 2**40]), Reason.SETPOINT)
        at = draw.choice(list(other))
        fields[at], reason = other[at]
        return Mutant(target, msgpack.packb(fields), reason)

    def _other_type(self, target: Target) -> Mutant:
        draw = self._random
        fields = self._fields(target)
        reasons = (
            *(Reason.VERSION, Reason.KIND, Reason.RUN, Reason.TICK, Reason.SENDER, Reason.SETPOINT),
            Reason.TYPE,
        )
        at = draw.randrange(7)
        fields[at] = draw.choice([None, True, False, 1.0, *NOT_FINITE, "1", [], {}, {"a": [1]}])
        return Mutant(target, msgpack.packb(fields), reasons[at])

    def _other_length(self, target: Target) -> Mutant:
        if target.kind is Kind.STOP:
            return self._cut(target)
        numbers = target.lengths[0]
        count = self._random.choice([0, numbers - 1, numbers + 1, 2 * numbers + 1, 8000])
        return Mutant(target, self._good(target, None, [0.5] * count), Reason.LENGTH)

    def _cut(self, target: Target) -> Mutant:
        good = self._good(target)
        if self._random.random() < 0.5:
            return Mutant(target, good[: self._random.randrange(len(good))], Reason.MALFORMED)
        return Mutant(
            target, good + self._random.randbytes(1 + self._random.randrange(40)), Reason.MALFORMED
        )

    def _flipped(self, target: Target) -> Mutant:
        """Some bits, most of them in the header."""
        raw = bytearray(self._good(target))
        for _ in range(self._random.choice((1, 1, 2, 5))):
            size = len(raw) if self._random.random() < 0.2 else min(len(raw), HEADER_BYTES)
            raw[self._random.randrange(size)] ^= 1 << self._random.randrange(8)
        return self._as_found(target, bytes(raw))

    def _noise(self, target: Target) -> Mutant:
        return self._as_found(target, self._random.randbytes(self._random.randrange(200)))

    def _nested(self, target: Target) -> Mutant:
        levels = self._random.choice((10, 500, 990, 1020, 2000))
        at = self._random.randrange(7)
        fields = [msgpack.packb(one) for one in self._fields(target)]
        fields[at] = b"\x91" * levels + b"\xc0"
        return self._as_found(target, b"\x97" + b"".join(fields))

    def _as_found(self, target: Target, raw: bytes) -> Mutant:
        """Of what nobody can say beforehand the codec says what is wrong."""
        return Mutant(target, raw, self._refusal(target, raw) or Reason.MALFORMED)


@dataclass
class Sent:
    """What went to one listener."""

    by_reason: Counter[Reason] = field(default_factory=Counter)
    near: int = 0

    def agrees(self, counters: dict[str, int]) -> str:
        """What differs from a process's final counters of what it refused; empty if nothing does.

        A number that is not finite, of a tick that is just going on, may also be refused for coming twice,
        for the setpoint that it stands for, or because the tick is over when it comes: these are taken
        together, the others one by one.
        """
        together = (
            Reason.NOT_FINITE,
            Reason.DUPLICATE,
            Reason.SETPOINT,
            Reason.STALE,
            Reason.LATE,
        )
        refused = {r: counters.get(f"rejected_{r.value}", 0) for r in Reason}
        wrong = [
            f"{r.value}: sent {self.by_reason[r]}, refused {refused[r]}"
            for r in Reason
            if r not in together and refused[r] != self.by_reason[r]
        ]
        sent, got = (sum(count[r] for r in together) for count in (self.by_reason, refused))
        if sent != got:
            wrong.append(f"{', '.join(r.value for r in together)}: sent {sent}, refused {got}")
        return "; ".join(wrong)


class Intruder:
    """Two sessions, one to the node and one to the plant, and a publisher for every key."""

    def __init__(self, victim: Victim, to_node: Any, to_plant: Any) -> None:
        self._publishers = {
            target: _publisher(to_plant if target.of_plant else to_node, target.key)
            for target in victim.targets
        }
        self._tick = 0
        self._listening = to_plant.declare_subscriber(
            Keys(run_tag(victim.run.run_id)).telemetry(PLANT), zsession.direct(self._hear)
        )
        self.node, self.plant = Sent(), Sent()
        limit = monotonic() + LINK_S
        while not (self._tick and all(map(zsession.matched, self._publishers.values()))):
            if monotonic() > limit:
                raise TimeoutError("the intruder found nobody who listens")
            sleep(0.01)

    def _hear(self, raw: bytes) -> None:
        """The plant's telemetry says where the run is."""
        self._tick = max(self._tick, int(msgpack.unpackb(raw)[3]) + 1)

    def send(self, mutants: Sequence[Mutant], rate_hz: float | None = None) -> float:
        """Publish them, so many a second (None: as fast as they are taken); returns the seconds it took."""
        began = monotonic()
        done = 0
        while done < len(mutants):
            due = len(mutants)
            if rate_hz is not None:
                due = min(due, 1 + int((monotonic() - began) * rate_hz))
            for mutant in mutants[done:due]:
                self._put(mutant)
            done = due
            if rate_hz is not None:
                sleep(BURST_S)
        return monotonic() - began

    def _put(self, mutant: Mutant) -> None:
        raw = mutant.raw
        sent = self.plant if mutant.target.of_plant else self.node
        if mutant.near:
            tick = struct.pack(">Q", self._tick + len(raw) % 7)
            raw = raw[:_TICK_AT] + tick + raw[_TICK_AT + 8 :]
            sent.near += 1
        self._publishers[mutant.target].put(raw)
        sent.by_reason[mutant.reason] += 1


def _publisher(session: Any, key: str) -> Any:
    """One like the run's own, but every message is to arrive: it waits for room."""
    return session.declare_publisher(
        key,
        express=True,
        congestion_control=zenoh.CongestionControl.BLOCK,
        priority=zenoh.Priority.REAL_TIME,
    )


@contextmanager
def intruding(victim: Victim) -> Iterator[Intruder]:
    """An intruder that is connected; its sessions are closed at the end."""
    to_node = zsession.open_session("peer", (), [victim.node_endpoint])
    to_plant = zsession.open_session("peer", (), [victim.plant_endpoint])
    try:
        intruder = Intruder(victim, to_node, to_plant)
        yield intruder
        del intruder
    finally:
        to_node.close()
        to_plant.close()
