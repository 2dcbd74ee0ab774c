"""docs/info.md shows what the verbs print and names what --json has."""

import re
from pathlib import Path

from simulated_run import Scenario, write_recording

from analysis.info import info
from analysis.info_table import info_table
from analysis.recover import recover, recover_text

PAGE = (Path(__file__).parents[2] / "docs" / "info.md").read_text()
SHOWN = re.findall(r"```\n(.*?)```", PAGE, re.DOTALL)


def test_the_page_names_every_key_of_json(tmp_path: Path) -> None:
    write_recording(tmp_path / "recording.mcap", Scenario(nodes=3, ticks=4))
    for key in info(tmp_path / "recording.mcap"):
        assert f"`{key}`" in PAGE


def labels(text: str) -> set[str]:
    """The first words of rows that begin with a name."""
    lines = [re.sub(r"worst: .*", "worst", line) for line in text.splitlines()]
    return {re.split(r"  +", line)[0] for line in lines if line[:1].isalpha() or line[:1] == "/"}


def test_the_page_shows_the_rows_that_are_printed(tmp_path: Path) -> None:
    write_recording(tmp_path / "recording.mcap", Scenario(nodes=10, ticks=4))
    printed = labels(info_table(info(tmp_path / "recording.mcap")))
    assert printed - labels(SHOWN[0]) == set()
    # A simulated run has no counters of these two, no machine and no pictures of the arm.
    assert labels(SHOWN[0]) - printed <= {"plant", "recorder", "machine", "/scene"}


def test_the_page_shows_the_lines_of_recover_and_its_record(tmp_path: Path) -> None:
    path, cut = tmp_path / "recording.mcap", tmp_path / "cut.mcap"
    write_recording(path, Scenario(nodes=3, ticks=40))
    cut.write_bytes(path.read_bytes()[:-60])
    said = recover_text(recover(cut)).splitlines()
    shown = SHOWN[1][SHOWN[1].index("$ octarm recover") :].splitlines()[1:]
    assert [line.split(":")[0] for line in said][1:3] == [line.split(":")[0] for line in shown][1:3]
    assert said[2] == shown[2] == "left out: nothing"
    record = info(tmp_path / "cut.recovered.mcap")["file"]["recovered"]
    assert all(f"`{key}`" in PAGE for key in record)
