"""The other end of all links of one node process, for a replay: plant, neighbours and recorder at once.

Between `supervise.replay_node`, which starts and ends everything, and Zenoh: recorded messages out, tick by
tick, answers and telemetry in. What did not come in the run is not sent, and the process learns of it as in the
run: by a neighbour's liveliness token that vanishes, or by messages of a later tick.
"""

from __future__ import annotations

import contextlib
from collections import deque
from dataclasses import dataclass, field
from functools import partial
from time import monotonic_ns
from typing import Any, Self

import numpy as np

from analysis.lives import Life
from analysis.replay import Feed, Replayed, name_of
from node.configured import sweeps_of
from supervise.replay_child import StartedNode, Turns
from supervise.replay_result import NodeReplay
from wire import session as zsession
from wire.channels import Degraded
from wire.child import Deadline
from wire.errors import OctarmError, StartUpTimeoutError
from wire.keys import Keys
from wire.messages import (
    PARTIAL,
    PLANT,
    Incoming,
    Kind,
    Numbers,
    RejectedError,
    Stop,
    encode_numbers,
    encode_stop,
    run_tag,
)
from wire.run_config import NodeConfig

START_S = 30.0
LAST_WORD_S = 5.0
"""How long to wait for rows and counters after the stop message; less if the node is not well."""
AGAIN_S = 0.25
"""After so long without an answer a neighbour that should have vanished does so again."""
MOMENT_S = 0.02
CAPACITY = 8192
"""Batches that may wait in memory."""


