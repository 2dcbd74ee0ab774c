"""The plant's process: the emulated arm behind n sensors and n actuators, and the clock of a run.

Each tick it sends y_i(k) to every node, waits for every u_i(k+1) and lets the arm move under u(k): in lock-step
as soon as the commands are there, in real time when the monotonic clock says so. Its Zenoh session is the
router that hands the nodes' telemetry on to the recorder.
"""

from __future__ import annotations

import gc
import math
from time import monotonic_ns
from typing import Any

import msgspec
import numpy as np

from plant.disturbance import DisturbanceSpec
from plant.exchange import Exchange
from plant.initial import initial_shape
from plant.model import ArmPlant, Array, PlantParameters
from plant.noise import SensorNoise
from plant.pace import Pace
from plant.record import PlantRecord
from wire import session as zsession
from wire.artefact import Arm, Setpoint
from wire.child import Child, Deadline
from wire.errors import ExitCode
from wire.keys import Keys
from wire.messages import PLANT, Stop, encode_counters, encode_stop, run_tag
from wire.placement import place
from wire.reference import Reference
from wire.run_config import PlantConfig

PROGRESS_NS = 100_000_000
SAFE_TICKS = 20
"""So long an arm that went safe is watched before the run ends."""


class PlantProcess:
    """The plant from its configuration to its exit code; `run` does everything."""

    def __init__(self, config: PlantConfig, child: Child) -> None:
        self._config = config
        self._child = child
        run = self._run = config.run
        self._n = run.nodes
        self._keys = Keys(run_tag(run.run_id))
        arm = msgspec.convert(config.arm, Arm)
        setpoint = msgspec.convert(config.setpoint, Setpoint)
        self._plant = ArmPlant(
            PlantParameters(
                arm=arm,
                faces_m=run.faces_m,
                tick_s=run.tick_s,
                initial=initial_shape(run.initial, setpoint, arm.length_m),
                disturbance=DisturbanceSpec(**vars(run.disturbance)),
                cells=run.plant_cells,
            )
        )
        self._noise = SensorNoise(run.seed, run.noise.velocity_y_m_per_s, run.noise.curvature_per_m)
        self._record = PlantRecord(
            self._plant,
            np.asarray(run.faces_m),
            Reference.from_plain(config.reference),
            self._keys.run,
            config.batch_ticks,
        )
        self._exchange = Exchange(
            self._keys,
            run.firsts,
            run.initial_commands_n_per_m,
            len(run.setpoint_names),
            run.setpoint_index,
            child.wake,
        )
        self._present: set[int] = set()
        self._keep: list[Any] = []
        self._orders: list[Stop] = []
        self._told_ns = 0
        self._done = 0
        """Ticks that are recorded."""
        self._late_ticks = 0

    def run(self) -> ExitCode:
        """Link up, wait for the launcher's start, run all ticks, end in order; returns the exit
        code."""
        links = self._config.links
        place(links.cpu, links.fifo, lambda text: self._child.status("note", text=text))
        session = zsession.open_session("router", links.listen, links.connect)
        try:
            self._declare(session)
            if self._link():
                pace = None if self._run.pace is None else Pace(self._run.pace)
                gc.collect()
                gc.freeze()
                gc.disable()  # a collection in the middle of a tick would be late for it
                stop = self._lockstep() if pace is None else self._realtime(pace)
                self._finish(stop)
        finally:
            self._exchange.publishers.clear()
            self._keep.clear()
            session.close()
        return ExitCode.OK

    # -- links ------------------------------------------------------------------------------------

    def _declare(self, session: Any) -> None:
        keys = self._keys
        self._keep += self._exchange.declare(session)
        self._stop_publisher = zsession.control_publisher(session, keys.stop)
        self._records = zsession.telemetry_publisher(session, keys.telemetry(PLANT))
        self._record.send_on(self._records)
        for publisher in (*self._exchange.publishers, self._records):
            self._keep.append(
                publisher.declare_matching_listener(zsession.observe(lambda _: self._child.wake()))
            )
        self._keep.append(
            zsession.watch_tokens(session, keys.all_ready, self._present, self._child.wake)
        )

    def _link(self) -> bool:
        """Wait for every node's token, every link and the launcher's start; False if stopped
        before."""
        told: list[str] | None = None
        ready = False
        self._child.status("up")
        while not self._child.stopping:
            missing = self._exchange.unlinked(self._present)
            if not zsession.matched(self._records):
                missing.append("recorder")
            if missing != told:
                self._child.status("waiting", missing=missing[:20])
                told = missing
            if not missing and not ready:
                ready = True
                self._child.status("ready")
            for message in self._child.wait(1.0):
                if message.get("do") == "start":
                    return True
                if message.get("do") == "stop":
                    return False
        return False

    # -- the run, as fast as it goes --------------------------------------------------------------

    def _lockstep(self) -> Stop:
        """Run the ticks, each as soon as the one before is complete; returns why and where they ended."""
        exchange = self._exchange
        for k in range(self._run.ticks):
            if stop := self._interrupted(k):
                return stop
            measured, state = self._measure(k), self._record.state(k)
            if stop := self._broken(k, measured, state):
                return stop
            held = exchange.commands.copy()
            started_ns = exchange.send(k, measured)
            if stop := self._wait(k) or self._take(k):
                return stop
            duration_ns = exchange.complete_ns - started_ns
            advance_ns = self._advance(held, k)
            self._add(k, state, (started_ns, started_ns, duration_ns, advance_ns))
        return self._all_done()

    def _wait(self, k: int) -> Stop | None:
        """Wait until every command of tick k is there; the order to stop if that does not
        happen."""
        exchange, deadline = self._exchange, Deadline(self._config.links.deadline_s)
        while exchange.left:
            self._hear(self._child.wait(deadline.left))
            if exchange.left and (stop := self._interrupted(k)):
                return stop
            if exchange.left and deadline.passed:
                text = (
                    f"tick {k}: no command within {self._config.links.deadline_s:g} s from "
                    f"{_nodes(exchange.missing())}"
                )
                return Stop(k, "safety", text)
        return None

    # -- the run in real time ---------------------------------------------------------------------

    def _realtime(self, pace: Pace) -> Stop:
        """Run the ticks by the clock; one whose sweep is not over when the next is due makes that one late.

        In a late tick nothing is measured and the commands are held. After more late ticks in a row than
        allowed the arm goes safe.
        """
        exchange = self._exchange
        started_ns, swept = 0, True
        measured, state = self._measure(0), self._record.state(0)
        pace.begin()
        for k in range(self._run.ticks):
            if stop := self._until(pace.due_ns(k)) or self._broken(k, measured, state):
                return stop
            if not swept and exchange.complete_by(pace.due_ns(k)):
                swept = True
                if stop := self._take(exchange.tick):
                    return stop
            if swept:
                pace.on_time()
                began_ns = started_ns = exchange.send(k, measured)
                swept = False
            else:
                began_ns = pace.due_ns(k)
                self._mark_late(state)
                if not pace.late():
                    return self._safe(pace, k, state)
            held = exchange.commands.copy()
            # The emulation has the rest of the period, but a sweep that is still going on has the cores first.
            if stop := self._until(pace.work_at_ns(k), or_complete=True):
                return stop
            work_ns = monotonic_ns()
            advance_ns = self._advance(held, k)
            measured, following = self._measure(k + 1), self._record.state(k + 1)
            pace.worked(monotonic_ns() - work_ns)
            if stop := self._until(pace.due_ns(k + 1), or_complete=True):
                return stop
            done = exchange.complete_by(pace.due_ns(k + 1))
            duration_ns = exchange.complete_ns - started_ns if done else 0
            self._add(k, state, (pace.due_ns(k), began_ns, duration_ns, advance_ns))
            state = following
        # The last sweep may be late as well; it is let through, so that what was sent is also received.
        stop = self._wait(exchange.tick)
        return self._all_done() if stop is None else stop._replace(tick=self._done)

    def _safe(self, pace: Pace, k: int, state: Array) -> Stop:
        """Stop the nodes and let the arm rest under the loads that hold the setpoint, for some ticks."""
        exchange = self._exchange
        name = self._run.setpoint_names[exchange.setpoint]
        text = (
            f"tick {k}: {pace.late_in_a_row} late ticks in a row, {pace.hold_ticks} may be; the sweep of "
            f"tick {exchange.tick} has no command from {_nodes(exchange.missing())}; the arm is safe under "
            f"the loads that hold setpoint {name}"
        )
        stop = Stop(k, "safety", text)
        self._stop_publisher.put(encode_stop(self._keys.run, stop))
        rest = np.asarray(self._config.holding_n_per_m[exchange.setpoint])
        for j in range(k, k + SAFE_TICKS):
            advance_ns = self._advance(rest, j)
            self._add(j, state, (pace.due_ns(j), pace.due_ns(j), 0, advance_ns))
            state = self._record.state(j + 1)
            self._mark_late(state)
            if self._until(pace.due_ns(j + 1)) or not np.isfinite(state).all():
                break
        return stop

    def _until(self, at_ns: int, *, or_complete: bool = False) -> Stop | None:
        """Wait for an instant, or for the sweep's end; the order to stop if one comes."""
        exchange = self._exchange
        while (left_ns := at_ns - monotonic_ns()) > 0 and not (or_complete and not exchange.left):
            self._hear(self._child.wait_precisely(left_ns))
            if self._orders or self._child.stopping:
                break
        return self._interrupted(self._done)

    # -- parts of a tick --------------------------------------------------------------------------

    def _measure(self, k: int) -> Array:
        return self._plant.measure() + self._noise.sample(k, self._n)

    def _mark_late(self, state: Array) -> None:
        self._late_ticks += 1
        self._record.mark_late(state)

    def _advance(self, held: Array, k: int) -> int:
        """Let the arm move; how long the emulation took, ns."""
        began_ns = monotonic_ns()
        self._plant.advance(held, k)
        return monotonic_ns() - began_ns

    def _add(self, k: int, state: Array, timing: tuple[int, int, int, int]) -> None:
        """Record a tick: instants due and begun, then how long sweep and emulation took."""
        due_ns, began_ns, sweep_ns, advance_ns = timing
        epoch_ns = self._config.links.epoch_ns or 0
        self._record.add(k, state, (due_ns - epoch_ns, began_ns - epoch_ns, sweep_ns, advance_ns))
        self._done = k + 1
        if began_ns - self._told_ns > PROGRESS_NS:
            self._told_ns = began_ns
            self._exchange.settle()
            self._child.status("progress", tick=k + 1)

    def _broken(self, k: int, measured: Array, state: Array) -> Stop | None:
        """The order to stop if a number of the arm is not finite."""
        if math.isfinite(float(measured.sum())) and np.isfinite(state).all():
            return None
        where = self._plant.first_non_finite() or "the plant's measurement is not finite"
        return Stop(k, "safety", f"tick {k}: {where}")

    def _take(self, k: int) -> Stop | None:
        """Take over the commands and the setpoint of the next tick; the order to stop if the nodes name
        different ones."""
        disagreed = self._exchange.take()
        if disagreed is None:
            return None
        nodes, said = disagreed
        names = self._run.setpoint_names
        text = (
            f"tick {k}: {_nodes(nodes)}: the next setpoint is {names[said]}, but "
            f"{names[self._exchange.said_first]} for node 0"
        )
        return Stop(k, "safety", text)

    def _all_done(self) -> Stop:
        ticks = self._run.ticks
        return Stop(ticks, "finished", f"all {ticks} ticks done")

    def _interrupted(self, k: int) -> Stop | None:
        """The order to stop that the launcher gave, if any."""
        if self._orders:
            return self._orders[0]._replace(tick=k)
        if self._child.stopping:
            return Stop(k, "interrupted", "the plant was told to stop")
        return None

    def _hear(self, messages: list[dict[str, Any]]) -> None:
        for message in messages:
            if message.get("do") == "stop":
                self._orders.append(Stop(0, message["cause"], message["text"]))

    def _finish(self, stop: Stop) -> None:
        """Tell everybody, send the last records and counters, and stay until the launcher ends
        it."""
        self._stop_publisher.put(encode_stop(self._keys.run, stop))
        self._record.flush(self._done)
        counters = self._exchange.counters() | self._record.flow.report("telemetry_sent")
        counters["late_ticks"] = self._late_ticks
        self._records.put(encode_counters(self._keys.run, self._done, PLANT, counters))
        self._child.status("stopped", tick=stop.tick, cause=stop.cause, text=stop.text)
        ended = self._child.orphaned
        self._child.stopping = ended
        while not (ended or self._child.stopping):
            ended = any(m.get("do") == "end" for m in self._child.wait(None))


def _nodes(indices: list[int]) -> str:
    shown = ", ".join(map(str, indices[:12]))
    more = f" and {len(indices) - 12} more" if len(indices) > 12 else ""
    plural = "nodes" if len(indices) > 1 else "node"
    return f"{plural} {shown}{more}"
