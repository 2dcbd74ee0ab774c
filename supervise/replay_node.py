"""A recording fed to a real node process over Zenoh, tick by tick: does it answer as in the run?

Beside `analysis.replay`, which runs only the mathematics: here it is the process, with its encoding, its links
and its telemetry. It gets its recorded configuration with other links; the replayer is its only peer, a router
that stands for plant, neighbours and recorder. A tick is fed when the one before has been answered.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import selectors
import signal
import tempfile
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from time import monotonic_ns
from typing import Any

import numpy as np
import numpy.typing as npt

from analysis.recording import Recording
from analysis.replay import Feed, Replayed, Rows, name_of, nothing_yet
from node.configured import sweeps_of
from supervise.children import Handle, Process, ending, module
from supervise.endpoints import choose
from wire import session as zsession
from wire.channels import label
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
from wire.run_config import LinkConfig, NodeConfig, dumps

Array = npt.NDArray[np.float64]

START_S = 30.0
END_S = 3.0
"""The node ends when it is told; after so long it is made to."""
CAPACITY = 8192
MESSAGES = (
    "measurement_received",
    "forward_received",
    "backward_received",
    "forward_sent",
    "backward_sent",
    "command_sent",
)
"""What a node counts; a replay of the whole run repeats the checksums too."""


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


def replay_process(
    feed: Feed, rows: Rows, deadline_s: float | None, progress: Callable[[str], None]
) -> NodeReplay:
    """Start the node process of a feed, give it every tick, and take what it gives; it is gone afterwards.

    `deadline_s`: longest wait for an answer; None: as in the run. StartUpTimeoutError if the process does not
    link up, OctarmError if it fails before the first tick. What goes wrong later is in the result.
    """
    with contextlib.ExitStack() as stack:
        endpoints = choose(2, "unix", None, None)
        stack.callback(endpoints.close)
        errors = stack.enter_context(tempfile.TemporaryFile())
        config = _relinked(feed.config, endpoints.plant, endpoints.private)
        session = zsession.open_session("router", [endpoints.plant], [])
        stack.callback(session.close)
        peer = stack.enter_context(_Peer(config, session))
        process = stack.enter_context(_Started(config, errors, peer))
        peer.link(process)
        pid = process.node.pid if process.node else 0
        progress(f"{name_of(config)} is linked, process {pid}")
        return peer.replay(feed, rows, process, deadline_s or config.links.deadline_s)


def same_messages(recording: Recording, replay: NodeReplay) -> tuple[int, int] | None:
    """How many of the run's message checksums the process has repeated, of how many; None if it was not fed
    as many ticks as in the run, or the run's counters are not there.

    A checksum is over all messages of one kind in order, headers and the last command included.
    """
    same = total = 0
    for index, counters in replay.counters.items():
        recorded = recording.process_counters(f"node/{label(index, recording.nodes)}")
        for name in MESSAGES:
            if f"{name}_crc32" not in counters or f"{name}_crc32" not in recorded:
                continue
            if counters[f"{name}_messages"] != recorded[f"{name}_messages"]:
                return None
            total += 1
            same += counters[f"{name}_crc32"] == recorded[f"{name}_crc32"]
    return (same, total) if total else None


def _relinked(config: NodeConfig, endpoint: str, directory: str | None) -> NodeConfig:
    links = LinkConfig(
        listen=(),
        connect=(endpoint,),
        directory=directory,
        deadline_s=config.links.deadline_s,
        epoch_ns=None,
        cpu=None,
        fifo=None,
    )
    return dataclasses.replace(config, links=links)


class _Started:
    """The node process, forked from a zygote as in a run. Leaving it leaves no process behind."""

    def __init__(self, config: NodeConfig, errors: Any, peer: _Peer) -> None:
        self._config = config
        self._errors = errors
        self._zygote = Process(
            "zygote", module("node", "--zygote", "--parent", str(os.getpid())), errors
        )
        self._peer = peer
        self.node: Handle | None = None
        self.ready = False
        self.waits_for: list[str] = []
        self.stopped = False
        self.ended: str | None = None
        """How it ended, once it has."""
        self.failure: str | None = None
        """What it said to be wrong."""

    def __enter__(self) -> _Started:
        self._peer.watch(self._zygote.status, self._hear)
        self._zygote.tell(dumps(self._config))
        return self

    def __exit__(self, *_: object) -> None:
        if self.node is not None:
            self._end(self.node)
            self.node.close()
        self._zygote.control.close()  # its lifeline
        self._end(self._zygote)
        self._peer.forget(self._zygote.status)
        self._zygote.reap()
        self._zygote.close()

    def _end(self, handle: Handle) -> None:
        """Ask it to end, then make it."""
        for number in (signal.SIGTERM, signal.SIGKILL):
            handle.signal(number)
            limit = Deadline(END_S)
            while handle.alive and not limit.passed:
                self._peer.turn(0.02)

    def last_words(self) -> str:
        """The last line that it wrote to standard error, if any."""
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").split("\n")
        said = [line.strip() for line in lines if line.strip()]
        return f"; it wrote: {said[-1]}" if said else ""

    def _hear(self) -> None:
        lines = self._zygote.lines()
        if lines is None:
            self._peer.forget(self._zygote.status)
            self.ended = self.ended or ending(self._zygote.reap())
            return
        for line in lines:
            match line["event"]:
                case "born":
                    self.node = Handle("node", line["pid"], parent=self._zygote.pid)
                case "ready":
                    self.ready = True
                case "waiting":
                    self.waits_for = line["missing"]
                case "stopped":
                    self.stopped = True
                case "failed":
                    self.failure = line["message"]
                case "died":
                    self.ended = ending(line["code"])


@dataclass
class _Answers:
    """What has come of a tick, on Zenoh's threads."""

    raw: dict[str, bytes] = field(default_factory=dict)
    at_ns: int = 0
    """When the command came."""


