"""The other end of all links of one node process, for a replay: plant, neighbours and recorder at once.

Between `supervise.replay_node`, which starts and ends everything, and Zenoh: recorded messages out, tick by
tick, answers and telemetry in.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from functools import partial
from time import monotonic_ns
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from analysis.replay import Feed, Replayed, Rows, name_of, nothing_yet
from node.configured import sweeps_of
from supervise.replay_child import StartedNode, Turns
from wire import session as zsession
from wire.child import Deadline
from wire.errors import OctarmError, StartUpTimeoutError
from wire.keys import Keys
from wire.messages import (
    PLANT,
    Incoming,
    Kind,
    Numbers,
    Reason,
    RejectedError,
    Stop,
    decode_batch,
    decode_counters,
    encode_numbers,
    encode_stop,
    kind_of,
    run_tag,
)
from wire.run_config import NodeConfig

Array = npt.NDArray[np.float64]

START_S = 30.0
LAST_WORD_S = 5.0
"""How long to wait for rows and counters after the stop message; less if the node is not well."""
CAPACITY = 8192
"""Batches that may wait in memory."""


@dataclass
class NodeReplay:
    """What a real process gave."""

    replayed: Replayed
    latencies_us: Array
    """Per tick, from the first message put to the command received."""
    counters: dict[int, dict[str, int]]
    """Its last word, per segment."""

    @property
    def rejected(self) -> int:
        """Messages that the process refused."""
        return sum(one.get("rejected_messages", 0) for one in self.counters.values())


@dataclass
class _Answers:
    """What has come of a tick, on Zenoh's threads."""

    raw: dict[str, bytes] = field(default_factory=dict)
    at_ns: int = 0
    """When the command came."""


