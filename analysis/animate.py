"""The film of a run: a GIF or MP4 of the arm in the plane, from a recording.

Last step of the analysis: recording in, film out. The pictures are `analysis.scene`'s; here are the
choice of ticks, and for the GIF the common palette, which keeps the file small, and the writing;
`analysis.mp4` writes the other kind.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np
from PIL import Image

from analysis.goals import active_setpoints
from analysis.mp4 import even, find_ffmpeg, write_mp4
from analysis.recording import Recording, find_recording, read_recording
from analysis.scene import Pixels, Scene
from analysis.whole_file import check_free, whole
from wire.errors import UsageError

FILM_S = 10.0
"""Length of the film if no speed is given."""
KINDS = {".gif": 50.0, ".mp4": 60.0}
"""Kinds of film and the most frames a second: a GIF counts hundredths of a second, viewers skip single ones."""
MOST_FRAMES = 3000
COLOURS, EXACT = 64, 24
"""Of the palette that all frames share; so many of them are the pictures' most frequent ones."""
_UNKNOWN = 255
LAST_S = 1.5
"""How long the last frame stays before the film begins again."""
SAY_EVERY_S = 2.0


@dataclass(frozen=True)
class Film:
    """How to show a run. Raises UsageError, naming the option, for what cannot be shown."""

    fps: float = 15.0
    """Frames a second; `KINDS` has how many there can be."""
    speed: float | None = None
    """Seconds of the arm's time in a second of the film; default: such that it lasts 10 s."""
    width_px: int = 480

    def __post_init__(self) -> None:
        if not 0.5 <= self.fps <= max(KINDS.values()):
            raise UsageError(
                f"--fps: expected 0.5 to {max(KINDS.values()):g} frames a second, got {self.fps:g}"
            )
        if self.speed is not None and not (math.isfinite(self.speed) and self.speed > 0.0):
            raise UsageError(f"--speed: expected a positive number, got {self.speed:g}")
        if not 240 <= self.width_px <= 1920:
            raise UsageError(f"--width: expected 240 to 1920 pixels, got {self.width_px}")


def animate(
    path: Path,
    out: Path | None,
    film: Film,
    progress: Callable[[str], None],
    *,
    force: bool = False,
) -> dict[str, Any]:
    """Make the film of a recording (or of the run's directory that holds it); facts for --json.

    `out` None is arm.gif beside the recording. The file appears whole or not at all. Raises UsageError
    if the recording cannot be read or has nothing to draw, if `out` is neither .gif nor .mp4, exists
    (without `force`) or cannot be written, or if ffmpeg is needed and is not there or fails.
    """
    path = find_recording(path)
    out = path.with_name("arm.gif") if out is None else out
    _check_kind(out, film)
    check_free(out, force=force)
    recording = read_recording(path)
    drawable = np.flatnonzero(np.isfinite(recording.shapes_m).all(axis=(1, 2)))
    if drawable.size < 2:
        raise UsageError(
            f"recording {path}: expected at least 2 ticks with the arm's shape to draw, got "
            f"{drawable.size}"
        )
    speed, ticks = choose_ticks(recording, film)
    ticks = sorted({int(drawable[np.abs(drawable - k).argmin()]) for k in ticks})
    with whole(out, force=force) as growing:
        scene = Scene(recording, ticks, film.width_px, f"{speed:g} x real time")
        width, height = scene.size
        pictures = _pictures(scene, ticks, progress)
        if out.suffix.lower() == ".mp4":
            width, height = width + width % 2, height + height % 2
            write_mp4(growing, map(even, pictures), (width, height), film.fps, out)
        else:
            palette = Palette(_sample(recording, scene, ticks))
            _write_gif(growing, [palette.indexed(pixels) for pixels in pictures], film.fps)
    return {
        "animation": str(out),
        "recording": str(path),
        "recording_complete": recording.unfinished is None,
        "frames": len(ticks),
        "fps": film.fps,
        "speed": speed,
        "width_px": width,
        "height_px": height,
        "bytes": out.stat().st_size,
    }


def film_line(facts: dict[str, Any]) -> str:
    """The facts of `animate` as one line."""
    cut = "" if facts["recording_complete"] else ", recording unfinished"
    return (
        f"{facts['animation']}: {facts['frames']} frames of {facts['width_px']} x "
        f"{facts['height_px']}, {facts['speed']:g} x real time{cut}, {facts['bytes'] / 1e6:.2f} MB"
    )


