"""The panels of the figures: what is drawn against the messages in the file, on sound and on odd recordings."""

import dataclasses
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from matplotlib.colors import to_hex
from mcap.reader import make_reader
from simulated_run import Scenario, write_recording

from analysis.goals import COLOURS
from analysis.panels import PANELS
from analysis.panels.arm import SHAPES
from analysis.panels.frame import MISSING
from analysis.plot import Choice, draw
from analysis.recording import Recording, read_recording
from analysis.table import Table
from wire.messages import PLANT
from wire.run_config import LegConfig

Array = npt.NDArray[np.float64]

NODES, TICKS, TICK_S = 4, 150, 0.2
LATE = frozenset({20, 21, 90, 148})
LOST = frozenset({(40, 2), (60, PLANT), (61, PLANT)})
"""(tick, sender) of rows that the recorder did not get."""
LEGS = (LegConfig("straight", (), 14.0, 6.0),)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """At rest in bent for 4 s, then to straight until 18 s, there; some ticks late, some rows lost."""
    out = tmp_path_factory.mktemp("run") / "recording.mcap"
    scenario = Scenario(
        nodes=NODES,
        ticks=TICKS,
        tick_s=TICK_S,
        first_hold_s=4.0,
        legs=LEGS,
        late=LATE,
    )
    write_recording(out, scenario, skip=LOST)
    return out


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Held in bent, from the chapter's shape."""
    out = tmp_path_factory.mktemp("run") / "recording.mcap"
    write_recording(out, Scenario(nodes=NODES, ticks=TICKS, disturbance="chapter"))
    return out


def messages(path: Path, topic: str) -> list[dict[str, Any]]:
    """The messages of a topic by the mcap package's own reader."""
    with path.open("rb") as stream:
        reader = make_reader(stream)
        return [json.loads(one.data) for _, _, one in reader.iter_messages([topic])]


def by_tick(path: Path, topic: str, field: str) -> Array:
    out = np.full(TICKS, np.nan)
    for row in messages(path, topic):
        out[row["tick"]] = row[field]
    return out


def of_nodes(path: Path, pattern: str, field: str) -> Array:
    return np.stack(
        [by_tick(path, pattern.format(f"{i:02d}"), field) for i in range(NODES)], axis=1
    )


def panel(recording: Recording, name: str) -> list[Any]:
    """The axes of a panel that is drawn alone."""
    figure = draw(recording, Choice((name,)), lambda _: None)
    axes = [ax for ax in figure.axes if ax.get_label() == name]
    assert axes and axes[0].get_title(loc="left")
    return axes


def factor(label: str) -> float:
    """By what the drawn numbers are larger than those in SI units."""
    (unit,) = re.findall(r"\[(.*)\]", label)
    return 1e3 if unit.startswith("10$^{-3}$") or re.fullmatch(r"m[NmJ]/?\w*", unit) else 1.0


def mapped(ax: Any) -> Array:
    """Numbers of a map, (K, n), in SI units."""
    (mesh,) = [one for one in ax.collections if hasattr(one, "get_coordinates")]
    values = np.ma.filled(mesh.get_array().astype(float), np.nan).T
    return values / factor(mesh.colorbar.ax.get_ylabel())


CURVATURE = "curvature_per_m"


def test_maps_show_the_recorded_numbers_at_their_ticks_and_segments(path: Path) -> None:
    recording = read_recording(path)
    truth = of_nodes(path, "/plant/truth/{}", CURVATURE)
    estimate = of_nodes(path, "/node/{}/estimate", CURVATURE)
    command = of_nodes(path, "/node/{}/command", "force_n_per_m")
    for k in sorted(LATE):
        command[k] = command[k - 1]  # held
    for name, expected in (
        ("curvature", truth),
        ("curvature-error", estimate - truth),
        ("commands", command),
    ):
        (ax,) = panel(recording, name)
        np.testing.assert_allclose(mapped(ax), expected, rtol=1e-12, atol=1e-15, err_msg=name)
        (mesh,) = [one for one in ax.collections if hasattr(one, "get_coordinates")]
        corners = mesh.get_coordinates()
        np.testing.assert_allclose(corners[0, :, 0], TICK_S * np.arange(TICKS + 1), atol=1e-9)
        np.testing.assert_allclose(corners[:, 0, 1], [0.0, 0.25, 0.5, 0.75, 1.0])
        assert to_hex(ax.get_facecolor()) == MISSING.lower()


