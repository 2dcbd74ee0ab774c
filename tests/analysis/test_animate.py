"""The film of a run: pictures that show what was recorded, a whole GIF or none, refusals."""

import dataclasses
import itertools
import json
import math
from pathlib import Path
from unittest import mock

import in_process
import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image
from scipy.integrate import solve_ivp
from simulated_run import Scenario, make_artefact, write_recording

from analysis.animate import Film, animate, choose_ticks
from analysis.estimated_arm import Near, arm_curve
from analysis.goals import COLOURS, colour, sectors
from analysis.recording import Recording, read_recording
from analysis.scene import Scene
from analysis.shape_error import face_positions
from wire.errors import UsageError
from wire.run_config import SchedulingConfig

Array = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("film") / "recording.mcap"
    write_recording(out, Scenario(nodes=4, ticks=40))
    return out


@pytest.fixture(scope="module")
def recording(path: Path) -> Recording:
    return read_recording(path)


def frames_of(gif: Path) -> list[tuple[int, npt.NDArray[np.uint8]]]:
    """Duration in ms and pixels of each frame, by Pillow's own reader."""
    with Image.open(gif) as film:
        out = []
        for i in range(getattr(film, "n_frames", 1)):
            film.seek(i)
            out.append((int(film.info["duration"]), np.asarray(film.convert("RGB"))))
        return out


def test_a_run_becomes_a_small_gif_of_the_asked_size(path: Path, tmp_path: Path) -> None:
    gif = tmp_path / "arm.gif"
    facts = animate(path, gif, Film(fps=5.0, speed=2.0, width_px=320), lambda _: None)
    frames = frames_of(gif)
    # 3.9 s at double speed: every fourth tick, and the last one
    assert facts["frames"] == len(frames) == 11
    assert [duration for duration, _ in frames] == [200] * 10 + [1500]
    assert {pixels.shape[1] for _, pixels in frames} == {facts["width_px"]} == {320}
    assert facts["bytes"] == gif.stat().st_size < 200_000
    assert list(tmp_path.iterdir()) == [gif]
    # The arm moves, the axes do not.
    assert (frames[0][1] != frames[5][1]).any()
    assert (frames[0][1][-40:] == frames[5][1][-40:]).all()
    assert json.loads(json.dumps(facts)) == facts


def test_the_arm_is_drawn_where_the_recording_has_it(recording: Recording) -> None:
    """The pixels in the setpoint's colour, as wide as the arm's line, end at the recorded tip."""
    ticks = [0, 20, 39]
    scene = Scene(recording, ticks, 480)
    (ax,) = scene.figure.axes
    for k in ticks:
        pixels = scene.draw(k).astype(int)
        tone = [int(colour(1)[i : i + 2], 16) for i in (1, 3, 5)]
        ours = np.abs(pixels - tone).sum(axis=2) < 30
        for point in recording.shapes_m[k, 8::8]:
            column, up = ax.transData.transform(point)
            row = len(pixels) - up
            near = ours[round(row) - 3 : round(row) + 4, round(column) - 3 : round(column) + 4]
            assert near.sum() >= 5
        x, y = ax.transData.transform(recording.shapes_m[k, -1])
        beyond = ours[20 : int(len(pixels) - y) - 12] if k == 0 else ours[:0]
        assert not beyond[:, : int(x)].any()  # nothing of the arm is above its tip


def test_a_picture_has_units_the_time_the_error_and_the_setpoint(recording: Recording) -> None:
    scene = Scene(recording, [0, 10], 480, "2 x real time")
    scene.draw(10)
    (ax,) = scene.figure.axes
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("x [m]", "y [m]")
    said = [text.get_text() for text in scene.figure.texts]
    error = 1e3 * float(recording.of_plant("tip", ("error_m",))[10, 0])
    assert {"time 1.0 s", f"tip error {error:.1f} mm", "setpoint bent", "2 x real time"} <= {*said}


