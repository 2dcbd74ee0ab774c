"""`octarm chapter`: what it writes, what stays, what it refuses; the documentation's pages are its own."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from in_process import octarm
from threadpoolctl import threadpool_info, threadpool_limits

from chapter.command import FACTS, INDEX, PARTS, claim_table, index, reproduce

DOCS = Path(__file__).resolve().parents[2] / "docs" / "chapter"
PNG = b"\x89PNG\r\n\x1a\n"


def test_a_part_is_made_again_and_the_others_stay(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "pages"
    out.mkdir()
    kept = json.loads((DOCS / FACTS).read_text())["model"]
    (out / FACTS).write_text(json.dumps({"model": kept}))
    assert octarm("chapter", "setpoints", "--out", out, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert list(told["parts"]) == ["setpoints"]
    facts = json.loads((out / FACTS).read_text())
    assert list(facts) == ["model", "setpoints"] and facts["model"] == kept
    figures = facts["setpoints"]["figures"]
    assert {file.name for file in out.iterdir()} == {FACTS, INDEX, "setpoints.md", *figures}
    assert all((out / figure).read_bytes().startswith(PNG) for figure in figures)
    assert (
        "(model.md)" in (out / INDEX).read_text() and "(setpoints.md)" in (out / INDEX).read_text()
    )
    # what is in the documentation is what the command makes today
    assert facts["setpoints"] == json.loads((DOCS / FACTS).read_text())["setpoints"]
    assert (out / "setpoints.md").read_text() == (DOCS / "setpoints.md").read_text()


def test_the_number_of_threads_does_not_count(tmp_path: Path) -> None:
    """The libraries are asked while the pages are made: with two threads the last digits would be others."""
    asked: list[int] = []

    def ask(_: str) -> None:
        asked.append(max(pool["num_threads"] for pool in threadpool_info()))

    with threadpool_limits(2):
        ask("before")
        reproduce(("setpoints",), tmp_path, ask)
    before, *meanwhile = asked
    assert before == 2
    assert set(meanwhile) == {1}
    for file in tmp_path.glob("setpoints*"):
        assert file.read_bytes() == (DOCS / file.name).read_bytes(), file.name


def test_what_cannot_be_done_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert octarm("chapter", "fourth", "--out", tmp_path) == 2
    assert "part fourth: there is no such part of the chapter; there are model," in (
        capsys.readouterr().err
    )
    file = tmp_path / "file"
    file.write_text("mine")
    assert octarm("chapter", "setpoints", "--out", file) == 2
    assert "give a directory that can be written" in capsys.readouterr().err
    assert octarm("chapter", "setpoints", "--out", "/proc/pages") == 2
    assert "give a directory that can be written" in capsys.readouterr().err
    (tmp_path / FACTS).write_text('{"model": 1}')
    assert octarm("chapter", "setpoints", "--out", tmp_path) == 2
    assert "its facts.json was not made by `octarm chapter`" in capsys.readouterr().err
    assert {one.name for one in tmp_path.iterdir()} == {"file", FACTS}


@pytest.mark.skipif(os.geteuid() == 0, reason="the superuser may write everywhere")
def test_a_directory_that_may_not_be_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    tmp_path.chmod(0o500)
    assert octarm("chapter", "setpoints", "--out", tmp_path / "pages") == 2
    assert "Permission denied" in capsys.readouterr().err


def test_the_documentation_has_every_part_with_its_figures() -> None:
    facts = json.loads((DOCS / FACTS).read_text())
    assert tuple(facts) == PARTS
    shown = {file.name for file in DOCS.glob("*.png")}
    assert shown == {figure for one in facts.values() for figure in one["figures"]}
    for key, one in facts.items():
        text = (DOCS / f"{key}.md").read_text()
        assert text.startswith(f"# {one['title']}\n")
        assert one["figures"] and all(f"({figure})" in text for figure in one["figures"])
        assert all(line in text for line in claim_table(one["claims"]))
        for figure in one["figures"]:
            picture = (DOCS / figure).read_bytes()
            width, height = (int.from_bytes(picture[k : k + 4], "big") for k in (16, 20))
            assert picture.startswith(PNG) and width >= 800 and height >= 300, figure
    assert (DOCS / INDEX).read_text() == index(facts)
