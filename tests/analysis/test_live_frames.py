"""Frames of the live page from the rows of a recorded run: what they say is what the file says."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from pathlib import Path
from random import Random
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from degraded_run import Faults, write_degraded
from live_frames import Array, check_frame, latency, live_config, telemetry
from simulated_run import Scenario, write_recording

from analysis.recording import Recording, read_recording
from live.frame import STUCK_S, FrameMaker, lagrange
from live.process import LiveProcess
from wire.channels import WELL, Health
from wire.child import Child
from wire.errors import OctarmError
from wire.messages import PLANT, Batch, encode_batch
from wire.run_config import LegConfig

BATCH = 12
LATE = frozenset({40, 41, 77})


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Five segments in real time on the way to another setpoint, three ticks late."""
    path = tmp_path_factory.mktemp("live") / "recording.mcap"
    leg = LegConfig("bent", (), 4.0, 1.0)
    write_recording(path, Scenario(ticks=100, setpoint="straight", legs=(leg,), late=LATE))
    return read_recording(path)


@pytest.fixture(scope="module")
def rows(recording: Recording) -> dict[int, dict[int, Array]]:
    return telemetry(recording)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """The monotonic clock of frames and rows, moved by hand."""
    now = SimpleNamespace(s=100.0)
    for module in ("live.frame", "live.rows"):
        monkeypatch.setattr(f"{module}.monotonic", lambda: now.s)
    return now


def batches(rows: dict[int, Array], sender: int, first: int) -> Iterator[Batch]:
    """The rows of a sender in batches as it would send them, the first one shorter: consecutive ticks only."""
    ticks, quota = sorted(rows), first
    while ticks:
        count = next(
            (j for j in range(1, len(ticks)) if j == quota or ticks[j] != ticks[0] + j), len(ticks)
        )
        yield Batch(ticks[0], sender, np.stack([rows[t] for t in ticks[:count]]))
        ticks, quota = ticks[count:], BATCH


