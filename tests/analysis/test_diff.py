"""`octarm diff`: what it says against a message-by-message comparison with the json module."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import in_process
import numpy as np
import pytest
from mcap_edit import Row, by_tick, messages, rewrite
from simulated_run import Scenario, write_recording

from analysis.diff import diff
from analysis.diff_table import diff_table
from wire.channels import FORMAT_VERSION
from wire.errors import UsageError

DATA = Path(__file__).parents[1] / "data"
SCENARIO = Scenario(nodes=3, ticks=30)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


def recorded(folder: Path, name: str, scenario: Scenario, **more: Any) -> Path:
    path = folder / name
    write_recording(path, scenario, **more)
    return path


@pytest.fixture(scope="module")
def one(folder: Path) -> Path:
    return recorded(folder, "one.mcap", SCENARIO)


@pytest.fixture(scope="module")
def seed(folder: Path) -> Path:
    return recorded(folder, "seed.mcap", Scenario(nodes=3, ticks=30, seed=4))


def octarm(*arguments: str | Path) -> object:
    return in_process.octarm("diff", *arguments)


def counts(row: Row) -> list[str]:
    if "message" in row:
        return ["time_s", "level", "name", "message"]
    return [field for field in row if field != "tick" and not field.endswith("_wall_ns")]


def kind(topic: str) -> str:
    return re.sub(r"/\d\d(?=/|$)", "/NN", topic)


def test_the_same_seed_is_the_same_run_every_value_of_it(
    folder: Path, one: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = recorded(folder, "other.mcap", SCENARIO)
    assert octarm(one, other, "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert (facts["verdict"], facts["same"], facts["first"]) == ("same", True, None)
    assert facts["values_compared"] == sum(len(counts(row)) for _, row in messages(one))
    assert facts["values_different"] == 0
    assert {c["kind"] for c in facts["channels"]} == {kind(topic) for topic, _ in messages(one)}
    assert facts["order"] is None and facts["configuration"] == []
    figures = {f["figure"]: f for f in facts["figures"]}
    assert figures["tip error at the end"]["ratio"] == figures["sweep p50"]["ratio"] == 1.0
    assert octarm(one, other) == 0
    assert capsys.readouterr().out.startswith("the same, bit for bit: ")


def one_bit(source: Path, target: Path, topic: str, tick: int, field: str) -> tuple[float, float]:
    """Change the last bit of one number; what it was and is."""
    values: list[float] = []

    def edit(name: str, row: Row) -> Row:
        if name == topic and row["tick"] == tick:
            values.extend([row[field], float(np.nextafter(row[field], np.inf))])
            return row | {field: values[-1]}
        return row

    rewrite(source, target, edit)
    return values[0], values[1]


@pytest.mark.parametrize(
    ("topic", "node", "tick", "field"),
    [
        ("/node/02/estimate", 2, 17, "strain"),
        ("/node/01/forward_sum", 1, 29, "c0"),
        ("/plant/truth/00", 0, 3, "curvature_per_m"),
        ("/plant/shape", None, 11, "y32_m"),
        ("/plant/tip", None, 1, "time_s"),
    ],
)
def test_one_bit_is_found_where_it_is(
    one: Path, tmp_path: Path, topic: str, node: int | None, tick: int, field: str
) -> None:
    a, b = one_bit(one, tmp_path / "bit.mcap", topic, tick, field)
    facts = diff(one, tmp_path / "bit.mcap", None)
    assert (facts["verdict"], facts["values_different"]) == ("different", 1)
    assert [c["kind"] for c in facts["channels"] if not c["same"]] == [kind(topic)]
    (channel,) = (c for c in facts["channels"] if not c["same"])
    largest = max(
        abs(row[field]) for name, row in messages(one) if kind(name) == kind(topic) and field in row
    )
    for place in (facts["first"], channel["first"], channel["largest"]):
        assert (place["topic"], place["node"], place["tick"]) == (topic, node, tick)
        assert (place["field"], place["a"], place["b"]) == (field, a, b)
        assert place["absolute"] == b - a
        assert place["relative"] == pytest.approx((b - a) / largest, rel=1e-12)
    text = diff_table(facts, everything=False)
    assert text.splitlines()[0].startswith("different; the first different value: tick ")
    assert f"tick {tick} (" in text and repr(a) in text and repr(b) in text
    # The other way around it is the same place.
    back = diff(tmp_path / "bit.mcap", one, None)
    assert (back["first"]["a"], back["first"]["b"], back["first"]["tick"]) == (b, a, tick)


def test_a_tolerance_counts_small_differences_as_none(
    one: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def scaled(topic: str, row: Row) -> Row:
        return row | {"x_m": row["x_m"] * (1.0 + 1e-10)} if topic == "/plant/tip" else row

    near = rewrite(one, tmp_path / "near.mcap", scaled)
    assert octarm(one, near, "--tolerance", "1e-9", "--json") == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["verdict"] == "same within the tolerance"
    assert facts["values_within_tolerance"] == 30
    assert facts["sentence"].startswith("the same within 1e-09: ")
    (tip,) = (c for c in facts["channels"] if c["kind"] == "/plant/tip")
    assert (tip["different"], tip["first"]) == (0, None)
    assert tip["largest"]["relative"] == pytest.approx(1e-10, rel=1e-3)
    assert octarm(one, near, "--tolerance", "1e-11") == 3
    assert octarm(one, near) == 3
    assert octarm(one, one, "--tolerance", "1e-11", "--json") == 0
    out = capsys.readouterr().out.splitlines()[-1]
    assert json.loads(out)["verdict"] == "same"
    for wrong in ("-1", "1", "nan"):
        assert octarm(one, one, "--tolerance", wrong) == 2
        assert "--tolerance: expected a share" in capsys.readouterr().err


def test_another_seed_in_numbers(one: Path, seed: Path) -> None:
    """How many values differ, the first and the largest, per kind of channel."""
    facts = diff(one, seed, None)
    assert facts["sentence"].startswith(
        "different; the first different value: tick 0 (0 s), node 0,"
    )
    assert [(c["key"], c["a"], c["b"]) for c in facts["configuration"]] == [("seed", 3, 4)]
    a, b = by_tick(one), by_tick(seed)
    for channel in (c for c in facts["channels"] if c["kind"] != "/scene"):
        own = [key for key in a if kind(key[0]) == channel["kind"]]
        pairs = [
            (tick, topic, field, a[topic, tick][field], b[topic, tick][field])
            for topic, tick in own
            for field in counts(a[topic, tick])
        ]
        assert channel["values"] == len(pairs)
        wrong = [pair for pair in pairs if pair[3] != pair[4]]
        assert channel["different"] == len(wrong)
        if not wrong:
            assert channel["first"] is channel["largest"] is None
            continue
        first = channel["first"]
        assert first["tick"] == min(pair[0] for pair in wrong)
        assert (first["tick"], first["topic"], first["field"], first["a"], first["b"]) in wrong
        scale = {
            field: max(max(abs(x), abs(y)) for _, _, f, x, y in pairs if f == field)
            for field in {pair[2] for pair in pairs}
        }
        largest = max(abs(x - y) / scale[field] for _, _, field, x, y in wrong)
        assert channel["largest"]["relative"] == pytest.approx(largest, rel=1e-12)
        place = channel["largest"]
        got = abs(a[place["topic"], place["tick"]][place["field"]] - place["b"])
        assert place["absolute"] == got
    figure = {f["figure"]: f for f in facts["figures"]}["tip error at the end"]
    assert figure["a"] == a["/plant/tip", 29]["error_m"]
    assert figure["b"] == b["/plant/tip", 29]["error_m"]
    assert figure["ratio"] == figure["b"] / figure["a"]


def test_other_segments_are_not_compared_at_their_nodes(folder: Path, one: Path) -> None:
    facts = diff(one, recorded(folder, "n4.mcap", Scenario(nodes=4, ticks=30)), None)
    assert facts["verdict"] == "different"
    assert {c["kind"].split("/")[1] for c in facts["channels"]} == {"plant", "sweep", "event"}
    assert "/node/NN/estimate" in facts["channels_not_compared"]
    assert "/plant/truth/NN" in facts["channels_not_compared"]
    keys = [c["key"] for c in facts["configuration"]]
    assert keys[:2] == ["nodes", "faces_m"]
    assert "the segments end at other places" in facts["sentence"]
    diff_table(facts, everything=True)


def test_other_ticks_are_compared_at_the_same_instants(folder: Path, one: Path) -> None:
    half = recorded(folder, "half.mcap", Scenario(nodes=3, ticks=60, tick_s=0.05))
    facts = diff(one, half, None)
    (tip,) = (c for c in facts["channels"] if c["kind"] == "/plant/tip")
    a, b = by_tick(one), by_tick(half)
    fields = [field for field in counts(a["/plant/tip", 0]) if field != "time_s"]
    wrong = [
        (k, field)
        for k in range(30)
        for field in fields
        if a["/plant/tip", k][field] != b["/plant/tip", 2 * k][field]
    ]
    assert (tip["messages"], tip["values"]) == (30, 30 * len(fields))
    assert tip["different"] == len(wrong) > 0
    assert tip["first"]["tick"] == wrong[0][0]
    assert tip["messages_missing_in_a"] == tip["messages_missing_in_b"] == 0
    assert [c["key"] for c in facts["configuration"]][:2] == ["tick_s", "ticks"]


def test_a_cut_recording_is_the_same_up_to_its_end(
    one: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    long = recorded(tmp_path, "long.mcap", Scenario(nodes=3, ticks=150))
    cut = tmp_path / "cut.mcap"
    raw = long.read_bytes()
    for share in (0.6, 0.8):
        cut.write_bytes(raw[: int(share * len(raw))])
        seen = by_tick(cut)
        topics = {topic for topic, _ in by_tick(long) if topic != "/event"}
        last = min(max(k for t, k in seen if t == topic) for topic in topics)
        assert 0 < last < 149
        for pair, name in (((long, cut), "B"), ((cut, long), "A")):
            assert octarm(*pair, "--json") == 3
            facts = json.loads(capsys.readouterr().out)
            assert facts["verdict"] == "same as far as both go"
            assert (
                f"up to tick {last}, where {name} ends ({name}: ends in the m" in facts["sentence"]
            )
            assert facts["values_different"] == 0
    # An own difference before the end is one.
    one_bit(long, tmp_path / "bit.mcap", "/plant/energy", 20, "kinetic_j")
    facts = diff(cut, tmp_path / "bit.mcap", None)
    assert (facts["verdict"], facts["first"]["tick"]) == ("different", 20)
    assert f"compared up to tick {last}, where A ends" in facts["sentence"]
    # A cut recording is not called the same even as itself: nobody knows how it went on.
    facts = diff(cut, cut, None)
    assert (facts["verdict"], facts["same"]) == ("same as far as both go", False)
    assert "where both end" in facts["sentence"]


def test_a_shorter_run_is_the_same_up_to_its_end(folder: Path, one: Path) -> None:
    short = recorded(folder, "short.mcap", Scenario(nodes=3, ticks=20))
    facts = diff(one, short, None)
    assert facts["verdict"] == "same as far as both go"
    assert facts["sentence"] == "the same, bit for bit, up to tick 19, where B ends"
    assert [c["key"] for c in facts["configuration"]] == ["ticks"]


def test_lost_rows_missing_numbers_and_channels_are_named(one: Path, tmp_path: Path) -> None:
    gaps = recorded(tmp_path, "gaps.mcap", SCENARIO, skip=frozenset({(12, 1), (13, 1)}))
    facts = diff(one, gaps, None)
    lost = {c["kind"]: c for c in facts["channels"] if not c["same"]}
    assert all(c["messages_missing_in_b"] == 2 and c["different"] == 0 for c in lost.values())
    assert "/node/NN/estimate" in lost and "/plant/tip" not in lost
    wanted = {"tick": 12, "topic": "/node/01/estimate", "missing_in": "b"}
    assert lost["/node/NN/estimate"]["first_missing"] == wanted
    assert "B has no message of /node/01/" in facts["sentence"]
    assert "/node/NN/estimate: 2 messages missing in B" in diff_table(facts, everything=False)

    def null(topic: str, row: Row) -> Row:
        hit = topic == "/node/00/command" and row["tick"] == 5
        return row | {"force_n_per_m": None} if hit else row

    facts = diff(one, rewrite(one, tmp_path / "null.mcap", null), 0.5)
    first = facts["first"]
    assert (facts["verdict"], facts["values_different"]) == ("different", 1)
    assert (first["tick"], first["node"], first["b"], first["absolute"]) == (5, 0, None, None)
    assert "| missing" in facts["sentence"]

    less = rewrite(
        one, tmp_path / "less.mcap", lambda t, row: None if t == "/node/01/schedule" else row
    )
    said: list[str] = []
    facts = diff(less, one, None, said.append)
    assert any("no figures: " in line and "/node/01/schedule" in line for line in said)
    figures = {f["figure"]: f for f in facts["figures"]}
    assert figures["tip error at the end"]["a"] is None is figures["tip error at the end"]["ratio"]
    assert figures["late ticks"]["a"] == 0
    assert facts["channels_only_in_b"] == ["/node/01/schedule"]
    assert facts["verdict"] == "different" and "only B has /node/01/schedule" in facts["sentence"]

    def field(topic: str, row: Row) -> Row:
        return row | {"more": 1.0} if topic == "/plant/energy" else row

    facts = diff(one, rewrite(one, tmp_path / "more.mcap", field), None)
    (energy,) = (c for c in facts["channels"] if not c["same"])
    assert (energy["kind"], energy["fields_only_in_b"]) == ("/plant/energy", ["more"])


def test_another_order_of_the_same_messages_is_a_difference(one: Path, tmp_path: Path) -> None:
    def swapped(rows: list[tuple[str, Row]]) -> list[tuple[str, Row]]:
        rows[100], rows[101] = rows[101], rows[100]
        return rows

    facts = diff(one, rewrite(one, tmp_path / "order.mcap", arrange=swapped), None)
    rows = list(messages(one))
    assert (facts["verdict"], facts["values_different"]) == ("different", 0)
    order = facts["order"]
    assert (order["after"], order["topic_a"], order["topic_b"]) == (100, rows[100][0], rows[101][0])
    assert "after 100 messages the order is another" in facts["sentence"]


def test_events_of_newer_recordings_are_compared_by_tick_name_and_text(
    one: Path, tmp_path: Path
) -> None:
    def log(topic: str, row: Row) -> Row:
        if topic != "/event":
            return row
        own = {"timestamp": {"sec": 3, "nsec": 0}, "level": 2, "file": "process.py", "line": 7}
        return row | own

    logged = rewrite(one, tmp_path / "log.mcap", log)
    assert diff(one, logged, None)["verdict"] == "same"

    def other(topic: str, row: Row) -> Row:
        return log(topic, row) | {"message": "it was not"} if topic == "/event" else row

    facts = diff(one, rewrite(one, tmp_path / "text.mcap", other), None)
    assert facts["verdict"] == "different"
    first = facts["first"]
    assert (first["topic"], first["field"]) == ("/event", "message")
    assert (first["a"], first["b"]) == ("every tick was done", "it was not")


def test_a_drawn_channel_without_ticks_may_be_missing_but_not_different(
    one: Path, tmp_path: Path
) -> None:
    def scene(size: float, rows: list[tuple[str, Row]]) -> list[tuple[str, Row]]:
        parts = [("/scene", {"entities": [{"id": "arm", "size": {"x": size}}], "deletions": []})]
        return [*rows, *parts]

    small = rewrite(one, tmp_path / "small.mcap", arrange=lambda rows: scene(1.0, rows))
    large = rewrite(one, tmp_path / "large.mcap", arrange=lambda rows: scene(2.0, rows))
    assert diff(one, small, None)["verdict"] == "same"
    assert diff(small, small, None)["verdict"] == "same"
    facts = diff(small, large, None)
    assert facts["verdict"] == "different"
    assert (facts["first"]["topic"], facts["first"]["field"]) == ("/scene", "entities")
    json.dumps(facts, allow_nan=False)


def test_a_recording_of_version_3_against_itself_and_a_new_one(one: Path) -> None:
    old = DATA / "recording_v3.mcap"
    assert diff(old, old, None)["verdict"] == "same"
    facts = diff(old, one, None)
    assert facts["verdict"] == "different"
    about = {fact["key"]: (fact["a"], fact["b"]) for fact in facts["about"]}
    assert about["format_version"] == ("3", str(FORMAT_VERSION))
    assert facts["b"]["format_version"] == FORMAT_VERSION
    # Both have three equal segments, so that all is compared, as far as the shorter goes.
    estimate = next(c for c in facts["channels"] if c["kind"] == "/node/NN/estimate")
    assert estimate["messages"] == 3 * 12
    assert not any(c["messages_missing_in_b"] for c in facts["channels"] if c["kind"] != "/event")


def test_all_shows_every_field(one: Path, seed: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert octarm(one, seed, "--all", "--quiet") == 3
    out, err = capsys.readouterr()
    assert err == ""
    for name in ("/node/NN/estimate strain", "/plant/pace late", "/plant/shape y32_m"):
        assert any(line.startswith(name) for line in out.splitlines())
    assert octarm(one, seed) == 3
    assert "/plant/pace late" not in capsys.readouterr().out


def test_what_cannot_be_compared_is_refused(
    one: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert octarm(one, tmp_path / "none.mcap") == 2
    assert "none.mcap" in capsys.readouterr().err
    with pytest.raises(UsageError, match="tolerance"):
        diff(one, one, math.inf)


def test_a_drawn_channel_of_a_cut_recording_is_not_missing(tmp_path: Path) -> None:
    """It has no ticks that would say whether what is missing was drawn before the end or after."""
    write_recording(tmp_path / "plain.mcap", Scenario(nodes=3, ticks=150))

    def drawn(rows: list[tuple[str, Row]]) -> list[tuple[str, Row]]:
        out: list[tuple[str, Row]] = []
        for number, row in enumerate(rows):
            out.append(row)
            if number % 5 == 0:
                out.append(("/scene", {"entities": [{"number": number}, {"number": 1}]}))
        return out

    whole = rewrite(tmp_path / "plain.mcap", tmp_path / "whole.mcap", arrange=drawn)
    raw = whole.read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(raw[: int(0.6 * len(raw))])
    facts = diff(whole, cut, None)
    assert facts["verdict"] == "same as far as both go"
    scene = next(c for c in facts["channels"] if c["kind"] == "/scene")
    assert 0 < scene["messages"] < sum(topic == "/scene" for topic, _ in messages(whole))


def test_numbers_as_far_apart_as_can_be_are_told(one: Path, tmp_path: Path) -> None:
    def huge(value: float) -> Path:
        def edit(topic: str, row: Row) -> Row:
            hit = topic == "/plant/tip" and row["tick"] == 9
            return row | {"x_m": value} if hit else row

        return rewrite(one, tmp_path / f"{value}.mcap", edit)

    facts = diff(huge(1.7e308), huge(-1.7e308), None)
    assert (facts["first"]["tick"], facts["first"]["absolute"]) == (9, None)
    json.dumps(facts, allow_nan=False)
    diff_table(facts, everything=False)
    zero = diff(huge(0.0), huge(-0.0), None)
    assert (zero["verdict"], zero["first"]["absolute"]) == ("different", 0.0)
    assert diff(huge(0.0), huge(-0.0), 1e-12)["same"] is True


def test_the_page_names_every_key_verdict_and_figure(one: Path, seed: Path) -> None:
    page = (DATA.parents[1] / "docs" / "diff.md").read_text()
    facts = diff(one, seed, None)
    named = set(re.findall(r"`([^`\n]+)`", re.sub(r"```.*?```", "", page, flags=re.DOTALL)))
    keys = {*facts, *facts["a"], *facts["first"], *facts["configuration"][0], *facts["figures"][0]}
    assert keys <= named
    assert {"same", "same within the tolerance", "same as far as both go", "different"} <= named
    for figure in facts["figures"]:
        assert f"\n{figure['figure']} " in page


def test_faces_that_differ_by_rounding_are_the_same_places(one: Path, tmp_path: Path) -> None:
    """As when two machines compute Chebyshev's points: the configuration differs, the nodes are compared."""

    def nudged(metadata: dict[str, str]) -> dict[str, str]:
        run = json.loads(metadata["run"])
        run["faces_m"][1] = float(np.nextafter(run["faces_m"][1], 1.0))
        return metadata | {"run": json.dumps(run)}

    near = rewrite(one, tmp_path / "near.mcap", about=nudged)
    facts = diff(one, near, None)
    assert (facts["verdict"], facts["channels_not_compared"]) == ("different", [])
    assert facts["sentence"].startswith("different; all ")
    assert "the configuration is not: faces_m[1]: 0.333" in facts["sentence"]
    facts = diff(one, near, 1e-12)
    assert facts["verdict"] == "same within the tolerance"
    assert [(c["key"], c["counts"], c["within"]) for c in facts["configuration"]] == [
        ("faces_m[1]", False, True)
    ]


def test_metadata_that_differs_is_shown_but_does_not_count(one: Path, tmp_path: Path) -> None:
    def elsewhere(metadata: dict[str, str]) -> dict[str, str]:
        machine = json.dumps({"cpu": "another", "cores": 2})
        return metadata | {"versions": '{"octarm": "test", "numpy": "9"}', "machine": machine}

    facts = diff(one, rewrite(one, tmp_path / "there.mcap", about=elsewhere), None)
    assert facts["verdict"] == "same"
    found = {(fact["key"], fact["a"]) for fact in facts["about"]}
    assert ("versions.numpy", None) in found
    assert any(key.startswith("machine") for key, _ in found)
    assert "does not count" in diff_table(facts, everything=False)