def test_what_is_less_the_reference_is_less_its_constant_in_a_hold(held: Path) -> None:
    """At rest the reference's state and command are those that the run starts from."""
    recording = read_recording(held)
    run = recording.configuration
    (ax,) = panel(recording, "deviation")
    wanted = [state[3] for state in run.initial_estimates]
    expected = of_nodes(held, "/plant/truth/{}", CURVATURE) - wanted
    np.testing.assert_allclose(mapped(ax), expected, atol=1e-12)
    (ax,) = panel(recording, "feedback")
    expected = of_nodes(held, "/node/{}/command", "force_n_per_m")
    expected -= run.initial_commands_n_per_m
    np.testing.assert_allclose(mapped(ax), expected, atol=1e-15)


@pytest.mark.parametrize(
    ("name", "field"),
    [("curvature-course", CURVATURE), ("velocity-course", "velocity_y_m_per_s")],
)
def test_estimate_lies_over_truth_and_the_error_below(path: Path, name: str, field: str) -> None:
    above, below = panel(read_recording(path), name)
    truth = of_nodes(path, "/plant/truth/{}", field)
    estimate = of_nodes(path, "/node/{}/estimate", field)
    shown = np.array([k not in LATE for k in range(TICKS)])
    broad = [line for line in above.lines if line.get_linewidth() == 3.6]
    thin = [line for line in above.lines if line.get_label().startswith("node")]
    errors = [line for line in below.lines if line.get_color() in {one.get_color() for one in thin}]
    errors = [line for line in errors if len(line.get_xdata()) > 2]
    assert [line.get_label() for line in thin] == [
        f"node {i}: {place} m"
        for i, place in zip(
            (0, 2, 3), ("0 0.5 0.75" if field == CURVATURE else "0.25 0.75 1").split(), strict=True
        )
    ]
    for i, node in enumerate((0, 2, 3)):
        scale = factor(above.get_ylabel())
        for line, values, by in (
            (broad[i], truth[:, node], scale),
            (thin[i], estimate[:, node], scale),
            (errors[i], (estimate - truth)[:, node], factor(below.get_ylabel())),
        ):
            times, drawn = line.get_data()
            kept = shown | np.isfinite(values)  # late ticks do not break a line, lost rows do
            np.testing.assert_allclose(times, TICK_S * np.flatnonzero(kept), atol=1e-9)
            np.testing.assert_allclose(drawn, by * values[kept], rtol=1e-12, atol=1e-15)


def test_regulated_output_tip_error_and_energy_are_as_recorded(held: Path) -> None:
    recording = read_recording(held)
    for ax, field in zip(
        panel(recording, "regulated"),
        ("mean_velocity_y_m_per_s", "mean_curvature_per_m"),
        strict=True,
    ):
        line = max(ax.lines, key=lambda one: len(one.get_xdata()))
        expected = factor(ax.get_ylabel()) * by_tick(held, "/plant/regulated", field)
        np.testing.assert_allclose(line.get_ydata(), expected, rtol=1e-12)
    (ax,) = panel(recording, "tip")
    (line,) = ax.lines
    np.testing.assert_allclose(line.get_ydata(), 1e2 * by_tick(held, "/plant/tip", "error_m"))
    assert ax.get_ylabel() == "distance from setpoint [cm]"
    (ax,) = panel(recording, "energy")
    for line in ax.lines:
        expected = by_tick(held, "/plant/energy", f"{line.get_label()}_j")
        np.testing.assert_allclose(line.get_ydata(), expected)
    assert {line.get_label() for line in ax.lines} == {"kinetic", "axial", "bending"}


def test_shapes_are_recorded_ones_with_the_estimates_of_the_same_ticks(held: Path) -> None:
    recording = read_recording(held)
    (ax,) = panel(recording, "shapes")
    rows = messages(held, "/plant/shape")
    recorded = np.array(
        [[[row[f"{axis}{i:02d}_m"] for axis in "xy"] for i in range(33)] for row in rows]
    )
    drawn = [np.asarray(line.get_xydata()) for line in ax.lines if len(line.get_xdata()) == 33]
    ticks = [int(np.flatnonzero((recorded == one).all(axis=(1, 2)))[0]) for one in drawn]
    assert ticks[0] == 0 and ticks[-1] == TICKS - 1 and sorted(ticks) == ticks
    assert SHAPES / 2 < len(ticks) <= SHAPES + 1
    dashed = [np.asarray(line.get_xydata()) for line in ax.lines if len(line.get_xdata()) == 257]
    assert len(dashed) == len(ticks)
    # The last estimate is close to the arm, the first one is the setpoint, far from it.
    assert np.hypot(*(dashed[-1][-1] - recorded[-1, -1])) < 0.05
    assert np.hypot(*(dashed[0][-1] - recorded[0, -1])) > 0.2


