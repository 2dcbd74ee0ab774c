"""`octarm export`: every number that comes out is the recorded one, read by others' readers, bit for bit."""

from __future__ import annotations

import csv
import json
import struct
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from unittest import mock

import in_process
import numpy as np
import pyarrow.parquet as pq
import pytest
from mcap_edit import Row, by_tick, messages, rewrite
from scipy.io import loadmat
from simulated_run import Scenario, write_recording

from analysis.export import export
from wire.errors import UsageError

DATA = Path(__file__).parents[1] / "data"
SCENARIO = Scenario(nodes=4, ticks=40, late=frozenset({7, 8, 30}))
FORMATS = ("parquet", "csv", "npz", "mat")
NODES = {
    "measurement": "/node/{:02d}/measurement",
    "estimate": "/node/{:02d}/estimate",
    "truth": "/plant/truth/{:02d}",
    "command": "/node/{:02d}/command",
    "schedule": "/node/{:02d}/schedule",
    "forward_sum": "/node/{:02d}/forward_sum",
    "backward_sum": "/node/{:02d}/backward_sum",
    "timing": "/node/{:02d}/timing",
    "degraded": "/node/{:02d}/degraded",
    "health": "/plant/health",
}
PLANT = {
    "tip": "/plant/tip",
    "energy": "/plant/energy",
    "regulated": "/plant/regulated",
    "guard": "/plant/guard",
    "pace": "/plant/pace",
    "sweep_timing": "/sweep/timing",
}
Number = float | None
Table = dict[str, list[Any]]


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "recording.mcap"
    write_recording(out, SCENARIO, skip=frozenset({(12, 1), (13, 2)}))
    return out