def all_batches(rows: dict[int, dict[int, Array]], seed: int = 1) -> list[Batch]:
    """Everybody's batches, by the tick at which they are complete, neighbours in any order."""
    order = Random(seed)
    sent = [
        batch
        for at, sender in enumerate(rows)
        for batch in batches(rows[sender], sender, 1 + (at * (BATCH - 1)) // len(rows))
    ]
    return sorted(sent, key=lambda b: b.tick + len(b.rows) + 3 * order.random())


def test_every_frame_is_one_tick_of_the_recording(
    recording: Recording, rows: dict[int, dict[int, Array]]
) -> None:
    maker = FrameMaker(live_config(recording))
    frames = []
    for batch in all_batches(rows):
        maker.add(batch)
        frame = maker.frame(int(3.1e8), running=True)
        if frame is not None:
            check_frame(frame, recording)
            frames.append(frame)
    ticks = [frame["tick"] for frame in frames]
    assert len(ticks) > 20
    assert ticks == sorted(set(ticks))
    assert ticks[-1] == recording.ticks - 1
    assert not LATE & set(ticks)
    assert [frame["late_ticks"] for frame in frames][-1] == len(LATE)
    assert frames[-1]["ticks_seen"] == recording.ticks
    assert all(frame["wall_s"] == pytest.approx(1e-3 * frame["tick"]) for frame in frames)
    assert {frame["setpoint"] for frame in frames} == {0, 1}
    assert "estimation_error" in frames[-1]


def test_running_figures_are_those_of_the_rows(
    recording: Recording, rows: dict[int, dict[int, Array]]
) -> None:
    maker = FrameMaker(live_config(recording))
    for batch in all_batches(rows):
        maker.add(batch)
    frame = maker.frame(None, running=True)
    assert frame is not None
    assert frame["wall_s"] == pytest.approx(1e-3 * frame["tick"])  # from the first tick itself
    durations = recording.sweep_durations_ms[np.isfinite(recording.sweep_durations_ms)]
    assert frame["sweeps"] == len(durations) == recording.ticks - len(LATE)
    assert frame["sweep_p50_ms"] == pytest.approx(np.percentile(durations, 50), rel=1e-5)
    assert frame["sweep_p99_ms"] == pytest.approx(np.percentile(durations, 99), rel=1e-5)
    assert frame["ticks_per_s"] == pytest.approx(1000.0)  # a tick every millisecond, it says


def test_figures_of_the_last_seconds_forget_what_is_older(
    recording: Recording, rows: dict[int, dict[int, Array]]
) -> None:
    maker = FrameMaker(live_config(recording))
    for at, batch in enumerate(batches(rows[PLANT], PLANT, BATCH)):
        slow = batch.rows.copy()
        slow[:, maker._began] = 1e9 * (at + np.linspace(0.0, 0.9, len(slow)))
        slow[:, maker._took] = 1e6 * (1 + at)
        maker.add(Batch(batch.tick, PLANT, slow))
    rates = maker._rates()
    assert rates["sweep_p99_ms"] == pytest.approx(1 + at)
    assert rates["sweeps"] == sum(
        len(b.rows) for b in list(batches(rows[PLANT], PLANT, BATCH))[-6:]
    )
    assert rates["sweep_p50_ms"] >= at - 3


def test_link_latencies_are_receiver_less_ready_sender(
    recording: Recording, rows: dict[int, dict[int, Array]]
) -> None:
    maker = FrameMaker(live_config(recording))
    for batch in all_batches(rows):
        maker.add(batch)
    frame = maker.frame(None, running=True)
    assert frame is not None
    links = frame["links"]
    on_time = [k for k in range(recording.ticks) if k not in LATE]
    assert links["ticks"] == len(on_time)
    for i in range(recording.nodes - 1):
        for way, sender, receiver in (("forward", i, i + 1), ("backward", i + 1, i)):
            us = 1e-3 * latency(recording, sender, receiver)[on_time]
            assert links[f"{way}_us"][i] == pytest.approx(float(np.median(us)), abs=0.051)
            assert links[f"{way}_most_us"][i] == pytest.approx(float(us.max()), abs=0.051)


def test_links_within_a_process_or_to_another_clock_are_left_out(
    recording: Recording, rows: dict[int, dict[int, Array]]
) -> None:
    maker = FrameMaker(live_config(recording, elsewhere=(3, 4)))
    for batch in all_batches(rows):
        maker.add(batch)
    frame = maker.frame(None, running=True)
    assert frame is not None
    for way in ("forward", "backward"):
        known = [us is not None for us in frame["links"][f"{way}_us"]]
        assert known == [True, True, False, False]


def test_a_node_that_is_alone_in_being_late_is_named(
    recording: Recording, rows: dict[int, dict[int, Array]], clock: SimpleNamespace
) -> None:
    """As the plant has seen it: each of the three things by itself, and only as long as it is so."""
    maker = FrameMaker(live_config(recording))
    at = maker._health_at.start
    wrong = {
        (30, 2): WELL & ~Health.ON_TIME,
        (31, 1): WELL & ~Health.VALID,
        (32, 3): WELL & ~(Health.ALIVE | Health.ON_TIME),
    }
    for batch in all_batches(rows):
        changed = batch.rows.copy()
        for (tick, node), health in wrong.items():
            if batch.sender == PLANT and batch.tick <= tick < batch.tick + len(changed):
                changed[tick - batch.tick, at + node] = health
        maker.add(Batch(batch.tick, batch.sender, changed))
    frame = maker.frame(None, running=True)
    assert frame is not None
    assert frame["nodes"]["late"] == [0, 0, 1, 1, 0]
    assert frame["nodes"]["alive"] == [True, True, True, False, True]
    assert frame["nodes"]["on_time"] == [True, True, False, False, True]
    assert frame["nodes"]["valid"] == [True, False, True, True, True]
    clock.s += 6.0
    frame = maker.frame(None, running=True)
    assert frame is not None
    assert frame["nodes"]["alive"] == frame["nodes"]["valid"] == [True] * 5
    assert frame["nodes"]["on_time"] == [False] * 5  # of the plant nothing has come for six seconds
    assert frame["nodes"]["late"] == [0, 0, 1, 1, 0]


def test_a_passive_arm_is_shown_at_once_and_bridged_sums_are_told(tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    cut = frozenset((k, 2, "forward") for k in range(40, 60))
    write_degraded(
        path, Scenario(nodes=4, ticks=70), Faults(cut=cut, dies=((3, 20, 24),), passive_from=60)
    )
    recording = read_recording(path)
    rows = telemetry(recording)
    maker = FrameMaker(live_config(recording))
    until(maker, rows, dict.fromkeys(range(4), 60) | {PLANT: 60})
    frame = maker.frame(None, running=True)
    assert frame is not None
    assert (frame["tick"], frame["passive"]) == (59, False)
    assert frame["nodes"]["flags"] == [0, 0, 1, 8]
    bridged = np.count_nonzero(recording.flags & 3, axis=0).tolist()
    assert bridged[2] >= 20
    assert frame["nodes"]["bridged"] == bridged
    assert frame["nodes"]["alive"] == [
        True,
        True,
        True,
        False,
    ]  # for some ticks since the last frame
    assert frame["nodes"]["late"][3] >= 4
    few = [k for k in range(60) if not recording.flags[k].any() and recording.out[k].sum() == 0]
    assert frame["links"]["ticks"] == len(few)
    until(maker, rows, {PLANT: 62})
    frame = maker.frame(None, running=False)
    assert frame is not None
    assert (frame["tick"], frame["passive"], frame["estimate_tick"]) == (61, True, 59)
    assert frame["nodes"]["alive"] == [True] * 4  # it came back
    assert maker.frame(None, running=False) is None  # nothing new


def test_refused_telemetry_is_counted_for_its_sender(
    recording: Recording, rows: dict[int, dict[int, Array]]
) -> None:
    maker = FrameMaker(live_config(recording))
    maker.refused(3)
    maker.refused(1, messages=4)
    maker.refused(0, messages=0)
    maker.refused(PLANT)
    for batch in all_batches(rows):
        maker.add(batch)
    frame = maker.frame(None, running=True)
    assert frame is not None
    assert frame["nodes"]["rejected"] == [0, 4, 0, 1, 0]
    assert frame["nodes"]["valid"] == [True, False, True, False, True]


def until(maker: FrameMaker, rows: dict[int, dict[int, Array]], ends: dict[int, int]) -> None:
    """Give the rows of each sender up to a tick."""
    for sender, end in ends.items():
        upto = {k: row for k, row in rows[sender].items() if k < end}
        for batch in batches(upto, sender, BATCH):
            maker.add(batch)


def test_an_arm_whose_nodes_say_nothing_more_goes_on_with_their_last_words(
    recording: Recording, rows: dict[int, dict[int, Array]], clock: SimpleNamespace
) -> None:
    maker = FrameMaker(live_config(recording))
    ends = {0: 30, 1: 25, 2: 28, 3: 30, 4: 30, PLANT: 31}
    until(maker, rows, ends)
    frame = maker.frame(None, running=True)
    assert frame is not None
    assert frame["tick"] == 24  # the newest that all have
    check_frame(frame, recording)
    until(maker, rows, {PLANT: 60})
    clock.s += 0.5 * STUCK_S
    assert maker.frame(None, running=True) is None
    clock.s += STUCK_S
    assert maker.frame(None, running=False) is None
    frame = maker.frame(None, running=True)
    assert frame is not None
    assert (frame["tick"], frame["estimate_tick"]) == (59, 24)
    assert frame["tip"] == pytest.approx(recording.tips_m[59].tolist(), abs=1e-5)
    last = [recording.estimates[ends[i] - 1, i, 3] for i in range(5)]
    assert frame["curvature_estimate"] == pytest.approx(last, abs=1e-4)
    assert "estimation_error" not in frame  # nothing to compare at one tick
    assert "estimation_error_m" not in frame
    assert frame["nodes"]["tick"] == [29, 24, 27, 29, 29]
    assert frame["nodes"]["age_s"] == [1.5] * 5
    assert frame["nodes"]["on_time"] == [False] * 5


def test_before_anything_has_come_there_is_no_frame(recording: Recording) -> None:
    maker = FrameMaker(live_config(recording))
    assert maker.frame(None, running=True) is None
    assert maker.awaits_first


def test_after_a_pause_nothing_old_is_shown(
    recording: Recording, rows: dict[int, dict[int, Array]], clock: SimpleNamespace
) -> None:
    maker = FrameMaker(live_config(recording))
    until(maker, rows, dict.fromkeys(rows, 30))
    assert not maker.awaits_first
    maker.resume()
    clock.s += 10.0
    maker.resume()
    assert maker.frame(None, running=True) is None
    frames: list[dict[str, Any]] = []
    for batch in all_batches(
        {s: {k: r for k, r in of.items() if k >= 60} for s, of in rows.items()}
    ):
        maker.add(batch)
        if (frame := maker.frame(None, running=True)) is not None:
            frames.append(frame)
    assert frames[0]["tick"] >= 60
    assert frames[-1]["links"]["ticks"] == 40 - 1
    check_frame(frames[-1], recording)
    assert "estimation_error" in frames[-1]  # the first tick was seen


def test_a_batch_that_comes_twice_changes_nothing(
    recording: Recording, rows: dict[int, dict[int, Array]]
) -> None:
    maker = FrameMaker(live_config(recording))
    until(maker, rows, dict.fromkeys(rows, 20))
    seen = maker._seen
    until(maker, rows, dict.fromkeys(rows, 20))
    assert maker._seen == seen == 20


def test_a_port_that_was_taken_since_it_was_tried_is_named(recording: Recording) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        child = Child("live", control=-1, status=-1, directory=None)
        with pytest.raises(OctarmError, match=rf"--live-port {port}: .* cannot be used \("):
            LiveProcess(live_config(recording, port=port), child).run()
        child.close()


@pytest.mark.parametrize("power", range(4))
def test_cubics_are_taken_to_any_place_exactly(power: int) -> None:
    places = np.array([0.0, 0.01, 0.3, 0.5, 0.97, 1.0])
    known = np.linspace(0.0, 1.0, 9)
    found = lagrange(places, 9) @ known**power
    np.testing.assert_allclose(found, places**power, atol=1e-13)


def test_numbers_of_a_frame_are_plain(
    recording: Recording, rows: dict[int, dict[int, Array]]
) -> None:
    """No number of numpy's, no infinity: what the page's JSON must not have."""
    maker = FrameMaker(live_config(recording))
    for batch in all_batches(rows):
        maker.add(batch)
    frame = maker.frame(int(3.1e8), running=True)

    def walk(value: Any) -> None:
        if isinstance(value, dict):
            assert all(type(key) is str for key in value)
            for inner in value.values():
                walk(inner)
        elif isinstance(value, list):
            for inner in value:
                walk(inner)
        else:
            assert value is None or type(value) in (bool, int, float), value
            assert value is None or np.isfinite(value)

    walk(frame)


class Finishing(Child):
    """A launcher whose only word is that the run is over."""

    def wait(self, seconds: float | None) -> list[dict[str, Any]]:
        return [{"do": "finish", "state": "finished", "message": "", "dead": []}]


def test_the_last_frame_is_of_the_last_tick_however_long_it_takes_to_read_all(
    recording: Recording, rows: dict[int, dict[int, Array]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading is broken off to make frames in time, but not when the run is over."""
    monkeypatch.setattr("live.process.DRAIN_S", -1.0)  # as if it got no core meanwhile
    child = Finishing("live", control=-1, status=-1, directory=None)
    process = LiveProcess(live_config(recording), child)
    run = process._keys.run
    raws = [encode_batch(run, b.tick, b.sender, b.rows) for b in all_batches(rows)]
    samples = [SimpleNamespace(key_expr="", payload=raw) for raw in raws[-process._most :]]
    process._samples = SimpleNamespace(try_recv=lambda: samples.pop(0) if samples else None)
    assert process._news.enter()
    process._hear(0.0)
    shown = process._news.after(0)
    assert shown is not None
    frame, state = (json.loads(line[6:]) for line in shown[1].splitlines() if line[:5] == b"data:")
    assert frame["tick"] == np.flatnonzero(~recording.late)[-1]
    assert state["final"]
    child.close()
