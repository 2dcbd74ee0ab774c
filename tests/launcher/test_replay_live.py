"""A recording on the live page: the frames are its ticks, it begins when somebody looks, nothing stays."""

from __future__ import annotations

import os
import signal
import socket
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from in_process import octarm
from live_frames import check_frame
from live_page import address, events

from analysis.recording import Recording, read_recording

if TYPE_CHECKING:
    from conftest import Cli, Start

NODES, TICKS = 4, 200
LIVE = "octarm-live"


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory, gains: Path) -> Iterator[Path]:
    from conftest import one_run

    with one_run(
        tmp_path_factory.mktemp("run"), gains, "--nodes", str(NODES), "--ticks", str(TICKS)
    ) as path:
        yield path


@pytest.fixture(scope="module")
def recording(path: Path) -> Recording:
    return read_recording(path)


def shown(start: Start, path: Path, *arguments: str) -> tuple[Cli, int]:
    cli = start("replay", path, "--publish", "--live", *arguments)
    cli.wait_for("live at ")
    port = address(cli.err)
    assert port is not None
    return cli, port


def nothing_left(cli: Cli) -> None:
    assert cli.gone() == {}
    assert list(cli.sockets.iterdir()) == []


def test_the_frames_are_the_recorded_ticks_and_the_end_is_told(
    start: Start, path: Path, recording: Recording
) -> None:
    cli, port = shown(start, path, "--rate", "5")
    told = list(events(port))
    assert cli.finish() == 0, cli.err
    nothing_left(cli)
    states = [state for kind, state in told if kind == "state"]
    frames = [frame for kind, frame in told if kind == "frame"]
    assert [True] * NODES in [state["alive"] for state in states]
    assert (states[-1]["state"], states[-1]["final"]) == ("finished", True)
    assert frames[0]["tick"] < TICKS // 2, "it began before anybody looked"
    for frame in frames:
        check_frame(frame, recording)
    assert frames[-1]["tick"] == TICKS - 1
    assert frames[-1]["nodes"]["rejected"] == [0] * NODES


def test_a_part_of_it_goes_round_until_ctrl_c(
    start: Start, path: Path, recording: Recording
) -> None:
    cli, port = shown(
        start, path, "--rate", "10", "--loop", "--from", "50", "--to", "149", "--quiet"
    )
    ticks: list[int] = []
    last = ""
    for kind, one in events(port):
        if kind == "state":
            last = one["state"]
            continue
        check_frame(one, recording)
        ticks.append(one["tick"])
        rounds = sum(b < a for a, b in pairwise(ticks))
        if rounds >= 2 and ticks[-1] > 80 and len(set(ticks)) > 10:  # however long that takes
            cli.popen.send_signal(signal.SIGINT)
            break
    assert cli.finish() == 130
    assert last == "running"
    assert 50 <= min(ticks) <= max(ticks) <= 149
    nothing_left(cli)


def test_without_its_page_it_stops(start: Start, path: Path) -> None:
    cli, _ = shown(start, path, "--loop", "--json")
    os.kill(cli.processes()[LIVE], signal.SIGKILL)
    assert cli.finish() == 3
    assert cli.json()["trouble"] == "the live page was ended by SIGKILL"
    nothing_left(cli)


def test_what_makes_no_sense_is_refused(path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert octarm("replay", path, "--live") == 2
    assert "--live is for --publish" in capsys.readouterr().err
    assert octarm("replay", path, "--publish", "--live-port", "8080") == 2
    assert "--live-port is for --live" in capsys.readouterr().err
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert octarm("replay", path, "--publish", "--live", "--live-port", str(port)) == 2
    assert f"--live-port {port}" in capsys.readouterr().err