def test_nothing_that_is_written_overlaps_or_leaves_the_picture(recording: Recording) -> None:
    scene = Scene(recording, [0, 10], 480, "12.5 x real time")
    scene.draw(0)
    figure = scene.figure
    (ax,) = figure.axes
    (legend,) = figure.legends
    written = [*figure.texts, *ax.texts, ax.xaxis.label, ax.yaxis.label, legend]
    for axis, limits in ((ax.xaxis, ax.get_xlim()), (ax.yaxis, ax.get_ylim())):
        ticks = [
            tick for tick in axis.get_major_ticks() if limits[0] <= tick.get_loc() <= limits[1]
        ]
        written += [tick.label1 for tick in ticks]
    boxes = [one.get_window_extent() for one in written]
    width, height = scene.size
    for box in boxes:
        assert box.x0 >= 0.0 and box.y0 >= 0.0 and box.x1 <= width and box.y1 <= height
    for a, b in itertools.combinations(boxes, 2):
        assert not (min(a.x1, b.x1) > max(a.x0, b.x0) and min(a.y1, b.y1) > max(a.y0, b.y0))


def test_setpoints_have_sectors_midway_between_their_tips(recording: Recording) -> None:
    _, bent = make_artefact().setpoints
    middle = 0.5 * math.atan2(bent.tip_m[1], bent.tip_m[0])
    assert sectors(recording) == {}
    both = SchedulingConfig((0, 1), (math.degrees(middle),), 1.0, 2.0)
    run = dataclasses.replace(recording.configuration, scheduling=both)
    found = sectors(dataclasses.replace(recording, configuration=run))
    assert found[0] == pytest.approx((-middle, middle))
    assert found[1] == pytest.approx((middle, 3.0 * middle))
    assert len({colour(i) for i in range(6)}) == len(COLOURS) == 6


@pytest.mark.parametrize("bend", [0.0, 0.9])
def test_a_smooth_arm_through_node_states_is_the_integral_of_curvature_and_strain(
    bend: float,
) -> None:
    """Against an ODE solver on the continuous arm; a node's curvature is at its inner face.

    With `bend`, the near arm turns by so much within 2 cm, which the nodes' numbers alone cannot show.
    """
    length, faces = 0.8, 0.8 * np.array([0.0, 0.07, 0.2, 0.33, 0.45, 0.6, 0.7, 0.82, 0.9, 1.0])

    def sharp(s: Array) -> Array:
        return bend / 0.02 * np.exp(-s / 0.02)

    def curvature(s: Array) -> Array:
        return sharp(s) + 4.0 * np.cos(3.0 * s) * (1.0 - s / length)

    def strain(s: Array) -> Array:
        return 0.05 - 0.04 * s

    def slope(s: float, y: Array) -> list[float]:
        k, e = float(curvature(np.array(s))), float(strain(np.array(s)))
        return [k, (1.0 + e) * math.cos(y[0]), (1.0 + e) * math.sin(y[0])]

    places = np.linspace(0.0, length, 257)
    true = solve_ivp(slope, (0.0, length), [0.0] * 3, t_eval=places, rtol=1e-9, atol=1e-12).y[1:]
    near = Near(
        angle=lambda s: bend * (1.0 - np.exp(-s / 0.02)),
        strain=lambda s: 0.03 * np.ones_like(s),
        node_curvature_per_m=sharp(faces[:-1]),
    )
    state = np.zeros((9, 4))
    state[:, 2] = strain(0.5 * (faces[1:] + faces[:-1]))
    state[:, 3] = curvature(faces[:-1])
    apart = np.hypot(*(arm_curve(state, faces, near).T - true)).max()
    assert apart < 1e-3
    assert apart < 0.1 * np.hypot(*(face_positions(state, faces)[-1] - true[:, -1]))
    state[3, 3] = np.nan
    assert np.isnan(arm_curve(state, faces, near)).all()


