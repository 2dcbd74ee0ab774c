"""Makes recordings of runs in which not all goes well: the loop in one process, nodes with their real block.

Beside `simulated_run`, with the same arm and writer. Every node is a `node.block.SegmentBlock`, messages are
handed on by function calls, and a seeded generator decides what does not come: a sum that a node then bridges,
a sweep that is given up, a node that dies and is replaced. What a node does then is what its process does
(`node.process`), step by step.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt
from simulated_run import Scenario, Stage, make_artefact, stage, summary

from node.block import SegmentBlock
from node.configured import sweeps_of
from node.joining import Joining
from wire.channels import WELL, Health, label
from wire.messages import PARTIAL, PLANT, Numbers, RejectedError
from wire.run_config import NodeConfig

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Faults:
    """What does not go well."""

    lost: frozenset[tuple[int, int, str]] = frozenset()
    """(tick, receiver, "forward" or "backward" or "measurement"): does not come; the tick is given up."""
    cut: frozenset[tuple[int, int, str]] = frozenset()
    """The same of sums, but their receiver bridges them at once."""
    dies: tuple[tuple[int, int, int | None], ...] = ()
    """(node, first tick that it does not do, tick in which its replacement joins or None)."""
    unsent: int = 0
    """So many rows go with a process that dies."""
    waits: int = 1
    """Late ticks before a sweep that does not end is given up."""
    passive_from: int | None = None
    """From this tick on the arm is passive, and the nodes have stopped."""


@dataclass
class _Node:
    """One process: the block, what it has recorded, and its mailbox."""

    config: NodeConfig
    post: deque[tuple[int, str, Numbers]]
    rows: dict[int, Array]
    commands: dict[int, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.sweeps = sweeps_of(self.config)
        (sweep,) = self.sweeps
        self.forward, self.backward = np.zeros(sweep.forward_sent), np.zeros(sweep.backward_sent)
        self.sent_command = np.zeros(1)
        self.block = SegmentBlock(self.sweeps, _Out(self), batch=4)

    def receive(self, name: str, message: Numbers) -> None:
        """As `node.receiving.Others.take`."""
        block = self.block
        if message.tick < block.tick:
            return
        if message.tick > block.tick and block.begun:
            block.close(7)
        if message.setpoint != block.setpoint:
            if message.tick != block.tick:
                block.skip_to(message.tick)
            if name == "forward":
                block.cut_forward(7)
            elif name == "backward":
                block.cut_backward(7, int(message.values[-1]))
            return
        if message.tick != block.tick:
            block.skip_to(message.tick)
        if message.partial:
            block.partial()
        take = {
            "measurement": block.on_measurement,
            "forward": block.on_forward,
            "backward": block.on_backward,
        }
        with contextlib.suppress(RejectedError):
            take[name](np.asarray(message.values).tobytes(), 7)


class _Out:
    """What a block gives, put into the others' mailboxes."""

    def __init__(self, node: _Node) -> None:
        self.forward, self.backward = node.forward, node.backward
        self.commands = node.sent_command
        self._node = node

    def send_forward(self, tick: int, setpoint: int) -> None:
        i = self._node.config.index
        partial = bool(setpoint & PARTIAL)
        said = Numbers(tick, i, setpoint & ~PARTIAL, self.forward.tolist(), partial)
        self._node.post.append((i + 1, "forward", said))

    def send_backward(self, tick: int, setpoint: int) -> None:
        i = self._node.config.index
        said = Numbers(tick, i, setpoint, self.backward.tolist())
        self._node.post.append((i - 1, "backward", said))

    def send_commands(self, tick: int, setpoint: int) -> None:
        self._node.commands[tick] = float(self.commands[0])

    def recorded(self, tick: int, rows: Sequence[Array]) -> None:
        for k, row in enumerate(rows[0], tick):
            self._node.rows[k] = row.copy()

    def begins(self, tick: int, setpoint: int) -> None:
        """Nobody waits for it here."""