def choose_ticks(recording: Recording, film: Film) -> tuple[float, list[int]]:
    """The speed and the ticks to draw, first and last tick included."""
    last = recording.ticks - 1
    seconds = last * recording.tick_s
    speed = film.speed
    if speed is None:
        exact = max(1.0, seconds / FILM_S)
        speed = float(f"{exact:.2g}")
    step = max(1.0, speed / film.fps / recording.tick_s)
    count = math.floor(last / step) + 1
    if count > MOST_FRAMES:
        raise UsageError(
            f"--speed {speed:g}: that would be {count} frames, expected at most {MOST_FRAMES}; "
            "give a larger --speed or a smaller --fps"
        )
    return speed, sorted({*(round(i * step) for i in range(count)), last})


def _check_kind(out: Path, film: Film) -> None:
    kind = out.suffix.lower()
    if kind not in KINDS:
        raise UsageError(f"--out {out}: expected a name that ends in .gif or .mp4")
    if film.fps > KINDS[kind]:
        raise UsageError(
            f"--fps: expected 0.5 to {KINDS[kind]:g} frames a second for {kind}, got {film.fps:g}"
        )
    if kind == ".mp4":
        find_ffmpeg(out)


class Palette:
    """The colours that all frames share, and the nearest of them to any other."""

    def __init__(self, sample: Pixels):
        """Choose from pixels that have every colour in them, (..., 3)."""
        tones, counts = np.unique(sample.reshape(-1, 3), axis=0, return_counts=True)
        # Areas keep their exact colour; what is left is between them, where edges are smoothed.
        tones = tones[np.argsort(counts)[::-1]]
        rest = Image.fromarray(tones[EXACT:][None]) if len(tones) > EXACT else None
        self.colours: Pixels = tones[:EXACT]
        if rest is not None:
            edges = rest.quantize(COLOURS - EXACT, method=Image.Quantize.MAXCOVERAGE)
            more = np.asarray(edges.getpalette("RGB"), dtype=np.uint8).reshape(-1, 3)
            self.colours = np.concatenate([self.colours, more])
        self._known = np.full(1 << 24, _UNKNOWN, dtype=np.uint8)

    def indexed(self, pixels: Pixels) -> Image.Image:
        """The picture in these colours; pixels: (height, width, 3)."""
        packed = pixels.astype(np.int32) @ np.array([1 << 16, 1 << 8, 1], dtype=np.int32)
        new = np.unique(packed[self._known[packed] == _UNKNOWN])
        tones = np.stack([new >> 16, new >> 8 & 255, new & 255], axis=1)
        apart = tones[:, None].astype(np.int32) - self.colours.astype(np.int32)
        self._known[new] = np.argmin((apart**2).sum(axis=2), axis=1)
        image = Image.fromarray(self._known[packed], mode="P")
        image.putpalette(self.colours.ravel().tolist())
        return image


def _sample(recording: Recording, scene: Scene, ticks: Sequence[int]) -> Pixels:
    """Frames that together have every colour of the film: ends, and the first with each setpoint."""
    active = active_setpoints(recording)[np.asarray(ticks)]
    firsts = {int(np.asarray(ticks)[active == index][0]) for index in np.unique(active)}
    return np.concatenate([scene.draw(k) for k in sorted({*firsts, ticks[0], ticks[-1]})])


def _pictures(
    scene: Scene, ticks: Sequence[int], progress: Callable[[str], None]
) -> Iterator[Pixels]:
    said = monotonic()
    for i, tick in enumerate(ticks):
        if monotonic() - said > SAY_EVERY_S:
            said = monotonic()
            progress(f"frame {i} of {len(ticks)}")
        yield scene.draw(tick)


def _write_gif(path: Path, frames: Sequence[Image.Image], fps: float) -> None:
    each = max(20, 10 * round(100.0 / fps))  # ms, in the hundredths that a GIF counts
    durations = [each] * (len(frames) - 1) + [max(each, round(1e3 * LAST_S))]
    frames[0].save(
        path,
        format="GIF",
        save_all=True,
        append_images=frames[1:],
        duration=durations,
        loop=0,
        optimize=True,  # what stays is transparent: a quarter of the bytes
        disposal=1,
    )
