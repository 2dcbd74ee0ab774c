"""The panel of what the plant knew of every node: alive, on time, valid, which are three different things."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.colors import ListedColormap

from analysis.degraded import KINDS, swept_ticks
from analysis.panels.frame import GREEN, GREY, MISSING, PURPLE, VERMILION, Cell, say
from analysis.recording import Recording
from wire.channels import Degraded

WORDS = {"alive": "alive", "on_time": "on time", "valid": "valid"}
_BRIDGED = int(Degraded.FORWARD_BRIDGED | Degraded.BACKWARD_BRIDGED)


def draw_health(cell: Cell, recording: Recording) -> None:
    """Three maps over time and node: green where it was so, red where it was not, grey where nothing was asked.

    Ticks are the plant's, the passive ones at the end included. Dots are bridged sums, where they were bridged.
    """
    if recording.format_version < 5:
        ax = cell.one()
        ax.set_title("Nodes: alive, on time, valid")
        say(ax, "recordings before version 5\ndo not say")
        return
    axes = cell.stack(1.0, 1.0, 1.0)
    axes[0].set_title("Nodes: alive, on time, valid")
    health, swept = recording.health, swept_ticks(recording)
    edges = np.arange(len(health) + 1) * recording.tick_s
    nodes = np.arange(recording.nodes + 1) - 0.5
    shades = ListedColormap([VERMILION, GREEN])
    passive = np.flatnonzero(recording.passive)
    for ax, (kind, bit) in zip(axes, KINDS.items(), strict=True):
        ax.set_facecolor(MISSING)
        well = np.where(swept[:, None], (health & int(bit)) != 0, np.nan)
        ax.pcolormesh(
            edges, nodes, well.T, cmap=shades, vmin=0.0, vmax=1.0, rasterized=True, alpha=0.8
        )
        lacks = int(np.count_nonzero(well == 0.0))
        _beside(ax, f"{WORDS[kind]}\n{'always' if not lacks else f'not: {lacks}'}")
        ax.set_xlim(0.0, max(edges[-1], recording.tick_s))
        if passive.size:
            span = edges[passive[0]], edges[passive[-1] + 1]
            ax.axvspan(*span, facecolor="none", edgecolor=PURPLE, hatch="//", linewidth=0.0)
    _dots(axes[1], recording)
    axes[-1].set_xlabel("time [s]")
    if passive.size:
        axes[0].text(
            *(edges[passive[0]], 1.02),
            "passive",
            transform=axes[0].get_xaxis_transform(),
            color=PURPLE,
            fontsize=8.5,
            ha="right",
        )


def _beside(ax: Any, text: str) -> None:
    ax.set_ylabel(text, rotation=0, ha="right", va="center")
    ax.set_yticks([])


def _dots(ax: Any, recording: Recording) -> None:
    bridged: npt.NDArray[np.bool_] = np.asarray((recording.flags & _BRIDGED) != 0)
    ticks, nodes = np.nonzero(bridged)
    if ticks.size:
        label = f"bridged sum ({ticks.size} ticks of nodes)"
        at = (ticks + 0.5) * recording.tick_s
        ax.plot(at, nodes, ".", color="black", markersize=3.0, label=label)
        ax.legend(loc="upper left", fontsize=8.0, framealpha=0.8)
    else:
        ax.plot([], [], color=GREY)