def test_late_ticks_gains_and_events_are_marked_on_axes_of_time(path: Path) -> None:
    recording = read_recording(path)
    events = recording.tables["/event"].columns
    added = {
        name: np.append(column, [value])
        for (name, column), value in zip(
            events.items(),
            [
                {"tick": 100, "time_s": 20.0, "name": "telemetry_lost"}.get(name, "")
                for name in events
            ],
            strict=True,
        )
    }
    added["tick"] = added["tick"].astype(np.int64)
    tables = {**recording.tables, "/event": Table("/event", added)}
    recording = dataclasses.replace(recording, tables=tables)
    late = [row["time_s"] for row in messages(path, "/plant/pace") if row["late"]]
    assert len(late) == len(LATE)
    used = {row["tick"]: row["setpoint"] for row in messages(path, "/node/00/schedule")}
    changes = [k for k in sorted(used) if k - 1 in used and used[k] != used[k - 1]]
    assert len(changes) == 1
    for name in ("curvature", "tip", "energy", "sweep-course", "estimation"):
        (ax,) = panel(recording, name)
        assert ax.get_xlim() == (0.0, TICKS * TICK_S)
        (marks,) = [line for line in ax.lines if line.get_label() == "_late"]
        np.testing.assert_allclose(marks.get_xdata(), late, atol=1e-9)
        strip = [line for line in ax.lines if line.get_label() == "_gains"]
        edge = changes[0] * TICK_S
        spans = [line.get_xdata() for line in strip]
        np.testing.assert_allclose(spans, [[0.0, edge], [edge, TICKS * TICK_S]], atol=1e-9)
        assert [line.get_color() for line in strip] == [COLOURS[1], COLOURS[0]]
        assert any(np.allclose(line.get_xdata(), 20.0) for line in ax.lines)
    figure = draw(recording, Choice(("tip",)), lambda _: None)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == [
        "gains of setpoint straight",
        "gains of setpoint bent",
        f"late tick ({len(LATE)} of {TICKS})",
        "not recorded (3 ticks)",
        "telemetry lost at 20 s",
    ]


def test_what_ended_the_run_is_marked_at_the_end_and_told_with_its_time(held: Path) -> None:
    """The stop came some ticks after the last one that every node and the plant have told of."""
    recording = read_recording(held)
    columns = recording.tables["/event"].columns
    stopped = {
        **columns,
        "tick": np.array([TICKS + 4]),
        "name": np.array(["safety_stop"], dtype=object),
    }
    tables = {**recording.tables, "/event": Table("/event", stopped)}
    figure = draw(
        dataclasses.replace(recording, tables=tables), Choice(("energy",)), lambda _: None
    )
    (ax,) = figure.axes
    assert any(np.allclose(line.get_xdata(), 0.1 * TICKS) for line in ax.lines)
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ["safety stop at 15.4 s"]


def test_a_sound_run_needs_no_key(held: Path) -> None:
    assert not draw(read_recording(held), Choice(("tip",)), lambda _: None).legends


def test_sweeps_are_counted_in_bins_and_told_by_percentiles(held: Path, path: Path) -> None:
    durations = sorted(1e-6 * row["duration_wall_ns"] for row in messages(held, "/sweep/timing"))
    (ax,) = panel(read_recording(held), "sweeps")
    labels = [text.get_text() for text in ax.get_legend().get_texts()]

    def percentile(share: float) -> float:
        below, rest = divmod(share * (len(durations) - 1), 1.0)
        pair = durations[int(below)], durations[min(int(below) + 1, len(durations) - 1)]
        return float(pair[0] + rest * (pair[1] - pair[0]))

    expected = [f"p{p} = {percentile(p / 100):.3g} ms" for p in (50, 95, 99)]
    assert labels[:-1] == expected
    end = 1.3 * percentile(0.99)
    inside = sum(one <= end for one in durations)
    assert sum(bar.get_height() for bar in ax.patches) == inside
    beyond = len(durations) - inside
    slowest = f"{durations[-1]:.3g} ms"
    assert labels[-1] == (f"{beyond} beyond, up to {slowest}" if beyond else f"max = {slowest}")
    # In late ticks no sweep begins, and in the tick before none ends.
    (ax,) = panel(read_recording(path), "sweep-course")
    drawn = np.asarray(ax.lines[0].get_ydata())
    recorded = by_tick(path, "/sweep/timing", "duration_wall_ns")
    np.testing.assert_allclose(drawn, 1e-6 * np.where(recorded > 0.0, recorded, np.nan))
    assert "period, 200 ms" in [text.get_text() for text in ax.get_legend().get_texts()]


