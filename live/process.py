"""The process behind the live page: telemetry in, frames out to every open page, nothing at all while none is.

A client of the Zenoh router inside the plant's process, like the recorder, and never on the control path. It
listens to telemetry only while somebody watches, keeps the newest of it, and steps back behind everything else
that runs on this machine.
"""

from __future__ import annotations

import contextlib
import math
import os
from time import monotonic, monotonic_ns
from typing import Any

import msgspec

from live.frame import FrameMaker
from live.server import LOOPBACK, LiveServer
from live.stream import Broadcast
from wire import session as zsession
from wire.child import Child
from wire.errors import ExitCode, OctarmError
from wire.keys import Keys
from wire.messages import (
    PLANT,
    Kind,
    RejectedError,
    decode_batch,
    decode_counters,
    kind_of,
    run_tag,
)
from wire.run_config import LiveConfig

PERIOD_S = 0.08
"""Between two frames: 12.5 a second."""
BATCHES = 8
"""Of each process may wait in Zenoh's ring; in a burst the oldest make room."""
DRAIN_S = 0.05
FIRST_S = 2.0
"""After the start it listens so long even without a page, until it has everybody's first tick."""
FAREWELL_S = 1.5
"""For the pages to get the last event, on a busy machine too: they are written to only when nobody else wants
the core. The launcher ends what still lives after two seconds; a page that does not read holds up the end."""
NICENESS = 5
"""On top of the process's own, where SCHED_IDLE is not to be had."""
_encode = msgspec.json.Encoder().encode


def step_back() -> None:
    """Let the calling thread, and those that it starts, run only when nobody else wants the core.

    Not Zenoh's thread, which was started before: it empties the link to the plant, which must never wait.
    """
    try:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    except OSError:
        with contextlib.suppress(OSError):
            os.nice(NICENESS)


