"""An MP4 film from pictures: H.264 as every player and browser shows it, made by ffmpeg.

Beside the GIF of `analysis.animate`. The pictures go to ffmpeg's standard input one by one, so that no film is
ever in memory; ffmpeg ends with the pictures, whatever ends them.
"""

from __future__ import annotations

import contextlib
import shutil
import signal
import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import IO

import numpy as np

from analysis.scene import Pixels
from wire.errors import UsageError

ENCODER = "libx264"
QUALITY = 18
"""Constant rate factor: the thin lines of a picture stay sharp."""
COLOURS = "bt709"


def find_ffmpeg(out: Path) -> str:
    """The ffmpeg of this machine; UsageError if there is none."""
    found = shutil.which("ffmpeg")
    if found is None:
        raise UsageError(
            f"--out {out}: ffmpeg was not found; install it, or take a name that ends in .gif"
        )
    return found


def even(pixels: Pixels) -> Pixels:
    """The picture with a row or column repeated at its end where it has an odd number of them."""
    height, width, _ = pixels.shape
    padding = ((0, height % 2), (0, width % 2), (0, 0))
    return np.ascontiguousarray(np.pad(pixels, padding, mode="edge"))


def write_mp4(
    path: Path, frames: Iterable[Pixels], size: tuple[int, int], fps: float, out: Path
) -> None:
    """Encode frames, each (height, width, 3) with an even size (width, height), into `path`.

    `out` is what a complaint calls the file. Raises UsageError with ffmpeg's own last words if it fails.
    """
    command = [
        find_ffmpeg(out),
        *("-hide_banner", "-loglevel", "error", "-xerror", "-y"),
        *("-f", "rawvideo", "-pixel_format", "rgb24"),
        *("-video_size", f"{size[0]}x{size[1]}", "-framerate", f"{fps:.6g}", "-i", "pipe:0"),
        *("-c:v", ENCODER, "-preset", "medium", "-crf", str(QUALITY), "-pix_fmt", "yuv420p"),
        *("-vf", f"scale=out_color_matrix={COLOURS}:out_range=tv"),
        *("-colorspace", COLOURS, "-color_primaries", COLOURS, "-color_trc", COLOURS),
        *("-color_range", "tv", "-movflags", "+faststart", "-f", "mp4", str(path)),
    ]
    with tempfile.TemporaryFile() as said:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=said
        )
        try:
            _feed(process, frames)
            code = process.wait()
        finally:
            process.kill()  # of no effect on one that has ended
            process.wait()
        # ffmpeg 5 ends with 0 where the disk was full for the last bytes: look at what it left.
        if code != 0 or not is_whole(path):
            raise UsageError(f"--out {out}: ffmpeg failed: {_last_words(said, code)}")


def is_whole(path: Path) -> bool:
    """Whether the boxes of an MP4 file reach to its end, index and pictures among them, the index first."""
    kinds = []
    with path.open("rb") as file:
        left = file.seek(0, 2)
        file.seek(0)
        while left > 0:
            head = file.read(8)
            if len(head) < 8:
                return False
            size = int.from_bytes(head[:4], "big")
            if size == 1:  # the true one follows, in 64 bits
                size = int.from_bytes(file.read(8), "big")
            if size < 8 or size > left:
                return False
            kinds.append(head[4:])
            left -= size
            file.seek(-left, 2)
    wanted = [kind for kind in kinds if kind in (b"moov", b"mdat")]
    return wanted == [b"moov", b"mdat"]


def _feed(process: subprocess.Popen[bytes], frames: Iterable[Pixels]) -> None:
    pipe = process.stdin
    assert pipe is not None
    try:
        for frame in frames:
            pipe.write(frame.tobytes())
    except BrokenPipeError:
        pass  # it ended before its pictures did: its exit code and its words tell why
    finally:
        with contextlib.suppress(BrokenPipeError):
            pipe.close()


def _last_words(said: IO[bytes], code: int) -> str:
    said.seek(0)
    lines = [line.strip() for line in said.read().decode(errors="replace").splitlines()]
    words = [line for line in lines if line]
    if words:
        return words[-1]
    if code < 0:
        return f"it was ended by {signal.Signals(-code).name}"
    return f"exit code {code}, it said nothing, and the film is not whole"
