"""The estimated arm as the nodes reckon it: where it ends at each segment's outer face, turned and stretched
from what the reference says.

Every forward sum carries the end of the arm so far (`ARM_SO_FAR`), so the telemetry of one tick has the whole
arm in it but for the tip's own segment, which is added here. Used by the nodes, which make it grow, and by
recorder and live page, which draw it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from wire.channels import ARM_SO_FAR, COMMAND, MEASUREMENT, STATE, SUMS_AT
from wire.reference import Reference

_STRAIN_AT = len(MEASUREMENT) + STATE.index("strain")
_CURVATURE_AT = len(MEASUREMENT) + STATE.index("curvature_per_m")
_CHORD = len(STATE) + len(COMMAND)
"""Where the chord stands in a segment's reference."""


class ArmEnd(NamedTuple):
    """Where the estimated arm ends so far: its turn from the reference there, x and y of the outer face."""

    turn_rad: float
    x_m: float
    y_m: float


CLAMP = ArmEnd(0.0, 0.0, 0.0)
"""Where the arm begins."""


def grow(
    end: Sequence[float], turn_rad: float, stretch: float, chord_x_m: float, chord_y_m: float
) -> tuple[float, float, float]:
    """The end (turn, x, y) of an arm with one segment more: the reference's chord, turned by turn_rad more and
    stretched."""
    turn, x, y = end
    turn += turn_rad
    if not math.isfinite(turn):  # it has no cosine; the caller sees that nothing is right here
        return turn, math.nan, math.nan
    cosine, sine = stretch * math.cos(turn), stretch * math.sin(turn)
    return (
        turn,
        x + cosine * chord_x_m - sine * chord_y_m,
        y + sine * chord_x_m + cosine * chord_y_m,
    )


@dataclass(frozen=True)
class TipConfig:
    """What must be known of the tip's segment to draw its end."""

    reference: dict[str, Any]
    """See wire.reference."""
    bend_m: float
    """Length of the stretch that its curvature bends, see wire.factors."""


class Joints:
    """The ends of the estimated arm's segments, from the telemetry rows of one tick.

    forward_widths: (n,) numbers in the forward sum that each node receives. Raises UsageError for a damaged
    reference.
    """

    def __init__(self, forward_widths: Sequence[int], tip: TipConfig) -> None:
        self._so_far_at = [SUMS_AT + width - len(ARM_SO_FAR) for width in forward_widths[1:]]
        self._nodes = len(forward_widths)
        self._reference = Reference.from_plain(tip.reference)
        self._bend_m = tip.bend_m

    def points(
        self, tick: int, rows: Mapping[int, Sequence[float]]
    ) -> list[tuple[float, float]] | None:
        """n + 1 points (x, y) in m, root first; None while the row of a node is missing."""
        points, end = [(0.0, 0.0)], tuple(CLAMP)
        for node, at in enumerate(self._so_far_at, 1):
            row = rows.get(node)
            if row is None:
                return None
            turn, x, y = end = tuple(row[at : at + len(ARM_SO_FAR)])
            points.append((x, y))
        row = rows.get(self._nodes - 1)
        if row is None:
            return None
        wanted = self._reference.at(tick).tolist()
        turn = (row[_CURVATURE_AT] - wanted[_CURVATURE_AT - len(MEASUREMENT)]) * self._bend_m
        stretch = (1.0 + row[_STRAIN_AT]) / (1.0 + wanted[_STRAIN_AT - len(MEASUREMENT)])
        _, x, y = grow(end, turn, stretch, *wanted[_CHORD : _CHORD + 2])
        return [*points, (x, y)]
