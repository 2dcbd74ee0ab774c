"""Fig. 1: which points the tip of an arm of length r = 1 reaches, rigid, jointed, continuous."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.optimize import brentq

Array = np.ndarray[Any, np.dtype[np.float64]]
LEAST_JOINT_DEG = 90.0
"""The chapter's limit, on the angle inside each joint; 180 degrees is straight."""


def two_segment_distance(joint_deg: float) -> float:
    """Distance of the tip from the root, two segments of length 1/2: the law of cosines is sin(joint / 2)."""
    return math.sin(math.radians(0.5 * joint_deg))


def least_distance(segments: int) -> float:
    """Smallest distance of the tip from the root, `segments` of equal length, joints of 90 degrees or more.

    One: 1. Two: a right angle, sqrt(2)/2. Three: a square without its fourth side, 1/3. Four close the
    square; more can close as well.
    """
    return {1: 1.0, 2: math.sqrt(0.5), 3: 1.0 / 3.0}.get(segments, 0.0)


def sampled_tips(segments: int, count: int, seed: int) -> Array:
    """Tips, shape (count, 2): the first segment in any direction, joint angles uniform over what is allowed."""
    draw = np.random.default_rng(seed)
    most = math.radians(180.0 - LEAST_JOINT_DEG)
    turns = draw.uniform(-most, most, (count, segments))
    turns[:, 0] = draw.uniform(-math.pi, math.pi, count)
    angles = np.cumsum(turns, axis=1)
    return np.stack([np.cos(angles).mean(axis=1), np.sin(angles).mean(axis=1)], axis=1)


def arc_distance(curvature: float) -> float:
    """Distance of the tip from the root, an arc of length 1: sin(a)/a with a half the curvature."""
    half = 0.5 * curvature
    return abs(math.sin(half) / half) if half else 1.0


def clamped_tips(limit: float, turns: int, bends: int) -> Array:
    """Tips of arms whose root points along x, shape (turns * bends, 2): curvature +-limit first, then constant.

    The first arc turns by up to a whole circle to either side, the second bends by up to a whole circle: two
    parameters, enough to fill what a curvature of at most `limit` reaches.
    """
    turn = np.linspace(-2.0 * math.pi, 2.0 * math.pi, turns)[:, None]
    side = np.sign(turn)
    rest = 1.0 - np.abs(turn) / limit
    x, y = np.sin(np.abs(turn)) / limit, side * (1.0 - np.cos(turn)) / limit
    bend = np.linspace(-2.0 * math.pi, 2.0 * math.pi, bends)[None, :]
    chord = rest * np.sinc(0.5 * bend / math.pi)
    keep = np.abs(bend) <= limit * rest
    tips = np.stack(
        [x + chord * np.cos(turn + 0.5 * bend), y + chord * np.sin(turn + 0.5 * bend)], axis=-1
    )
    return np.asarray(tips[np.broadcast_to(keep, tips.shape[:2])])


def clamped_boundary(limit: float, count: int = 721) -> Array:
    """Outermost tips of the same arms, shape (count, 2), a closed curve: turn as hard as possible, then
    straight.

    (The shortest paths of bounded curvature to far points without a final direction, Dubins.) The two branches
    meet behind the root.
    """

    def height(turn: float) -> float:
        return (1.0 - math.cos(turn)) / limit + (1.0 - turn / limit) * math.sin(turn)

    last = float(brentq(height, 0.5 * math.pi, 1.5 * math.pi))
    turn = np.linspace(-last, last, count)
    rest, size = 1.0 - np.abs(turn) / limit, np.abs(turn)
    x = np.sin(size) / limit + rest * np.cos(turn)
    y = np.sign(turn) * (1.0 - np.cos(turn)) / limit + rest * np.sin(turn)
    return np.stack([x, y], axis=1)


def area(curve: Array) -> float:
    """Area inside a closed curve, shape (n, 2)."""
    x, y = curve[:, 0], curve[:, 1]
    return float(0.5 * abs(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))))


def missed_cells(tips: Array, boundary: Array, size: float) -> tuple[int, int]:
    """(cells not hit, cells) of a square grid of that size, of those wholly inside the boundary by one cell."""
    radius = np.hypot(boundary[:, 0], boundary[:, 1])
    angle = np.unwrap(np.arctan2(boundary[:, 1], boundary[:, 0]))
    order = np.argsort(angle)
    half = int(np.ceil(1.0 / size))
    centres = (np.arange(-half, half) + 0.5) * size
    x, y = np.meshgrid(centres, centres, indexing="ij")
    edge = np.interp(np.arctan2(y, x), angle[order], radius[order])
    inside = np.hypot(x, y) < edge - 1.5 * size
    hit = np.zeros_like(inside)
    cell = np.floor(tips / size).astype(int) + half
    good = np.all((cell >= 0) & (cell < 2 * half), axis=1)
    hit[cell[good, 0], cell[good, 1]] = True
    return int(np.sum(inside & ~hit)), int(np.sum(inside))
