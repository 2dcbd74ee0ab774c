"""A frame of the page: everything about the newest tick that plant and nodes have in common, in plain numbers.

From `live.rows` to the JSON of an event. What a node is, alive, on time
and valid, is what the plant says. Positions in m, rounded to what a screen can show; what has not come
is None. The running figures (sweep durations, ticks a second, late ticks) are of the rows that came while
somebody watched.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from time import monotonic
from typing import Any

import numpy as np

from live.latency import C, D, Instants, Y
from live.rows import NEVER, Array, Ints, RecentRows
from wire.channels import (
    BATCH_NS,
    DEGRADED,
    SHAPE_POINTS,
    STATE,
    Degraded,
    Health,
    columns_of,
    label,
)
from wire.joints import Joints
from wire.link_latency import MESSAGES, link_kinds, link_latencies
from wire.messages import PLANT, Batch
from wire.run_config import LiveConfig

WINDOW_S = 5.0
"""Running figures are those of the last so many seconds."""
STUCK_S = 1.0
"""After so long without a tick of everybody the plant's newest is shown, with what the nodes last said."""
SLACK_S = 4e-9 * BATCH_NS
"""What the plant says of the nodes is of now if it is no older than this and two periods: a batch waits a
quarter of that."""
_BRIDGED = int(Degraded.FORWARD_BRIDGED | Degraded.BACKWARD_BRIDGED)
CURVATURE = STATE.index("curvature_per_m")
METRES, CURVATURES, NUMBERS = 5, 4, 6
"""Decimals of positions, decimals of curvatures, significant digits of errors."""