class _Peer:
    """The replayer's end of all links of one node process."""

    def __init__(self, config: NodeConfig, session: Any) -> None:
        self._config = config
        self._run = run_tag(config.run_id)
        self._keys = Keys(self._run)
        self._name = name_of(config)
        self._sweeps = sweeps_of(config)
        self._selector = selectors.DefaultSelector()
        self._read, self._write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._answers = _Answers()
        self._late: deque[str] = deque()
        """Messages that nobody waited for."""
        self._present: set[int] = set()
        self._keep: list[Any] = []
        self._publishers: dict[str, Any] = {}
        self._session = session

    def __enter__(self) -> _Peer:
        self._selector.register(self._read, selectors.EVENT_READ, self._woken)
        self._declare(self._session)
        return self

    def __exit__(self, *_: object) -> None:
        self._publishers.clear()
        self._keep.clear()
        del self._records
        self._selector.close()
        os.close(self._read)
        os.close(self._write)

    # -- waiting ----------------------------------------------------------------------------------

    def watch(self, file: int, act: Callable[[], None]) -> None:
        """Call this when the file can be read."""
        self._selector.register(file, selectors.EVENT_READ, act)

    def forget(self, file: int) -> None:
        """Do not watch it any more."""
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(file)

    def turn(self, seconds: float) -> None:
        """Wait for something to happen and handle it."""
        for key, _ in self._selector.select(seconds):
            act: Callable[[], None] = key.data
            act()

    def _woken(self) -> None:
        with contextlib.suppress(BlockingIOError):
            os.read(self._read, 4096)

    def _wake(self) -> None:
        with contextlib.suppress(OSError):  # full of wake-ups, or closed
            os.write(self._write, b"w")

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
                publisher.declare_matching_listener(zsession.observe(lambda _: self._wake()))
            )
        self._keep.append(zsession.watch_tokens(session, keys.all_ready, self._present, self._wake))

    def link(self, process: _Started) -> None:
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
            self.turn(min(0.2, limit.left))

    # -- the replay -------------------------------------------------------------------------------

    def replay(self, feed: Feed, rows: Rows, process: _Started, deadline_s: float) -> NodeReplay:
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
            self._wake()

    def _await(self, k: int, process: _Started, deadline_s: float, into: Replayed) -> bool:
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
            self.turn(min(0.5, limit.left))
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

    def _finish(self, out: NodeReplay, process: _Started, tick: int) -> None:
        """Stop the node as the plant does, and wait for its last rows and counters."""
        stop = Stop(tick, "finished", "the replay is over")
        self._publishers["stop"].put(encode_stop(self._run, stop))
        limit = Deadline(END_S)
        replayed = out.replayed
        while len(out.counters) < len(replayed.rows) and not process.ended and not limit.passed:
            self.turn(0.01)
            self._drain(out)
        self._drain(out)
        if len(out.counters) < len(replayed.rows) and not replayed.ended:
            how = process.ended or f"sent nothing within {END_S:g} s of the stop message"
            replayed.ended = f"{self._name}: its last word did not come, it {how}"


def latency_facts(latencies_us: Array) -> dict[str, float | None]:
    """Median and 99 % of the time from feeding a tick to its command, us; None without a tick."""
    shares = {"p50": 50.0, "p99": 99.0}
    some = latencies_us.size > 0
    return {
        name: float(np.percentile(latencies_us, share)) if some else None
        for name, share in shares.items()
    }
