"""Runs in real time by a clock of the test's own: what is late, what is held, when the arm goes safe."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from heapq import heappop, heappush
from itertools import count, pairwise
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from closed_form import artefact
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from deploy import SegmentGrid, deploy
from deploy.path import make_references
from plant.pace import LEAD_NS, Pace
from plant.process import SAFE_TICKS, PlantProcess
from wire.channels import WELL, Health, plant_channels, width
from wire.child import Child
from wire.keys import Keys
from wire.messages import (
    PLANT,
    Kind,
    Stop,
    decode_batch,
    decode_counters,
    decode_numbers,
    decode_stop,
    encode_numbers,
    run_tag,
)
from wire.run_config import (
    DisturbanceConfig,
    LinkConfig,
    NoiseConfig,
    PaceConfig,
    PlantConfig,
    RunConfig,
    SchedulingConfig,
)

Array = npt.NDArray[np.float64]
RUN = run_tag("r")
KEYS = Keys(RUN)
NODES, TICKS, HOLD = 3, 14, 2
PERIOD_NS = 10_000_000
EPOCH_NS = 500
QUICK_NS = 1_000_000
FIELDS = [(channel.topic, name) for channel in plant_channels(NODES) for name in channel.fields]
GAINS = artefact()
DEPLOYMENT = deploy(GAINS, NODES, 0.05)


def plant_config(ticks: int, hold: int) -> PlantConfig:
    starts = DEPLOYMENT.nodes
    run = RunConfig(
        run_id="r",
        scenario="s",
        nodes=NODES,
        spacing="equispaced",
        faces_m=tuple(DEPLOYMENT.faces_m.tolist()),
        tick_s=0.05,
        ticks=ticks,
        seed=1,
        setpoint="1",
        setpoint_names=DEPLOYMENT.setpoint_names,
        first_hold_s=0.0,
        legs=(),
        scheduling=SchedulingConfig((1,), (), 1.0, 1.0),
        control=True,
        initial="setpoint",
        disturbance=DisturbanceConfig(),
        noise=NoiseConfig(1e-5, 1e-4),
        plant_cells=12,
        artefact_path="p",
        artefact_sha256="0",
        initial_estimates=tuple(tuple(f.initial_estimate[1].tolist()) for f in starts),
        initial_commands_n_per_m=tuple(float(f.initial_command[1]) for f in starts),
        energy_weights=((1.0,) * 4,) * NODES,
        segments_per_process=1,
        pace=PaceConfig(PERIOD_NS * 1e-9, hold),
    )
    references = make_references(GAINS, SegmentGrid(DEPLOYMENT.faces_m), run.tick_s, "1")
    return PlantConfig(
        run=run,
        arm=msgspec.to_builtins(GAINS.arm),
        setpoint=msgspec.to_builtins(GAINS.setpoints[1]),
        reference=references.plant.to_plain(),
        holding_n_per_m=tuple(tuple(float(f.initial_command[i]) for f in starts) for i in range(2)),
        batch_ticks=4,
        links=LinkConfig((), (), None, 2.0, EPOCH_NS, None, None),
    )


class World(Child):
    """The clock, the launcher, and what happens when; it is the plant's session as well."""

    def __init__(self) -> None:
        super().__init__("plant", control=-1, status=-1, directory=None)
        self.now_ns = 7_000_000
        self.sent: list[tuple[str, bytes]] = []
        self.on_put: Callable[[str, bytes], None] = lambda _, __: None
        self.handlers: dict[str, Callable[[bytes], None]] = {}
        self._events: list[tuple[int, int, Callable[[], list[dict[str, Any]]]]] = []
        self._number = count()

    def at(self, at_ns: int, happens: Callable[[], list[dict[str, Any]]]) -> None:
        heappush(self._events, (at_ns, next(self._number), happens))

    def pass_time(self, nanoseconds: int) -> None:
        """The plant is busy; messages come meanwhile."""
        end_ns = self.now_ns + nanoseconds
        while self._events and self._events[0][0] <= end_ns:
            at_ns, _, happens = heappop(self._events)
            self.now_ns = max(self.now_ns, at_ns)
            assert happens() == []
        self.now_ns = end_ns

    # -- the child

    def wait_precisely(self, nanoseconds: int) -> list[dict[str, Any]]:
        end_ns = self.now_ns + max(0, nanoseconds)
        if self._events and self._events[0][0] <= end_ns:
            at_ns, _, happens = heappop(self._events)
            self.now_ns = max(self.now_ns, at_ns)
            return happens()
        self.now_ns = end_ns
        return []

    def wait(self, seconds: float | None) -> list[dict[str, Any]]:
        if seconds is None:
            return [{"do": "end"}]
        return self.wait_precisely(int(seconds * 1e9))

    def status(self, event: str, **fields: Any) -> None:
        """Nobody listens."""

    # -- the session

    def declare_subscriber(self, key: str, handler: Callable[[bytes], None], **_: Any) -> None:
        self.handlers[key] = handler

    def declare_publisher(self, key: str, **_: Any) -> SimpleNamespace:
        def put(raw: bytes) -> None:
            self.sent.append((key, raw))
            self.on_put(key, raw)

        return SimpleNamespace(put=put, declare_matching_listener=lambda _: None)

    def liveliness(self) -> World:
        return self