def test_messages_are_those_whose_sums_are_in_the_file(held: Path) -> None:
    """The counters against the rows that every node wrote of what it had received."""
    kinds, links = panel(read_recording(held), "messages")
    assert kinds.get_title(loc="left") == f"Messages; sums: {2 * (NODES - 1)} a tick expected"

    def rows(topic: str, nodes: range) -> list[int]:
        return [len(messages(held, f"/node/{i:02d}/{topic}")) for i in nodes]

    forward = rows("forward_sum", range(1, NODES))
    backward = rows("backward_sum", range(NODES - 1))
    assert [bar.get_width() for bar in kinds.patches] == [
        sum(forward),
        sum(backward),
        sum(rows("measurement", range(NODES))),
        sum(rows("command", range(NODES))),
    ]
    assert [line.get_xdata()[0] for line in kinds.lines] == [
        (NODES - 1) * TICKS,
        (NODES - 1) * TICKS,
        NODES * TICKS,
        NODES * TICKS,
    ]
    assert [text.get_text() for text in kinds.texts][:3:2] == [
        f"{(NODES - 1) * TICKS} = {NODES - 1} a tick",
        f"{NODES * TICKS} = {NODES} a tick",
    ]
    drawn = {line.get_label(): line for line in links.lines}
    assert list(drawn["forward"].get_ydata()) == forward
    assert list(drawn["backward"].get_ydata()) == backward
    assert list(drawn["forward"].get_xdata()) == [0.5, 1.5, 2.5]
    assert len(drawn["ends differ (0)"].get_xdata()) == 0


def changed(recording: Recording, node: str, **fields: int) -> Recording:
    assert recording.counters is not None
    counters = json.loads(recording.counters[node]) | fields
    altered = {**recording.counters, node: json.dumps(counters)}
    return dataclasses.replace(recording, counters=altered)


def test_a_link_whose_ends_differ_is_ringed(held: Path) -> None:
    recording = changed(read_recording(held), "node/02", forward_received_messages=TICKS - 9)
    kinds, links = panel(recording, "messages")
    drawn = {line.get_label(): line for line in links.lines}
    assert drawn["ends differ (1)"].get_xydata().tolist() == [[1.5, TICKS - 9]]
    assert kinds.patches[0].get_width() == (NODES - 1) * TICKS - 9


def words(axes: list[Any]) -> str:
    return " ".join(text.get_text() for ax in axes for text in ax.texts)


def test_without_counts_the_panel_of_messages_says_why(held: Path) -> None:
    recording = read_recording(held)
    killed = dataclasses.replace(recording, counters=None)
    assert "the file ends before the final counters" in words(panel(killed, "messages"))
    assert recording.counters is not None
    silent = {k: v for k, v in recording.counters.items() if k != "node/01"}
    silent["nodes_reporting"] = str(NODES - 1)
    partly = dataclasses.replace(recording, counters=silent)
    assert "of 3 of 4 nodes arrived" in words(panel(partly, "messages"))


def test_without_feedback_there_is_no_map_of_it(held: Path) -> None:
    recording = read_recording(held)
    run = dataclasses.replace(recording.configuration, control=False)
    off = dataclasses.replace(recording, configuration=run)
    assert words(panel(off, "feedback")) == "this run has no feedback"
    assert "no feedback" in draw(off, Choice(("tip",)), lambda _: None).get_suptitle()


def _cut(source: Path, share: float) -> Recording:
    short = source.with_name(f"cut-{share}.mcap")
    raw = source.read_bytes()
    short.write_bytes(raw[: int(share * len(raw))])
    return read_recording(short)


