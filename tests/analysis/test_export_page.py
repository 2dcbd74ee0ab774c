"""docs/export.md has every column with its unit, and every field of every channel has a description."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from analysis.events import FIELDS
from analysis.export_tables import DICTIONARY, Exported
from analysis.recording import read_recording
from wire.channels import SHAPE, Channel, node_channels, plant_channels
from wire.columns import DESCRIPTIONS, channel_name, description, unit

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "export.md").read_text()
CHANNELS = [*node_channels(1, 3, 5, 3), *plant_channels(3), Channel("/event", FIELDS)]


def page_rows(table: str) -> list[str]:
    """The lines that the page must have for a table; the points of the arm are said once."""
    rows = []
    for column in DICTIONARY[table]:
        if column.name in SHAPE:
            continue
        rows.append(f"| `{column.name}` | {column.type} | {column.unit} | {column.description} |")
    return rows


@pytest.mark.parametrize("table", DICTIONARY)
def test_the_page_has_every_column(table: str) -> None:
    part = PAGE.split(f"### `{table}`")[1].split("\n### ")[0].split("\n## ")[0]
    shown = [line for line in part.splitlines() if line.startswith("| `")]
    assert [line for line in shown if "x00_m" not in line] == page_rows(table)
    if table == "shape":
        assert "| `x00_m`, `y00_m`, ... `x32_m`, `y32_m` | double | m |" in part


def test_the_page_has_every_array() -> None:
    recording = read_recording(ROOT / "tests" / "data" / "recording_v3.mcap")
    part = PAGE.split("## Arrays")[1]
    named = set(re.findall(r"`(\w+)`", part))
    for name in Exported(recording).arrays():
        assert name in named or name.endswith("_fields"), name


@pytest.mark.parametrize("channel", CHANNELS, ids=lambda channel: channel.topic)
def test_every_field_is_described(channel: Channel) -> None:
    name = channel_name(channel.topic)
    for field in channel.fields:
        assert description(name, field)


def test_nothing_is_described_that_is_not_there() -> None:
    fields: dict[str, set[str]] = {}
    for channel in CHANNELS:
        fields.setdefault(channel_name(channel.topic), set()).update(channel.fields)
    for name, described in DESCRIPTIONS.items():
        assert set(described) <= fields[name]


@pytest.mark.parametrize(
    ("field", "expected"),
    [
        ("velocity_x_m_per_s", "m/s"),
        ("curvature_per_m", "1/m"),
        ("force_n_per_m", "N/m"),
        ("bump_n_per_m", "N/m"),
        ("x00_m", "m"),
        ("duration_wall_ns", "ns"),
        ("turn_rad", "rad"),
        ("time_s", "s"),
        ("axial_j", "J"),
        ("c12", "sqrt(J)"),
        ("strain", ""),
        ("late", ""),
        ("tick", ""),
    ],
)
def test_units_are_the_ends_of_the_names(field: str, expected: str) -> None:
    assert unit(field) == expected