@pytest.fixture(scope="module")
def exports(path: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("exports")
    for name in FORMATS:
        export(path, [name], folder / (name if name in ("parquet", "csv") else f"run.{name}"))
    return folder


def octarm(*arguments: str | Path) -> object:
    return in_process.octarm("export", *arguments)


def bits(value: Number) -> bytes | None:
    return None if value is None else struct.pack("<d", value)


def from_parquet(folder: Path, name: str) -> Table:
    table: Table = pq.read_table(folder / f"{name}.parquet").to_pydict()
    return table


def from_csv(folder: Path, name: str) -> Table:
    whole = {"tick", "node", "index", "process"}
    texts = {"direction", "level", "name", "message"}

    def value(column: str, cell: str) -> Any:
        if column in texts:
            return cell
        if cell == "":
            return None
        return int(cell) if column in whole else float(cell)

    with (folder / f"{name}.csv").open(newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    return {column: [value(column, row[i]) for row in rows] for i, column in enumerate(head)}


def told(path: Path) -> list[Row]:
    """The events of a recording; newer ones count the levels and have more fields."""
    words = {2: "info", 3: "warning", 4: "error"}
    names = ("tick", "time_s", "level", "name", "message")
    rows = [row for topic, row in messages(path) if topic == "/event"]
    rows = [row | {"level": words.get(row["level"], row["level"])} for row in rows]
    return [{name: row[name] for name in names} for row in rows]


READERS: dict[str, Callable[[Path, str], Table]] = {"parquet": from_parquet, "csv": from_csv}


def split(column: str, channels: Mapping[str, str]) -> tuple[str, str]:
    """Topic and field of a column: forward_sum_x_m is x_m of forward_sum."""
    name = next(name for name in channels if column.startswith(f"{name}_"))
    return channels[name], column.removeprefix(f"{name}_")


def recorded(rows: Mapping[tuple[str, int], Row], topic: str, tick: int, field: str) -> Number:
    value: Number = rows.get((topic, tick), {}).get(field)
    return value


@pytest.mark.parametrize("form", READERS)
def test_nodes_and_plant_are_the_messages_of_the_file(path: Path, exports: Path, form: str) -> None:
    rows = by_tick(path)
    nodes = READERS[form](exports / form, "nodes")
    assert nodes["tick"] == [k for k in range(40) for _ in range(4)]
    assert nodes["node"] == list(range(4)) * 40
    used = {("tick", "tick")}
    for column in list(nodes)[3:]:
        pattern, field = split(column, NODES)
        used.add((pattern, field))
        for tick, node, value in zip(nodes["tick"], nodes["node"], nodes[column], strict=True):
            if pattern == "/plant/health":  # one message says it of all nodes
                own = f"node_{node:02d}"
                used.add((pattern, own))
                expected = recorded(rows, pattern, tick, own)
            else:
                expected = recorded(rows, pattern.format(node), tick, field)
            assert bits(value) == bits(expected), (column, tick, node)
    plant = READERS[form](exports / form, "plant")
    assert plant["tick"] == list(range(40))
    assert [bits(t) for t in plant["time_s"]] == [
        bits(rows["/plant/tip", k]["time_s"]) for k in range(40)
    ]
    for column in list(plant)[2:]:
        topic, field = split(column, PLANT)
        used.add((topic, field))
        assert [bits(v) for v in plant[column]] == [
            bits(recorded(rows, topic, k, field)) for k in range(40)
        ]
    shape = READERS[form](exports / form, "shape")
    for column in list(shape)[2:]:
        assert [bits(v) for v in shape[column]] == [
            bits(recorded(rows, "/plant/shape", k, column)) for k in range(40)
        ]
    # And every field of every message has a column, but those that are in `sums`.
    for topic, tick in rows:
        if topic in ("/event", "/scene", "/plant/shape"):
            continue
        general = "/".join("{:02d}" if part.isdigit() else part for part in topic.split("/"))
        for field in rows[topic, tick]:
            in_sums = field[0] in "cd" and field[1:].isdigit()
            assert in_sums or field in ("tick", "time_s") or (general, field) in used
    assert set(shape) == set(rows["/plant/shape", 0])


@pytest.mark.parametrize("form", READERS)
def test_sums_are_long_and_complete(path: Path, exports: Path, form: str) -> None:
    sums = READERS[form](exports / form, "sums")
    expected: dict[tuple[int, int, str, int], float] = {}
    for topic, row in messages(path):
        if not topic.endswith("_sum"):
            continue
        _, _, node, kind = topic.split("/")
        for field, value in row.items():
            if field[0] in "cd" and field[1:].isdigit():
                key = (row["tick"], int(node), kind.removesuffix("_sum"), int(field[1:]))
                expected[key] = value
    keys = list(zip(sums["tick"], sums["node"], sums["direction"], sums["index"], strict=True))
    assert len(keys) == len(expected)
    assert keys == sorted(keys, key=lambda k: (k[0], k[1], k[2] == "backward", k[3]))
    for key, value in zip(keys, sums["value"], strict=True):
        assert bits(value) == bits(expected[key])
    assert sums["time_s"][-1] == 39 * 0.1


@pytest.mark.parametrize("form", READERS)
def test_events_and_places(path: Path, exports: Path, form: str) -> None:
    events = READERS[form](exports / form, "events")
    assert [
        dict(zip(events, values, strict=True)) for values in zip(*events.values(), strict=True)
    ] == told(path)
    places = READERS[form](exports / form, "places")
    run = json.loads((exports / form / "run.json").read_text())["configuration"]
    assert places["inner_face_m"] + places["outer_face_m"][-1:] == run["faces_m"]
    weights = [places[c] for c in places if c.startswith("energy_weight_")]
    assert [list(row) for row in zip(*weights, strict=True)] == run["energy_weights"]
    assert places["process"] == places["node"] == [0, 1, 2, 3]


def test_units_and_descriptions_are_in_the_parquet_files_and_in_run_json(exports: Path) -> None:
    facts = json.loads((exports / "parquet" / "run.json").read_text())
    for name, columns in facts["tables"].items():
        schema = pq.read_schema(exports / "parquet" / f"{name}.parquet")
        assert schema.names == [column["name"] for column in columns]
        for column in columns:
            field = schema.field(column["name"])
            assert field.metadata[b"unit"].decode() == column["unit"]
            assert field.metadata[b"description"].decode() == column["description"] != ""
            wanted = {"int64": "int64", "double": "double", "text": "string"}[column["type"]]
            assert str(field.type) == wanted
    units = {c["name"]: c["unit"] for table in facts["tables"].values() for c in table}
    assert units["estimate_velocity_x_m_per_s"] == units["measurement_velocity_y_m_per_s"] == "m/s"
    assert units["command_force_n_per_m"] == "N/m"
    assert units["truth_curvature_per_m"] == "1/m"
    assert (units["forward_sum_turn_rad"], units["tip_error_m"]) == ("rad", "m")
    assert (units["energy_axial_j"], units["sweep_timing_due_wall_ns"]) == ("J", "ns")
    assert units["estimate_strain"] == units["schedule_setpoint"] == ""


def arrays_of(folder: Path, form: str) -> dict[str, Any]:
    if form == "npz":
        with np.load(folder / "run.npz") as data:  # without pickles
            return dict(data)
    found: dict[str, Any] = loadmat(folder / "run.mat", chars_as_strings=True)
    flat = {}
    for name, value in found.items():
        if name.startswith("__"):
            continue
        if value.dtype == object:
            flat[name] = np.array([cell.item() for cell in value.ravel()])
        else:
            flat[name] = value[:, 0] if value.ndim == 2 and value.shape[1] == 1 else value
    return flat


@pytest.mark.parametrize("form", ["npz", "mat"])
def test_arrays_are_the_messages_of_the_file(path: Path, exports: Path, form: str) -> None:
    rows = by_tick(path)
    data = arrays_of(exports, form)
    assert data["tick"].dtype == np.int64 and data["tick"].tolist() == list(range(40))
    assert data["time_s"].tolist() == [rows["/plant/tip", k]["time_s"] for k in range(40)]

    def check(name: str, got: Any, expected: Number) -> None:
        missing = expected is None and np.isnan(got)
        assert missing or struct.pack("<d", got) == bits(expected), name

    renamed = {"forward_sum": "arm_so_far", "backward_sum": "announced"}
    for channel, pattern in NODES.items():
        name = renamed.get(channel, channel)
        fields = data[f"{name}_fields"].tolist()
        values = data[name].reshape(40, 4, len(fields))
        assert data[name].shape == ((40, 4, len(fields)) if len(fields) > 1 else (40, 4))
        for k, node, f in np.ndindex(values.shape):
            field = f"node_{node:02d}" if channel == "health" else fields[f]
            check(name, values[k, node, f], recorded(rows, pattern.format(node), k, field))
    for name, topic in PLANT.items():
        fields = data[f"{name}_fields"].tolist()
        values = data[name].reshape(40, len(fields))
        for k, f in np.ndindex(values.shape):
            check(name, values[k, f], recorded(rows, topic, k, fields[f]))
    for direction, letter in (("forward", "c"), ("backward", "d")):
        values = data[f"{direction}_sum"]
        for k, node, i in np.ndindex(values.shape):
            topic = f"/node/{node:02d}/{direction}_sum"
            check(topic, values[k, node, i], recorded(rows, topic, k, f"{letter}{i}"))
    assert data["shape_m"].shape == (40, 33, 2)
    for k, point, axis in np.ndindex(data["shape_m"].shape):
        field = f"{'xy'[axis]}{point:02d}_m"
        check(field, data["shape_m"][k, point, axis], rows["/plant/shape", k][field])
    facts = json.loads(str(data["run_json"]) if form == "npz" else data["run_json"].item())
    assert facts["configuration"]["seed"] == SCENARIO.seed
    assert data["faces_m"].tolist() == facts["configuration"]["faces_m"]
    assert data["energy_weights"].tolist() == facts["configuration"]["energy_weights"]
    for field in ("tick", "time_s", "level", "name", "message"):
        assert data[f"event_{field}"].tolist() == [row[field] for row in told(path)]
    assert all(len(name) <= 31 for name in data)  # what version 5 allows a variable's name


def test_run_json_has_what_the_metadata_has(path: Path, exports: Path) -> None:
    facts = json.loads((exports / "csv" / "run.json").read_text())
    assert facts["metadata"]["versions"] == {"octarm": "test"}
    assert facts["metadata"]["artefact_sha256"] == facts["configuration"]["artefact_sha256"]
    assert facts["arm"]["length_m"] == facts["configuration"]["faces_m"][-1]
    assert facts["summary"]["node/01"]["forward_received_messages"] == 37
    assert (facts["complete"], facts["ticks"], facts["nodes"]) == (True, 40, 4)


def test_the_verb_writes_beside_the_recording_and_over_nothing_unasked(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "recording.mcap").write_bytes(path.read_bytes())
    every = [f"--{name}" for name in FORMATS]
    assert octarm(tmp_path, *every, "--json") == 0
    out, err = capsys.readouterr()
    facts = json.loads(out)
    assert err == ""
    names = ["recording-parquet", "recording-csv", "recording.npz", "recording.mat"]
    assert [Path(e["path"]).name for e in facts["exports"]] == names
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*names, "recording.mcap"])
    assert facts["exports"][0]["rows"]["nodes"] == 160
    files = sorted(p.name for p in (tmp_path / "recording-csv").iterdir())
    tables = ["events", "nodes", "places", "plant", "shape", "sums"]
    assert files == sorted([*(f"{t}.csv" for t in tables), "run.json"])
    for flag in every:
        assert octarm(tmp_path, flag) == 2
        assert "it exists already; give another name or --force" in capsys.readouterr().err
    (tmp_path / "recording-csv" / "nodes.csv").write_text("old")
    (tmp_path / "recording-csv" / "notes.txt").write_text("mine")
    assert octarm(tmp_path, *every, "--force") == 2
    assert "which --force does not delete" in capsys.readouterr().err
    (tmp_path / "recording-csv" / "notes.txt").unlink()
    assert octarm(tmp_path, *every, "--force") == 0
    assert (tmp_path / "recording-csv" / "nodes.csv").stat().st_size > 1000
    assert "rows: nodes 160, plant 40" in capsys.readouterr().out
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([*names, "recording.mcap"])


