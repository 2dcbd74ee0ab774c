"""Real runs compared with `octarm diff`, and exported by the example."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

from conftest import ROOT, Start
from mcap.reader import make_reader

from wire.channels import FORMAT_VERSION

OLD = ROOT / "tests" / "data" / "recording_v3.mcap"


def test_two_runs_with_one_seed_are_the_same_and_another_seed_is_not(start: Start) -> None:
    runs = [
        start.run("--nodes", "3", "--ticks", "60", "--seed", seed, "--no-plot", "--quiet")
        for seed in ("5", "5", "6")
    ]
    assert [run.finish() for run in runs] == [0, 0, 0]
    recordings = [run.recording() for run in runs]
    same = start("diff", recordings[0], recordings[1].parent, "--json")
    assert same.finish() == 0, same.err
    assert same.json()["verdict"] == "same"
    assert same.json()["values_compared"] > 60 * 3 * 20
    other = start("diff", recordings[0], recordings[2])
    assert other.finish() == 3
    first = other.out.splitlines()[0]
    assert first.startswith("different; the first different value: tick 0 (0 s), node 0, ")
    assert re.search(r"^seed +5 +6$", other.out, re.MULTILINE)


def test_a_new_run_repeats_a_recording_of_version_3(start: Start, tmp_path: Path) -> None:
    """Its gains and options again; to rounding, because the old one was made on another machine."""
    gains = tmp_path / "old.gains.json"
    with OLD.open("rb") as stream:
        (data,) = (a.data for a in make_reader(stream).iter_attachments() if a.name == "gains.json")
    gains.write_bytes(data)
    options = ("--nodes", "3", "--ticks", "12", "--setpoint", "1", "--seed", "1")
    new = start("run", "--gains", gains, *options, "--no-plot", "--quiet")
    assert new.finish() == 0, new.err
    compared = start("diff", OLD, new.recording(), "--tolerance", "1e-9", "--json")
    assert compared.finish() == 0, compared.out
    facts = compared.json()
    assert facts["same"] is True
    assert (facts["a"]["format_version"], facts["b"]["format_version"]) == (3, FORMAT_VERSION)
    story = next(c for c in facts["channels"] if c["kind"] == "/event")
    assert story["messages"] >= 2 and story["same"]


def test_the_example_reads_a_recording_that_it_has_made(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(tmp_path)}
    environment["MPLBACKEND"] = "Agg"
    done = subprocess.run(
        [sys.executable, "-W", "error", str(ROOT / "examples" / "read_recording.py")],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "10 nodes, 600 ticks of 0.1 s, arm chapter" in done.stdout
    decay = re.search(r"the error decays with (\S+) 1/s, from (\S+) to (\S+) sqrt", done.stdout)
    assert decay is not None
    assert 0.0 < float(decay[1]) < 1.0 and float(decay[3]) < 0.2 * float(decay[2])
    assert (tmp_path / "read_recording.png").read_bytes().startswith(b"\x89PNG")
    assert [p.name for p in tmp_path.iterdir()] == ["read_recording.png"]
    assert len((ROOT / "examples" / "read_recording.py").read_text().splitlines()) <= 80
