"""`octarm chaos`: a short campaign, its report, one case again, and its own end, by Ctrl-C or by force."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
import pytest
from in_process import octarm

from chaos.draw import draw_case

if TYPE_CHECKING:
    from conftest import Cli, Start


def _nothing_left(cli: Cli, family: list[psutil.Process]) -> None:
    _, alive = psutil.wait_procs(family, timeout=5.0)
    assert alive == []
    assert cli.gone() == {}
    assert list(cli.sockets.iterdir()) == []


def _family(cli: Cli) -> list[psutil.Process]:
    """Everything below a campaign, once runs are going on."""
    limit = time.monotonic() + 60.0
    while True:
        with contextlib.suppress(psutil.NoSuchProcess):  # one that ended while they were looked at
            family = psutil.Process(cli.popen.pid).children(recursive=True)
            if any(process.name().startswith("octarm-node") for process in family):
                return family
        assert time.monotonic() < limit
        time.sleep(0.02)


@pytest.mark.alone
def test_a_short_campaign_survives_and_reports(start: Start) -> None:
    cli = start("chaos", "--seed", "20", "--minutes", "4", "--faults", "15", "--json")
    assert cli.finish(patience_s=280.0) == 0, cli.out + cli.err
    facts = cli.json()
    assert (facts["seed"], facts["ended"], facts["violations"]) == (20, "finished", [])
    assert facts["faults"] == facts["faults_in_a_row"] == facts["longest_row"] >= 15
    assert facts["faults"] == sum(sum(codes.values()) for codes in facts["by_fault"].values())
    assert facts["runs"] == sum(facts["exit_codes"].values())
    drawn = {f.name for number in range(facts["runs"]) for f in draw_case(20, number).faults}
    assert set(facts["by_fault"]) <= drawn
    assert list(cli.work.rglob("case-*")) == []
    _nothing_left(cli, [])


def test_one_case_again_is_kept(start: Start) -> None:
    number = next(n for n in range(50) if draw_case(20, n).prepared is None)
    cli = start("chaos", "--seed", "20", "--only", str(number), "--out", "kept")
    assert cli.finish() == 0, cli.out + cli.err
    (story,) = cli.work.glob(f"kept/case-{number}/case.json")
    told = json.loads(story.read_text())
    case = draw_case(20, number)
    assert [fault["at_s"] for fault in told["plan"]] == [fault.at_s for fault in case.faults]
    assert told["command"][3:] == case.run.arguments()
    assert "seed 20: " in cli.out and f"case {number}: exit code" in cli.out
    assert list(cli.work.glob(f"kept/case-{number}/stderr.txt"))


def test_ctrl_c_ends_it_with_what_it_has(start: Start) -> None:
    cli = start("chaos", "--seed", "21", "--minutes", "5", "--out", "out")
    family = _family(cli)
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130, cli.err
    assert "octarm chaos: interrupted; this is what was done by then" in cli.err
    assert "faults survived in a row" in cli.out
    assert list(cli.work.iterdir()) == []
    _nothing_left(cli, family)


@pytest.mark.variants("campaign")
@pytest.mark.parametrize("whom", ["campaign", "worker"])
def test_what_is_killed_takes_its_runs_along(start: Start, whom: str) -> None:
    cli = start("chaos", "--seed", "22", "--minutes", "5", "--quiet")
    family = _family(cli)
    worker = next(process for process in family if process.name() == "octarm-chaos")
    os.kill(cli.popen.pid if whom == "campaign" else worker.pid, signal.SIGKILL)
    assert cli.finish() == (-signal.SIGKILL if whom == "campaign" else 1)
    if whom == "campaign":
        _nothing_left(cli, family)
    else:  # the directory of its own for sockets stays; its run's are gone
        assert "was ended by SIGKILL" in cli.err
        _, alive = psutil.wait_procs(family, timeout=5.0)
        assert alive == []
        assert [path for path in cli.sockets.rglob("*") if not path.match("oc-*")] == []


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--seed", "-1"), "--seed: expected a whole number from 0 on, got -1"),
        (("--minutes", "0"), "--minutes: expected more than 0"),
        (("--minutes", "nan"), "--minutes: expected more than 0"),
        (("--faults", "0"), "--faults: expected at least 1, got 0"),
        (("--only", "-3"), "--only: expected the number of a case"),
    ],
)
def test_what_makes_no_sense_is_refused(
    capsys: pytest.CaptureFixture[str], arguments: tuple[str, ...], text: str
) -> None:
    assert octarm("chaos", *arguments) == 2
    assert text in capsys.readouterr().err


def test_nothing_is_written_over(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "mine").touch()
    assert octarm("chaos", "--out", tmp_path) == 2
    assert "there is something in it already (mine)" in capsys.readouterr().err