class Run:
    """A plant whose nodes answer tick k after `delays_ns[k]` (None: never); u(k + 1) of node i is that of the
    start and 1e-6 (10 k + i) more."""

    def __init__(
        self,
        delays_ns: Mapping[int, int | None],
        *,
        ticks: int = TICKS,
        hold: int = HOLD,
        work_ns: int = 300_000,
        order: tuple[int, str] | None = None,
    ) -> None:
        self.world = World()
        self.delays_ns = delays_ns
        self.measured: list[int] = []
        """Ticks that were sent to the nodes."""
        self.held: list[Array] = []
        """What the arm moved under, tick by tick."""
        self.kept: list[int] = []
        """Messages that were kept for counting, tick by tick."""
        config = plant_config(ticks, hold)
        self.start = np.array(config.run.initial_commands_n_per_m)
        self.rest = np.array(config.holding_n_per_m[1])
        self.world.on_put = self._answer
        with pytest.MonkeyPatch.context() as patch:
            for module in ("plant.process", "plant.pace", "plant.exchange", "plant.record"):
                patch.setattr(f"{module}.monotonic_ns", lambda: self.world.now_ns)
            for name in ("direct", "observe"):
                patch.setattr(f"wire.session.{name}", lambda function: function)
            plant = PlantProcess(config, self.world)
            plant._declare(self.world)
            emulate, exchange = plant._plant.advance, plant._exchange

            def advance(held: Array, tick: int) -> None:
                assert tick == len(self.held)
                self.held.append(held.copy())
                flows = (exchange._sent, *exchange._received, plant._record.flow)
                self.kept.append(sum(len(flow._waiting) for flow in flows))
                emulate(held, tick)
                self.world.pass_time(work_ns)

            patch.setattr(plant._plant, "advance", advance)
            if order is not None:
                at_ns, cause = order
                message = {"do": "stop", "cause": cause, "text": "enough"}
                self.world.at(self.due_ns(0) + at_ns, lambda: [message])
            assert config.run.pace is not None
            self.stop = plant._realtime(Pace(config.run.pace))
            plant._finish(self.stop)
        self.world.close()
        self._read()

    @staticmethod
    def due_ns(tick: int) -> int:
        return 7_000_000 + LEAD_NS + tick * PERIOD_NS

    def command(self, tick: int) -> Array:
        """u(tick + 1) as the nodes say at `tick`; at -1 that of the start."""
        return self.start + 1e-6 * (10.0 * tick + np.arange(NODES)) if tick >= 0 else self.start

    def _answer(self, key: str, raw: bytes) -> None:
        nodes = [i for i in range(NODES) if key == KEYS.measurement(i)]
        if not nodes:
            return
        tick = decode_numbers(raw, Kind.MEASUREMENT, RUN, PLANT, [2, 2]).tick
        if nodes == [0]:
            self.measured.append(tick)
        delay_ns = self.delays_ns.get(tick, QUICK_NS)
        if delay_ns is not None:
            self.world.at(self.world.now_ns + delay_ns, partial(self._command, nodes[0], tick))

    def _command(self, node: int, tick: int) -> list[dict[str, Any]]:
        value = [float(self.command(tick)[node])]
        raw = encode_numbers(Kind.COMMAND, RUN, tick, node, 1, value)
        self.world.handlers[KEYS.command(node)](raw)
        return []

    def _read(self) -> None:
        columns = {PLANT: width(plant_channels(NODES))}
        *batches, last = [raw for key, raw in self.world.sent if key == KEYS.telemetry(PLANT)]
        decoded = [decode_batch(raw, RUN, columns) for raw in batches]
        self.recorded = [k for b in decoded for k in range(b.tick, b.tick + len(b.rows))]
        self.rows = np.vstack([b.rows for b in decoded]) if decoded else np.zeros((0, len(FIELDS)))
        _, self.first_not_done, self.counters = decode_counters(last, RUN)
        self.ordered = [decode_stop(raw, RUN) for key, raw in self.world.sent if key == KEYS.stop]

    def column(self, topic: str, field: str) -> list[float]:
        values: list[float] = self.rows[:, FIELDS.index((topic, field))].tolist()
        return values

    @property
    def late(self) -> list[int]:
        """Ticks that are marked as late."""
        marks = self.column("/plant/pace", "late")
        assert set(marks) <= {0.0, 1.0}
        return [tick for tick, mark in zip(self.recorded, marks, strict=True) if mark]


