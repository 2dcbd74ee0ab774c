"""Recordings of real runs, finished and killed: what octarm info says of them, and that they are valid MCAP."""

from __future__ import annotations

import contextlib
import json
import os
import signal
from typing import TYPE_CHECKING, Any

import in_process
import pytest
from container import check_container, check_schemas, rows_by_index, rows_in_file_order

if TYPE_CHECKING:
    from conftest import Start


def facts_of(capsys: pytest.CaptureFixture[str], verb: str, *arguments: Any) -> tuple[int, Any]:
    code = in_process.octarm(verb, *arguments, "--json")
    assert isinstance(code, int)
    return code, json.loads(capsys.readouterr().out)


def test_a_real_run_is_valid_and_told_as_its_summary_tells_it(
    start: Start, capsys: pytest.CaptureFixture[str]
) -> None:
    cli = start.run("--nodes", "4", "--ticks", "60", "--no-plot", "--json", "--quiet")
    assert cli.finish() == 0
    summary = cli.json()
    path = cli.recording()
    statistics = check_container(path)
    rows = rows_in_file_order(path)
    assert sorted(rows) == sorted(rows_by_index(path))
    assert check_schemas(path) == len(rows) == statistics.message_count
    code, facts = facts_of(capsys, "info", path.parent)
    assert code == 0
    assert facts["whole"] is True
    assert sum(one["messages"] for one in facts["channels"]) == len(rows)
    messages = facts["messages"]
    for kind in ("forward", "backward", "measurement", "command"):
        assert messages[kind]["messages"] == summary["sweep_messages"][kind]
    neighbours = messages["forward"]["messages"] + messages["backward"]["messages"]
    assert neighbours == summary["neighbour_messages"] == 6 * 60
    assert facts["sweep_ms"]["p99"] == pytest.approx(summary["sweep_ms"]["p99"], rel=1e-12)
    assert facts["duration"]["ticks"] == 60
    assert 0.0 < facts["duration"]["wall_s"] < summary["run_s"] + 1.0
    assert all(one["reported"] for one in facts["processes"])
    # The message with a process's own counters cannot be among those that it counts: of 4 nodes and the plant.
    sent = sum(one["sent_messages"] for one in facts["processes"])
    assert sum(one["received_messages"] for one in facts["processes"]) == sent + 5
    assert facts["links"]["measured"] == 6
    # No sum is there before its sender could send it, and none takes longer than its sweep.
    for link in facts["links"]["links"]:
        assert 0.0 < link["latency_ms"]["p50"] <= facts["sweep_ms"]["max"]
    code, done = facts_of(capsys, "recover", path)
    assert (code, done["recovered"]) == (0, None)


def test_segments_in_one_process_have_no_link_between_them(
    start: Start, capsys: pytest.CaptureFixture[str]
) -> None:
    cli = start.run("--nodes", "5", "--segments-per-process", "2", "--ticks", "20", "--no-plot")
    assert cli.finish() == 0
    code, facts = facts_of(capsys, "info", cli.recording())
    assert code == 0
    assert facts["links"]["left_out"] == {"in memory": 4}
    assert {(one["from"], one["to"]) for one in facts["links"]["links"]} == {
        (1, 2),
        (2, 1),
        (3, 4),
        (4, 3),
    }
    nodes = [one for one in facts["processes"] if one["segments"]]
    assert [one["segments"] for one in nodes] == [[0, 1], [2, 3], [4, 4]]
    assert facts["messages"]["forward"]["per_tick"] == 2.0
    assert facts["messages"]["passed"]["per_tick"] == 4.0


def test_a_run_whose_processes_were_all_killed_is_recovered(
    start: Start, capsys: pytest.CaptureFixture[str]
) -> None:
    cli = start.run("--nodes", "3", "--ticks", "1000000", "--no-plot")
    cli.wait_for_records()
    for pid in cli.processes().values():
        with contextlib.suppress(ProcessLookupError):  # some end when the launcher does
            os.kill(pid, signal.SIGKILL)
    assert cli.gone() == {}
    path = cli.recording()
    code, facts = facts_of(capsys, "info", path)
    assert code == 3
    assert facts["file"]["closed"] is False
    assert facts["duration"]["ticks"] > 0
    code, done = facts_of(capsys, "recover", path)
    assert code == 0
    out = path.with_name("recording.recovered.mcap")
    assert done["recovered"] == str(out)
    assert check_schemas(out) == done["kept"]["messages"] == check_container(out).message_count
    rows = rows_in_file_order(out)
    assert len(rows) == sum(one["messages"] for one in facts["channels"])
    code, after = facts_of(capsys, "info", out)
    assert code == 3  # closed properly, but without the run's end
    assert after["file"]["closed"] is True
    assert after["file"]["has_summary"] is False
    assert after["duration"] == facts["duration"]