@dataclass
class _Answers:
    """What has come of a tick, on Zenoh's threads."""

    tick: int
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
        self._answers = _Answers(0)
        self._given_up: dict[int, _Answers] = {}
        """Of ticks that the process gives up: what it sent before it did."""
        self._tokens: dict[str, Any] = {}
        """Of the neighbours' processes, while they are there, by the sums that come from them."""
        self._cut: set[str] = set()
        """Sums that the process does not wait for, having bridged them in the tick before."""
        self._vanished: set[str] = set()
        """Sums that do not come in this tick because whoever they come from is gone."""
        self.unwanted = 0
        """Sums that it was given too late, so that it must refuse them."""
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
        self._tokens.clear()
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
        self._appear("forward", "backward")
        if config.joins:
            sides = (
                ("forward", first.first, first.index - 1),
                ("backward", last.last, last.index + 1),
            )
            for name, nobody, segment in sides:
                if not nobody:
                    key = keys.state(config.index, segment)
                    publisher = zsession.control_publisher(session, key)
                    self._publishers[f"state {name}"] = publisher
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
            there = self._config.joins or self._config.index in self._present
            if there and process.ready and not missing:
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

    def replay(
        self, feed: Feed, life: Life, process: StartedNode, deadline_s: float, out: NodeReplay
    ) -> None:
        """Feed the ticks of a life, then stop the node in order and take its last records."""
        replayed = out.replayed
        latencies = []
        before = -1
        for k in life.ticks:
            joins = life.joined and before < 0
            if joins:
                self._tell_states(feed, k)
            began_ns = self._feed(feed, k, before)
            before = k
            if feed.flags[k] & int(Degraded.HELD):
                self._given_up[k] = self._answers
            elif not self._await(k, process, deadline_s, replayed):
                break
            else:
                latencies.append((self._answers.at_ns - began_ns) * 1e-3)
                replayed.broke_off = self._take(self._answers, feed, replayed)
            if replayed.broke_off is not None:
                break
            replayed.ticks += 1
            self._drain(out)
        out.latencies_us = np.concatenate([out.latencies_us, latencies])
        if before in self._given_up and not (replayed.broke_off or replayed.ended):
            self._answers = _Answers(before + 1)
            self._put("measurement", feed, before, as_tick=before + 1)  # with which it gives it up
        self._finish(out, process, before + 1)
        for answers in self._given_up.values():
            replayed.broke_off = replayed.broke_off or self._take(answers, feed, replayed)

    def _feed(self, feed: Feed, k: int, before: int) -> int:
        """Send what came in a tick, and let the process know what does not come; the instant of the first one.

        What it has bridged, it does not wait for in the tick after: then the sums must be there first.
        """
        flags = int(feed.flags[k])
        self._answers = _Answers(k)
        names = ["measurement", "forward", "backward"]
        if before >= 0 and feed.flags[before]:
            names = names[1:] + names[:1]
        absent = {
            "measurement": flags & int(Degraded.MEASUREMENT_HELD),
            "forward": flags & int(Degraded.FORWARD_BRIDGED),
            "backward": flags & int(Degraded.BACKWARD_BRIDGED),
        }
        held = bool(flags & int(Degraded.HELD))
        missing = {name for name in ("forward", "backward") if absent[name]}
        self._appear(*(name for name in ("forward", "backward") if not absent[name]))
        began_ns = monotonic_ns()
        for name in names:
            if name == "measurement" and held and missing and missing <= self._cut:
                # Somebody was waited for: a sum that came too late had shown that its sender is there.
                self._put(min(missing), feed, before, as_tick=before)
                self.unwanted += 1
            if not absent[name]:
                self._put(name, feed, k)
            elif not (held or name in self._cut) and name in self._tokens:
                self._tokens.pop(name).undeclare()
        self._cut = missing
        self._vanished = set() if held else missing
        return began_ns

    def _put(self, name: str, feed: Feed, k: int, as_tick: int | None = None) -> None:
        """Send one recorded message."""
        kind, sender, values = {
            "measurement": (Kind.MEASUREMENT, PLANT, feed.measurement),
            "forward": (Kind.FORWARD_SUM, self._config.index - 1, feed.forward),
            "backward": (Kind.BACKWARD_SUM, self._config.last + 1, feed.backward),
        }[name]
        if name not in self._publishers:
            return
        setpoint = int(feed.setpoints[k])
        if name == "forward" and feed.flags[k] & int(Degraded.PARTIAL):
            setpoint |= PARTIAL
        tick = k if as_tick is None else as_tick
        raw = encode_numbers(kind, self._run, tick, sender, setpoint, values[k].tolist())
        self._publishers[name].put(raw)

    def _appear(self, *names: str) -> None:
        """The neighbours that sums of these names come from are there; without one at the arm's ends."""
        config, liveliness = self._config, self._session.liveliness()
        processes = {"forward": config.left, "backward": config.last + 1}
        for name in names:
            there = name in self._tokens or (name == "backward" and self._sweeps[-1].last)
            if processes[name] >= 0 and not there:
                key = self._keys.ready(processes[name])
                self._tokens[name] = liveliness.declare_token(key)

    def _vanish(self) -> None:
        """Let the neighbours that the process is to do without vanish once more: of a token that comes and goes
        at once, neither may be told."""
        for name in self._vanished:
            self._appear(name)
            self._turns.turn(MOMENT_S)
            if name in self._tokens:
                self._tokens.pop(name).undeclare()

    def _tell_states(self, feed: Feed, k: int) -> None:
        """Be the neighbours of a replacement: with both in the state that it began with, so does it again."""
        (sweep,) = sweeps_of(self._config)
        sweep.join(k, int(feed.setpoints[k]), feed.states[k, 0])
        deviation = sweep.row.state.tolist()
        for name, sender in (("forward", sweep.index - 1), ("backward", sweep.index + 1)):
            if (publisher := self._publishers.get(f"state {name}")) is not None:
                setpoint = int(feed.setpoints[k])
                raw = encode_numbers(Kind.STATE, self._run, k, sender, setpoint, deviation)
                publisher.put(raw)

    def _answered(self, name: str, raw: bytes) -> None:
        """On Zenoh's thread: keep the answer."""
        at_ns, answers = monotonic_ns(), self._answers
        with contextlib.suppress(RejectedError):  # else it is looked at with the tick that goes on
            tick = self._incoming[name].decode(raw).tick
            answers = self._given_up.get(tick, answers)
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
        limit, again = Deadline(deadline_s), Deadline(AGAIN_S)
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
            self._turns.turn(min(0.5, limit.left, again.left))
            if again.passed:
                again = Deadline(AGAIN_S)
                self._vanish()
        return True

    def _take(self, answers: _Answers, feed: Feed, into: Replayed) -> str | None:
        """Put a tick's answers where they belong; what is wrong with them, apart from numbers."""
        k, setpoint = answers.tick, int(feed.setpoints[answers.tick])
        if k in self._given_up and "command" in answers.raw:
            return (
                f"tick {k}: {self._name} sent its command, although the run had given the tick up"
            )
        place = {"command": into.commands, "forward": into.forward, "backward": into.backward}
        for name, raw in answers.raw.items():
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
            if name == "forward":
                into.partial[k] = int(Degraded.PARTIAL) if message.partial else 0
        if self._late:
            return f"tick {k}: {self._name} sent a second {self._late[0]} message"
        return None

    # -- records and the end ----------------------------------------------------------------------

    def _drain(self, out: NodeReplay) -> None:
        """Take the rows and counters that have come."""
        while (sample := self._records.try_recv()) is not None:
            try:
                out.take(bytes(sample.payload), self._run)
            except RejectedError as error:
                text = f"{self._name} sent telemetry that is none ({error})"
                out.replayed.broke_off = out.replayed.broke_off or text

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
