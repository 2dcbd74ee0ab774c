"""Replays of the mathematics: equal to the bit where nothing was changed; what was changed is found exactly."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from altered import alter, one_bit
from simulated_run import Scenario, write_recording

from analysis.recorded_nodes import RecordedNodes, recorded_nodes
from analysis.recording import Recording, read_recording
from analysis.replay import rows_of
from analysis.replay_check import WHOLE, Comparison, Span, Story, Verdict, check, story_of
from analysis.telemetry_rows import late_ticks, telemetry_channels, telemetry_rows, whole
from recorder.writer import RecordingWriter
from wire.channels import NODES_ATTACHMENT, width
from wire.errors import UsageError
from wire.messages import PLANT
from wire.run_config import LegConfig, NodeConfig

DATA = Path(__file__).parents[1] / "data"
NODES, TICKS = 4, 60
LATE = frozenset({1, 30, 31, 32, *range(48, 139, 3)})
MOVING = Scenario(
    nodes=NODES,
    ticks=140,
    tick_s=0.2,
    setpoint="straight",
    initial="setpoint",
    first_hold_s=2.0,
    legs=(LegConfig("bent", (), 10.0, 4.0), LegConfig("straight", (), 10.0, 2.0)),
)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "recording.mcap"
    write_recording(path, Scenario(nodes=NODES, ticks=TICKS))
    return path


def checked(path: Path, span: Span = WHOLE) -> Comparison:
    return check(story_of(read_recording(path), span))


def values_of(recording: Recording, ticks: int, processes: int | None = None) -> int:
    """How many values a full comparison has: of every node state, command, schedule, flags, and what it
    receives, and of every forward sum to another process whether it is of the whole arm."""
    sums = sum(
        node.forward_received + node.backward_received for node in recording.deployment.nodes
    )
    return ticks * (8 * recording.nodes + sums + (processes or recording.nodes) - 1)


def test_what_nobody_changed_is_equal_and_nothing_is_left_out(finished: Path) -> None:
    found = checked(finished)
    assert found.verdict is Verdict.EQUAL
    assert (found.differing, found.first, found.missing, found.wrong) == (0, None, (), ())
    assert found.node_ticks == NODES * TICKS
    assert found.values == values_of(read_recording(finished), TICKS)


def test_moves_changes_of_gains_and_late_ticks_are_replayed(tmp_path: Path) -> None:
    for late in (frozenset[int](), LATE):
        path = tmp_path / f"{len(late)}.mcap"
        write_recording(path, dataclasses.replace(MOVING, late=late))
        recording = read_recording(path)
        swept = recording.setpoints_used[~recording.late]
        assert set(swept) == {0, 1}  # gains do change
        found = checked(path)
        assert found.verdict is Verdict.EQUAL
        assert found.ticks == MOVING.ticks - len(late)
        assert found.values == values_of(recording, MOVING.ticks - len(late))


@pytest.mark.parametrize("per_process", [2, 3, 4])
def test_segments_that_share_a_process_give_the_same_and_their_inner_sums_are_compared(
    finished: Path, per_process: int
) -> None:
    recording = read_recording(finished)
    story = shared(recording, per_process)
    assert len(story.nodes.configs) == -(-NODES // per_process)
    found = check(story)
    assert found.verdict is Verdict.EQUAL
    assert found.values == values_of(recording, TICKS, len(story.nodes.configs))
    assert found.node_ticks == NODES * TICKS


def shared(recording: Recording, per_process: int) -> Story:
    """The same run, had so many segments been in one process."""
    alone = recorded_nodes(recording).configs
    configs: list[NodeConfig] = []
    for first in range(0, len(alone), per_process):
        own = alone[first : first + per_process]
        segments = tuple(config.segments[0] for config in own)
        configs.append(dataclasses.replace(own[0], segments=segments))
    return Story(
        recording, RecordedNodes(tuple(configs), recorded=True), rows_of(recording, configs), Span()
    )


def test_an_inner_sum_that_was_changed_is_found(finished: Path, tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    before, after = alter(finished, path, topic="/node/01/forward_sum", tick=9, field="c1")
    found = check(shared(read_recording(path), 2))
    assert found.differing == 1  # the node in the same process got the right one, in memory
    assert found.first is not None
    assert (found.first.tick, found.first.topic, found.first.field) == (
        9,
        "/node/01/forward_sum",
        "c1",
    )
    assert (found.first.recorded, found.first.replayed) == (after, before)


def test_a_recording_of_version_3_is_replayed_with_gains_deployed_again() -> None:
    story = story_of(read_recording(DATA / "recording_v3.mcap"))
    assert not story.nodes.recorded
    found = check(story)
    assert found.verdict is Verdict.EQUAL
    assert found.node_ticks == 3 * 12


# -- one bit of one number -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("node", "tick", "channel", "field", "giver", "alone"),
    [
        (2, 37, "estimate", "strain", 2, True),
        (0, 0, "estimate", "curvature_per_m", 0, True),
        (3, TICKS - 1, "estimate", "velocity_y_m_per_s", 3, True),
        (1, 20, "command", "force_n_per_m", 1, True),
        (1, 20, "schedule", "bump_n_per_m", 1, True),
        (1, 20, "schedule", "setpoint", 1, True),
        # Sums are the receiver's input as well: what it makes of them may differ too, if not rounded away.
        (2, 20, "forward_sum", "c0", 1, False),
        (1, 20, "forward_sum", "turn_rad", 0, False),
        (3, TICKS - 1, "forward_sum", "x_m", 2, True),
        (1, 20, "backward_sum", "d1", 2, False),
        (0, TICKS - 1, "backward_sum", "d0", 1, True),
    ],
)
def test_one_bit_of_an_output_is_found_where_it_is(
    finished: Path,
    tmp_path: Path,
    node: int,
    tick: int,
    channel: str,
    field: str,
    giver: int,
    alone: bool,
) -> None:
    path, topic = tmp_path / "other.mcap", f"/node/{node:02d}/{channel}"
    before, after = alter(finished, path, topic=topic, tick=tick, field=field)
    assert before != after
    found = checked(path)
    assert found.verdict is Verdict.DIFFERENT
    assert found.differing == 1 or not alone
    first = found.first
    assert first is not None
    assert (first.tick, first.topic, first.field, first.node) == (tick, topic, field, giver)
    assert (first.recorded, first.replayed) == (after, before)
    assert first.ulps == 1
    assert f"recorded {after!r}, node {giver} gives {before!r} (1 ulp)" in str(first)
    # Up to the tick before, nothing is different.
    if tick > 0:
        assert checked(path, Span(0, tick - 1)).verdict is Verdict.EQUAL


def test_one_bit_of_an_input_shows_in_what_its_node_makes_of_it(
    finished: Path, tmp_path: Path
) -> None:
    path = tmp_path / "other.mcap"
    changes: tuple[Callable[[float], float], ...] = (one_bit, lambda value: value + 1e-6)
    for change in changes:
        alter(
            finished,
            path,
            topic="/node/01/measurement",
            tick=20,
            field="curvature_per_m",
            change=change,
        )
        found = checked(path)
        assert found.first is not None
        assert (found.first.tick, found.first.node) == (20, 1)
        assert (
            found.first.topic == "/node/02/forward_sum"
        )  # the first thing that it makes of a measurement
    assert found.differing > 100  # and its estimate goes another way from then on


def test_a_zero_with_another_sign_is_another_number(tmp_path: Path) -> None:
    path, other = tmp_path / "recording.mcap", tmp_path / "other.mcap"
    write_recording(path, Scenario(nodes=2, ticks=5))
    alter(path, other, topic="/node/01/schedule", tick=3, field="bump_n_per_m", change=lambda x: -x)
    found = checked(other)
    assert found.differing == 1
    assert found.first is not None
    assert repr(found.first.recorded) == "-0.0"


def test_other_matrices_give_other_numbers(finished: Path, tmp_path: Path) -> None:
    """The recorded configuration counts, not what the gains would give again."""

    def longer(configs: Any) -> Any:
        configs[1]["segments"][0]["factors"]["bend_m"] *= 1.0 + 1e-12
        return configs

    path = tmp_path / "other.mcap"
    alter(finished, path, attachments={NODES_ATTACHMENT: longer})
    found = checked(path)
    assert found.verdict is Verdict.DIFFERENT
    assert found.first is not None
    assert found.first.node == 1
    assert found.first.topic == "/node/02/forward_sum"
    assert found.first.field in ("turn_rad", "x_m", "y_m")


def test_an_input_that_a_node_refuses_is_told(finished: Path, tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    alter(
        finished,
        path,
        topic="/node/01/backward_sum",
        tick=7,
        field="setpoint",
        change=lambda _: 7.0,
    )
    found = checked(path)
    assert found.verdict is Verdict.DIFFERENT
    (text,) = found.wrong
    assert text.startswith("tick 7: node 1 refuses what it received (setpoint: expected one of 2")
    assert found.first is not None
    assert (found.first.tick, found.first.topic) == (7, "/node/01/backward_sum")


# -- what is not there ---------------------------------------------------------------------------------------


def test_lost_rows_end_the_replay_of_their_node_only(tmp_path: Path) -> None:
    path = tmp_path / "gaps.mcap"
    write_recording(path, Scenario(nodes=3, ticks=60), skip=frozenset({(30, 1), (31, 1)}))
    found = checked(path)
    assert found.verdict is Verdict.INCOMPLETE
    assert found.differing == 0
    assert found.node_ticks == 60 + 30 + 60
    (text,) = found.missing
    assert text == (
        "node 1: replayed up to tick 29; telemetry of tick 30 was lost, and with it the state of 28 later ticks"
    )
    assert checked(path, Span(0, 29)).verdict is Verdict.EQUAL
    assert checked(path, Span(0, 30)).verdict is Verdict.INCOMPLETE


def test_late_ticks_alone_are_not_called_equal(tmp_path: Path) -> None:
    path = tmp_path / "late.mcap"
    write_recording(path, Scenario(nodes=2, ticks=20, late=frozenset({7, 8})))
    found = checked(path, Span(7, 8))
    assert found.verdict is Verdict.INCOMPLETE
    assert found.missing == ("there is nothing in these ticks to compare: they were late",)
    assert checked(path, Span(6, 8)).verdict is Verdict.EQUAL


def test_rows_that_nobody_got_at_the_end_are_missed_by_the_counters(tmp_path: Path) -> None:
    """All telemetry of the last two ticks was lost; only how many commands a node sent tells it."""
    path = tmp_path / "recording.mcap"
    write_recording(path, Scenario(nodes=2, ticks=20))
    recording = read_recording(path)
    counters = dict(recording.counters or {})
    for i, sent in enumerate((20, 22)):
        own = recording.process_counters(f"node/{i:02d}") | {"command_sent_messages": sent}
        counters[f"node/{i:02d}"] = json.dumps(own)
    found = check(story_of(dataclasses.replace(recording, counters=counters)))
    assert found.verdict is Verdict.INCOMPLETE
    assert found.missing == (
        "node 1: replayed up to tick 19; telemetry of 2 ticks after that was lost",
    )
    counters.pop("node/00")
    found = check(story_of(dataclasses.replace(recording, counters=counters)))
    assert found.missing[0].startswith("node 0: replayed up to tick 19; it sent no last word")
    found = check(story_of(dataclasses.replace(recording, counters=None)))
    (both,) = found.missing  # the same of every node is said once
    assert both.startswith("node 0 and 1 more: replayed up to tick 19; it sent no last word")


def test_lost_rows_of_the_plant_are_not_needed(tmp_path: Path) -> None:
    path = tmp_path / "gaps.mcap"
    write_recording(path, Scenario(nodes=3, ticks=20), skip=frozenset({(7, PLANT)}))
    assert checked(path).verdict is Verdict.EQUAL


def test_a_tick_that_the_plant_does_not_call_late_is_a_lost_one(tmp_path: Path) -> None:
    path = tmp_path / "gaps.mcap"
    skip = frozenset({(7, PLANT), (7, 0), (7, 1)})
    write_recording(path, Scenario(nodes=2, ticks=20), skip=skip)
    found = checked(path)
    assert found.verdict is Verdict.INCOMPLETE
    assert found.ticks == 7


@pytest.mark.parametrize("share", [0.35, 0.5, 0.8, 0.97])
def test_a_file_that_was_cut_short_is_replayed_as_far_as_it_goes(
    tmp_path: Path, share: float
) -> None:
    source, path = tmp_path / "recording.mcap", tmp_path / "cut.mcap"
    write_recording(source, Scenario(nodes=3, ticks=150))
    raw = source.read_bytes()
    path.write_bytes(raw[: int(share * len(raw))])
    found = checked(path)
    assert found.verdict is Verdict.INCOMPLETE
    assert found.differing == 0
    assert 0 < found.ticks <= 150
    (text,) = found.missing
    assert text.startswith("the file ") and f"nothing is there after tick {found.ticks - 1}" in text
    assert checked(path, Span(0, found.ticks // 2)).verdict is Verdict.EQUAL


def test_a_recording_whose_recorder_was_killed_is_not_called_complete(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    write_recording(path, Scenario(nodes=2, ticks=20), close=False)
    found = checked(path)
    assert found.verdict is Verdict.INCOMPLETE
    assert (found.differing, found.ticks) == (0, 20)


def test_a_recording_without_a_tick_has_nothing_to_say(finished: Path, tmp_path: Path) -> None:
    raw = finished.read_bytes()
    for length in range(3000, len(raw), 500):
        path = tmp_path / "cut.mcap"
        path.write_bytes(raw[:length])
        try:
            recording = read_recording(path)
        except UsageError:
            continue
        break
    assert recording.ticks == 0
    found = check(story_of(recording))
    assert found.verdict is Verdict.INCOMPLETE
    assert found.missing[-1] == "there is no tick of which a node has recorded everything"


@pytest.mark.parametrize(
    ("span", "text"),
    [
        (Span(TICKS), "--from 60: expected a tick of the recording, 0 to 59"),
        (Span(-1), "--from -1: expected"),
        (Span(0, TICKS), "--to 60: expected"),
        (Span(9, 8), "--to 8: expected a tick of the recording from 9 on"),
    ],
)
def test_ticks_that_are_not_there_are_refused(finished: Path, span: Span, text: str) -> None:
    with pytest.raises(UsageError, match=text):
        checked(finished, span)


@pytest.mark.parametrize(
    ("edit", "text"),
    [
        (lambda _: {}, "expected a JSON list"),
        (lambda configs: configs[1:], r"expected the segments 0 to 3 in order, got \[1, 2, 3\]"),
        (lambda configs: [*configs[:3], {}], r"nodes.json\[3\]: batch_ticks is missing"),
    ],
)
def test_configurations_that_are_no_arm_are_refused(
    finished: Path, tmp_path: Path, edit: Callable[[Any], Any], text: str
) -> None:
    path = tmp_path / "other.mcap"
    alter(finished, path, attachments={NODES_ATTACHMENT: edit})
    with pytest.raises(UsageError, match=text):
        checked(path)


# -- the rows themselves -------------------------------------------------------------------------------------

SPECIAL = (
    -0.0,
    5e-324,
    -2.2250738585072014e-308,
    1.7976931348623157e308,
    1e22,
    0.1 + 0.2,
    3.0,
    -7.0,
)


def test_rows_are_what_the_recorder_was_given(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    given: dict[tuple[int, int], list[float]] = {}
    write = RecordingWriter.tick

    def tick(self: RecordingWriter, number: int, rows: dict[int, list[float]]) -> None:
        for sender, row in rows.items():
            if sender >= 0:
                row[: len(SPECIAL)] = np.roll(SPECIAL, number).tolist()
            given[number, sender] = list(row)
        write(self, number, rows)

    monkeypatch.setattr(RecordingWriter, "tick", tick)
    path, ticks = tmp_path / "recording.mcap", 30
    late = frozenset({5, 6})
    write_recording(
        path, Scenario(nodes=3, ticks=ticks, late=late), skip=frozenset({(11, 1), (12, PLANT)})
    )
    recording = read_recording(path)
    rows = telemetry_rows(recording)
    assert list(rows) == [0, 1, 2, PLANT]
    layout = telemetry_channels(recording)
    for sender, own in rows.items():
        assert own.shape == (ticks, width(layout[sender]))
        for k in range(ticks):
            expected = given.get((k, sender))
            assert bool(whole(own)[k]) is (expected is not None)
            if expected is not None:
                assert own[k].tobytes() == np.array(expected).tobytes()
    assert not {(5, 0), (11, 1), (12, PLANT)} & given.keys()
    assert set(np.flatnonzero(late_ticks(rows))) == late
