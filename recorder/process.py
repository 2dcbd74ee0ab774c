"""The recorder's process: telemetry of every process in, one MCAP file out, and the figures for the
progress bar.

It is a client of the Zenoh router inside the plant's process and is never on the control path.
Samples wait in a queue inside Zenoh until this process has time for them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from recorder.merge import Gap, Row, TickMerge
from recorder.scene import SceneDrawer
from recorder.writer import RecordingWriter
from wire import session as zsession
from wire.channels import LATE_AT, REFUSED, SETPOINT_AT, Health, columns_of, label, width
from wire.child import Child, Deadline
from wire.counters import Flow, Rejections
from wire.errors import ExitCode, OctarmError, UsageError
from wire.keys import Keys
from wire.messages import (
    PLANT,
    Kind,
    Reason,
    RejectedError,
    decode_batch,
    decode_counters,
    kind_of,
    run_tag,
)
from wire.run_config import RecorderConfig
from wire.telemetry import telemetry_layout

CAPACITY = 8192
"""Batches that may wait in memory for this process."""
POLL_S = 0.005
PROGRESS_S = 0.1
BEYOND = 1000
"""Ticks after a run's last one that may come: an arm that went safe is watched a little longer."""
QUIET_S = 5.0
"""After the end of the run: when nothing has come for so long, nothing is on its way any more."""
FINISH_S = 10.0
"""How long to wait for the last words of processes that are alive."""


