"""Finite differences of the source chapter (its section 4.1): one grid, one clamped end, one free end.

Even derivatives are second-order central differences, odd ones first-order differences biased to one side. The
chapter calls them upwind-biased; nothing is blown along here (waves run both ways), so the side is a choice:
towards the root, where the two clamped values are known, unless asked otherwise. What the stencils ask for
beyond the ends are ghost points that the boundary conditions give.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Bias = Literal["root", "tip"]
AxialEnds = Literal["two", "four"]

ORDERS = 5
"""Derivatives 0 to 4."""
_GHOSTS = 2  # points beyond either end that a fourth difference asks for
_EVEN: dict[int, dict[int, float]] = {
    0: {0: 1.0},
    2: {-1: 1.0, 0: -2.0, 1: 1.0},
    4: {-2: 1.0, -1: -4.0, 0: 6.0, 1: -4.0, 2: 1.0},
}
_ODD: dict[Bias, dict[int, dict[int, float]]] = {
    "root": {1: {-1: -1.0, 0: 1.0}, 3: {-2: -1.0, -1: 3.0, 0: -3.0, 1: 1.0}},
    "tip": {1: {0: -1.0, 1: 1.0}, 3: {-1: -1.0, 0: 3.0, 1: -3.0, 2: 1.0}},
}


@dataclass(frozen=True, eq=False)
class Differences:
    """Matrices (5, cells, cells): values at s_1..s_cells to their derivatives 0 to 4 there, one set a field.

    The values at the clamp s_0 are zero and left out. SI units.
    """

    step_m: float
    axial: Array
    """Of u."""
    transverse: Array
    """Of w."""


def differences(
    cells: int, length_m: float, *, bias: Bias = "root", axial_ends: AxialEnds = "two"
) -> Differences:
    """The chapter's differences on a grid of so many cells over [0, length_m].

    Ghost points. w: w_s = 0 at the root (even about it); w_ss = w_sss = 0 at the tip, by central differences.
    u with "four" conditions, as the chapter prints them: the same. u with "two", as a wave equation has them
    (theory, section 1): fixed at the root, hence odd about it; u_s = 0 at the tip, hence even about it.
    Raises ValueError for fewer than 4 cells.
    """
    if cells < 4:
        raise ValueError(f"cells: expected at least 4, got {cells}")
    beam = _with_ghosts(cells, root=1.0, tip=((2.0, -1.0, 0.0), (4.0, -4.0, 1.0)))
    wave = _with_ghosts(cells, root=-1.0, tip=((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
    step = length_m / cells
    return Differences(
        step,
        _matrices(cells, step, bias, beam if axial_ends == "four" else wave),
        _matrices(cells, step, bias, beam),
    )


def _with_ghosts(cells: int, root: float, tip: tuple[tuple[float, ...], ...]) -> Array:
    """Values at s_1..s_n to values at s_-2..s_n+2; `root`: 1 even, -1 odd; `tip`: ghosts n+1 and n+2 from the
    values at s_n, s_n-1 and s_n-2."""
    samples = np.zeros((cells + 1 + 2 * _GHOSTS, cells))
    samples[_GHOSTS + 1 : _GHOSTS + 1 + cells] = np.eye(cells)
    for beyond in (1, 2):
        samples[_GHOSTS - beyond] = root * samples[_GHOSTS + beyond]
        for back, weight in enumerate(tip[beyond - 1]):
            samples[_GHOSTS + cells + beyond] += weight * samples[_GHOSTS + cells - back]
    return samples


def _matrices(cells: int, step: float, bias: Bias, samples: Array) -> Array:
    found = np.zeros((ORDERS, cells, cells))
    for order, stencil in {**_EVEN, **_ODD[bias]}.items():
        for offset, weight in stencil.items():
            first = _GHOSTS + 1 + offset
            found[order] += weight * samples[first : first + cells]
        found[order] /= step**order
    return found
