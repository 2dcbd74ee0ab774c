"""`octarm plot`: kinds of files, what is refused, the same bytes twice, nothing left of what failed."""

import inspect
import json
import re
from pathlib import Path
from unittest import mock

import in_process
import matplotlib.image
import pytest
from simulated_run import Scenario, write_recording

from analysis.panels import PANELS, SUMMARY
from analysis.plot import Choice
from supervise.recording_verbs import plot


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("plot") / "recording.mcap"
    write_recording(out, Scenario(nodes=3, ticks=30, late=frozenset({7})))
    return out


def octarm(*arguments: str | Path) -> object:
    """`octarm plot` in this process; its exit code."""
    return in_process.octarm("plot", *arguments)


def test_all_panels_go_into_one_png_beside_the_recording(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert octarm(path.parent, "--json", "--dpi", "50") == 0
    out, err = capsys.readouterr()
    facts = json.loads(out)
    png = path.with_name("panels.png")
    assert err == ""
    assert facts == {
        "plot": str(png),
        "recording": str(path),
        "recording_complete": True,
        "panels": list(PANELS),
        "ticks": 30,
        "late_ticks": 1,
        "ticks_not_recorded": 0,
        "ticks_bridged": 0,
        "width_in": 14.0,
        "height_in": facts["height_in"],
        "dpi": 50,
        "bytes": png.stat().st_size,
    }
    height, width, _ = matplotlib.image.imread(png).shape
    assert (width, height) == (700, int(facts["height_in"] * 50))
    assert set(SUMMARY) < set(PANELS)
    png.unlink()


def test_one_panel_is_larger_and_goes_by_its_name(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    png = path.with_name("curvature.png")
    assert octarm(path, "--only", "curvature") == 0
    line = capsys.readouterr().out
    height, width, _ = matplotlib.image.imread(png).shape
    assert line.startswith(f"{png}: curvature of 30 ticks, {width} x {height} pixels, ")
    assert width == 900 > height > 600
    png.unlink()


@pytest.mark.variants(".svg-<?xml")
@pytest.mark.parametrize(
    ("kind", "magic"),
    [(".png", b"\x89PNG"), (".pdf", b"%PDF"), (".svg", b"<?xml"), (".PNG", b"\x89PNG")],
)
def test_two_plots_of_one_recording_are_the_same_bytes(
    path: Path, tmp_path: Path, kind: str, magic: bytes
) -> None:
    chosen = ("--only", "shapes", "commands", "messages", "--dpi", "50", "--quiet")
    made = []
    for name in ("first", "second"):
        out = tmp_path / f"{name}{kind}"
        assert octarm(path, "--out", out, *chosen) == 0
        made.append(out.read_bytes())
    assert made[0] == made[1]
    assert made[0].startswith(magic)
    for changing in (b"Matplotlib v", b"Date", b"matplotlib version"):
        assert changing.lower() not in made[0].lower()
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"first{kind}", f"second{kind}"]


def test_nothing_is_written_over_unasked(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "tip.png"
    out.write_text("mine")
    assert octarm(path, "--only", "tip", "--out", out) == 2
    assert "exists already; give another name or --force" in capsys.readouterr().err
    assert out.read_text() == "mine"
    assert octarm(path, "--only", "tip", "--out", out, "--force") == 0
    assert out.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "culprit"),
    [
        (["--only", "tips"], "no panel 'tips' (did you mean tip?); expected some of shapes, "),
        (["--width", "2"], "--width: expected 4.5 to 60 inches, got 2"),
        (["--width", "nan"], "--width: expected 4.5 to 60 inches, got nan"),
        (["--dpi", "1000"], "--dpi: expected 30 to 600 dots an inch, got 1000"),
        (["--dpi", "600", "--width", "40"], "pixels, expected at most 100 million"),
        (["--out", "plot.jpg"], "plot.jpg: expected a name that ends in .png, .pdf or .svg"),
        (["--out", "plot"], "plot: expected a name that ends in .png, .pdf or .svg"),
        (["--out", "none/plot.png"], "none/plot.png: No such file or directory"),
        (["--out", "folder.png"], "folder.png: that is a directory"),
    ],
)
def test_what_cannot_be_plotted_is_named(
    path: Path,
    tmp_path: Path,
    arguments: list[str],
    culprit: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "folder.png").mkdir()
    monkeypatch.chdir(tmp_path)
    assert octarm(path, *arguments) == 2
    out, err = capsys.readouterr()
    assert (out, culprit in err, "Traceback" in err) == ("", True, False), err
    assert [p.name for p in tmp_path.iterdir()] == ["folder.png"]


def test_a_recording_without_a_tick_is_refused(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    raw = path.read_bytes()
    text = tmp_path / "text.mcap"
    text.write_text("no recording")
    for file, culprit in (
        (tmp_path / "none.mcap", "none.mcap: No such file"),
        (text, "expected an MCAP file"),
    ):
        assert octarm(file) == 2
        assert culprit in capsys.readouterr().err
    short = tmp_path / "short.mcap"
    for size in range(len(raw) // 2, 0, -len(raw) // 60):
        short.write_bytes(raw[:size])
        if octarm(short, "--only", "tip", "--force", "--quiet") == 2:
            break
        capsys.readouterr()
    assert "expected at least 1 complete tick to plot, got none" in capsys.readouterr().err


def test_a_recording_cut_short_is_plotted_and_told(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = tmp_path / "short.mcap"
    raw = path.read_bytes()
    short.write_bytes(raw[: len(raw) - 100])
    assert octarm(short, "--only", "tip", "messages", "--out", tmp_path / "cut.png") == 3
    assert ", recording unfinished, " in capsys.readouterr().out
    assert octarm(short, "--only", "tip", "--json") == 3
    assert json.loads(capsys.readouterr().out)["recording_complete"] is False
    assert (tmp_path / "cut.png").exists() and (tmp_path / "tip.png").exists()


def test_nothing_is_left_of_a_plot_that_failed(path: Path, tmp_path: Path) -> None:
    with mock.patch("analysis.plot.draw", side_effect=KeyboardInterrupt):
        assert octarm(path, "--out", tmp_path / "plot.png") == 130
    assert list(tmp_path.iterdir()) == []


def test_help_and_default_know_every_panel() -> None:
    assert plot.__doc__ is not None
    listed = inspect.cleandoc(plot.__doc__).partition("default all: ")[2].partition(".\n")[0]
    assert [name.strip() for name in listed.split(",")] == list(PANELS)
    page = (Path(__file__).parents[2] / "docs/plots.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ((?:`[a-z-]+`(?:, )?)+) \|", page, re.MULTILINE)
    named = [name for row in rows for name in re.findall(r"`([^`]+)`", row)]
    assert [name for name in named if not name.startswith("--")] == list(PANELS)
    assert Choice().names == tuple(PANELS)
    assert Choice(("tip", "tip")).names == ("tip",)
    assert Choice(width_in=5.0).grid == (len(PANELS), 1)
    assert Choice(width_in=9.0).grid == ((len(PANELS) + 1) // 2, 2)
