"""The README tells the truth: its commands are run and what they print is compared with what it shows."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
SHOWN = re.findall(r"<!-- output: (.*?) -->\n```\n(.*?)```", README, re.DOTALL)


def shape_of(text: str) -> list[str]:
    """Lines with every number and path replaced: what a reader must find again on another machine."""
    text = re.sub(r"\S*runs/\S+", "PATH", text)
    text = re.sub(r"\d[\d.]*(e[-+]?\d+)?", "#", text)
    return [re.sub(r"\s+", " ", line).strip() for line in text.splitlines() if line.strip()]


def octarm(*arguments: str, cwd: Path) -> str:
    command = [sys.executable, str(ROOT / "launcher.py"), *arguments]
    done = subprocess.run(
        command, cwd=cwd, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(("command", "shown"), [s for s in SHOWN if s[0].startswith("octarm")])
def test_shown_output_is_what_the_command_prints(command: str, shown: str, tmp_path: Path) -> None:
    printed = octarm(*shlex.split(command)[1:], cwd=tmp_path)
    assert shape_of(printed) == shape_of(shown)


def test_the_default_run_prints_the_rows_that_the_readme_shows(tmp_path: Path) -> None:
    (shown,) = [text for command, text in SHOWN if command == "run"]
    printed = octarm("run", "--ticks", "40", "--no-plot", cwd=tmp_path)

    def labels(text: str) -> list[str]:
        rows = text[text.index("figure") :].splitlines()
        return [row[:24].strip() for row in rows if row[:1].strip() and "  " in row]

    assert labels(printed)[: len(labels(shown)) - 2] == labels(shown)[:-2]


def test_the_shown_answer_of_solve_is_what_it_prints(tmp_path: Path) -> None:
    """The rows of the first table, and gamma within one per cent: solvers differ from machine to machine."""
    ((command, shown),) = [s for s in SHOWN if s[0].startswith("solve")]
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    printed = octarm(*shlex.split(command), "--quiet", cwd=tmp_path)

    def rows(text: str) -> dict[str, str]:
        table = text[: text.index("degree  Gram")].splitlines()[2:]
        return {
            row[:15].strip(): row[15:].split("  ")[0].strip() for row in table if row[:1].strip()
        }

    expected, found = rows(shown), rows(printed)
    assert list(found) == list(expected)
    assert found["verdict"] == expected["verdict"] == "certified"
    assert float(found["gamma"]) == pytest.approx(float(expected["gamma"]), rel=1e-2)


def test_every_file_that_the_readme_names_is_there() -> None:
    names = re.findall(r"\]\(([^)#]+)\)", README)
    missing = [name for name in names if not (ROOT / name).exists()]
    assert names and not missing


def test_every_room_of_the_readme_is_a_package() -> None:
    rooms = re.findall(r"^\| `(\w+)/` \|", README, re.MULTILINE)
    assert len(rooms) == 12
    assert all((ROOT / room / "__init__.py").exists() for room in rooms)
