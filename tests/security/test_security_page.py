"""docs/security.md: its command prints what it shows, and every attack in its table is tried and named so."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from security_runs import ROOT
from test_attacks import ATTACKS

if TYPE_CHECKING:
    from conftest import Start

PAGE = (ROOT / "docs" / "security.md").read_text(encoding="utf-8")
((COMMAND, SHOWN),) = re.findall(r"<!-- output: octarm (.*?) -->\n```\n(.*?)```", PAGE, re.DOTALL)


def test_the_shown_keys_are_what_is_printed(start: Start) -> None:
    words = [str(ROOT / word) if word.startswith("examples/") else word for word in COMMAND.split()]
    cli = start(*words)
    assert cli.finish() == 0, cli.err

    def undated(text: str) -> str:
        return re.sub(r"\d{4}-\d\d-\d\d \d\d:\d\d", "DATE", text)

    assert undated(cli.out) == undated(SHOWN)


def test_every_attack_of_the_table_is_a_test() -> None:
    table = PAGE[PAGE.index("| attack |") :].split("\n\n")[0].splitlines()[2:]
    tests = "".join(one.read_text() for one in Path(__file__).parent.glob("test_*.py"))
    listed = {found for row in table for found in re.findall(r"`(\w+)`", row)}
    assert all(f"def {name}(" in tests for name in listed), listed
    assert {attack.__name__ for attack, _ in ATTACKS} <= listed
    for attack, named in ATTACKS:
        (row,) = (row for row in table if f"`{attack.__name__}`" in row)
        shown = [cell.strip() for cell in row.split("|")][3]
        pattern = re.escape(shown).replace("ADDRESS", r"[\d.]+").replace(r"\.\.\.", ".*")
        if shown != "the same":
            assert re.search(pattern, named), (shown, named)