@pytest.mark.parametrize("speed", [None, 0.05, 1.0, 40.0])
def test_ticks_are_evenly_spaced_and_end_with_the_last(
    recording: Recording, speed: float | None
) -> None:
    used, ticks = choose_ticks(recording, Film(fps=10.0, speed=speed))
    assert used == (1.0 if speed is None else speed)  # 3.9 s need no hurry
    assert (ticks[0], ticks[-1]) == (0, 39)
    steps = set(np.diff(ticks[:-1]).tolist())
    assert steps <= {max(1, round(used))}


def test_what_cannot_be_shown_is_refused_by_name() -> None:
    for wrong, culprit in (
        ({"fps": 0.0}, "--fps"),
        ({"fps": 61.0}, "--fps"),
        ({"fps": math.nan}, "--fps"),
        ({"speed": 0.0}, "--speed"),
        ({"speed": math.inf}, "--speed"),
        ({"width_px": 5}, "--width"),
    ):
        with pytest.raises(UsageError, match=culprit):
            Film(**wrong)


def test_too_many_frames_are_refused(recording: Recording) -> None:
    with (
        mock.patch("analysis.animate.MOST_FRAMES", 30),
        pytest.raises(UsageError, match=r"--speed 1: that would be 40 frames, expected at most 30"),
    ):
        choose_ticks(recording, Film(fps=10.0, speed=1.0))


def octarm(*arguments: str | Path) -> object:
    """`octarm animate` in this process; its exit code."""
    return in_process.octarm("animate", *arguments)


def test_the_verb_takes_a_directory_and_writes_over_nothing_unasked(
    path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    few = ("--fps", "1", "--width", "240")
    assert octarm(path.parent, "--json", *few) == 0
    facts = json.loads(capsys.readouterr().out)
    gif = path.with_name("arm.gif")
    assert facts["animation"] == str(gif)
    first = gif.read_bytes()
    assert octarm(path, *few) == 2
    assert "exists already; give another name or --force" in capsys.readouterr().err
    assert octarm(path, *few, "--force", "--speed", "2") == 0
    assert "2 x real time" in capsys.readouterr().out
    assert gif.read_bytes() != first
    gif.unlink()


def test_nothing_is_left_of_a_film_that_failed(path: Path, tmp_path: Path) -> None:
    gif = tmp_path / "arm.gif"
    with (
        mock.patch("analysis.scene.Scene.draw", side_effect=KeyboardInterrupt),
        pytest.raises(KeyboardInterrupt),
    ):
        animate(path, gif, Film(), lambda _: None)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("name", "culprit"),
    [
        ("arm.avi", "ends in .gif or .mp4"),
        ("arm", "ends in .gif or .mp4"),
        ("none/arm.gif", "No such file or directory"),
        ("folder.gif", "is a directory"),
    ],
)
def test_a_target_that_cannot_be_written_is_named(
    path: Path, tmp_path: Path, name: str, culprit: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "folder.gif").mkdir()
    assert octarm(path, "--out", tmp_path / name) == 2
    out, err = capsys.readouterr()
    assert (out, "Traceback" in err, culprit in err, name in err) == ("", False, True, True)


def test_a_recording_without_an_arm_to_draw_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    short = tmp_path / "short.mcap"
    write_recording(short, Scenario(nodes=2, ticks=1))
    assert octarm(short, "--out", tmp_path / "arm.gif") == 2
    assert "at least 2 ticks with the arm's shape to draw, got 1" in capsys.readouterr().err
    assert octarm(tmp_path / "no.mcap", "--out", tmp_path / "arm.gif") == 2
    assert "no.mcap" in capsys.readouterr().err
    assert not (tmp_path / "arm.gif").exists()


def test_a_recording_that_was_cut_short_is_shown_and_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_recording(tmp_path / "recording.mcap", Scenario(nodes=2, ticks=20), close=False)
    assert in_process.octarm("animate", tmp_path, "--quiet") == 3
    assert "recording unfinished" in capsys.readouterr().out
    assert (tmp_path / "arm.gif").exists()
