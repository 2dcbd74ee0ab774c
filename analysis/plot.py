"""The figures of a run: the summary that `octarm run` leaves, and all that `octarm plot` can show of it.

Last step of the analysis: recording in, PNG, PDF or SVG out. What is drawn is the business of
`analysis.panels`; here they are put together and written. Uses matplotlib's objects and the Agg canvas
directly, so that nothing depends on a display or on the state of pyplot. One recording gives the same
bytes every time.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from analysis.goals import active_setpoints
from analysis.panels import PANELS, SUMMARY
from analysis.panels.frame import Cell, bridged_ticks, key_of_marks, missing_ticks, ticks_in_words
from analysis.recording import Recording, find_recording, read_recording
from analysis.whole_file import check_free, whole
from wire.errors import UsageError

WIDTH_IN, DPI = 14.0, 100
SINGLE_IN = 9.0
"""Width of a figure of one panel."""
COLUMN_IN, ROW_IN = 4.5, 3.4
"""A panel is not drawn narrower or lower."""
TALL = {1: 0.62, 2: 0.72, 3: 0.83}
"""Height of a panel over its width, by the number of columns."""
LINE_IN, KEY_IN = 0.2, 2.3
"""Height of a line of the title or the key of marks, and width of an entry of that key."""
MOST_PIXELS = 100_000_000
SAY_EVERY_S = 2.0
STYLE = {
    "font.size": 10.0,
    "axes.titlesize": 10.5,
    "axes.labelsize": 10.0,
    "legend.fontsize": 9.0,
    "xtick.labelsize": 9.0,
    "ytick.labelsize": 9.0,
    "svg.hashsalt": "octarm",
}
NOTHING_THAT_CHANGES: dict[str, dict[str, None]] = {
    ".png": {"Software": None},
    ".pdf": {"CreationDate": None, "Creator": None, "Producer": None},
    ".svg": {"Date": None, "Creator": None},
}
"""Kinds of file, and the metadata that would make two of them differ."""


@dataclass(frozen=True)
class Choice:
    """What to draw and how large. Raises UsageError, naming the option, for what cannot be drawn."""

    only: tuple[str, ...] = ()
    """Names of panels; none: all."""
    width_in: float | None = None
    """Of the figure; default: 14, for one panel 9."""
    dpi: int = DPI

    def __post_init__(self) -> None:
        for name in self.only:
            if name not in PANELS:
                near = difflib.get_close_matches(name, PANELS, 1)
                hint = f" (did you mean {near[0]}?)" if near else ""
                raise UsageError(
                    f"--only: there is no panel {name!r}{hint}; expected some of {', '.join(PANELS)}"
                )
        if self.width_in is not None and not COLUMN_IN <= self.width_in <= 60.0:
            raise UsageError(f"--width: expected {COLUMN_IN:g} to 60 inches, got {self.width_in:g}")
        if not 30 <= self.dpi <= 600:
            raise UsageError(f"--dpi: expected 30 to 600 dots an inch, got {self.dpi}")
        wide, tall = self.size_in
        pixels = wide * self.dpi, tall * self.dpi
        if pixels[0] * pixels[1] > MOST_PIXELS:
            raise UsageError(
                f"--width {wide:g} --dpi {self.dpi}: that would be {pixels[0]:.0f} x {pixels[1]:.0f} "
                f"pixels, expected at most {MOST_PIXELS // 1_000_000} million; give less of one"
            )

    @property
    def names(self) -> tuple[str, ...]:
        """The panels to draw, each once."""
        return tuple(dict.fromkeys(self.only)) or tuple(PANELS)

    @property
    def grid(self) -> tuple[int, int]:
        """Rows and columns."""
        columns = max(1, min(3, len(self.names), int(self._width / COLUMN_IN)))
        return math.ceil(len(self.names) / columns), columns

    @property
    def size_in(self) -> tuple[float, float]:
        """Width and height of the figure."""
        rows, columns = self.grid
        tall = max(ROW_IN, TALL[columns] * self._width / columns)
        return self._width, 0.6 + rows * tall

    @property
    def _width(self) -> float:
        if self.width_in is not None:
            return self.width_in
        return SINGLE_IN if len(self.names) == 1 else WIDTH_IN


def plot_run(recording_path: Path, png_path: Path) -> None:
    """Draw the summary figure of a run into a PNG of 1400 x 820 pixels.

    Raises UsageError if the recording cannot be read, has no complete tick, or the PNG cannot be
    written.
    """
    plot_recording(read_recording(recording_path), png_path)


def plot_recording(recording: Recording, png_path: Path) -> None:
    """As `plot_run`, for a recording that is in memory."""
    figure = draw_run(recording)
    try:
        png_path.parent.mkdir(parents=True, exist_ok=True)
        _save(figure, png_path, ".png", DPI)
    except OSError as error:
        raise UsageError(
            f"plot {png_path}: {error.strerror or error}; give another place to write it to"
        ) from None


def plot_file(
    path: Path,
    out: Path | None,
    choice: Choice,
    progress: Callable[[str], None],
    *,
    force: bool = False,
) -> dict[str, Any]:
    """Draw panels of a recording (or of the run's directory that holds it) into a file; facts for --json.

    `out` None is panels.png beside the recording, or <panel>.png if it is one. The file appears whole or
    not at all. Raises UsageError if the recording cannot be read or has no complete tick, if `out` is of
    another kind than PNG, PDF and SVG, exists (without `force`) or cannot be written.
    """
    path = find_recording(path)
    names = choice.names
    if out is None:
        out = path.with_name(f"{names[0] if len(names) == 1 else 'panels'}.png")
    kind = out.suffix.lower()
    if kind not in NOTHING_THAT_CHANGES:
        raise UsageError(f"--out {out}: expected a name that ends in .png, .pdf or .svg")
    check_free(out, force=force)
    recording = read_recording(path)
    with whole(out, force=force) as growing:
        figure = draw(recording, choice, progress)
        _save(figure, growing, kind, choice.dpi)
    wide, tall = figure.get_size_inches().tolist()
    return {
        "plot": str(out),
        "recording": str(path),
        "recording_complete": recording.unfinished is None,
        "panels": list(names),
        "ticks": recording.ticks,
        "late_ticks": int(recording.late.sum()),
        "ticks_not_recorded": missing_ticks(recording),
        "ticks_bridged": int(np.count_nonzero(bridged_ticks(recording))),
        "width_in": wide,
        "height_in": tall,
        "dpi": choice.dpi,
        "bytes": out.stat().st_size,
    }


def plot_line(facts: dict[str, Any]) -> str:
    """The facts of `plot_file` as one line."""
    panels = len(facts["panels"])
    what = facts["panels"][0] if panels == 1 else f"{panels} panels"
    wide, tall = (round(facts[side] * facts["dpi"]) for side in ("width_in", "height_in"))
    if facts["plot"].lower().endswith(".png"):
        size = f"{wide} x {tall} pixels"
    else:
        size = f"{facts['width_in']:.3g} x {facts['height_in']:.3g} in"
    cut = "" if facts["recording_complete"] else ", recording unfinished"
    return (
        f"{facts['plot']}: {what} of {ticks_in_words(facts['ticks'])}{cut}, {size}, "
        f"{facts['bytes'] / 1e6:.2f} MB"
    )


def draw_run(recording: Recording) -> Figure:
    """The summary figure of a run, not yet written anywhere."""
    return draw(recording, Choice(SUMMARY), lambda _: None, height_in=8.2)


def draw(
    recording: Recording,
    choice: Choice,
    progress: Callable[[str], None],
    height_in: float | None = None,
) -> Figure:
    """A figure of panels, not yet written anywhere. Raises UsageError if there is no complete tick."""
    if recording.ticks < 1:
        raise UsageError(
            f"recording {recording.path}: expected at least 1 complete tick to plot, got none"
        )
    names, (rows, columns), (wide, tall) = choice.names, choice.grid, choice.size_in
    with mpl.rc_context(STYLE):
        spacing = ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.08, wspace=0.03, hspace=0.04)
        title, key = _wrapped(title_parts(recording), wide), key_of_marks(recording)
        beside = max(1, int(wide / KEY_IN))
        tall += LINE_IN * (title.count("\n") + math.ceil(len(key) / beside))
        figure = Figure(figsize=(wide, height_in or tall), dpi=choice.dpi, layout=spacing)
        FigureCanvasAgg(figure)
        grid = figure.add_gridspec(rows, columns)
        pad = 6.0 if np.ptp(active_setpoints(recording)) == 0 else 11.0  # room for the strip
        said = monotonic()
        for i, name in enumerate(names):
            if monotonic() - said > SAY_EVERY_S:
                said = monotonic()
                progress(f"panel {i + 1} of {len(names)}, {name}")
            place = figure.add_subfigure(grid[divmod(i, columns)])
            PANELS[name](Cell(place, name), recording)
            first = place.axes[0]
            text = first.get_title()
            letter = f"({chr(ord('a') + i)})  " if len(names) > 1 else ""
            first.set_title("")
            first.set_title(f"{letter}{text}", loc="left", pad=pad)
        figure.suptitle(title, fontsize=11.5)
        if key:
            figure.legend(
                handles=key, loc="outside lower center", ncols=min(len(key), beside), frameon=False
            )
        # Place everything now, with the fonts of this style, and only once.
        figure.draw_without_rendering()
        figure.set_layout_engine("none")
    return figure


def title_parts(recording: Recording) -> list[str]:
    """Which run this is, in few words each."""
    run = recording.configuration
    parts = [
        f"scenario {run.scenario!r}",
        f"{run.nodes} nodes, {ticks_in_words(recording.ticks)} of {run.tick_s:g} s",
        f"setpoint {' - '.join([run.setpoint, *(leg.to for leg in run.legs)])}",
        f"initial shape {run.initial!r}",
        f"disturbance {run.disturbance.name!r}",
        f"seed {run.seed}",
    ]
    if not run.control:
        parts.append("no feedback")
    if recording.unfinished is not None:
        parts.append(f"recording unfinished, {recording.ticks} of {run.ticks} ticks")
    return parts


def _wrapped(parts: Sequence[str], width_in: float) -> str:
    """The parts in as many lines as a figure of this width needs."""
    letters = int(width_in / 0.078)
    lines = [""]
    for part in parts:
        longer = f"{lines[-1]}  ·  {part}" if lines[-1] else part
        if lines[-1] and len(longer) > letters:
            lines.append(part)
        else:
            lines[-1] = longer
    return "\n".join(lines)


def _save(figure: Figure, path: Path, kind: str, dpi: int) -> None:
    with mpl.rc_context(STYLE):
        figure.savefig(path, format=kind[1:], dpi=dpi, metadata=NOTHING_THAT_CHANGES[kind])
