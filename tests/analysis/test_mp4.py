"""The film as MP4: what ffprobe says of it, its pictures decoded again, what ffmpeg's failures become."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import in_process
import numpy as np
import numpy.typing as npt
import pytest
from simulated_run import Scenario, write_recording

from analysis.animate import Film, animate, choose_ticks
from analysis.mp4 import even, is_whole, write_mp4
from analysis.recording import read_recording
from analysis.scene import Scene
from wire.errors import UsageError

ROOT = Path(__file__).parents[2]
Pixels = npt.NDArray[np.uint8]
needs_ffmpeg = pytest.mark.skipif(
    shutil.which("ffmpeg") is None or shutil.which("ffprobe") is None, reason="ffmpeg is not there"
)


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("film") / "recording.mcap"
    write_recording(out, Scenario(nodes=4, ticks=40))
    return out


def octarm(*arguments: str | Path) -> object:
    return in_process.octarm("animate", *arguments)


def probed(film: Path) -> dict[str, Any]:
    command = ["ffprobe", "-v", "error", "-count_frames", "-show_streams", "-of", "json", str(film)]
    done = subprocess.run(command, capture_output=True, check=True)
    (stream,) = json.loads(done.stdout)["streams"]
    assert isinstance(stream, dict)
    return stream


def decoded(film: Path, width: int, height: int) -> Pixels:
    """All pictures, (frames, height, width, 3), by ffmpeg."""
    command = ["ffmpeg", "-v", "error", "-i", str(film), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run(command, capture_output=True, check=True)
    return np.frombuffer(done.stdout, dtype=np.uint8).reshape(-1, height, width, 3)


@needs_ffmpeg
@pytest.mark.parametrize(("fps", "width"), [(60.0, 321), (12.5, 240)])
def test_the_film_is_what_players_and_browsers_show(
    path: Path, tmp_path: Path, fps: float, width: int
) -> None:
    out = tmp_path / "arm.mp4"
    facts = animate(path, out, Film(fps, 2.0, width), lambda _: None)
    stream = probed(out)
    assert (stream["codec_name"], stream["pix_fmt"]) == ("h264", "yuv420p")
    assert (stream["color_space"], stream["color_range"]) == ("bt709", "tv")
    assert (stream["width"], stream["height"]) == (facts["width_px"], facts["height_px"])
    assert stream["width"] == width + width % 2 and stream["height"] % 2 == 0
    assert int(stream["nb_read_frames"]) == facts["frames"]
    assert float(stream["duration"]) == pytest.approx(facts["frames"] / fps, abs=1e-3)
    assert rate(stream["avg_frame_rate"]) == pytest.approx(fps)
    assert facts["bytes"] == out.stat().st_size < 200_000
    raw = out.read_bytes()
    assert raw.index(b"moov") < raw.index(b"mdat")  # fast start: shown while it loads
    assert is_whole(out)
    assert list(tmp_path.iterdir()) == [out]
    assert out.stat().st_mode & 0o777 == 0o644


def rate(text: str) -> float:
    above, below = text.split("/")
    return int(above) / int(below)


@needs_ffmpeg
def test_its_pictures_are_those_of_the_scene(path: Path, tmp_path: Path) -> None:
    """The GIF's own pictures before their palette, within what compression and halved colours cost."""
    out, film = tmp_path / "arm.mp4", Film(10.0, 2.0, 321)
    facts = animate(path, out, film, lambda _: None)
    pictures = decoded(out, facts["width_px"], facts["height_px"]).astype(int)
    recording = read_recording(path)
    speed, ticks = choose_ticks(recording, film)
    scene = Scene(recording, ticks, 321, f"{speed:g} x real time")
    assert len(pictures) == len(ticks) == 21
    for shown, tick in zip(pictures, ticks, strict=True):
        drawn = scene.draw(tick).astype(int)
        height, width, _ = drawn.shape
        apart = np.abs(shown[:height, :width] - drawn)
        assert apart.mean() < 3.0
        # Areas, where halved colours do not matter: white stays white, the sector its tone.
        flat = (np.ptp(drawn[:-2, :-2], axis=2) < 4) & (drawn[:-2, :-2, 0] > 250)
        assert apart[:-2, :-2][flat].mean() < 1.0
    still = scene.draw(ticks[0]).astype(int)[:height, :width]
    moved = np.abs(pictures[-1][:height, :width] - still).mean()
    assert moved > 3.0 * np.abs(pictures[0][:height, :width] - still).mean()


def test_odd_pictures_get_a_row_and_a_column_more() -> None:
    picture = np.arange(5 * 3 * 3, dtype=np.uint8).reshape(5, 3, 3)
    larger = even(picture)
    assert larger.shape == (6, 4, 3)
    assert (larger[:5, :3] == picture).all()
    assert (larger[5, :3] == picture[4]).all() and (larger[:5, 3] == picture[:, 2]).all()
    assert (even(larger) == larger).all()


def test_without_ffmpeg_the_remedy_is_told_before_anything_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    assert octarm(tmp_path / "none.mcap", "--out", tmp_path / "arm.mp4") == 2
    assert capsys.readouterr().err == (
        f"octarm: --out {tmp_path / 'arm.mp4'}: ffmpeg was not found; install it, or take a name that "
        "ends in .gif\n"
    )
    assert list(tmp_path.iterdir()) == []


