"""The plant's process: the emulated arm behind n sensors and n actuators, and the clock of a
lock-step run.

Each tick it sends y_i(k) to every node, waits for every u_i(k+1), then lets the arm move under
u(k). Its Zenoh session is the router that hands the nodes' telemetry on to the recorder.
"""

from __future__ import annotations

import gc
import math
import traceback
from collections.abc import Callable
from threading import Lock
from time import monotonic_ns
from typing import Any

import msgspec
import numpy as np

from plant.disturbance import DisturbanceSpec
from plant.initial import initial_shape
from plant.model import ArmPlant, Array, PlantParameters
from plant.noise import SensorNoise
from wire import session as zsession
from wire.artefact import Arm, Setpoint
from wire.channels import SHAPE_POINTS, plant_channels, width
from wire.child import Child, Deadline
from wire.counters import Flow, Rejections
from wire.errors import ExitCode
from wire.keys import Keys
from wire.messages import (
    PLANT,
    Kind,
    Reason,
    RejectedError,
    Stop,
    decode_numbers,
    encode_batch,
    encode_counters,
    encode_numbers,
    encode_stop,
    run_tag,
)
from wire.placement import place
from wire.reference import Reference
from wire.run_config import PlantConfig

BATCH_NS = 250_000_000
PROGRESS_NS = 100_000_000


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
        self._reference = Reference.from_plain(config.reference)
        self._shape_at = np.linspace(0.0, arm.length_m, SHAPE_POINTS)
        self._regulated = _regulated_weights(np.asarray(run.faces_m))
        self._setpoint = run.setpoint_index
        """Whose gains the nodes use in this tick, as their last commands say."""
        self._said = [run.setpoint_index] * self._n
        self._lock = Lock()
        self._tick = -1
        """The tick whose commands are being collected."""
        self._commands = list(run.initial_commands_n_per_m)
        self._have = [False] * self._n
        self._left = 0
        self._complete_ns = 0
        self._present: set[int] = set()
        self._publishers: list[Any] = []
        self._keep: list[Any] = []
        self._received = [Flow() for _ in range(self._n)]
        self._sent, self._telemetry = Flow(), Flow()
        self._rejections = Rejections()
        self._rows = np.empty((config.batch_ticks, width(plant_channels(self._n))))
        self._filled = 0
        self._batch_began_ns = 0
        self._orders: list[Stop] = []

    def run(self) -> ExitCode:
        """Link up, wait for the launcher's start, run all ticks, end in order; returns the exit
        code."""
        links = self._config.links
        place(links.cpu, links.fifo, lambda text: self._child.status("note", text=text))
        session = zsession.open_session("router", links.listen, links.connect)
        try:
            self._declare(session)
            if self._link():
                stop = self._ticks()
                self._finish(stop)
        finally:
            self._publishers.clear()
            self._keep.clear()
            session.close()
        return ExitCode.OK

    # -- links ------------------------------------------------------------------------------------

    def _declare(self, session: Any) -> None:
        keys = self._keys
        for i in range(self._n):
            handler = self._receiver(i)
            self._keep.append(session.declare_subscriber(keys.command(i), zsession.direct(handler)))
            self._publishers.append(zsession.control_publisher(session, keys.measurement(i)))
        self._stop_publisher = zsession.control_publisher(session, keys.stop)
        self._records = zsession.telemetry_publisher(session, keys.telemetry(PLANT))
        for publisher in (*self._publishers, self._records):
            self._keep.append(
                publisher.declare_matching_listener(zsession.observe(lambda _: self._child.wake()))
            )
        self._keep.append(
            session.liveliness().declare_subscriber(
                keys.all_ready, zsession.observe(self._presence), history=True
            )
        )

    def _presence(self, sample: Any) -> None:
        index = int(str(sample.key_expr).rsplit("/", 1)[1])
        if zsession.is_put(sample):
            self._present.add(index)
        else:
            self._present.discard(index)
        self._child.wake()

    def _link(self) -> bool:
        """Wait for every node's token, every link and the launcher's start; False if stopped
        before."""
        told: list[str] | None = None
        ready = False
        self._child.status("up")
        while not self._child.stopping:
            missing = [f"node {i}" for i in range(self._n) if i not in self._present]
            missing += [
                f"link to node {i}"
                for i, publisher in enumerate(self._publishers)
                if i in self._present and not zsession.matched(publisher)
            ]
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

    # -- the run ----------------------------------------------------------------------------------

    def _ticks(self) -> Stop:
        """Run the ticks; returns why and where they ended."""
        gc.collect()
        gc.freeze()
        run = self._run
        told_ns = 0
        for k in range(run.ticks):
            if stop := self._interrupted(k):
                return stop
            measured = self._plant.measure() + self._noise.sample(k, self._n)
            row = self._state_row(k)
            if not (math.isfinite(float(measured.sum())) and np.isfinite(row).all()):
                where = self._plant.first_non_finite() or "the plant's measurement is not finite"
                return Stop(k, "safety", f"tick {k}: {where}")
            held = np.array(self._commands)
            started_ns = self._send(k, measured)
            if stop := self._wait(k) or self._agreed(k):
                return stop
            advance_ns = monotonic_ns()
            self._plant.advance(held, k)
            now_ns = monotonic_ns()
            self._record(
                k,
                row,
                started_ns - self._config.links.epoch_ns,
                self._complete_ns - started_ns,
                now_ns - advance_ns,
            )
            if now_ns - told_ns > PROGRESS_NS:
                told_ns = now_ns
                self._child.status("progress", tick=k + 1)
        return Stop(run.ticks, "finished", f"all {run.ticks} ticks done")

    def _send(self, k: int, measured: Array) -> int:
        run, setpoint = self._keys.run, self._setpoint
        messages = [
            encode_numbers(Kind.MEASUREMENT, run, k, PLANT, setpoint, y) for y in measured.tolist()
        ]
        with self._lock:
            self._tick = k
            self._have = [False] * self._n
            self._left = self._n
        started_ns = monotonic_ns()
        for publisher, raw in zip(self._publishers, messages, strict=True):
            publisher.put(raw)
        for raw in messages:
            self._sent.add(raw)
        return started_ns

    def _wait(self, k: int) -> Stop | None:
        """Wait until every command of tick k is there; the order to stop if that does not
        happen."""
        deadline = Deadline(self._config.links.deadline_s)
        while self._left:
            self._hear(self._child.wait(deadline.left))
            if self._left and (stop := self._interrupted(k)):
                return stop
            if self._left and deadline.passed:
                missing = [i for i, have in enumerate(self._have) if not have]
                text = (
                    f"tick {k}: no command within {self._config.links.deadline_s:g} s from "
                    f"{_nodes(missing)}"
                )
                return Stop(k, "safety", text)
        return None

    def _agreed(self, k: int) -> Stop | None:
        """Take over the setpoint of the next tick; the order to stop if the nodes name different ones."""
        self._setpoint = self._said[0]
        other = [i for i, setpoint in enumerate(self._said) if setpoint != self._setpoint]
        if not other:
            return None
        names = self._run.setpoint_names
        text = (
            f"tick {k}: {_nodes(other)}: the next setpoint is {names[self._said[other[0]]]}, but "
            f"{names[self._setpoint]} for node 0"
        )
        return Stop(k, "safety", text)

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
        self._flush(stop.tick)
        counters = (
            {
                "command_received_messages": sum(flow.messages for flow in self._received),
                "command_received_bytes": sum(flow.bytes for flow in self._received),
            }
            | self._sent.report("measurement_sent")
            | self._telemetry.report("telemetry_sent")
            | self._rejections.report()
        )
        self._records.put(encode_counters(self._keys.run, stop.tick, PLANT, counters))
        self._child.status("stopped", tick=stop.tick, cause=stop.cause, text=stop.text)
        ended = self._child.orphaned
        self._child.stopping = ended
        while not (ended or self._child.stopping):
            ended = any(m.get("do") == "end" for m in self._child.wait(None))

    # -- records ----------------------------------------------------------------------------------

    def _state_row(self, k: int) -> Array:
        """Everything about the arm at the start of a tick, in the order of `plant_channels`."""
        truth = self._plant.truth()
        tip = self._plant.tip()
        *wanted, wanted_v, wanted_k = self._reference.at(k).tolist()
        error = float(np.hypot(*(tip - wanted)))
        means = [
            float(self._regulated[0] @ truth[:, 1]) - wanted_v,
            float(self._regulated[1] @ truth[:, 3]) - wanted_k,
        ]
        shape = self._plant.shape_at(self._shape_at)
        energy = self._plant.energy()
        parts = (truth.ravel(), tip, [error], wanted, energy, means, shape.ravel())
        return np.concatenate(parts)

    def _record(self, tick: int, row: Array, *timing: int) -> None:
        if self._filled == 0:
            self._batch_began_ns = monotonic_ns()
        target = self._rows[self._filled]
        target[: row.size] = row
        target[row.size :] = timing
        self._filled += 1
        age_ns = monotonic_ns() - self._batch_began_ns
        if self._filled == len(self._rows) or age_ns > BATCH_NS:
            self._flush(tick + 1)

    def _flush(self, next_tick: int) -> None:
        if self._filled:
            rows = self._rows[: self._filled]
            raw = encode_batch(self._keys.run, next_tick - self._filled, PLANT, rows)
            self._records.put(raw)
            self._telemetry.add(raw)
            self._filled = 0

    # -- Zenoh's thread ---------------------------------------------------------------------------

    def _check(self, tick: int, index: int) -> None:
        """Refuse a command that is not this tick's first from its node."""
        if tick != self._tick:
            reason = Reason.STALE if tick < self._tick else Reason.EARLY
            raise RejectedError(reason, f"expected tick {self._tick}, got {tick}")
        if self._have[index]:
            raise RejectedError(Reason.DUPLICATE, f"tick {tick} has the command of node {index}")

    def _receiver(self, index: int) -> Callable[[bytes], None]:
        run, lengths = self._keys.run, [1] * len(self._run.setpoint_names)

        def receive(raw: bytes) -> None:
            try:
                message = decode_numbers(raw, Kind.COMMAND, run, index, lengths)
                with self._lock:
                    self._check(message.tick, index)
                    self._have[index] = True
                    self._commands[index] = message.values[0]
                    self._said[index] = message.setpoint
                    self._received[index].add(raw)
                    if self._left == 1:
                        self._complete_ns = monotonic_ns()
                    self._left -= 1
                    done = not self._left
            except RejectedError as error:
                self._rejections.add(error.reason)
                return
            except Exception:
                traceback.print_exc()
                return
            if done:
                self._child.wake()

        return receive


def _regulated_weights(faces: Array) -> Array:
    """Row weights (2, n) of the means over the arm of v_y (outer faces) and of the curvature (inner
    faces)."""
    middle = 0.5 * (faces[1:] + faces[:-1])
    outer = np.diff(np.append(middle, faces[-1]))
    inner = np.diff(np.concatenate(([faces[0]], middle)))
    return np.asarray(np.stack([outer, inner]) / (faces[-1] - faces[0]))


def _nodes(indices: list[int]) -> str:
    shown = ", ".join(map(str, indices[:12]))
    more = f" and {len(indices) - 12} more" if len(indices) > 12 else ""
    return f"node{'s' if len(indices) > 1 else ''} {shown}{more}"