def test_a_run_that_keeps_its_pace_is_that_of_lock_step() -> None:
    run = Run({})
    assert run.stop == Stop(TICKS, "finished", f"all {TICKS} ticks done")
    assert run.measured == run.recorded == list(range(TICKS))
    assert run.late == []
    assert run.counters["late_ticks"] == 0
    for k, held in enumerate(run.held):
        np.testing.assert_array_equal(held, run.command(k - 1))
    due = [run.due_ns(k) - EPOCH_NS for k in range(TICKS)]
    assert run.column("/sweep/timing", "due_wall_ns") == due
    assert run.column("/sweep/timing", "started_wall_ns") == due
    assert run.column("/sweep/timing", "duration_wall_ns") == [QUICK_NS] * TICKS
    assert run.ordered == [run.stop]


def test_messages_are_not_kept_for_the_whole_run() -> None:
    """1200 of them in this one."""
    assert max(Run({}, ticks=200).kept) < 300


def test_late_sweeps_make_the_following_ticks_late_and_the_commands_are_held() -> None:
    run = Run({4: 15_000_000, 9: 25_000_000}, hold=4)
    assert run.stop.cause == "finished"
    assert run.recorded == list(range(TICKS))
    assert run.late == [5, 10, 11]
    assert run.counters["late_ticks"] == 3
    assert run.measured == [k for k in range(TICKS) if k not in run.late]
    in_use = [-1, 0, 1, 2, 3, 3, 4, 6, 7, 8, 8, 8, 9, 12]
    for held, said in zip(run.held, in_use, strict=True):
        np.testing.assert_array_equal(held, run.command(said))
    durations = [float(QUICK_NS)] * TICKS
    durations[4:6] = [0.0, 15_000_000.0]
    durations[9:12] = [0.0, 0.0, 25_000_000.0]
    assert run.column("/sweep/timing", "duration_wall_ns") == durations
    due = [run.due_ns(k) - EPOCH_NS for k in range(TICKS)]
    assert run.column("/sweep/timing", "due_wall_ns") == due


delays = st.integers(0, 45_000_000).filter(lambda delay_ns: delay_ns % PERIOD_NS != 0)