class _Simulation:
    def __init__(self, made: Stage, faults: Faults) -> None:
        self.made, self.faults = made, faults
        n = made.run.nodes
        self.post: deque[tuple[int, str, Numbers]] = deque()
        self.rows: list[dict[int, Array]] = [{} for _ in range(n)]
        self.nodes: list[_Node | None] = [
            _Node(config, self.post, self.rows[i]) for i, config in enumerate(made.configs)
        ]
        self.joining: dict[int, Joining] = {}
        self.plant: dict[int, list[float]] = {}
        self.command = np.array(made.run.initial_commands_n_per_m)
        self.rest = self.command.copy()
        self.setpoint = made.run.setpoint_index
        self.fade = math.exp(-made.run.tick_s / made.run.scheduling.bump_s)
        self.late = 0
        self.gone_rows: list[tuple[int, int]] = []
        """(node, tick) whose row went with its process, although the plant had had the command."""

    def run(self) -> None:
        """All ticks."""
        faults, n = self.faults, self.made.run.nodes
        waiting: int | None = None
        for k in range(self.made.run.ticks):
            self._deaths(k)
            passive = faults.passive_from is not None and k >= faults.passive_from
            late = passive or (waiting is not None and k - waiting <= faults.waits)
            done: set[int] = set()
            if not late:
                done = self._sweep(k)
                waiting = None if len(done) == sum(one is not None for one in self.nodes) else k
            self.late += late
            health = [float(self._health(i, i in done or late)) for i in range(n)]
            now = self.rest if passive else self.command
            self.plant[k] = self.made.plant_row(
                k, late=late, health=health, passive=passive, command=now, sweep_ns=0.0
            )
            self.made.plant.advance(now, k)
            if not late:
                self._take(k, done)
        for i, one in enumerate(self.nodes):
            if one is not None:
                one.block.flush()
                self.rows[i].update(one.rows)

    def _health(self, i: int, on_time: bool) -> int:
        alive = self.nodes[i] is not None and i not in self.joining
        return (
            WELL & ~(0 if alive else int(Health.ALIVE)) & ~(0 if on_time else int(Health.ON_TIME))
        )

    def _deaths(self, k: int) -> None:
        for i, dies, joins in self.faults.dies:
            one = self.nodes[i]
            if k == dies and one is not None:
                one.block.flush()
                for tick in sorted(one.rows)[len(one.rows) - self.faults.unsent :]:
                    del one.rows[tick]
                    if tick in one.commands:
                        self.gone_rows.append((i, tick))
                self.nodes[i] = None
                self._cut(i)
            if k == joins:
                new = _Node(
                    dataclasses.replace(self.made.configs[i], joins=True), self.post, self.rows[i]
                )
                self.nodes[i] = new
                self.joining[i] = Joining(new.sweeps, new.block)

    def _cut(self, dead: int) -> None:
        for i, cut in ((dead - 1, "cut_backward"), (dead + 1, "cut_forward")):
            if 0 <= i < len(self.nodes) and (one := self.nodes[i]) is not None:
                getattr(one.block, cut)(7)

    def _sweep(self, k: int) -> set[int]:
        """One tick of all nodes; those whose command has come."""
        made, n = self.made, self.made.run.nodes
        measured = made.plant.measure() + made.noise.sample(k, n)
        for tick, i, way in sorted(self.faults.cut):
            if tick == k and (one := self.nodes[i]) is not None and one.block.tick == k:
                (one.block.cut_forward if way == "forward" else one.block.cut_backward)(7)
        for i, y in enumerate(measured):
            said = self._said(i)
            self.post.append((i, "measurement", Numbers(k, PLANT, said, y.tolist())))
        while self.post:
            i, name, message = self.post.popleft()
            one = self.nodes[i]
            if one is None or (k, i, name) in self.faults.lost | self.faults.cut:
                continue
            if i in self.joining:
                if name != "measurement" or not self._join(i, message):
                    continue
                del self.joining[i]
            one.receive(name, message)
        return {i for i, one in enumerate(self.nodes) if one is not None and k in one.commands}

    def _said(self, i: int) -> int:
        one = self.nodes[i]
        return self.setpoint if one is None or i in self.joining else one.block.setpoint

    def _join(self, i: int, message: Numbers) -> bool:
        """What the neighbours tell a node that has not joined; whether it does with this measurement."""
        joining = self.joining[i]
        for side, j in (("left", i - 1), ("right", i + 1)):
            if 0 <= j < len(self.nodes) and (other := self.nodes[j]) is not None:
                first, last = other.block.deviations()
                values = (last if side == "left" else first).tolist()
                joining.heard(side, Numbers(other.block.tick, j, other.block.setpoint, values))
        return joining.begin(message)

    def _take(self, k: int, done: set[int]) -> None:
        """As `plant.exchange.Exchange.take`."""
        for i, one in enumerate(self.nodes):
            if i in done and one is not None:
                self.command[i] = one.commands[k]
                self.setpoint = one.block.setpoint
            elif one is None or i in self.joining:
                self.command[i] = self.rest[i] + self.fade * (self.command[i] - self.rest[i])


def write_degraded(path: Path, scenario: Scenario, faults: Faults) -> list[tuple[int, int]]:
    """Simulate and record; (node, tick) of the rows that went with their process, of commands that had come."""
    growing = path.with_suffix(".growing")
    scenario = dataclasses.replace(scenario, realtime=True)
    made = stage(growing, path.with_suffix(".gains.json"), scenario, make_artefact())
    simulation = _Simulation(made, faults)
    simulation.run()
    n = made.run.nodes
    for k, row in simulation.plant.items():
        rows = {i: own[k].tolist() for i, own in enumerate(simulation.rows) if k in own}
        made.writer.tick(k, {**rows, PLANT: row})
    made.writer.event(made.run.ticks, "info", "finished", "every tick was done")
    counters = summary(made.run, simulation.late)
    for i, one in enumerate(simulation.nodes):
        name = f"node/{label(i, n)}"
        if one is None:
            del counters[name]
            continue
        own = json.loads(counters[name]) | {
            "command_sent_messages": len(one.commands),
            "bridged_sums": one.block.bridged,
        }
        counters[name] = json.dumps(own)
    made.writer.close(counters)
    growing.replace(path)
    return simulation.gone_rows


def seeded(seed: int, nodes: int, ticks: int, share: float = 0.08) -> Faults:
    """Sums and measurements lost or cut at random, and a node that dies and comes back."""
    draw = np.random.default_rng(seed)
    lost, cut = set(), set()
    for k in range(2, ticks):
        for i in range(nodes):
            for way in ("forward", "backward", "measurement"):
                there = {"forward": i > 0, "backward": i < nodes - 1, "measurement": True}[way]
                chance = draw.random()
                if there and chance < share / 3.0:
                    lost.add((k, i, way))
                elif there and way != "measurement" and chance < share:
                    cut.add((k, i, way))
    node = int(draw.integers(nodes))
    dies = int(draw.integers(ticks // 4, ticks // 2))
    joins = dies + int(draw.integers(2, 9))
    return Faults(
        lost=frozenset(lost),
        cut=frozenset(cut),
        dies=((node, dies, joins),),
        unsent=int(draw.integers(0, 3)),
        waits=int(draw.integers(1, 4)),
    )
