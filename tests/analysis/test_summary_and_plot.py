"""What a run reports: every key with a plausible value, a table for a person, a picture."""

import cmath
import dataclasses
import json
import math
import re
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from simulated_run import BYTES_PER_MESSAGE, Scenario, make_artefact, write_recording

from analysis.goals import setpoint_shape
from analysis.panels.arm import telling_ticks
from analysis.plot import draw_run, plot_run
from analysis.recording import read_recording
from analysis.render import render
from analysis.summary import summarise
from wire.errors import UsageError


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("run") / "recording.mcap"
    write_recording(out, Scenario(nodes=4, ticks=240, disturbance="chapter"))
    return out


def test_the_summary_has_what_the_command_line_promises(path: Path) -> None:
    summary = summarise(path)
    assert json.loads(json.dumps(summary, allow_nan=False)) == summary
    assert summary["nodes"] == 4
    assert summary["ticks"] == summary["ticks_asked_for"] == 240
    assert summary["tick_s"] == 0.1
    assert summary["neighbour_messages"] == 2 * 3 * 240
    assert summary["neighbour_messages_per_tick"] == 6
    assert summary["bytes_per_message"] == BYTES_PER_MESSAGE
    assert summary["sweep_messages"] == {
        "forward": 720,
        "backward": 720,
        "measurement": 960,
        "command": 960,
    }
    assert 0.0 < summary["sweep_ms"]["p50"] < summary["sweep_ms"]["p99"]
    assert summary["start_up_s"] == pytest.approx(0.31)
    assert summary["max_difference_to_central"] < 1e-12
    assert summary["estimation_error"]["initial"] == 1.0
    assert 0.0 < summary["estimation_error"]["final"] < 0.5
    assert summary["tip_error_m"]["initial"] > 0.1
    assert summary["estimation_below_1_percent_s"] == {"observer": None, "open_loop_model": None}
    assert summary["gamma"]["observer"] == {"certified": 0.1414, "achieved": 0.135}
    assert summary["rejected_messages"] == 0
    assert summary["intact_links"] == 6
    assert summary["ended"] == "finished"
    assert summary["recording"] == str(path)
    assert summary["recording_complete"] is True
    assert len(summary["artefact_sha256"]) == 64


def test_a_link_that_lost_or_altered_something_is_not_counted_as_intact(path: Path) -> None:
    recording = read_recording(path)
    assert recording.counters is not None
    for field, changed in (("forward_received_crc32", 4), ("forward_received_messages", 239)):
        counters = json.loads(recording.counters["node/02"]) | {field: changed}
        altered = {**recording.counters, "node/02": json.dumps(counters)}
        assert dataclasses.replace(recording, counters=altered).intact_links() == 5
    silent = {k: v for k, v in recording.counters.items() if k != "node/01"}
    assert dataclasses.replace(recording, counters=silent).intact_links() is None


def test_the_estimation_error_is_the_energy_of_the_difference(path: Path) -> None:
    """By hand from the recorded numbers and the arm's stiffnesses, 4 equal segments."""
    recording = read_recording(path)
    arm, h = recording.artefact.arm, 0.25
    dual = np.array([h, h, h, h / 2.0])
    energy = 0.0
    for i in range(4):
        v_x, v_y, e, k = recording.estimates[-1, i] - recording.truth[-1, i]
        energy += 0.5 * arm.mass_per_length_kg_per_m * dual[i] * (v_x**2 + v_y**2)
        energy += 0.5 * arm.axial_stiffness_n * h * e**2
        energy += 0.5 * arm.bending_stiffness_n_m2 * dual[3 - i] * k**2
    final = summarise(path)["estimation_error_root_joule"]["final"]
    assert final == pytest.approx(math.sqrt(energy), rel=1e-9)


def test_the_shape_error_is_the_distance_of_the_shapes_and_counts_signs(path: Path) -> None:
    """Each arm by hand as a chain of complex numbers, 4 equal segments, root's dual cell half."""
    recording = read_recording(path)

    def faces(states: np.ndarray) -> list[complex]:
        places, angle = [0j], 0.0
        for i, (_, _, strain, curvature) in enumerate(states):
            angle += curvature * (0.125 if i == 0 else 0.25)
            places.append(places[-1] + 0.25 * (1.0 + strain) * cmath.exp(1j * angle))
        return places[1:]

    def distance(estimate: np.ndarray, truth: np.ndarray) -> float:
        pairs = zip(faces(estimate), faces(truth), strict=True)
        return math.sqrt(sum(abs(a - b) ** 2 for a, b in pairs) / 4.0)

    summary = summarise(path)
    first, last = (distance(recording.estimates[k], recording.truth[k]) for k in (0, -1))
    assert summary["shape_estimation_error_m"] == pytest.approx({"initial": first, "final": last})
    assert summary["shape_estimation_error"] == pytest.approx(
        {"initial": 1.0, "final": last / first}
    )
    for k in (0, 20):  # signs as the arm has them; 4 segments are coarse
        tip = faces(recording.truth[k])[-1]
        recorded = recording.of_plant("tip", ("x_m", "y_m"))[k]
        assert recorded[1] > 0.2
        assert [tip.real, tip.imag] == pytest.approx(recorded.tolist(), abs=0.12)