def test_a_gif_is_not_faster_than_a_gif_can_be(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert octarm(path, "--out", tmp_path / "arm.gif", "--fps", "60") == 2
    assert "--fps: expected 0.5 to 50 frames a second for .gif, got 60" in capsys.readouterr().err
    assert octarm(path, "--out", tmp_path / "arm.mp4", "--fps", "61") == 2
    assert "--fps: expected 0.5 to 60 frames a second, got 61" in capsys.readouterr().err


@needs_ffmpeg
def test_an_encoder_that_is_not_there_is_told_in_ffmpegs_words(
    path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with mock.patch("analysis.mp4.ENCODER", "no_such_encoder"):
        assert octarm(path, "--out", tmp_path / "arm.mp4") == 2
    err = capsys.readouterr().err
    assert "arm.mp4: ffmpeg failed: Unknown encoder 'no_such_encoder'" in err
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def tiny(tmp_path: Path) -> Iterator[Path]:
    """A disk that is full after 16 kB."""
    place = tmp_path / "tiny"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=16k", "tmpfs", place], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"no small disk can be mounted: {mounted.stderr.decode().strip()}")
    try:
        yield place
    finally:
        subprocess.run(["umount", place], check=True)


@needs_ffmpeg
def test_a_full_disk_is_told_and_leaves_nothing(
    path: Path, tiny: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert octarm(path, "--out", tiny / "arm.mp4", "--speed", "0.3") == 2
    err = capsys.readouterr().err
    assert "arm.mp4: ffmpeg failed: " in err and "No space left on device" in err
    assert list(tiny.iterdir()) == []


@needs_ffmpeg
def test_a_film_that_was_cut_is_not_taken_for_whole(path: Path, tmp_path: Path) -> None:
    out = tmp_path / "arm.mp4"
    animate(path, out, Film(5.0, 4.0, 240), lambda _: None)
    raw = out.read_bytes()
    cut = tmp_path / "cut.mp4"
    for size in (len(raw) - 1, len(raw) // 2, 20, 4, 0):
        cut.write_bytes(raw[:size])
        assert not is_whole(cut)
    cut.write_bytes(raw + b"\0\0\0\x08free")
    assert is_whole(cut)


@needs_ffmpeg
def test_ffmpeg_that_is_killed_is_told_by_the_signal(tmp_path: Path) -> None:
    def frames() -> Iterator[Pixels]:
        for i in range(200):
            if i == 3:
                (mine,) = children("ffmpeg")
                os.kill(mine, signal.SIGKILL)
            yield np.full((240, 240, 3), i, dtype=np.uint8)

    with pytest.raises(UsageError, match=r"arm\.mp4: ffmpeg failed: it was ended by SIGKILL"):
        write_mp4(tmp_path / "growing.mp4", frames(), (240, 240), 20.0, tmp_path / "arm.mp4")


def children(name: str, parent: int | None = None) -> list[int]:
    """Process numbers of the living children with this name."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                command, _, rest = (entry / "stat").read_text().rpartition(")")
                state, above = rest.split()[:2]
                mine = int(above) == (os.getpid() if parent is None else parent)
                if mine and state != "Z" and command.endswith(f"({name}"):
                    found.append(int(entry.name))
    return found


def alive(pid: int) -> bool:
    try:
        return (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@needs_ffmpeg
def test_nothing_is_left_of_a_film_whose_picture_failed(path: Path, tmp_path: Path) -> None:
    with (
        mock.patch("analysis.scene.Scene.draw", side_effect=KeyboardInterrupt),
        pytest.raises(KeyboardInterrupt),
    ):
        animate(path, tmp_path / "arm.mp4", Film(), lambda _: None)
    assert list(tmp_path.iterdir()) == []
    assert children("ffmpeg") == []


@pytest.mark.variants("9")
@needs_ffmpeg
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_ffmpeg_ends_with_the_verb(
    tmp_path_factory: pytest.TempPathFactory, tmp_path: Path, end: signal.Signals
) -> None:
    """However the verb ends; only a SIGKILL leaves what was written so far."""
    path = tmp_path_factory.mktemp("long") / "recording.mcap"
    write_recording(path, Scenario(nodes=4, ticks=60))  # a film of 18000 pictures
    command = [sys.executable, str(ROOT / "launcher.py"), "animate", str(path)]
    command += [
        "--out",
        str(tmp_path / "arm.mp4"),
        "--speed",
        "0.02",
        "--fps",
        "60",
        "--width",
        "1200",
    ]
    verb = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
    limit = time.monotonic() + 60.0
    try:
        while not (mine := children("ffmpeg", verb.pid)):
            assert verb.poll() is None and time.monotonic() < limit
            time.sleep(0.02)
        verb.send_signal(end)
        _, err = verb.communicate(timeout=60.0)
    finally:
        verb.kill()
        verb.wait()
    assert verb.returncode == (-end if end is signal.SIGKILL else 130), err
    while alive(mine[0]):
        assert time.monotonic() < limit
        time.sleep(0.02)
    assert not (tmp_path / "arm.mp4").exists()
    if end is not signal.SIGKILL:
        assert list(tmp_path.iterdir()) == []
