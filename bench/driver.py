"""The driver of a group, in the plant's place: sends measurements, collects commands, keeps the times.

It takes orders from the launcher (`bench.group`) as JSON lines: burst, report, finish, end. Results go
into files in the group's private directory, because a status line is short.
"""

from __future__ import annotations

import gc
import json
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from bench.configs import DriverConfig
from bench.pacing import TickLostError, lock_step, paced
from bench.raw import RawLinks
from bench.worker import is_counters
from bench.zenoh_links import ZenohLinks
from wire.child import Child
from wire.errors import ExitCode
from wire.messages import (
    PLANT,
    Kind,
    Reason,
    RejectedError,
    Stop,
    decode_batch,
    decode_counters,
    encode_numbers,
    encode_stop,
    run_tag,
)
from wire.placement import place

NOISE = 1e-3
"""Standard deviation of what is added to a measurement: m/s and 1/m."""
NOISE_TICKS = 64
"""The noise repeats after so many ticks: it is made before the first."""
COLLECT_S = 10.0


class Driver:
    """One driver from its configuration to its exit code; `run` does everything."""

    def __init__(self, config: DriverConfig, child: Child) -> None:
        self._config = config
        self._child = child
        self._run = run_tag(config.run_id)
        self._ticks = count()
        self._done = 0
        self._first = 0
        self._times: list[int] = []
        self._chain: dict[int, dict[int, tuple[float, float]]] = {}
        """Of each end node, by tick: when the measurement came, when the sum from the other end."""
        random = np.random.default_rng(config.seed)
        self._values = [
            [(random.normal(scale=NOISE, size=len(c)) + c).tolist() for c in config.centres]
            for _ in range(NOISE_TICKS)
        ]
        self._links: ZenohLinks | RawLinks

    def run(self) -> ExitCode:
        """Link up and take orders until the end; returns the exit code."""
        links = self._config.links
        place(links.cpu, links.fifo, lambda text: self._child.status("note", text=text))
        raw = self._config.pattern == "raw"
        self._links = (RawLinks if raw else ZenohLinks)(self._config, self._child)
        try:
            if self._links.link():
                gc.collect()
                gc.freeze()
                gc.disable()
                self._child.status("ready")
                self._serve()
        finally:
            self._links.close()
        return ExitCode.OK

    def _serve(self) -> None:
        while not self._child.stopping:
            for order in self._child.wait(None):
                match order["do"]:
                    case "burst":
                        self._burst(order)
                    case "report":
                        np.save(order["path"], np.array(self._times, dtype=np.int64))
                        self._child.status("reported", first=self._first)
                    case "finish":
                        Path(order["path"]).write_text(json.dumps(self._finish()))
                        self._child.status("finished")
                    case "end":
                        return

    def _messages(self) -> list[bytes]:
        """The measurements of the next tick."""
        tick, run, setpoint = next(self._ticks), self._run, self._config.setpoint
        wrap = self._links.wrap
        self._done = tick + 1
        return [
            wrap(encode_numbers(Kind.MEASUREMENT, run, tick, PLANT, setpoint, values))
            for values in self._values[tick % NOISE_TICKS]
        ]

    def _burst(self, order: dict[str, Any]) -> None:
        period_ns = order["period_ns"]
        began = self._done
        try:
            if period_ns:
                self._first = began + order["warm"]
                self._times = paced(
                    self._links,
                    self._messages,
                    order["ticks"],
                    period_ns,
                    warm=order["warm"],
                    most_late=order["most_late"],
                    idle=self._drain,
                )
            else:
                lock_step(self._links, self._messages, order["warm"], order["warm_s"])
                self._first = self._done
                self._times = lock_step(
                    self._links, self._messages, order["ticks"], order["limit_s"]
                )
        except TickLostError:
            if not self._child.stopping:
                text = f"tick {self._done - 1}: no command from {self._links.missing()}"
                self._child.status("failed", code="deadline", message=text)
            return
        self._child.status("ran", ticks=self._done - began)
        self._drain()
        gc.collect()

    def _drain(self) -> None:
        for raw in self._links.drain():
            self._instants(raw)

    def _instants(self, raw: bytes) -> None:
        ends = self._config.ends
        if ends is None or is_counters(raw):
            return
        widths = {0: ends.first_width, ends.tip: ends.last_width}
        try:
            batch = decode_batch(raw, self._run, widths)
        except RejectedError as error:
            if error.reason is Reason.SENDER:  # another segment of an end's process
                return
            raise
        of = self._chain.setdefault(batch.sender, {})
        for row, (measured, arrived) in enumerate(
            batch.rows[:, [ends.measured, ends.arrived]].tolist()
        ):
            of[batch.tick + row] = (measured, arrived)

    def _finish(self) -> dict[str, Any]:
        """Totals over the group's life, counted by the receivers, and the chain's time of each tick."""
        records = self._links.finish(
            encode_stop(self._run, Stop(self._done, "finished", "")), COLLECT_S
        )
        totals = {kind: [0, 0] for kind in ("exchange", "measurement", "command")}
        rejected = 0
        reported = set()
        for raw in records:
            if not is_counters(raw):
                self._instants(raw)
                continue
            sender, _, counted = decode_counters(raw, self._run)
            reported.add(sender)
            rejected += counted.get("rejected_messages", 0)
            for name in ("forward", "backward", "exchange", "measurement"):
                kind = name if name in totals else "exchange"
                totals[kind][0] += counted.get(f"{name}_received_messages", 0)
                totals[kind][1] += counted.get(f"{name}_received_bytes", 0)
        totals["command"] = [self._links.command.messages, self._links.command.bytes]
        return {
            "ticks": self._done,
            "totals": totals,
            "rejected": rejected,
            "silent": sorted(set(self._config.members) - reported),
            "chain_ns": self._chain_times(),
        }

    def _chain_times(self) -> list[float] | None:
        """Of each tick the longer of both directions in ns, -1 where an instant is missing."""
        ends = self._config.ends
        if ends is None:
            return None
        root, tip = self._chain.get(0, {}), self._chain.get(ends.tip, {})
        out = []
        for tick in range(self._done):
            if tick in root and tick in tip:
                forward = tip[tick][1] - root[tick][0]
                backward = root[tick][1] - tip[tick][0]
                out.append(max(forward, backward))
            else:
                out.append(-1.0)
        return out
