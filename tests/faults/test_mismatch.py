"""Gains and configurations that do not fit: refused or timed out with the reason, and what nobody can know."""

from __future__ import annotations

import base64
import json
import signal
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from closed_form import artefact

from analysis.central import compare_with_central
from chaos.aftermath import Expected
from wire.artefact import write_artefact

if TYPE_CHECKING:
    from conftest import Cli, Start

FOUR = ("--nodes", "4", "--no-plot")
AGAIN = r"make it again with `octarm design`"


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda raw: raw[: len(raw) // 2], rf"not a whole octarm gains file \(.*\); {AGAIN}"),
        (lambda raw: b"", rf"not a whole octarm gains file \(.*\); {AGAIN}"),
        (
            lambda raw: raw.replace(b'"length_m":1.0', b'"length_m":2.0'),
            rf"SHA-256 is .*, the file says .*: it was damaged or edited; {AGAIN}",
        ),
        (
            lambda raw: raw.replace(b'"version":2', b'"version":9'),
            rf"format version 9, this octarm reads 1 to 2; a newer octarm wrote it: update .*{AGAIN}",
        ),
        (
            lambda raw: raw.replace(b'"format":"octarm', b'"format":"other'),
            "expected format 'octarm",
        ),
    ],
    ids=["cut", "empty", "another arm", "future", "format"],
)
def test_gains_that_are_not_whole_are_refused(
    start: Start, tmp_path: Path, damage: Callable[[bytes], bytes], words: str
) -> None:
    whole = start.gains.read_bytes()
    damaged = damage(whole)
    assert damaged != whole
    path = tmp_path / "damaged.json"
    path.write_bytes(damaged)
    cli = start("run", "--gains", path, *FOUR, "--ticks", "20")
    cli.ends(Expected((6,), said=(rf"gains artefact {path}: .*{words}",), recording=False))


def _configuration(cli: Cli, node: int) -> Path:
    cli.wait_for(f"node {node} is yours")
    (path,) = cli.work.glob(f"runs/*/node-{node}.json")
    return path


def _edited(path: Path, edit: Callable[[dict[str, Any]], None]) -> str:
    configuration = json.loads(path.read_text())
    edit(configuration)
    path.write_text(json.dumps(configuration))
    return str(path)


def test_node_with_the_configuration_of_another_run_is_never_linked(start: Start) -> None:
    cli = start.run(*FOUR, "--ticks", "20", "--by-hand", "1", "--start-timeout", "6")
    path = _configuration(cli, 1)
    node = start.node(_edited(path, lambda c: c.update(run_id="20200101-000000-abcdef")))
    said = (
        r"not every link was up after 6 s: node 0 waits for node 1; node 1 was not started "
        r"\(it is yours: --by-hand\); node 2 waits for node 1",
    )
    cli.ends(Expected((5,), said=said, recording=False))
    node.popen.send_signal(signal.SIGINT)
    assert node.finish() == 0
    waited = [json.loads(line) for line in node.out.splitlines()]
    assert sorted(waited[0]["missing"]) == ["node 0", "node 2", "the plant", "the recorder"]
    assert all(line["event"] != "ready" for line in waited)


def test_node_with_the_matrices_of_another_deployment_is_refused(
    start: Start, tmp_path: Path
) -> None:
    """The run's name, but the matrices for an arm of five segments."""
    other = start.run("--nodes", "5", "--no-plot", "--ticks", "20", "--by-hand", "1", "--out", "o")
    other.wait_for("node 1 is yours")
    segments = json.loads((other.work / "o" / "node-1.json").read_text())["segments"]
    other.popen.send_signal(signal.SIGINT)
    assert other.finish() == 130
    cli = start.run(*FOUR, "--ticks", "20", "--by-hand", "1", "--start-timeout", "3")
    node = start.node(_edited(_configuration(cli, 1), lambda c: c.update(segments=segments)))
    assert node.finish() == 2
    assert "factors are those of node 1 of 5" in node.err
    said = (r"node 1 was not started \(it is yours: --by-hand\)",)
    cli.ends(Expected((5,), said=said, recording=False))


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda text: text[: len(text) // 2], "not JSON"),
        (lambda text: text.replace('"run_id"', '"run"'), "run_id is missing"),
        (
            lambda text: text.replace('"index":1', '"index":7', 1),
            "index: expected 1 of the segments",
        ),
    ],
)
def test_damaged_configuration_is_refused(
    start: Start, damage: Callable[[str], str], words: str
) -> None:
    cli = start.run(*FOUR, "--ticks", "20", "--by-hand", "1", "--start-timeout", "3")
    path = _configuration(cli, 1)
    path.write_text(damage(path.read_text()))
    node = start.node(str(path))
    assert node.finish() == 2
    assert words in node.err
    cli.ends(Expected((5,), said=(r"node 1 was not started",), recording=False))


def test_the_same_node_twice_cannot_listen(start: Start) -> None:
    cli = start.run(*FOUR, "--ticks", "1000000", "--by-hand", "1")
    path = str(_configuration(cli, 1))
    first = start.node(path)
    cli.wait_for("tick ")
    second = start.node(path)
    assert second.finish() == 1
    assert "node: cannot listen on unixsock-stream/" in second.err
    assert "Traceback" not in second.err
    cli.popen.send_signal(signal.SIGINT)
    cli.ends(Expected((130,)))
    assert first.finish() == 0


def _other_matrix(configuration: dict[str, Any]) -> None:
    for setpoint in configuration["segments"][0]["factors"]["setpoints"]:
        rows, columns, packed = setpoint["D"]
        numbers = np.frombuffer(base64.b64decode(packed["base64"])) * 1.001
        assert len(numbers) == rows * columns
        packed["base64"] = base64.b64encode(numbers.tobytes()).decode()


def test_edited_matrices_are_not_noticed_by_the_run_but_by_its_summary(start: Start) -> None:
    """A node is what its configuration says: no message could tell. What was sent does, recorded."""
    cli = start.run(*FOUR, "--ticks", "40", "--by-hand", "1")
    node = start.node(_edited(_configuration(cli, 1), _other_matrix))
    cli.ends(Expected(ticks=40))
    assert node.finish() == 0
    assert compare_with_central(cli.recorded()).worst.relative > 1e-6
    again = start("replay", cli.recording())
    assert again.finish() == 3
    assert "node 1" in again.out + again.err


def test_gains_of_another_arm_that_were_sealed_again_are_its_gains(
    start: Start, tmp_path: Path
) -> None:
    """An artefact is the arm and its gains in one: there is no other arm that it could be held against."""
    path = tmp_path / "sealed.json"
    write_artefact(artefact(gain_per_s=0.4), path)
    cli = start("run", "--gains", path, *FOUR, "--ticks", "20")
    cli.ends(Expected(ticks=20))
