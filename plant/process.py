"""The plant's process: the emulated arm behind n sensors and n actuators, and the clock of a run.

Each tick it sends y_i(k) to every node, waits for every u_i(k+1) and lets the arm move under u(k): in lock-step
as soon as the commands are there, in real time when the monotonic clock says so. When something fails it
degrades before it stops: commands are held, a sweep that does not end is given up, a node that is gone is
left out while it is replaced, and in the end the arm is passive. Its Zenoh session is the router that hands the
nodes' telemetry on to the recorder.
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
from plant.presence import Presence, named
from plant.record import PlantRecord
from wire import session as zsession
from wire.artefact import Arm, Setpoint
from wire.child import Child, Deadline
from wire.errors import ExitCode
from wire.gate import Gate
from wire.keys import Keys
from wire.limits import check_files
from wire.messages import PLANT, Stop, encode_counters, encode_stop, run_tag
from wire.placement import place
from wire.reference import Reference
from wire.run_config import PlantConfig

PROGRESS_NS = 100_000_000
SAFE_TICKS = 20
"""So long an arm that is passive is watched before the run ends."""


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
        active = config.holding_n_per_m[run.setpoint_index]
        self._plant = ArmPlant(
            PlantParameters(
                arm=arm,
                faces_m=run.faces_m,
                tick_s=run.tick_s,
                initial=initial_shape(run.initial, setpoint, arm.length_m),
                disturbance=DisturbanceSpec(**vars(run.disturbance)),
                cells=run.plant_cells,
                model=run.plant_model,
                about=initial_shape("setpoint", setpoint, arm.length_m),
                holding_n_per_m=active,
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
            lenient=run.pace is not None or run.restart,
        )
        self._fade = math.exp(-run.tick_s / run.scheduling.bump_s)
        self._presence = Presence(
            self._exchange, len(run.firsts), child.status, restart=run.restart
        )
        self._passive = False
        """Latched: nothing that a node says counts any more."""
        self._bridged_ticks = 0
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
        gate = Gate("router", links, self._child)
        session = gate.session
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
            gate.close()
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
            zsession.watch_tokens(
                session,
                keys.all_ready,
                self._present,
                self._child.wake,
                self._exchange.vanished,
            )
        )

    def _link(self) -> bool:
        """Wait for every node's token, every link and the launcher's start; False if stopped
        before."""
        told: list[str] | None = None
        ready = False
        self._child.status("up")
        while not self._child.stopping:
            missing = self._exchange.unlinked(self._present)
            if not ready:  # then every link is there
                check_files()
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
                return self._rest(stop, k, self._record.state(k))
            measured, state = self._measure(k), self._record.state(k)
            if stop := self._broken(k, measured, state):
                return stop
            held = exchange.commands.copy()
            started_ns = exchange.send(k, measured)
            self._presence.tell_back(k)
            if stop := self._wait(k) or self._take(k):
                return self._rest(stop, k, state)
            self._record.mark_health(state, exchange.health())
            duration_ns = exchange.complete_ns - started_ns
            advance_ns = self._advance(held, k, state)
            self._add(k, state, (started_ns, started_ns, duration_ns, advance_ns))
        return self._all_done()

    def _wait(self, k: int) -> Stop | None:
        """Wait until every command of tick k is there; the order to stop if that does not
        happen."""
        limit_s = self._config.links.deadline_s
        complete = self._complete_within(limit_s)
        if stop := self._interrupted(k):
            return None if complete else stop
        if complete:
            return None
        text = f"tick {k}: no command within {limit_s:g} s from {named(self._exchange.missing())}"
        return Stop(k, "safety", text)

    def _complete_within(self, seconds: float) -> bool:
        """Wait for the sweep's end, so long at most and not if there is something else to do."""
        deadline = Deadline(seconds)
        while self._exchange.left and not deadline.passed:
            if self._interrupted(self._done):
                break
            if self._exchange.left:
                self._hear(self._child.wait(deadline.left))
        return not self._exchange.left

    # -- the run in real time ---------------------------------------------------------------------

    def _realtime(self, pace: Pace) -> Stop:
        """Run the ticks by the clock; one whose sweep is not over when the next is due makes that one late.

        In a late tick nothing is measured and the commands are held. A sweep that does not end is given up
        after half of the late ticks that are allowed: then every tick has a sweep again, in which the nodes
        bridge what does not come, and the commands of those that are late are held. After more such ticks in a
        row than allowed the arm goes passive.
        """
        exchange = self._exchange
        started_ns, swept = 0, True
        measured, state = self._measure(0), self._record.state(0)
        pace.begin()
        for k in range(self._run.ticks):
            if stop := self._broken(k, measured, state):
                return stop
            if stop := self._until(pace.due_ns(k)):
                return self._rest(stop, k, state, pace)
            if not swept:
                if swept := exchange.complete_by(pace.due_ns(k)):
                    pace.on_time()
                elif not (pace.late() or self._presence.leave_stuck_out(pace, k)):
                    return self._rest(self._too_late(pace, k), k, state, pace)
                elif swept := pace.gives_up:
                    self._bridged_ticks += 1
                if swept and (stop := self._take(exchange.tick)):
                    return self._rest(stop, k, state, pace)
            if swept:
                began_ns = started_ns = exchange.send(k, measured)
                self._presence.tell_back(k)
                swept = False
            else:
                began_ns = pace.due_ns(k)
                self._mark_late(state)
            held = exchange.commands.copy()
            # The emulation has the rest of the period, but a sweep that is still going on has the cores first.
            if stop := self._until(pace.work_at_ns(k), or_complete=True):
                return self._rest(stop, k, state, pace)
            work_ns = monotonic_ns()
            advance_ns = self._advance(held, k, state)
            measured, following = self._measure(k + 1), self._record.state(k + 1)
            pace.worked(monotonic_ns() - work_ns)
            if stop := self._until(pace.due_ns(k + 1), or_complete=True):
                self._record.mark_health(state, exchange.health())
                self._add(k, state, (pace.due_ns(k), began_ns, 0, advance_ns))
                return self._rest(stop._replace(tick=k + 1), k + 1, following, pace)
            done = exchange.complete_by(pace.due_ns(k + 1))
            self._record.mark_health(state, exchange.health())
            duration_ns = exchange.complete_ns - started_ns if done else 0
            self._add(k, state, (pace.due_ns(k), began_ns, duration_ns, advance_ns))
            state = following
        # The last sweep may be late as well; it is let through, so that what was sent is also received.
        if not self._complete_within(max(1, pace.hold_ticks) * pace.period_ns * 1e-9):
            self._bridged_ticks += 1
        stop = self._interrupted(self._done)
        return self._all_done() if stop is None else stop

    def _too_late(self, pace: Pace, k: int) -> Stop:
        exchange = self._exchange
        missing = exchange.missing()
        why = f"has no command from {named(missing)}" if missing else "ended too late"
        text = (
            f"tick {k}: {pace.late_in_a_row} late ticks in a row, {pace.hold_ticks} may be; the sweep of "
            f"tick {exchange.tick} {why}"
        )
        return Stop(k, "safety", text)

    def _rest(self, stop: Stop, k: int, state: Array, pace: Pace | None = None) -> Stop:
        """After a fault: stop the nodes and let the arm rest passively, under the loads that hold the setpoint,
        for some ticks from k on, whose state is given. Returns the stop, which says so.

        Static loads have a potential, so what is left in the arm above its rest can only be damped. What the
        user ended is not a fault.
        """
        if stop.cause != "safety":
            return stop
        self._passive = True
        self._orders.clear()
        name = self._run.setpoint_names[self._exchange.setpoint]
        text = f"{stop.text}; the arm is passive under the loads that hold setpoint {name}"
        stop = Stop(k, "safety", text if stop.text.startswith("tick") else f"tick {k}: {text}")
        self._stop_publisher.put(encode_stop(self._keys.run, stop))
        self._child.status("passive", tick=k, text=stop.text)
        rest = np.asarray(self._config.holding_n_per_m[self._exchange.setpoint])
        for j in range(k, k + SAFE_TICKS):
            began_ns = monotonic_ns() if pace is None else pace.due_ns(j)
            self._mark_late(state)
            self._record.mark_health(state, self._exchange.health())
            advance_ns = self._advance(rest, j, state)
            self._add(j, state, (began_ns, began_ns, 0, advance_ns))
            state = self._record.state(j + 1)
            self._hear(self._child.wait(0.0) if pace is None else [])
            if (pace is not None and self._until(pace.due_ns(j + 1))) or self._orders:
                break
            if self._child.stopping or not np.isfinite(state).all():
                break
        return stop

    def _until(self, at_ns: int, *, or_complete: bool = False) -> Stop | None:
        """Wait for an instant, or for the sweep's end; the order to stop if one comes."""
        exchange = self._exchange
        while (left_ns := at_ns - monotonic_ns()) > 0 and not (or_complete and not exchange.left):
            self._hear(self._child.wait_precisely(left_ns))
            if stop := self._interrupted(self._done):
                return stop
        return self._interrupted(self._done)

    # -- parts of a tick --------------------------------------------------------------------------

    def _measure(self, k: int) -> Array:
        return self._plant.measure() + self._noise.sample(k, self._n)

    def _mark_late(self, state: Array) -> None:
        self._late_ticks += 1
        self._record.mark_late(state)

    def _advance(self, held: Array, k: int, state: Array) -> int:
        """Let the arm move, and note in the tick's state what moves it; how long the emulation took, ns."""
        self._record.mark_guard(state, self._plant.load_potential(held), passive=self._passive)
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
        rest = np.asarray(self._config.holding_n_per_m[self._exchange.setpoint])
        disagreed = self._exchange.take(rest, self._fade)
        if disagreed is None:
            return None
        nodes, said = disagreed
        names = self._run.setpoint_names
        text = (
            f"tick {k}: {named(nodes)}: the next setpoint is {names[said]}, but "
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
        return None if self._passive else self._presence.see_who_is_gone(k)

    def _hear(self, messages: list[dict[str, Any]]) -> None:
        for message in messages:
            if message.get("do") == "gone":
                self._exchange.vanished.add(message["node"])
            # What made the arm passive is reported by several; only the user ends the watch before its time.
            if message.get("do") == "stop" and not (self._passive and message["cause"] == "safety"):
                self._orders.append(Stop(0, message["cause"], message["text"]))

    def _finish(self, stop: Stop) -> None:
        """Tell everybody, send the last records and counters, and stay until the launcher ends
        it."""
        self._stop_publisher.put(encode_stop(self._keys.run, stop))
        self._record.flush(self._done)
        counters = self._exchange.counters() | self._record.flow.report("telemetry_sent")
        counters["late_ticks"] = self._late_ticks
        counters["bridged_ticks"] = self._bridged_ticks
        self._records.put(encode_counters(self._keys.run, self._done, PLANT, counters))
        self._child.status("stopped", tick=stop.tick, cause=stop.cause, text=stop.text)
        ended = self._child.orphaned
        self._child.stopping = ended
        while not (ended or self._child.stopping):
            ended = any(m.get("do") == "end" for m in self._child.wait(None))