@settings(suppress_health_check=[HealthCheck.too_slow], max_examples=30, deadline=None)
@given(
    st.dictionaries(st.integers(0, TICKS - 1), delays, max_size=6),
    st.integers(0, 4_000_000),
)
def test_whatever_the_delays_a_tick_is_late_exactly_if_the_sweep_before_is_not_over(
    delays_ns: dict[int, int], work_ns: int
) -> None:
    run = Run(delays_ns, hold=12, work_ns=work_ns)
    expected, free_at = [], 0
    for k in range(TICKS):
        if k < free_at:
            expected.append(k)
        else:
            free_at = k + max(1, -(-delays_ns.get(k, QUICK_NS) // PERIOD_NS))
    assert run.late == expected
    assert run.stop.cause == "finished"
    assert run.recorded == list(range(TICKS))
    assert run.measured == [k for k in range(TICKS) if k not in expected]
    assert run.counters["late_ticks"] == len(expected)


def test_a_sweep_that_ends_at_the_last_instant_is_in_time() -> None:
    assert Run({3: PERIOD_NS - 1}).late == []
    assert Run({3: PERIOD_NS + 1}).late == [4]


def test_emulation_that_takes_long_delays_ticks_but_loses_none() -> None:
    """Longer than the period: nothing is late for the sweeps, each tick begins as soon as it can."""
    run = Run({}, work_ns=PERIOD_NS + 1_000_000, ticks=6)
    assert run.stop.cause == "finished"
    assert run.recorded == list(range(6))
    started = run.column("/sweep/timing", "started_wall_ns")
    assert all(a < b for a, b in pairwise(started))


def test_after_too_many_late_ticks_the_arm_rests_under_the_holding_loads() -> None:
    run = Run(dict.fromkeys(range(5, TICKS)))
    first = 6 + HOLD  # in 6 the sweep is waited for, in 7 there is a new one, 8 is once too often
    assert run.stop.cause == "safety"
    assert run.stop.tick == first
    assert f"tick {first}: {HOLD + 1} late ticks in a row, {HOLD} may be" in run.stop.text
    assert "the sweep of tick 7 has no command from nodes 0, 1, 2" in run.stop.text
    assert "setpoint 1" in run.stop.text
    assert run.ordered[0] == run.stop
    for k, held in enumerate(run.held[:first]):
        np.testing.assert_array_equal(held, run.command(min(k - 1, 4)))
    assert len(run.held) == first + SAFE_TICKS
    for held in run.held[first:]:
        np.testing.assert_array_equal(held, run.rest)
    assert run.recorded == list(range(first + SAFE_TICKS))
    assert run.late == [6, *range(first, first + SAFE_TICKS)]
    assert run.column("/plant/guard", "passive") == [float(k >= first) for k in run.recorded]
    assert run.column("/plant/health", "node_00")[5:first] == [WELL & ~Health.ON_TIME] * 3
    assert np.isfinite(run.rows).all()


def test_no_late_tick_at_all_may_be_asked_for() -> None:
    run = Run({2: 11_000_000}, hold=0)
    assert (run.stop.cause, run.stop.tick) == ("safety", 3)
    assert run.measured == [0, 1, 2]


def test_a_sweep_that_never_ends_is_given_up_and_a_new_one_begun() -> None:
    run = Run({5: None})
    assert run.stop.cause == "finished"
    assert run.late == [6]
    assert run.measured == [k for k in range(TICKS) if k != 6]
    assert (run.counters["late_ticks"], run.counters["bridged_ticks"]) == (1, 1)
    in_use = [-1, 0, 1, 2, 3, 4, 4, 4, 7, 8, 9, 10, 11, 12]
    for held, said in zip(run.held, in_use, strict=True):
        np.testing.assert_array_equal(held, run.command(said))


@pytest.mark.parametrize("delay_ns", [QUICK_NS, 8_000_000])
@pytest.mark.parametrize(
    "at_ns", [-1_000_000, 400_000, 3_000_000, 9_950_000, 43_000_000, 49_800_000]
)
def test_an_order_to_stop_ends_the_run_at_the_first_tick_that_is_not_done(
    at_ns: int, delay_ns: int
) -> None:
    """Wherever in a tick it comes: before its begin, during the sweep, before and after the emulation."""
    run = Run(dict.fromkeys(range(TICKS), delay_ns), order=(at_ns, "interrupted"))
    assert (run.stop.cause, run.stop.text) == ("interrupted", "enough")
    assert run.ordered == [run.stop]
    assert run.recorded == list(range(run.first_not_done))
    assert run.stop.tick == run.first_not_done
    done = max(0, at_ns // PERIOD_NS)
    assert run.stop.tick in (done, done + 1)


def test_an_order_to_stop_in_a_late_tick_counts_the_late_ones() -> None:
    run = Run({2: None}, hold=10, order=(64_000_000, "interrupted"))
    assert run.recorded == list(range(run.first_not_done))
    assert run.stop.tick == run.first_not_done
    assert run.stop.tick in (6, 7)