def test_two_exports_of_a_recording_are_the_same_bytes(
    path: Path, exports: Path, tmp_path: Path
) -> None:
    export(path, ["parquet"], tmp_path / "again")
    for file in (tmp_path / "again").iterdir():
        assert file.read_bytes() == (exports / "parquet" / file.name).read_bytes()
    export(path, ["npz"], tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (exports / "run.npz").read_bytes()


@pytest.mark.parametrize(
    ("arguments", "culprit"),
    [
        ((), "at least one of --parquet, --csv, --npz, --mat"),
        (("--csv", "--npz", "--out", "x"), "one name for 2 formats"),
        (("--npz", "--out", "x.mat"), "ends in .npz"),
        (("--mat", "--out", "folder"), "ends in .mat"),
        (("--mat", "--out", "folder.mat", "--force"), "that is a directory"),
        (("--csv", "--out", "file"), "that is a file"),
        (("--csv", "--out", "folder", "--force"), "which --force does not delete"),
        (("--parquet", "--out", "none/there"), "No such file or directory"),
        (("--npz", "--out", "none/there.npz"), "No such file or directory"),
    ],
)
def test_a_target_that_cannot_be_is_named(
    path: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: tuple[str, ...],
    culprit: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("folder").mkdir()
    Path("folder.mat").mkdir()
    Path("folder/precious.txt").write_text("mine")
    Path("file").write_text("mine")
    assert octarm(path, *arguments) == 2
    out, err = capsys.readouterr()
    assert out == "" and culprit in err and "Traceback" not in err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder", "folder.mat"]
    assert Path("folder/precious.txt").read_text() == "mine"


@pytest.mark.parametrize(
    ("form", "culprit"),
    [("csv", "analysis.export_files.csv.writer"), ("npz", "numpy.savez_compressed")],
)
def test_nothing_is_left_of_an_export_that_failed(
    path: Path, tmp_path: Path, form: str, culprit: str
) -> None:
    out = tmp_path / f"out.{form}"
    with mock.patch(culprit, side_effect=KeyboardInterrupt), pytest.raises(KeyboardInterrupt):
        export(path, [form], out)
    assert list(tmp_path.iterdir()) == []
    export(path, [form], out)
    before = [p for p in tmp_path.rglob("*") if p.is_file()]
    kept = {p: p.read_bytes() for p in before}
    with (
        mock.patch(culprit, side_effect=OSError(28, "No space left on device")),
        pytest.raises(UsageError, match="No space left"),
    ):
        export(path, [form], out, force=True)
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == kept


def test_without_pyarrow_the_message_says_how_to_get_it(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with mock.patch.dict(sys.modules, {"pyarrow": None}):
        assert octarm(path, "--parquet", "--csv", "--quiet") == 2
    assert "pip install 'octarm[parquet]'" in capsys.readouterr().err
    assert not path.with_name("recording-csv").exists()


def test_a_cut_recording_is_exported_as_far_as_it_goes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recording(tmp_path / "whole.mcap", Scenario(nodes=3, ticks=150))
    raw = (tmp_path / "whole.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(raw[: int(0.7 * len(raw))])
    assert octarm(cut, "--csv", "--npz", "--json") == 3
    out, err = capsys.readouterr()
    facts = json.loads(out)
    assert facts["complete"] is False
    assert "ends in the middle of a record at byte" in facts["stops"]
    assert "everything before is exported" in err
    rows = by_tick(cut)
    last = max(tick for topic, tick in rows if topic != "/event")
    assert 0 < last < 149 and facts["ticks"] == last + 1
    nodes = from_csv(tmp_path / "cut-csv", "nodes")
    for tick, node, value in zip(
        nodes["tick"], nodes["node"], nodes["estimate_strain"], strict=True
    ):
        assert value == recorded(rows, f"/node/{node:02d}/estimate", tick, "strain")
    sums = sum(
        field[0] in "cd" and field[1:].isdigit()
        for (topic, _), row in rows.items()
        if topic.endswith("_sum")
        for field in row
    )
    assert facts["exports"][0]["rows"]["sums"] == sums
    # One that was cut before the first tick has tables without rows.
    cut.write_bytes(raw[: raw.index(b"nodes.json") + 50])
    empty = export(cut, ["npz", "mat", "csv", "parquet"], None, force=True)
    assert empty["ticks"] == 0
    assert empty["exports"][2]["rows"]["nodes"] == 0
    assert arrays_of_empty(tmp_path / "cut.npz") == (0, 3, 4)


def arrays_of_empty(path: Path) -> tuple[int, ...]:
    with np.load(path) as data:
        shape: tuple[int, ...] = data["estimate"].shape
    return shape


def test_a_tick_that_the_run_cannot_have_is_refused(path: Path, tmp_path: Path) -> None:
    def late(topic: str, row: Row) -> Row:
        hit = topic == "/plant/tip" and row["tick"] == 39
        return row | {"tick": 10**9} if hit else row

    rewrite(path, tmp_path / "edited.mcap", late)
    with pytest.raises(
        UsageError, match=r"channel /plant/tip, field 'tick': expected whole numbers"
    ):
        export(tmp_path / "edited.mcap", ["csv"], None)
    assert not (tmp_path / "edited-csv").exists()


def test_a_recording_of_version_3_and_a_newer_story(path: Path, tmp_path: Path) -> None:
    old = DATA / "recording_v3.mcap"
    facts = export(old, ["csv"], tmp_path / "old")
    assert facts["exports"][0]["rows"]["nodes"] == 36
    story = from_csv(tmp_path / "old", "events")
    assert story["name"] == ["started", "finished"]

    def log(topic: str, row: Row) -> Row:
        own = {"timestamp": {"sec": 3, "nsec": 0}, "level": 3, "file": "process.py", "line": 7}
        return row | own if topic == "/event" else row

    rewrite(path, tmp_path / "log.mcap", log)
    export(tmp_path / "log.mcap", ["parquet"], tmp_path / "log")
    assert set(from_parquet(tmp_path / "log", "events")["level"]) == {"warning"}
