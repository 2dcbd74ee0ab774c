"""Two recordings of one seed are the same; a difference is named."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from simulated_run import Scenario, write_recording

from analysis.compare import first_difference
from analysis.recording import Recording, read_recording
from analysis.table import Table


def recorded(folder: Path, name: str, scenario: Scenario) -> Recording:
    write_recording(folder / name, scenario)
    return read_recording(folder / name)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def one(folder: Path) -> Recording:
    return recorded(folder, "one.mcap", Scenario(nodes=3, ticks=30))


def altered(recording: Recording, topic: str, field: str, row: int) -> Recording:
    table = recording.tables[topic]
    column = table.columns[field].copy()
    column[row] = np.nextafter(column[row], np.inf)
    changed = Table(topic, {**table.columns, field: column})
    return dataclasses.replace(recording, tables={**recording.tables, topic: changed})


def test_the_same_seed_gives_the_same_recording(folder: Path, one: Recording) -> None:
    other = recorded(folder, "other.mcap", Scenario(nodes=3, ticks=30))
    assert first_difference(one, other) is None


def test_one_last_bit_is_named(one: Recording) -> None:
    changed = altered(one, "/node/01/estimate", "curvature_per_m", 17)
    text = first_difference(one, changed)
    assert text is not None
    assert text.startswith("/node/01/estimate: tick 17, curvature_per_m: ")
    assert len(set(text.split("curvature_per_m: ")[1].split(" and "))) == 2


def test_wall_clock_does_not_count(one: Recording) -> None:
    assert first_difference(one, altered(one, "/sweep/timing", "duration_wall_ns", 3)) is None


def test_another_seed_another_length_and_a_missing_channel_are_named(
    folder: Path, one: Recording
) -> None:
    seed = recorded(folder, "seed.mcap", Scenario(nodes=3, ticks=30, seed=4))
    assert first_difference(one, seed) == "configuration, seed: 3 and 4"
    same = dataclasses.replace(seed, configuration=one.configuration)
    assert "/node/00/measurement: tick 0, velocity_y_m_per_s: " in str(first_difference(one, same))
    short = recorded(folder, "short.mcap", Scenario(nodes=3, ticks=20))
    short = dataclasses.replace(short, configuration=one.configuration)
    text = first_difference(one, short)
    assert text is not None
    assert text.startswith("/event: tick 30") or text.endswith("30 and 20 messages")
    tables = {k: v for k, v in one.tables.items() if k != "/plant/tip"}
    less = dataclasses.replace(one, tables=tables)
    assert first_difference(one, less) == "/plant/tip: not in the second recording"