class LiveProcess:
    """The process from its configuration to its exit code; `run` does everything."""

    def __init__(self, config: LiveConfig, child: Child) -> None:
        self._config = config
        self._child = child
        self._keys = Keys(run_tag(config.run.run_id))
        self._frames = FrameMaker(config)
        self._news = Broadcast(child.wake)
        self._alive: set[int] = set()
        self._told_alive: set[int] = set()
        self._state: dict[str, Any] = {"state": "waiting", "message": "", "final": False}
        self._started_s: float | None = None
        self._started_ns: int | None = None
        self._samples: Any = None
        self._most = BATCHES * (config.run.nodes + 1)
        """Samples that may wait."""
        self._next_s = 0.0
        self._ended = False

    def run(self) -> ExitCode:
        """Serve the page until the launcher says how the run ended, or is gone; returns the exit code."""
        server = self._serve()
        session = None
        try:
            session = zsession.open_client(
                self._config.links.connect, self._given_up, self._config.links.tls
            )
            if session is not None:
                tokens = zsession.watch_tokens(
                    session, self._keys.all_ready, self._alive, self._child.wake
                )
                step_back()
                server.start()
                self._child.status("listening", url=server.url)
                self._child.status("ready")
                self._attend(session)
                del tokens
        finally:
            self._news.end()
            self._news.empty(FAREWELL_S)
            if session is not None:
                self._ignore()
                session.close()
            server.close()
        return ExitCode.OK

    def _serve(self) -> LiveServer:
        port = self._config.port
        try:
            return LiveServer(port, _encode(run_facts(self._config)), self._news)
        except OSError as error:
            raise OctarmError(
                f"--live-port {port}: port {port} of {LOOPBACK} cannot be used "
                f"({error.strerror}); give another or leave it out"
            ) from None

    def _given_up(self) -> bool:
        """Whether the end was asked for while the plant was not there yet."""
        self._hear(0.0)
        return self._ended or self._child.stopping

    # -- the run ----------------------------------------------------------------------------------

    def _attend(self, session: Any) -> None:
        self._tell()
        while True:
            self._hear(self._patience())
            # Nodes leave after the launcher's last word was sent: heard now, it comes before their leaving.
            alive = self._alive.copy()
            self._hear(0.0)
            if self._child.stopping or self._ended:
                return
            self._listen(session)
            if self._told_alive != alive:
                self._told_alive = alive
                self._tell()
            if monotonic() >= self._next_s and self._samples is not None:
                self._next_s = monotonic() + PERIOD_S
                self._take_all()
                if self._news.watched:
                    self._show()

    def _patience(self) -> float | None:
        return None if self._samples is None else max(0.0, self._next_s - monotonic())

    def _hear(self, seconds: float | None) -> None:
        for message in self._child.wait(seconds):
            if message.get("do") == "start":
                self._started_s = monotonic()
                if self._config.replay_from is None:  # a recording's instants are of another time
                    self._started_ns = monotonic_ns() - (self._config.links.epoch_ns or 0)
                self._tell(state="running")
            elif message.get("do") == "ending":
                self._tell(state="ending", message=message["message"])
            elif message.get("do") == "finish" and not self._ended:
                if self._news.watched and self._samples is not None:
                    # The last frame is of the last tick, however long that takes on a busy machine.
                    self._take_all(math.inf)
                    self._show()
                self._ended = True
                self._told_alive.difference_update(message["dead"])
                self._tell(state=message["state"], message=message["message"], final=True)

    def _tell(self, **news: Any) -> None:
        """Publish where the run stands and which nodes' tokens are there."""
        self._state |= news
        run, every = self._config.run, self._config.run.segments_per_process
        alive = [i - i % every in self._told_alive for i in range(run.nodes)]
        about = {"run_id": run.run_id, "alive": alive}
        self._news.put("state", _encode(self._state | about))

    # -- telemetry --------------------------------------------------------------------------------

    def _listen(self, session: Any) -> None:
        """Have a subscription if it is of use, and only after the start.

        Before, a subscription of this process would make the nodes believe that the recorder is linked.
        """
        started = self._started_s
        first = (
            started is not None
            and self._config.replay_from is None  # which waits for somebody who watches
            and self._frames.awaits_first
            and monotonic() - started < FIRST_S
        )
        wanted = started is not None and (self._news.watched or first)
        if wanted and self._samples is None:
            ring = zsession.newest(self._most)
            self._frames.resume()
            self._samples = session.declare_subscriber(self._keys.all_telemetry, ring)
        elif not wanted:
            self._ignore()

    def _ignore(self) -> None:
        if self._samples is not None:
            self._samples.undeclare()
            self._samples = None
            self._news.forget("frame")

    def _take_all(self, seconds: float | None = None) -> None:
        """Read what waits, and not what comes meanwhile, for so long at most; None: while a frame can wait."""
        seconds = DRAIN_S if seconds is None else seconds
        began = monotonic()
        for _ in range(self._most):
            if (sample := self._samples.try_recv()) is None:
                return
            self._take(str(sample.key_expr), bytes(sample.payload))
            if monotonic() - began > seconds:
                return

    def _take(self, key: str, raw: bytes) -> None:
        frames = self._frames
        try:
            if kind_of(raw) is Kind.COUNTERS:
                sender, _, counters = decode_counters(raw, self._keys.run)
                frames.refused(sender, counters.get("rejected_messages", 0))
                return
            frames.add(decode_batch(raw, self._keys.run, frames.rows.columns))
        except RejectedError:
            from_whom = key.rpartition("/")[2]
            frames.refused(int(from_whom) if from_whom.isdigit() else PLANT)

    def _show(self) -> None:
        running = self._state["state"] == "running"
        frame = self._frames.frame(self._started_ns, running=running)
        if frame is not None:
            self._news.put("frame", _encode(frame))


def run_facts(config: LiveConfig) -> dict[str, Any]:
    """What /run.json says: everything about the run that does not change."""
    run = config.run
    return {
        "run_id": run.run_id,
        "scenario": run.scenario,
        "nodes": run.nodes,
        "processes": list(run.firsts),
        "spacing": run.spacing,
        "faces_m": [round(face, 6) for face in run.faces_m],
        "length_m": run.faces_m[-1],
        "tick_s": run.tick_s,
        "ticks": run.ticks,
        "period_s": None if run.pace is None else run.pace.period_s,
        "replay": config.replay_from is not None,
        "control": run.control,
        "setpoint_names": list(run.setpoint_names),
        "setpoint": run.setpoint_index,
        "goals": [{"setpoint": goal.setpoint, "shape_m": goal.shape_m} for goal in config.goals],
        "gains_sha256": run.artefact_sha256,
        "elsewhere": list(config.elsewhere),
        "frames_per_s": 1.0 / PERIOD_S,
    }