class FrameMaker:
    """Takes batches and makes frames; one thread."""

    def __init__(self, config: LiveConfig) -> None:
        run = self._run = config.run
        self.rows = RecentRows(
            run.nodes, config.forward_widths, config.backward_widths, config.replay_from
        )
        self._period_s = config.period_s
        self._joints = Joints(config.forward_widths, config.tip)
        self._instants = Instants(self.rows)
        kinds = link_kinds(run.nodes, run.firsts, frozenset(config.elsewhere))
        self._links = [kind == MESSAGES for kind in kinds]
        self._onto_faces = lagrange(np.asarray(run.faces_m) / run.faces_m[-1], SHAPE_POINTS)
        self._weights = np.asarray(run.energy_weights)
        self._firsts: dict[int, Array] = {}
        self._first_energy = 0.0
        plant, root = self.rows.layout[PLANT], self.rows.layout[0]
        self._tip, self._shape = columns_of(plant, "/plant/tip"), columns_of(plant, "/plant/shape")
        self._late = columns_of(plant, "/plant/pace").start
        self._health_at = columns_of(plant, "/plant/health")
        self._passive = columns_of(plant, "/plant/guard", "passive").start
        self._began, self._took = (
            columns_of(plant, "/sweep/timing", f"{name}_wall_ns").start
            for name in ("started", "duration")
        )
        # before the sums every node's row is the same
        node = f"/node/{label(0, run.nodes)}"
        self._estimate = columns_of(root, f"{node}/estimate")
        self._setpoint = columns_of(root, f"{node}/schedule", "setpoint").start
        self._sweeps: deque[tuple[Array, Array, int]] = deque()
        """Instants begun in ns, durations in ns, first tick: of the batches of the last seconds."""
        self._since = self._counted = NEVER
        self._moved_at = monotonic()
        self._seen = self._late_ticks = 0
        self._rejected, self._lateness, self._bridged = (
            np.zeros(run.nodes, dtype=np.int64) for _ in range(3)
        )
        self._well = np.full(run.nodes, -1, dtype=np.int64)
        """What the plant has said of each node in all of the ticks since the last frame."""
        self._judged = NEVER
        self._passive_at = NEVER
        """The newest tick that a frame has shown of a passive arm."""
        self._trouble_at = np.full(run.nodes, -math.inf)

    # -- what comes -------------------------------------------------------------------------------

    def add(self, batch: Batch) -> None:
        """Take a batch of rows."""
        if batch.tick == 0:
            self._note_first(batch)
        again = self.rows.begins_again(batch)
        if not self.rows.add(batch):
            return
        if batch.sender != PLANT:
            flags = batch.rows[:, -len(DEGRADED)].astype(np.int64)
            self._bridged[batch.sender] += np.count_nonzero(flags & _BRIDGED)
            return
        self._judge(batch.rows[:, self._health_at].astype(np.int64))
        if again:
            self._sweeps.clear()
            self._since = self._counted = NEVER
        rows = batch.rows
        self._seen += len(rows)
        self._late_ticks += int(rows[:, self._late].sum())
        began, took = rows[:, self._began].copy(), rows[:, self._took].copy()
        self._sweeps.append((began, took, batch.tick))
        while self._sweeps[0][0][-1] < began[-1] - 1e9 * WINDOW_S:
            self._sweeps.popleft()

    def _judge(self, health: Ints) -> None:
        """Take what the plant says of the nodes in some ticks, (ticks, n)."""
        self._well &= np.bitwise_and.reduce(health, axis=0)
        self._lateness += np.count_nonzero(~health & int(Health.ON_TIME), axis=0)
        self._trouble_at[np.any(~health & int(Health.VALID), axis=0)] = monotonic()

    def refused(self, sender: int, messages: int = 1) -> None:
        """Telemetry of this sender, or messages to it, were refused."""
        if 0 <= sender < self._run.nodes and messages:
            self._rejected[sender] += messages
            self._trouble_at[sender] = monotonic()

    def resume(self) -> None:
        """Rows come from now on; nothing has come for a while, which is nobody's fault."""
        self.rows.arrived_s[:] = -math.inf
        self._sweeps.clear()
        self._since = self._counted = int(self.rows.newest[-1])
        self._moved_at = monotonic()

    @property
    def awaits_first(self) -> bool:
        """Whether rows of tick 0 are missing, to which the estimation error is related."""
        return len(self._firsts) <= self._run.nodes

    def _note_first(self, batch: Batch) -> None:
        self._firsts[batch.sender] = batch.rows[0].copy()
        if not self.awaits_first:
            self._first_energy = self._energy(self._firsts)

    # -- what goes --------------------------------------------------------------------------------

    def frame(self, started_ns: float | None, *, running: bool) -> dict[str, Any] | None:
        """The frame of now; None while there is nothing new.

        started_ns: about when the run began, on the clock and from the epoch of the telemetry, for want of the
        first tick. running: whether something should come, so that it is told when nothing does.
        """
        rows, now = self.rows, monotonic()
        ticks = rows.complete(after=self._since)
        fresh = ticks[ticks > self._counted]
        passive = rows.newest[-1] != NEVER and bool(rows.of(PLANT, rows.newest[-1])[self._passive])
        if fresh.size:
            self._counted, self._moved_at = int(fresh[-1]), now
        elif passive and rows.newest[-1] != self._passive_at:
            self._passive_at = int(rows.newest[-1])  # the nodes have stopped: nobody waits for them
        elif not running or now - self._moved_at < STUCK_S or rows.newest[-1] == NEVER:
            return None
        if fresh.size:
            tick = said = self._counted
        else:
            tick, said = int(rows.newest[-1]), int(rows.newest[:-1].min())
        of = rows.last if not fresh.size else (lambda sender: rows.of(sender, tick))
        own = {i: row for i in range(self._run.nodes) if (row := of(i)) is not None}
        truth = rows.of(PLANT, tick)
        shape = truth[self._shape].reshape(-1, 2)
        joints = self._joints.points(said, {i: row.tolist() for i, row in own.items()})
        x, y, error, wanted_x, wanted_y = truth[self._tip].tolist()
        frame: dict[str, Any] = {
            "tick": tick,
            "time_s": round(tick * self._run.tick_s, 6),
            "setpoint": int(own[0][self._setpoint]) if 0 in own else None,
            "late": bool(truth[self._late]),
            "passive": passive,
            "late_ticks": self._late_ticks,
            "ticks_seen": self._seen,
            "tip": [_metres(x), _metres(y)],
            "reference": [_metres(wanted_x), _metres(wanted_y)],
            "tip_error_m": _significant(error),
            "shape": _listed(shape, METRES),
            "joints": None if joints is None else _listed(np.asarray(joints), METRES),
            "estimate_tick": said,
            "curvature": _listed(self._states(truth)[:, CURVATURE], CURVATURES),
            "curvature_estimate": [
                round(float(own[i][self._estimate][CURVATURE]), CURVATURES) if i in own else None
                for i in range(self._run.nodes)
            ],
            "links": self._latencies(ticks),
            "nodes": self._health(now),
        }
        if PLANT in self._firsts:
            started_ns = self._firsts[PLANT][self._began]
        if started_ns is not None:
            frame["wall_s"] = round(float(truth[self._began] - started_ns) * 1e-9, 4)
        if fresh.size and joints is not None:
            frame |= self._apart(np.asarray(joints), shape, {**own, PLANT: truth})
        return frame | self._rates()

    def _apart(self, joints: Array, shape: Array, rows: Mapping[int, Array]) -> dict[str, Any]:
        """How far the estimate is from the truth, in m (rms over the joints) and in the energy norm."""
        squares = np.sum((joints - self._onto_faces @ shape)[1:] ** 2, axis=1)
        apart = {"estimation_error_m": _significant(float(np.sqrt(np.mean(squares))))}
        if self._first_energy > 0.0:
            ratio = math.sqrt(self._energy(rows) / self._first_energy)
            apart["estimation_error"] = _significant(ratio)
        return apart

    def _energy(self, rows: Mapping[int, Array]) -> float:
        """Energy in J of estimate less truth, from everybody's rows of one tick."""
        estimates = np.stack([rows[i][self._estimate] for i in range(self._run.nodes)])
        return float(np.sum(self._weights * (estimates - self._states(rows[PLANT])) ** 2))

    def _states(self, truth: Array) -> Array:
        """(n, 4) the exact state where the nodes hold theirs, from the plant's row."""
        return truth[: self._weights.size].reshape(-1, len(STATE))

    def _rates(self) -> dict[str, Any]:
        """Of the last seconds: ticks a second, durations of the sweeps that ended."""
        none = {"ticks_per_s": None, "sweep_p50_ms": None, "sweep_p99_ms": None, "sweeps": 0}
        if not self._sweeps:
            return none
        first, last = self._sweeps[0], self._sweeps[-1]
        span_s = (last[0][-1] - first[0][0]) * 1e-9
        ticks = last[2] + len(last[0]) - 1 - first[2]
        took = np.concatenate([durations for _, durations, _ in self._sweeps])
        took = took[took > 0.0]
        if span_s <= 0.0 or not took.size:
            return none
        p50, p99 = (np.percentile(took, (50.0, 99.0)) * 1e-6).tolist()
        return {
            "ticks_per_s": _significant(ticks / span_s),
            "sweep_p50_ms": _significant(p50),
            "sweep_p99_ms": _significant(p99),
            "sweeps": int(took.size),
        }

    def _latencies(self, ticks: Ints) -> dict[str, Any]:
        """Median and longest of each link in microseconds, over the ticks that are here and whole."""
        ticks = self._instants.came(ticks)
        unknown: list[float | None] = [None] * (self._run.nodes - 1)
        names = ("forward_us", "forward_most_us", "backward_us", "backward_most_us")
        if not ticks.size:
            return dict.fromkeys(names, unknown) | {"ticks": 0}
        out: dict[str, Any] = {"ticks": int(ticks.size)}
        instants = self._instants.at(ticks)
        found = link_latencies(*(instants[:, :, which] for which in (Y, C, D)))
        for name, latencies in (("forward", found.forward_ns), ("backward", found.backward_ns)):
            for word, figures in (
                ("us", np.median(latencies, axis=0)),
                ("most_us", latencies.max(axis=0)),
            ):
                out[f"{name}_{word}"] = [
                    round(figure * 1e-3, 1) if known else None
                    for figure, known in zip(figures.tolist(), self._links, strict=True)
                ]
        return out

    def _health(self, now: float) -> dict[str, Any]:
        """What the plant says of each node, in all of the ticks since the last frame, and its own rows."""
        rows = self.rows
        age = now - rows.arrived_s[:-1]
        here = np.isfinite(age)
        well, self._well = self._well, np.full(self._run.nodes, -1, dtype=np.int64)
        newest = rows.newest[-1]
        if newest != NEVER:  # so that a frame without news of the plant says what the last one said
            well = well & rows.of(PLANT, newest)[self._health_at].astype(np.int64)
        news = now - rows.arrived_s[-1] <= SLACK_S + 2.0 * self._period_s
        latest = [rows.last(i) for i in range(self._run.nodes)]
        return {
            "alive": ((well & int(Health.ALIVE)) != 0).tolist(),
            "flags": [0 if row is None else int(row[-len(DEGRADED)]) for row in latest],
            "bridged": self._bridged.tolist(),
            "tick": self.rows.newest[:-1].tolist(),
            "age_s": [
                round(a, 2) if h else None for a, h in zip(age.tolist(), here.tolist(), strict=True)
            ],
            "on_time": (news & ((well & int(Health.ON_TIME)) != 0)).tolist(),
            "rejected": self._rejected.tolist(),
            "late": self._lateness.tolist(),
            "valid": (now - self._trouble_at > WINDOW_S).tolist(),
        }


def lagrange(places: Array, points: int) -> Array:
    """The matrix (len(places), points) that takes values at equally spaced points of [0, 1] to `places`.

    Cubic through the four points around each place: exact for polynomials up to the third degree.
    """
    out = np.zeros((len(places), points))
    for row, place in zip(out, np.clip(places, 0.0, 1.0) * (points - 1), strict=True):
        first = min(max(int(place) - 1, 0), points - 4)
        near = range(first, first + 4)
        for j in near:
            row[j] = math.prod((place - m) / (j - m) for m in near if m != j)
    return out


def _listed(numbers: Array, decimals: int) -> list[float]:
    listed: list[float] = np.round(numbers, decimals).ravel().tolist()
    return listed


def _metres(value: float) -> float:
    return round(value, METRES)


def _significant(value: float) -> float:
    return float(f"{value:.{NUMBERS}g}")