def _written(out: Path, scenario: Scenario, **more: Any) -> Recording:
    write_recording(out, scenario, **more)
    return read_recording(out)


def _silent(path: Path) -> Recording:
    """At rest where it is wanted, without noise or disturbance: no error, no motion."""
    scenario = Scenario(nodes=3, ticks=5, setpoint="straight", initial="setpoint", noise=(0.0, 0.0))
    return _written(path, scenario)


PLANT_LOST = frozenset((k, PLANT) for k in range(5))
ODD: dict[str, Callable[[Path], Recording]] = {
    "one tick": lambda p: _written(p, Scenario(nodes=2, ticks=1)),
    "two ticks": lambda p: _written(p, Scenario(nodes=2, ticks=2)),
    "one tick of a run with moves": lambda p: _written(
        p, Scenario(nodes=3, ticks=1, first_hold_s=1.0, legs=LEGS)
    ),
    "every other tick late": lambda p: _written(
        p, Scenario(nodes=3, ticks=30, late=frozenset(range(1, 30, 2)))
    ),
    "no tick with a sweep but the first": lambda p: _written(
        p, Scenario(nodes=3, ticks=4, late=frozenset({1, 2}))
    ),
    "a hundred nodes": lambda p: _written(p, Scenario(nodes=100, ticks=3, tick_s=0.05)),
    "plant heard at the end only": lambda p: _written(
        p, Scenario(nodes=3, ticks=6), skip=PLANT_LOST
    ),
    "a node heard at the end only": lambda p: _written(
        p, Scenario(nodes=3, ticks=6), skip=frozenset((k, 1) for k in range(5))
    ),
    "recorder killed": lambda p: _written(p, Scenario(nodes=3, ticks=20), close=False),
    "silent": _silent,
    "chebyshev": lambda p: _written(p, Scenario(nodes=5, ticks=8, spacing="chebyshev")),
    "version 3": lambda p: read_recording(Path(__file__).parents[1] / "data/recording_v3.mcap"),
}


@pytest.fixture(scope="module")
def odd(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Recording]:
    made: dict[str, Recording] = {}
    folder = tmp_path_factory.mktemp("odd")

    def get(name: str) -> Recording:
        if name not in made:
            made[name] = ODD[name](folder / f"{name.replace(' ', '-')}.mcap")
        return made[name]

    return get


@pytest.mark.variants("every other tick late", "recorder killed")
@pytest.mark.parametrize("kind", ODD)
def test_every_panel_draws_every_odd_recording(
    odd: Callable[[str], Recording], kind: str, tmp_path: Path
) -> None:
    """Any warning is an error."""
    recording = odd(kind)
    figure = draw(recording, Choice(dpi=40), lambda _: None)
    for name in PANELS:
        axes = [ax for ax in figure.axes if ax.get_label() == name]
        assert axes[0].get_title(loc="left"), name
        written = any(ax.texts for ax in axes)
        assert written or axes[-1].get_xlabel(), name
    figure.savefig(tmp_path / "odd.png")


@pytest.mark.variants("0.3")
@pytest.mark.parametrize("share", [0.3, 0.8])
def test_a_file_cut_short_says_so_and_shows_what_there_is(held: Path, share: float) -> None:
    recording = _cut(held, share)
    assert 0 < recording.ticks <= TICKS and recording.unfinished
    figure = draw(recording, Choice(dpi=40), lambda _: None)
    said = figure.get_suptitle().replace("\n", " ")
    assert f"recording unfinished, {recording.ticks} of {TICKS} ticks" in said
    (ax,) = [ax for ax in figure.axes if ax.get_label() == "curvature"]
    np.testing.assert_array_equal(
        mapped(ax), of_nodes(held, "/plant/truth/{}", CURVATURE)[: recording.ticks]
    )


def test_nothing_written_in_a_panel_leaves_the_figure(path: Path) -> None:
    recording = read_recording(path)
    for choice in (Choice(), Choice(("messages", "shapes"), 9.0), Choice(("tip",), 4.5)):
        figure = draw(recording, choice, lambda _: None)
        wide, tall = (figure.get_size_inches() * figure.dpi).tolist()
        for ax in figure.axes:
            box = ax.get_tightbbox()
            assert box is not None
            assert box.x0 >= -1.0 and box.y0 >= -1.0, ax.get_label()
            assert box.x1 <= wide + 1.0 and box.y1 <= tall + 1.0, ax.get_label()