class RecorderProcess:
    """The recorder from its configuration to its exit code; `run` does everything."""

    def __init__(self, config: RecorderConfig, child: Child) -> None:
        self._config = config
        self._child = child
        run = config.run
        self._run = run_tag(run.run_id)
        layout = telemetry_layout(config.forward_widths, config.backward_widths)
        self._columns = {sender: width(channels) for sender, channels in layout.items()}
        self._merge = TickMerge(list(layout))
        try:
            self._writer = RecordingWriter(Path(config.path), run.tick_s, layout, config.flush_s)
        except OSError as error:  # the directory was there when the launcher made it
            raise UsageError(_cannot_begin(config.path, error)) from None
        self._scenes = SceneDrawer(config)
        self._tip_error = columns_of(layout[PLANT], "/plant/tip", "error_m")
        self._counters: dict[int, dict[str, int]] = {}
        self._received = Flow()
        self._rejections = Rejections()
        self._weights = np.asarray(run.energy_weights)
        self._last: tuple[int, dict[int, Row]] | None = None
        self._first_energy: float | None = None
        self._told_at = 0.0
        self._heard_at = 0.0
        self._written = 0
        self._cut_at: int | None = None
        """First tick that is not in the file because the disk was full."""
        self._setpoint = run.setpoint_index
        self._silent: set[int] = set()
        self._absent: dict[int, set[int]] = {i: set() for i in range(run.nodes)}
        """Ticks of which the plant had no command of a node in time: it may have done nothing."""
        self._health = columns_of(layout[PLANT], "/plant/health")
        self._guard = columns_of(layout[PLANT], "/plant/guard")
        self._refused: list[dict[str, Any]] = []
        """Peers that other processes did not let in, as the launcher has it."""
        self._late: set[int] = set()
        """Ticks that had no sweep: no node has anything to record of them."""
        self._events: list[tuple[int, str, str, str]] = []
        """Events whose tick is not written yet: they go into the file before the ticks that follow
        them."""

    def run(self) -> ExitCode:
        """Record until the launcher says finish (or is gone); returns the exit code."""
        config = self._config
        try:
            self._writer.head(config.metadata, config.attachments)
        except OSError as error:
            self._writer.abandon()
            raise UsageError(_cannot_begin(config.path, error)) from None
        try:
            self._record()
            self._close()
        except OSError as error:  # a disk that fails, a file that is gone
            self._writer.abandon()
            raise OctarmError(f"recording {config.path}: {error.strerror}") from None
        return ExitCode.OK

    def _record(self) -> None:
        """Take what comes until it is time to close the file."""
        session = zsession.open_client(
            self._config.links.connect, self._given_up, self._config.links.tls
        )
        if session is None:
            return
        try:
            keys = Keys(self._run)
            handler = zsession.queue(CAPACITY)
            samples = session.declare_subscriber(keys.all_telemetry, handler)
            self._child.status("up")
            finish: Deadline | None = None
            while True:
                for message in self._child.wait(POLL_S):
                    if message.get("do") == "finish":
                        self._silent |= set(message["dead"])
                        self._refused = message.get("refused", [])
                        self._heard_at = monotonic()
                        limit = Deadline(message.get("seconds", FINISH_S))
                        finish = limit if finish is None or limit.at < finish.at else finish
                    elif message.get("do") == "event":
                        self._events.append(
                            (message["tick"], message["level"], message["name"], message["message"])
                        )
                self._drain(samples)
                if finish and monotonic() - self._told_at > PROGRESS_S:
                    self._told_at = monotonic()
                    self._child.status("writing", tick=self._written)
                # Lasting signals only end the wait for others: the file is closed in any case.
                waiting = [s for s in self._merge.waiting_for() if s not in self._silent]
                quiet = monotonic() - self._heard_at > QUIET_S
                if finish and (not waiting or quiet or finish.passed):
                    break
                if self._child.stopping and (self._child.orphaned or finish is None):
                    self._drain(samples)
                    break
            del samples
        finally:
            session.close()

    def _given_up(self) -> bool:
        """Whether the end was asked for while the plant was not there yet."""
        self._child.wait(0.0)
        return self._child.stopping

    def _drain(self, samples: Any) -> None:
        began = monotonic()
        while (sample := samples.try_recv()) is not None:
            raw = bytes(sample.payload)
            self._heard_at = monotonic()
            try:
                self._take(raw)
                self._received.add(raw)
            except RejectedError as error:
                self._rejections.add(error.reason)
            if monotonic() - began > 0.1:
                break  # look at the launcher's messages in between
        self._received.settle()
        self._write(self._merge.complete())
        self._writer.flush_if_due()
        self._progress()

    def _take(self, raw: bytes) -> None:
        if kind_of(raw) is Kind.COUNTERS:
            sender, tick, counters = decode_counters(raw, self._run)
            if sender not in self._columns:
                raise RejectedError(Reason.SENDER, f"unknown sender {sender}")
            self._check_tick(tick)
            self._counters[sender] = counters
            self._merge.end(sender, tick)
            return
        batch = decode_batch(raw, self._run, self._columns)
        self._check_tick(batch.tick + len(batch.rows))
        if not self._merge.add(batch):
            raise RejectedError(Reason.DUPLICATE, f"sender {batch.sender}, tick {batch.tick}")

    def _check_tick(self, after: int) -> None:
        """RejectedError if the ticks before this one are none of the run: a gap up to there has no end."""
        if after > (most := self._config.run.ticks + BEYOND):
            raise RejectedError(Reason.TICK, f"expected ticks up to {most}, got {after}")

    def _write(self, ticks: Iterator[tuple[int, dict[int, Row]]]) -> None:
        for tick, rows in ticks:
            self._note_absent(tick, rows)
            if self._cut_at is None:
                self._write_tick(tick, rows)
            self._last = (tick, rows)
            if tick == 0:
                self._first_energy = self._error_energy(rows)

    def _write_tick(self, tick: int, rows: dict[int, Row]) -> None:
        self._tell(tick)
        self._tell_setpoint(tick, rows)
        self._tell_late(tick, rows)
        self._writer.tick(tick, rows)
        if self._writer.full is not None:
            self._end_early(tick)
            return
        if scene := self._scenes.draw(tick, self._writer.log_time_ns(tick), rows):
            self._writer.scene(tick, scene)
        self._written = tick + 1

    def _end_early(self, tick: int) -> None:
        """The disk is full: the recording ends here, for good; what is said at the end has its room."""
        self._cut_at = tick
        text = f"the recording ends before tick {tick}: {self._writer.full}"
        self._writer.event(tick, "error", "disk_full", text)
        self._writer.flush()
        self._child.status("note", text=f"{text}; the run goes on unrecorded")

    def _tell(self, tick: float) -> None:
        due = [event for event in self._events if event[0] <= tick]
        if due:
            self._events = [event for event in self._events if event[0] > tick]
            for event in due:
                self._writer.event(*event)

    def _tell_setpoint(self, tick: int, rows: dict[int, Row]) -> None:
        """Write an event when the nodes have changed to another setpoint's gains."""
        row = next((rows[i] for i in range(self._config.run.nodes) if i in rows), None)
        if row is None or int(row[SETPOINT_AT]) == self._setpoint:
            return
        names = self._config.run.setpoint_names
        if not 0.0 <= row[SETPOINT_AT] < len(names):
            return  # it is recorded; there is nothing to tell
        before, self._setpoint = self._setpoint, int(row[SETPOINT_AT])
        text = f"setpoint {names[before]} -> {names[self._setpoint]} at tick {tick}"
        self._writer.event(tick, "info", "setpoint", text)

    def _tell_late(self, tick: int, rows: dict[int, Row]) -> None:
        """Write an event when ticks begin to be late; every one of them is marked in /plant/pace."""
        if PLANT in rows and rows[PLANT][LATE_AT]:
            self._late.add(tick)
            passive = rows[PLANT][self._guard][0] > 0.0  # which has an event of its own
            if tick - 1 not in self._late and not passive:
                text = "the sweep of the tick before was not over: the commands are held"
                self._writer.event(tick, "warning", "late", text)

    def _note_absent(self, tick: int, rows: dict[int, Row]) -> None:
        if PLANT in rows and len(rows) <= self._config.run.nodes:
            for node, health in enumerate(rows[PLANT][self._health]):
                if not int(health) & Health.ON_TIME:
                    self._absent[node].add(tick)

    # -- figures for the progress bar -------------------------------------------------------------

    def _progress(self) -> None:
        now = monotonic()
        if self._last is None or now - self._told_at < PROGRESS_S:
            return
        self._told_at = now
        tick, rows = self._last
        energy = self._error_energy(rows)
        if energy is None or not math.isfinite(
            energy
        ):  # a word all the same, of a recorder that is well
            self._child.status("writing", tick=tick + 1)
            return
        (tip_error_m,) = rows[PLANT][self._tip_error]
        relative = math.sqrt(energy / self._first_energy) if self._first_energy else None
        self._child.status(
            "progress", tick=tick + 1, tip_error_m=tip_error_m, estimation_error=relative
        )

    def _error_energy(self, rows: dict[int, Row]) -> float | None:
        """Energy in J of estimate less truth at one tick; None while a row is missing."""
        nodes = self._config.run.nodes
        plant = rows.get(PLANT)
        if plant is None or len(rows) <= nodes:
            return None
        truth = np.asarray(plant[: 4 * nodes]).reshape(nodes, 4)
        estimate = np.asarray([rows[i][2:6] for i in range(nodes)])
        return float(np.sum(self._weights * (estimate - truth) ** 2))

    # -- the end ----------------------------------------------------------------------------------

    def _close(self) -> None:
        self._write(self._merge.rest())
        run = self._config.run
        for gap in self._merge.gaps:
            beyond = self._cut_at is not None and gap.first >= self._cut_at
            if beyond or not (lost := self._lost(gap)):
                continue
            who = "plant" if gap.sender == PLANT else f"node {gap.sender}"
            text = f"telemetry of {who}: ticks {gap.first} to {gap.after - 1} were lost"
            if late := gap.after - gap.first - lost:
                text += f", but for {late} that it may not have done"
            self._writer.event(gap.first, "warning", "telemetry_lost", text)
        self._tell(math.inf)
        totals = self._totals()
        summary = {name: str(value) for name, value in totals.items()}
        for sender, counters in sorted(self._counters.items()):
            who = "plant" if sender == PLANT else f"node/{label(sender, run.nodes)}"
            summary[f"{who}"] = json.dumps(counters)
        summary["recorder"] = json.dumps(
            self._received.report("telemetry_received") | self._rejections.report()
        )
        if self._refused:
            summary[REFUSED] = json.dumps(self._refused)
        self._writer.close(summary)
        self._child.status("closed", **totals)

    def _lost(self, gap: Gap) -> int:
        """Ticks of a gap that a node has done and the recorder did not get."""
        absent = self._late | self._absent.get(gap.sender, set())
        return sum(tick not in absent for tick in range(gap.first, gap.after))

    def _totals(self) -> dict[str, int]:
        nodes = [c for sender, c in self._counters.items() if sender != PLANT]
        plant = self._counters.get(PLANT, {})

        def total(*names: str) -> int:
            return sum(c.get(name, 0) for c in nodes for name in names)

        return {
            "ticks_recorded": self._written,
            "disk_full_at": self._cut_at if self._cut_at is not None else -1,
            "ticks_lost": sum(map(self._lost, self._merge.gaps)),
            "late_ticks": plant.get("late_ticks", 0),
            "bridged_ticks": plant.get("bridged_ticks", 0),
            "bridged_sums": total("bridged_sums"),
            "nodes_reporting": len(nodes),
            "neighbour_messages": total("forward_received_messages", "backward_received_messages"),
            "neighbour_bytes": total("forward_received_bytes", "backward_received_bytes"),
            "passed_messages": total("passed_messages"),
            "neighbour_messages_sent": total("forward_sent_messages", "backward_sent_messages"),
            "measurement_messages": total("measurement_received_messages"),
            "measurement_bytes": total("measurement_received_bytes"),
            "command_messages": plant.get("command_received_messages", 0),
            "command_bytes": plant.get("command_received_bytes", 0),
            "rejected_messages": total("rejected_messages") + plant.get("rejected_messages", 0),
        }


def _cannot_begin(path: str, error: OSError) -> str:
    return f"recording {path}: {error.strerror}; make room, or choose another place with --out"
