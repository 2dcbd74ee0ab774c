"""Replays of runs with bridged sums, sweeps given up and nodes replaced: equal to the bit through all of it."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from altered import alter
from degraded_run import Faults, seeded, write_degraded
from simulated_run import Scenario

from analysis.central import compare_with_central
from analysis.recording import Recording, read_recording
from analysis.replay_check import WHOLE, Comparison, Span, Verdict, check, story_of
from analysis.table import Table
from wire.channels import Degraded
from wire.run_config import LegConfig

NODES, TICKS = 5, 90
RESTING = Scenario(nodes=NODES, ticks=TICKS)
MOVING = Scenario(
    nodes=4,
    ticks=140,
    tick_s=0.2,
    setpoint="straight",
    initial="setpoint",
    first_hold_s=2.0,
    legs=(LegConfig("bent", (), 10.0, 4.0), LegConfig("straight", (), 10.0, 2.0)),
)


def made(path: Path, faults: Faults, scenario: Scenario = RESTING) -> Recording:
    write_degraded(path, scenario, faults)
    return read_recording(path)


def checked(recording: Recording, span: Span = WHOLE) -> Comparison:
    return check(story_of(recording, span))


def count(recording: Recording, flag: Degraded) -> int:
    return int(np.count_nonzero(recording.flags & int(flag)))


@pytest.mark.parametrize("scenario", [RESTING, MOVING], ids=["resting", "moving"])
@pytest.mark.parametrize("seed", range(6))
def test_whatever_does_not_come_the_replay_does_the_same(
    tmp_path: Path, seed: int, scenario: Scenario
) -> None:
    faults = seeded(seed, scenario.nodes, scenario.ticks)
    path = tmp_path / "recording.mcap"
    gone = write_degraded(path, scenario, faults)
    recording = read_recording(path)
    for flag in (Degraded.FORWARD_BRIDGED, Degraded.BACKWARD_BRIDGED):
        assert count(recording, flag) > 5, flag
    for flag in (Degraded.PARTIAL, Degraded.HELD, Degraded.MEASUREMENT_HELD, Degraded.JOINED):
        assert count(recording, flag) > 0, flag
    found = checked(recording)
    assert found.first is None, str(found.first)
    assert (found.differing, found.wrong) == (0, ())
    ((node, dies, joins),) = faults.dies
    if not gone:
        assert (found.verdict, found.missing) == (Verdict.EQUAL, ())
    else:
        assert found.verdict is Verdict.INCOMPLETE
        (text,) = found.missing
        assert text.startswith(f"node {node}: replayed up to tick ")
        assert text.endswith("lost with the process that died")
        assert f" and from tick {next(k for k in _own(recording, node) if k >= dies)} on;" in text
    assert joins is not None and joins <= int(np.argmax(recording.flags[:, node] & 32 > 0))
    rows = sum(len(_own(recording, i)) for i in range(scenario.nodes))
    assert found.node_ticks == rows


def _own(recording: Recording, node: int) -> list[int]:
    """Ticks of which a node has a row, those after the others' last one included."""
    return [int(k) for k in recording.table(f"/node/{node:02d}/estimate").ticks]


def test_a_tick_that_was_given_up_holds_its_command_and_ticks_without_a_sweep_follow(
    tmp_path: Path,
) -> None:
    faults = Faults(lost=frozenset({(20, 2, "forward")}), waits=3)
    recording = made(tmp_path / "recording.mcap", faults)
    assert np.flatnonzero(recording.late).tolist() == [21, 22, 23]
    held = (recording.flags[20] & int(Degraded.HELD)) != 0
    # the sums of the two sides meet nowhere: those from the gap on have no forward, the others no backward sum
    assert held.tolist() == [False, False, True, True, True] or held.all()
    commands = recording.of_nodes("command", ("force_n_per_m",))[:, :, 0]
    assert (commands[24, held] == commands[20, held]).all()
    found = checked(recording)
    assert (found.verdict, found.missing) == (Verdict.EQUAL, ())