class Peer:
    """The replayer's end of all links of one node process."""

    def __init__(self, config: NodeConfig, session: Any, turns: Turns) -> None:
        self._config = config
        self._run = run_tag(config.run_id)
        self._keys = Keys(self._run)
        self._name = name_of(config)
        self._sweeps = sweeps_of(config)
        self._turns = turns
        self._answers = _Answers()
        self._late: deque[str] = deque()
        """Messages that nobody waited for."""
        self._present: set[int] = set()
        self._keep: list[Any] = []
        self._publishers: dict[str, Any] = {}
        self._session = session

    def __enter__(self) -> Self:
        self._declare(self._session)
        return self

    def __exit__(self, *_: object) -> None:
        self._publishers.clear()
        self._keep.clear()
        del self._records

    # -- links ------------------------------------------------------------------------------------

    def _declare(self, session: Any) -> None:
        config, keys = self._config, self._keys
        first, last = self._sweeps[0], self._sweeps[-1]
        setpoints = first.setpoints
        send = {"measurement": keys.measurement(config.index)}
        receive = {"command": (keys.command(config.index), Kind.COMMAND, len(self._sweeps))}
        if not first.first:
            send["forward"] = keys.forward(config.index)
            key = keys.backward(config.index - 1)
            receive["backward"] = (key, Kind.BACKWARD_SUM, first.backward_sent)
        if not last.last:
            send["backward"] = keys.backward(config.last)
            key = keys.forward(config.last + 1)
            receive["forward"] = (key, Kind.FORWARD_SUM, last.forward_sent)
        senders = {"command": config.index, "backward": config.index, "forward": config.last}
        self._incoming = {
            name: Incoming(kind, self._run, senders[name], [numbers] * setpoints)
            for name, (_, kind, numbers) in receive.items()
        }
        for name, (key, _, _) in receive.items():
            handler = zsession.direct(partial(self._answered, name))
            self._keep.append(session.declare_subscriber(key, handler))
        self._records = session.declare_subscriber(
            keys.telemetry(config.index), zsession.queue(CAPACITY)
        )
        for name, key in send.items():
            self._publishers[name] = zsession.control_publisher(session, key)
        self._publishers["stop"] = zsession.control_publisher(session, keys.stop)
        for publisher in self._publishers.values():
            self._keep.append(
                publisher.declare_matching_listener(zsession.observe(lambda _: self._turns.wake()))
            )
        self._keep.append(
            zsession.watch_tokens(session, keys.all_ready, self._present, self._turns.wake)
        )

    def link(self, process: StartedNode) -> None:
        """Wait until the node is ready and every link to it is up."""
        limit = Deadline(START_S)
        while True:
            missing = [n for n, p in self._publishers.items() if not zsession.matched(p)]
            if self._config.index in self._present and process.ready and not missing:
                return
            if process.failure or process.ended:
                why = process.failure or f"it {process.ended}"
                raise OctarmError(f"{self._name} did not start: {why}{process.last_words()}")
            if limit.passed:
                waits = ", ".join(process.waits_for or missing) or "its start"
                raise StartUpTimeoutError(
                    f"{self._name} was not linked after {START_S:g} s, it waits for {waits}"
                    f"{process.last_words()}"
                )
            self._turns.turn(min(0.2, limit.left))

    # -- the replay -------------------------------------------------------------------------------

    def replay(self, feed: Feed, rows: Rows, process: StartedNode, deadline_s: float) -> NodeReplay:
        """Feed all ticks, then stop the node in order and take its last records."""
        columns = [rows.of[i].shape[1] for i in feed.segments]
        replayed = nothing_yet(feed, self._sweeps, columns)
        out = NodeReplay(replayed, np.zeros(0), {})
        latencies = []
        for k in feed.ticks:
            began_ns = self._feed(feed, k)
            if not self._await(k, process, deadline_s, replayed):
                break
            latencies.append((self._answers.at_ns - began_ns) * 1e-3)
            replayed.broke_off = self._take(k, int(feed.setpoints[k]), replayed)
            if replayed.broke_off is not None:
                break
            replayed.ticks += 1
            self._drain(out)
        out.latencies_us = np.array(latencies)
        self._finish(out, process, feed.ticks[-1] + 1 if feed.ticks else 0)
        return out

    def _feed(self, feed: Feed, k: int) -> int:
        """Send a tick's messages; the instant of the first one."""
        setpoint = int(feed.setpoints[k])
        self._answers = _Answers()
        inputs = {
            "measurement": (Kind.MEASUREMENT, PLANT, feed.measurement),
            "forward": (Kind.FORWARD_SUM, self._config.index - 1, feed.forward),
            "backward": (Kind.BACKWARD_SUM, self._config.last + 1, feed.backward),
        }
        messages = [
            (
                self._publishers[name],
                encode_numbers(kind, self._run, k, sender, setpoint, values[k].tolist()),
            )
            for name, (kind, sender, values) in inputs.items()
            if name in self._publishers
        ]
        began_ns = monotonic_ns()
        for publisher, raw in messages:
            publisher.put(raw)
        return began_ns

    def _answered(self, name: str, raw: bytes) -> None:
        """On Zenoh's thread: keep the answer."""
        at_ns, answers = monotonic_ns(), self._answers
        if name in answers.raw:
            self._late.append(name)
        else:
            answers.raw[name] = raw
        if name == "command":
            answers.at_ns = at_ns
        if len(answers.raw) == len(self._incoming):
            self._turns.wake()

    def _await(self, k: int, process: StartedNode, deadline_s: float, into: Replayed) -> bool:
        """Wait for all answers of a tick; False, and it is noted why, if they do not come."""
        limit = Deadline(deadline_s)
        while len(self._answers.raw) < len(self._incoming):
            if process.failure:  # in the run it had nothing to complain of
                into.broke_off = f"{self._name} failed: {process.failure}{process.last_words()}"
                return False
            if process.ended:
                into.ended = f"tick {k}: {self._name} {process.ended}{process.last_words()}"
                return False
            if limit.passed:
                missing = [name for name in self._incoming if name not in self._answers.raw]
                what = " and no ".join(missing)
                into.ended = f"tick {k}: {self._name} gave no {what} within {deadline_s:g} s"
                return False
            self._turns.turn(min(0.5, limit.left))
        return True

    def _take(self, k: int, setpoint: int, into: Replayed) -> str | None:
        """Put a tick's answers where they belong; what is wrong with them, apart from numbers."""
        place = {"command": into.commands, "forward": into.forward, "backward": into.backward}
        for name, raw in self._answers.raw.items():
            try:
                message: Numbers = self._incoming[name].decode(raw)
            except RejectedError as error:
                return f"tick {k}: {self._name} sent a {name} message that is none ({error})"
            if message.tick != k:
                return f"tick {k}: {self._name} sent a {name} message of tick {message.tick}"
            if name != "command" and message.setpoint != setpoint:
                return (
                    f"tick {k}: {self._name} sent a {name} message of setpoint {message.setpoint}, "
                    f"expected {setpoint}"
                )
            place[name][k] = message.values
        if self._late:
            return f"tick {k}: {self._name} sent a second {self._late[0]} message"
        return None

    # -- records and the end ----------------------------------------------------------------------

    def _drain(self, out: NodeReplay) -> None:
        """Take the rows and counters that have come."""
        while (sample := self._records.try_recv()) is not None:
            try:
                self._record(bytes(sample.payload), out)
            except RejectedError as error:
                text = f"{self._name} sent telemetry that is none ({error})"
                out.replayed.broke_off = out.replayed.broke_off or text

    def _record(self, raw: bytes, out: NodeReplay) -> None:
        if kind_of(raw) is Kind.COUNTERS:
            sender, _, counters = decode_counters(raw, self._run)
            out.counters[sender] = counters
            return
        kept = out.replayed.rows
        batch = decode_batch(raw, self._run, {i: rows.shape[1] for i, rows in kept.items()})
        rows, end = kept[batch.sender], batch.tick + len(batch.rows)
        if end > len(rows):
            raise RejectedError(
                Reason.EARLY, f"expected ticks up to {len(rows) - 1}, got {end - 1}"
            )
        rows[batch.tick : end] = batch.rows

    def _finish(self, out: NodeReplay, process: StartedNode, tick: int) -> None:
        """Stop the node as the plant does, and wait for its last rows and counters."""
        stop = Stop(tick, "finished", "the replay is over")
        self._publishers["stop"].put(encode_stop(self._run, stop))
        replayed = out.replayed
        seconds = LAST_WORD_S if replayed.ended is None else 0.1 * LAST_WORD_S
        limit = Deadline(seconds)
        while len(out.counters) < len(replayed.rows) and not process.ended and not limit.passed:
            self._turns.turn(0.01)
            self._drain(out)
        self._drain(out)
        if len(out.counters) < len(replayed.rows) and not replayed.ended:
            how = process.ended or f"sent nothing within {seconds:g} s of the stop message"
            replayed.ended = f"{self._name}: its last word did not come, it {how}"
