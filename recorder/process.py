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
from wire.channels import LATE_AT, SETPOINT_AT, columns_of, label, width
from wire.child import Child, Deadline
from wire.counters import Flow, Rejections
from wire.errors import ExitCode
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
        self._writer = RecordingWriter(Path(config.path), run.tick_s, layout, config.flush_s)
        self._scenes = SceneDrawer(config)
        self._tip_error = columns_of(layout[PLANT], "/plant/tip", "error_m")
        self._counters: dict[int, dict[str, int]] = {}
        self._received = Flow()
        self._rejections = Rejections()
        self._weights = np.asarray(run.energy_weights)
        self._last: tuple[int, dict[int, Row]] | None = None
        self._first_energy: float | None = None
        self._told_at = 0.0
        self._written = 0
        self._setpoint = run.setpoint_index
        self._silent: set[int] = set()
        self._late: set[int] = set()
        """Ticks that had no sweep: no node has anything to record of them."""
        self._events: list[tuple[int, str, str, str]] = []
        """Events whose tick is not written yet: they go into the file before the ticks that follow
        them."""

    def run(self) -> ExitCode:
        """Record until the launcher says finish (or is gone); returns the exit code."""
        config = self._config
        self._writer.head(config.metadata, config.attachments)
        session = zsession.open_client(config.links.connect, self._given_up)
        if session is None:
            self._close()
            return ExitCode.OK
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
                        finish = finish or Deadline(message.get("seconds", FINISH_S))
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
                if finish and (not waiting or finish.passed):
                    break
                if self._child.stopping and (self._child.orphaned or finish is None):
                    self._drain(samples)
                    break
            del samples
        finally:
            session.close()
            self._close()
        return ExitCode.OK

    def _given_up(self) -> bool:
        """Whether the end was asked for while the plant was not there yet."""
        self._child.wait(0.0)
        return self._child.stopping

    def _drain(self, samples: Any) -> None:
        began = monotonic()
        while (sample := samples.try_recv()) is not None:
            raw = bytes(sample.payload)
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
            self._counters[sender] = counters
            self._merge.end(sender, tick)
            return
        batch = decode_batch(raw, self._run, self._columns)
        if not self._merge.add(batch):
            raise RejectedError(Reason.DUPLICATE, f"sender {batch.sender}, tick {batch.tick}")

    def _write(self, ticks: Iterator[tuple[int, dict[int, Row]]]) -> None:
        for tick, rows in ticks:
            self._tell(tick)
            self._tell_setpoint(tick, rows)
            self._tell_late(tick, rows)
            self._writer.tick(tick, rows)
            if scene := self._scenes.draw(tick, self._writer.log_time_ns(tick), rows):
                self._writer.scene(tick, scene)
            self._last = (tick, rows)
            if tick == 0:
                self._first_energy = self._error_energy(rows)
            self._written = tick + 1

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
        before, self._setpoint = self._setpoint, int(row[SETPOINT_AT])
        names = self._config.run.setpoint_names
        text = f"setpoint {names[before]} -> {names[self._setpoint]} at tick {tick}"
        self._writer.event(tick, "info", "setpoint", text)

    def _tell_late(self, tick: int, rows: dict[int, Row]) -> None:
        """Write an event when ticks begin to be late; every one of them is marked in /plant/pace."""
        if PLANT in rows and rows[PLANT][LATE_AT]:
            self._late.add(tick)
            if tick - 1 not in self._late:
                text = "the sweep of the tick before was not over: the commands are held"
                self._writer.event(tick, "warning", "late", text)

    # -- figures for the progress bar -------------------------------------------------------------

    def _progress(self) -> None:
        now = monotonic()
        if self._last is None or now - self._told_at < PROGRESS_S:
            return
        self._told_at = now
        tick, rows = self._last
        energy = self._error_energy(rows)
        if energy is None:
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
            if not (lost := self._lost(gap)):
                continue
            who = "plant" if gap.sender == PLANT else f"node {gap.sender}"
            text = f"telemetry of {who}: ticks {gap.first} to {gap.after - 1} were lost"
            if late := gap.after - gap.first - lost:
                text += f", but for {late} that were late"
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
        self._writer.close(summary)
        self._child.status("closed", **totals)

    def _lost(self, gap: Gap) -> int:
        """Ticks of a gap that a node has done and the recorder did not get."""
        return sum(tick not in self._late for tick in range(gap.first, gap.after))

    def _totals(self) -> dict[str, int]:
        nodes = [c for sender, c in self._counters.items() if sender != PLANT]
        plant = self._counters.get(PLANT, {})

        def total(*names: str) -> int:
            return sum(c.get(name, 0) for c in nodes for name in names)

        return {
            "ticks_recorded": self._written,
            "ticks_lost": sum(map(self._lost, self._merge.gaps)),
            "late_ticks": plant.get("late_ticks", 0),
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