def test_the_three_measures_of_the_estimation_have_their_times(path: Path) -> None:
    """Without correction only drag, 0.01/s on average, takes the error away: ln(100)/0.01 = 461 s."""
    summary = summarise(path)
    assert summary["shape_below_1_percent_s"]["open_loop_model"] is None
    # The shape error swings with the first mode (37 s), so 24 s give no rate to extrapolate by.
    assert summary["shape_below_1_percent_extrapolated_s"] == {"open_loop_model": None}
    linear = summary["linear_model_below_1_percent_s"]
    assert linear["open_loop_model"] == pytest.approx(461.0, rel=0.15)
    assert 0.0 < linear["observer"] < 0.5 * linear["open_loop_model"]
    text = render(summary)
    assert "energy norm; open-loop model" in text
    assert "rms distance of estimated from true arm" in text
    assert f"{linear['observer']:.3g} s" in text


def test_the_table_says_it_in_words_and_units(path: Path) -> None:
    text = render(summarise(path))
    assert "4 nodes, 240 ticks of 0.1 s" in text
    assert "1440, 6 a tick" in text
    assert "not within the run (extrapolated:" in text
    assert f"recording {path} (complete)" in text
    assert "None" not in text
    assert max(map(len, text.splitlines()[:-1])) <= max(118, len(str(path)) + 25)


def test_the_table_of_a_run_cut_short_says_so(path: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    raw = path.read_bytes()
    cut.write_bytes(raw[: len(raw) // 2])
    text = render(summarise(cut))
    assert "of 240 ticks of 0.1 s" in text
    assert re.search(r"^neighbour messages +unknown ", text, re.MULTILINE)
    assert "(not complete: ends in the middle of a record at byte" in text


def test_the_plot_is_a_png_of_readme_width(path: Path, tmp_path: Path) -> None:
    png = tmp_path / "new" / "plot.png"
    plot_run(path, png)  # any warning is an error
    height, width, _ = matplotlib.image.imread(png).shape
    assert (width, height) == (1400, 820)
    assert 50_000 < png.stat().st_size < 1_000_000


def test_every_panel_has_labels_with_units_and_nothing_leaves_the_figure(path: Path) -> None:
    figure = draw_run(read_recording(path))
    panels = [ax for ax in figure.axes if ax.get_title(loc="left")]
    assert [ax.get_title(loc="left")[:3] for ax in panels] == [f"({c})" for c in "abcdef"]
    for ax in panels:
        assert "[" in ax.get_xlabel()
        assert ax.get_ylabel()
        box = ax.get_tightbbox()
        assert box is not None
        assert box.x0 >= 0.0
        assert box.y0 >= 0.0
        assert box.x1 <= 1400.0
        assert box.y1 <= 820.0


def test_a_recording_cut_short_can_be_plotted(path: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut.mcap"
    raw = path.read_bytes()
    cut.write_bytes(raw[: len(raw) // 2])
    title = draw_run(read_recording(cut)).get_suptitle()
    assert "recording unfinished" in title


def test_two_nodes_and_two_ticks_can_be_plotted(tmp_path: Path) -> None:
    small = tmp_path / "small.mcap"
    write_recording(small, Scenario(nodes=2, ticks=2, setpoint="straight", initial="setpoint"))
    draw_run(read_recording(small))
    summary = summarise(small)
    json.dumps(summary, allow_nan=False)
    render(summary)


def test_one_tick_can_be_plotted_and_a_bad_place_is_named(path: Path, tmp_path: Path) -> None:
    small = tmp_path / "small.mcap"
    write_recording(small, Scenario(nodes=2, ticks=1))
    plot_run(small, tmp_path / "plot.png")
    assert summarise(small)["ticks"] == 1
    with pytest.raises(UsageError, match=r"Not a directory|File exists"):
        plot_run(path, path / "plot.png")


def test_the_setpoint_of_constant_curvature_is_an_arc() -> None:
    bent = make_artefact().setpoints[1]
    arc = type(bent)(
        **{f: getattr(bent, f) for f in bent.__struct_fields__} | {"curvature_per_m": [2.0]}
    )
    shape = setpoint_shape(arc, 1.0)
    assert shape[-1] == pytest.approx([math.sin(2.0) / 2.0, (1 - math.cos(2.0)) / 2.0], abs=1e-5)


def test_shapes_are_drawn_at_equal_steps_of_the_tips_path() -> None:
    x = np.concatenate([np.linspace(0.0, 1.0, 11), np.ones(90)])
    shapes = np.zeros((101, 2, 2))
    shapes[:, -1, 0] = x
    assert telling_ticks(shapes, 6) == [0, 2, 4, 6, 8, 10, 100]
    assert telling_ticks(np.zeros((5, 3, 2)), 6) == [0, 4]