def test_another_flag_is_another_story(tmp_path: Path) -> None:
    """Nothing is taken on trust: a sum that is said to be bridged must be what bridging gives."""
    path, other = tmp_path / "recording.mcap", tmp_path / "other.mcap"
    faults = Faults(cut=frozenset({(30, 2, "forward"), (31, 2, "forward")}))
    recording = made(path, faults)
    assert checked(recording).verdict is Verdict.EQUAL
    # bridged sums themselves
    before, after = alter(path, other, topic="/node/02/forward_sum", tick=31, field="c0")
    found = checked(read_recording(other))
    assert found.first is not None
    assert (found.first.tick, found.first.topic, found.first.node) == (
        31,
        "/node/02/forward_sum",
        2,
    )
    assert (found.first.recorded, found.first.replayed) == (after, before)
    # flags that are not so
    for tick, flags in ((31, 0.0), (40, 1.0), (40, 4.0), (40, 16.0), (40, 20.0), (40, 8.0)):
        alter(
            path,
            other,
            topic="/node/02/degraded",
            tick=tick,
            field="flags",
            change=partial(_instead, flags),
        )
        assert checked(read_recording(other)).verdict is Verdict.DIFFERENT, (tick, flags)


def test_a_node_that_is_never_replaced_is_replayed_to_its_end(tmp_path: Path) -> None:
    recording = made(tmp_path / "recording.mcap", Faults(dies=((2, 40, None),), passive_from=70))
    found = checked(recording)
    assert (found.verdict, found.missing) == (Verdict.EQUAL, ())
    assert found.node_ticks == 4 * 70 + 40


def test_two_lives_of_two_neighbours(tmp_path: Path) -> None:
    faults = Faults(dies=((2, 20, 24), (3, 40, 45), (2, 60, 64), (4, 61, 66)), unsent=1)
    found = checked(made(tmp_path / "recording.mcap", faults))
    assert (found.verdict, found.differing, found.wrong) == (Verdict.INCOMPLETE, 0, ())
    assert len(found.missing) == 4
    assert found.first is None
    assert checked(made(tmp_path / "recording.mcap", faults), Span(0, 18)).verdict is Verdict.EQUAL


def test_a_replacement_that_hears_nothing_of_the_tip_keeps_its_setpoint(tmp_path: Path) -> None:
    """What it has never had, it cannot fade: the next setpoint is then the one that it joined with."""
    faults = Faults(dies=((2, 20, 24), (3, 22, 60)))
    recording = made(tmp_path / "recording.mcap", faults)
    (joined,) = np.flatnonzero(recording.flags[:, 2] & int(Degraded.JOINED))
    assert recording.flags[joined, 2] & int(Degraded.BACKWARD_BRIDGED)
    said = recording.of_nodes("schedule", ("setpoint",))[joined : joined + 8, 2, 0]
    assert set(said[np.isfinite(said)]) == {1.0}
    assert checked(recording).verdict is Verdict.EQUAL


def test_telemetry_that_is_lost_in_a_second_life_ends_that_life_only(tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    recording = made(path, Faults(dies=((2, 20, 24), (2, 60, 64))))
    lost = {
        topic: _without(table, 40) if topic.startswith("/node/02/") else table
        for topic, table in recording.tables.items()
    }
    found = checked(dataclasses.replace(recording, tables=lost))
    (text,) = found.missing
    assert text == (
        "node 2: replayed up to tick 39; telemetry of tick 40 was lost, and with it the state of 19 later ticks"
    )
    assert found.differing == 0


def _instead(flags: float, _: float) -> float:
    return flags


def _without(table: Table, tick: int) -> Table:
    keep = table.ticks != tick
    return dataclasses.replace(
        table, columns={name: column[keep] for name, column in table.columns.items()}
    )


def test_the_central_run_is_compared_up_to_a_death_and_not_with_the_plants_own_command(
    tmp_path: Path,
) -> None:
    """In its first tick out a node has no command; the one that the plant uses is no product of the gains."""
    recording = made(tmp_path / "recording.mcap", Faults(dies=((2, 40, 45),)))
    assert recording.out[40, 2] and np.isfinite(recording.commands[40, 2])
    found = compare_with_central(recording)
    assert (found.ticks, found.degraded_from) == (41, 40)
    assert found.worst.relative < 1e-12
