"""Replays of a real node process: fed from recordings over Zenoh, compared, and gone whatever happens."""

from __future__ import annotations

import dataclasses
import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest
from altered import alter
from degraded_run import seeded, write_degraded
from simulated_run import Scenario, write_recording
from test_replay import LATE, MOVING, shared

from analysis.recording import read_recording
from analysis.replay import Feed
from analysis.replay_check import Comparison, Story, Verdict, compare, story_of
from supervise.replay_node import latency_facts, replay_process
from supervise.replay_peer import Peer
from supervise.replay_result import NodeReplay
from wire.channels import Degraded
from wire.errors import OctarmError, StartUpTimeoutError
from wire.run_config import LinkConfig


@pytest.fixture(autouse=True)
def _nothing_left(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Sockets are made where the test can see them; afterwards there is none, and no process."""
    sockets = tmp_path / "s"
    sockets.mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(sockets))
    yield
    assert list(sockets.iterdir()) == []
    names = [child.name() for child in psutil.Process().children(recursive=True)]
    assert [name for name in names if name.startswith("octarm")] == []


def quiet(_: str) -> None:
    """No progress."""


def replayed(story: Story, node: int) -> tuple[Comparison, NodeReplay]:
    feed = story.feed(story.nodes.process_of(node))
    given = replay_process(feed, story.rows, 20.0, quiet)
    return compare(story, [feed], [given.replayed], process=True), given


def values_of(story: Story, ticks: int, segments: range, following: int) -> int:
    """Whole rows without instants but with flags, what goes to neighbours, and commands for a tick not late."""
    rows, n = story.rows, story.recording.nodes
    own = sum(10 + rows.forward[i] + rows.backward[i] for i in segments)
    out = rows.forward[segments[-1] + 1] if segments[-1] < n - 1 else 0
    out += rows.backward[segments[0] - 1] if segments[0] > 0 else 0
    out += segments[-1] < n - 1  # and whether it is of the whole arm
    return ticks * (own + out) + following * len(segments)


def test_every_process_of_a_run_answers_as_it_did(tmp_path: Path) -> None:
    path, ticks = tmp_path / "recording.mcap", 40
    write_recording(path, Scenario(nodes=3, ticks=ticks))
    story = story_of(read_recording(path))
    for node in range(3):
        found, given = replayed(story, node)
        assert found.verdict is Verdict.EQUAL, found
        assert found.values == values_of(story, ticks, range(node, node + 1), ticks - 1)
        assert given.rejected == 0
        counters = given.counters[node]
        assert counters["measurement_received_messages"] == ticks
        assert counters["command_sent_messages"] == ticks
        assert counters["forward_received_messages"] == (ticks if node > 0 else 0)
        assert counters["backward_received_messages"] == (ticks if node < 2 else 0)
        assert len(given.latencies_us) == ticks
        assert (given.latencies_us > 0.0).all()
        latencies = latency_facts(given.latencies_us)
        assert latencies["p50"] is not None and latencies["p99"] is not None
        assert latencies["p50"] <= latencies["p99"]


def test_late_ticks_and_changes_of_gains_are_fed_as_in_the_run(tmp_path: Path) -> None:
    path = tmp_path / "recording.mcap"
    write_recording(path, dataclasses.replace(MOVING, late=LATE))
    story = story_of(read_recording(path))
    ticks = MOVING.ticks - len(LATE)
    swept = [k for k in range(MOVING.ticks) if k not in LATE]
    following = sum(k + 1 in swept for k in swept)
    for node in (0, 2, 3):
        found, given = replayed(story, node)
        assert found.verdict is Verdict.EQUAL, found
        assert found.ticks == ticks
        assert found.values == values_of(story, ticks, range(node, node + 1), following)
        assert given.rejected == 0


def test_several_segments_of_one_process(tmp_path: Path) -> None:
    path, ticks = tmp_path / "recording.mcap", 30
    write_recording(path, Scenario(nodes=5, ticks=ticks))
    story = shared(read_recording(path), 2)
    found, given = replayed(story, 3)  # shares a process with segment 2
    assert found.verdict is Verdict.EQUAL, found
    assert sorted(given.counters) == [2, 3]
    assert found.values == values_of(story, ticks, range(2, 4), ticks - 1)
    assert given.counters[2]["passed_messages"] + given.counters[3]["passed_messages"] == 2 * ticks


def test_rows_that_a_neighbour_lost_are_missed(tmp_path: Path) -> None:
    """What node 1 sent to node 2 in tick 7 is recorded nowhere."""
    path = tmp_path / "recording.mcap"
    write_recording(path, Scenario(nodes=4, ticks=20), skip=frozenset({(7, 2)}))
    story = story_of(read_recording(path))
    found, _ = replayed(story, 1)
    assert found.verdict is Verdict.INCOMPLETE
    assert (found.ticks, found.differing) == (20, 0)
    (text,) = found.missing
    assert text.startswith("node 2, which got its sums: telemetry of tick 7 was lost")
    assert replayed(story, 0)[0].verdict is Verdict.EQUAL


@pytest.mark.parametrize(
    ("channel", "field"), [("estimate", "strain"), ("command", "force_n_per_m")]
)
def test_a_changed_bit_is_found(tmp_path: Path, channel: str, field: str) -> None:
    path, other, topic = tmp_path / "a.mcap", tmp_path / "b.mcap", f"/node/01/{channel}"
    write_recording(path, Scenario(nodes=3, ticks=20))
    before, after = alter(path, other, topic=topic, tick=11, field=field)
    found, _ = replayed(story_of(read_recording(other)), 1)
    assert found.verdict is Verdict.DIFFERENT
    # A command is in the telemetry and was sent: two numbers that are not the recorded one.
    assert found.differing == (2 if channel == "command" else 1)
    assert found.first is not None
    assert (found.first.tick, found.first.topic, found.first.field) == (11, topic, field)
    assert (found.first.recorded, found.first.replayed) == (after, before)


def test_a_message_that_the_process_refuses_is_told(tmp_path: Path) -> None:
    path, other = tmp_path / "a.mcap", tmp_path / "b.mcap"
    write_recording(path, Scenario(nodes=3, ticks=20))
    alter(
        path, other, topic="/node/01/backward_sum", tick=7, field="setpoint", change=lambda _: 7.0
    )
    story = story_of(read_recording(other))
    feed = story.feed(story.nodes.process_of(1))
    given = replay_process(feed, story.rows, 3.0, quiet)
    assert given.rejected == 1
    assert given.replayed.ticks == 7
    assert given.replayed.ended is not None
    assert given.replayed.ended.startswith("tick 7: node 1 gave no ")
    assert given.replayed.ended.endswith("within 3 s")
    found = compare(story, [feed], [given.replayed], process=True)
    assert found.verdict is not Verdict.EQUAL


def disturbed(
    story: Story, number: signal.Signals, deadline_s: float, monkeypatch: pytest.MonkeyPatch
) -> tuple[Feed, NodeReplay]:
    """Replay node 1, which gets a signal before tick 12."""
    pids: list[int] = []
    feed_tick = Peer._feed

    def before(self: Peer, feed: Feed, k: int, before: int) -> int:
        if k == 12:
            os.kill(pids[0], number)
        return feed_tick(self, feed, k, before)

    monkeypatch.setattr(Peer, "_feed", before)
    feed = story.feed(story.nodes.process_of(1))
    note = lambda text: pids.append(int(text.rpartition(" ")[2]))  # noqa: E731
    return feed, replay_process(feed, story.rows, deadline_s, note)


def test_a_process_that_is_killed_in_the_middle_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "recording.mcap"
    write_recording(path, Scenario(nodes=3, ticks=40))
    story = story_of(read_recording(path))
    feed, given = disturbed(story, signal.SIGKILL, 20.0, monkeypatch)
    found = compare(story, [feed], [given.replayed], process=True)
    assert found.verdict is Verdict.INCOMPLETE
    assert 12 <= found.ticks <= 13  # a signal needs a moment
    (text,) = found.missing
    assert text == f"tick {found.ticks}: node 1 was ended by SIGKILL"
    assert (found.differing, found.values > 0) == (0, True)


def test_a_process_that_is_frozen_is_given_up_after_the_deadline(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "recording.mcap"
    write_recording(path, Scenario(nodes=3, ticks=40))
    story = story_of(read_recording(path))
    feed, given = disturbed(story, signal.SIGSTOP, 0.4, monkeypatch)
    (text,) = compare(story, [feed], [given.replayed], process=True).missing
    assert "node 1 gave no " in text and text.endswith("within 0.4 s")


def test_a_process_that_does_not_start_says_why(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "recording.mcap"
    write_recording(path, Scenario(nodes=3, ticks=10))
    story = story_of(read_recording(path))
    began = time.monotonic()
    feed = story.feed(story.nodes.process_of(1))
    assert replay_process(feed, story.rows, 20.0, quiet).replayed.ended is None
    enough_s = 1.0 + 2.0 * (time.monotonic() - began)  # for its start, on a machine as busy as now
    with monkeypatch.context() as patch:
        patch.setattr("supervise.replay_child.dumps", lambda _: "{}")
        with pytest.raises(OctarmError, match=r"node 1 did not start: .*batch_ticks is missing"):
            replay_process(feed, story.rows, 1.0, quiet)
    with monkeypatch.context() as patch:
        nowhere = LinkConfig((), ("unixsock-stream/nowhere",), None, 5.0, None, None, None)
        patch.setattr(
            "supervise.replay_node._relinked",
            lambda config, *_: dataclasses.replace(config, links=nowhere),
        )
        patch.setattr("supervise.replay_peer.START_S", enough_s)
        with pytest.raises(
            StartUpTimeoutError, match=r"not linked after \S+ s, it waits for the plant"
        ):
            replay_process(feed, story.rows, 1.0, quiet)


# -- runs in which not all went well -------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [1, 4])
def test_processes_bridge_give_up_and_join_as_they_did(tmp_path: Path, seed: int) -> None:
    path, nodes, ticks = tmp_path / "recording.mcap", 5, 70
    write_degraded(path, Scenario(nodes=nodes, ticks=ticks), seeded(seed, nodes, ticks))
    story = story_of(read_recording(path))
    flags = Degraded(0)
    for node in range(nodes):
        found, given = replayed(story, node)
        rows = story.rows
        assert found.first is None, str(found.first)
        assert (found.differing, found.wrong, given.rejected) == (0, (), 0)
        assert found.node_ticks == int(rows.whole[node].sum())
        # what the process recorded is all of what the run has, flags included
        there = rows.whole[node]
        assert (given.replayed.rows[node][there, -1] == rows.of[node][there, -1]).all()
        flags |= Degraded(int(np.bitwise_or.reduce(rows.flags(node))))
    assert flags == Degraded(63)
