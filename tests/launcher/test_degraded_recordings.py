"""Recordings of real runs in which nodes were killed or frozen: replayed, told and shown for what they are."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from in_process import octarm

from analysis.degraded import gaps
from analysis.recording import Recording, read_recording
from analysis.render import render
from analysis.replay_check import Verdict, check, story_of
from analysis.summary import summary_of
from wire.channels import Degraded

if TYPE_CHECKING:
    from conftest import Cli, Start

NODES, TICKS, PERIOD_S = 5, 170, 0.04
RUN = (
    *("--nodes", str(NODES), "--ticks", str(TICKS), "--disturbance", "none"),
    *("--realtime", "--tick", str(PERIOD_S), "--no-plot", "--quiet"),
)


def facts_of(capsys: pytest.CaptureFixture[str], *arguments: str | Path, code: int = 0) -> Any:
    """What a verb says with --json."""
    capsys.readouterr()
    found = octarm(*arguments, "--json")
    said = capsys.readouterr()
    assert found == code, said.err + said.out
    return json.loads(said.out)


def kill(cli: Cli, node: int) -> None:
    """Kill a node of this run, and no other process."""
    os.kill(cli.processes()[f"octarm-node{node}"], signal.SIGKILL)


def count(recording: Recording, flag: Degraded) -> int:
    return int(np.count_nonzero(recording.flags & int(flag)))


def test_a_node_that_was_killed_and_replaced(
    start: Start, capsys: pytest.CaptureFixture[str]
) -> None:
    cli = start.run(*RUN, "--hold-ticks", "60", "--restart")
    cli.wait_for_ticks()
    kill(cli, 2)
    assert cli.finish() == 3, cli.err
    path = cli.recording()
    recording = read_recording(path)
    assert recording.ticks == TICKS
    assert recording.replaced == {2: 1}
    assert (
        count(recording, Degraded.FORWARD_BRIDGED) > 0 < count(recording, Degraded.BACKWARD_BRIDGED)
    )

    # The mathematics of all lives of all nodes; rows that the killed process had not sent are missed.
    told = int(sum(np.isfinite(recording.estimates[:, i, 0]).sum() for i in range(NODES)))
    replayed = octarm("replay", path, "--json")
    found = json.loads(capsys.readouterr().out)
    assert (found["values_different"], found["first_difference"], found["done_otherwise"]) == (
        0,
        None,
        [],
    )
    assert found["node_ticks"] == told
    lost = [text for text in found["missing"] if "lost with the process that died" in text]
    assert found["missing"] == lost and len(lost) <= 1
    assert replayed == (3 if lost else 0)

    # Real processes: both lives of the node, and a neighbour that bridged.
    for node in (1, 2):
        octarm("replay", path, "--node", str(node), "--json")
        one = json.loads(capsys.readouterr().out)
        assert (one["values_different"], one["done_otherwise"], one["rejected_messages"]) == (
            0,
            [],
            0,
        )
        assert one["node_ticks"] == int(np.isfinite(recording.estimates[:, node, 0]).sum())
        assert one["checksums_equal"] == one["checksums_compared"] > 3

    summary = summary_of(recording)
    degraded = summary["degraded"]
    (replaced,) = degraded["replacements"]
    assert (replaced["node"], summary["replaced_links"]) == (2, 4)
    out, joined, back = (replaced[k] for k in ("out_from_tick", "joined_tick", "back_tick"))
    assert out < joined <= back
    assert replaced["seconds"] == pytest.approx((back - out) * PERIOD_S)
    assert gaps(recording) == [(2, out, joined - 1)]
    assert not recording.flags[:out].any()
    assert degraded["health"]["on_time"]["not"]["2"] >= back - out - int(
        recording.late[out:back].sum()
    )
    assert set(degraded["health"]["alive"]["not"]) == {"2"}
    assert degraded["bridged"]["forward_sums"] == count(recording, Degraded.FORWARD_BRIDGED)
    # The central run is compared with what came before the first bridged sum, or before what was lost.
    central = summary["difference_to_central"]
    assert central["ticks_compared"] <= degraded["first_degraded_tick"] + 1
    assert summary["max_difference_to_central"] < 1e-11
    table = render(summary)
    assert "replaced                  node 2 (" in table
    assert f"compared up to tick {central['ticks_compared'] - 1}" in table
    assert summary["open_loop_model_error"]["final"] is not None

    told_facts = facts_of(capsys, "info", path)
    assert told_facts["health"]["replaced"] == {"2": 1}
    assert told_facts["health"]["alive"] < told_facts["health"]["node_ticks"]
    assert {event["name"] for event in told_facts["events"]} >= {"node_gone", "node_back"}
    assert facts_of(capsys, "diff", path, path)["verdict"] == "same"
    shown = facts_of(capsys, "plot", path, "--only", "health", "tip", "curvature")
    assert shown["ticks_bridged"] == degraded["bridged"]["ticks"]
    assert facts_of(capsys, "export", path, "--npz")["complete"]
    with np.load(path.with_suffix(".npz")) as arrays:
        assert np.array_equal(np.nan_to_num(arrays["degraded"]), recording.flags)
        assert np.array_equal(arrays["health"], recording.health)
    published = facts_of(capsys, "replay", path, "--publish", "--at-once", "--rate", "inf")
    assert published["rows_published"] == told + TICKS


@pytest.mark.every
def test_sweeps_that_are_given_up_are_replayed(start: Start) -> None:
    """A node that is frozen for longer than a sweep is waited for: late ticks, then every tick has a sweep
    again that the others close."""
    cli = start.run(*RUN, "--hold-ticks", "30")
    cli.wait_for_ticks()
    frozen = cli.processes()["octarm-node2"]
    os.kill(frozen, signal.SIGSTOP)
    time.sleep(22 * PERIOD_S)
    os.kill(frozen, signal.SIGCONT)
    cli.finish()
    path = cli.recording()
    recording = read_recording(path)
    assert recording.late.sum() >= 15  # it was waited for
    assert count(recording, Degraded.HELD) > 0
    found = check(story_of(recording))
    assert (found.first, found.wrong, found.missing) == (None, (), ())
    assert found.verdict is Verdict.EQUAL


def test_the_energy_of_a_passive_arm_never_rises(
    start: Start, capsys: pytest.CaptureFixture[str]
) -> None:
    cli = start.run(*RUN, "--hold-ticks", "60")
    cli.wait_for_ticks()
    kill(cli, 3)
    assert cli.finish() == 4, cli.err
    recording = read_recording(cli.recording())
    passive = np.flatnonzero(recording.passive)
    assert passive.size == 20
    energy = recording.energy_above_loads_j[passive]
    assert np.isfinite(energy).all()
    assert np.diff(energy).max() <= 4e-16 * np.abs(energy).max()  # rounding
    assert energy[-1] < energy[0]
    facts = summary_of(recording)["degraded"]["passive"]
    assert facts == {
        "from_tick": int(passive[0]),
        "ticks": 20,
        "energy_first_j": energy[0],
        "energy_last_j": energy[-1],
        "fall_j": energy[0] - energy[-1],
        "largest_rise_j": pytest.approx(0.0, abs=1e-15),
        "disturbed": False,
    }
    assert facts_of(capsys, "info", cli.recording())["health"]["passive_from_tick"] == passive[0]
    assert f"passive from tick {passive[0]}" in render(summary_of(recording))
    octarm("replay", cli.recording(), "--json")
    found = json.loads(capsys.readouterr().out)
    assert (found["values_different"], found["done_otherwise"]) == (0, [])
    assert all("node 3" in text for text in found["missing"])
