"""Equations (2), (3) and (5) as the chapter prints them, letter by letter, as data.

u1, w2, ... are derivatives of u and w by x; ue1, we2, ... those of the setpoint. `chapter.derivation` reads the
strings and compares them with what (1) gives; nothing here is corrected.
"""

from __future__ import annotations

from typing import Literal

Equation = Literal["u", "w"]

# Right of "rho u_tt - EA u_xx =" and of "rho w_tt + EI w_xxxx =", a string for each bracket with its factor.
SECOND: dict[Equation, tuple[str, ...]] = {
    "u": ("EA*w1*w2", "EI*(w2*w3 + w1*w4)"),
    "w": ("EA*(u2*w1 + u1*w2)", "EI*(u2*w2 + u1*w3)", "EI*D(u1*w1, 3)"),
}
"""(2) without f; D(., 3) is the third derivative by x, which the chapter leaves unexpanded."""
SECOND_LEFT: dict[Equation, str] = {"u": "-EA*u2", "w": "EI*w4"}
"""What (2) has left of the equals sign besides the inertia."""

# Right of "rho u~_tt =" and "rho w~_tt =": by the displacement and the order of its derivative.
THIRD: dict[Equation, dict[tuple[Equation, int], str]] = {
    "u": {
        ("u", 2): "EA",
        ("w", 1): "EA*we2 + EI*we4",
        ("w", 2): "EA*we1 + EI*we3",
        ("w", 3): "EI*we2",
        ("w", 4): "EI*we1",
    },
    "w": {
        ("w", 1): "EA*ue2 + EI*ue4",
        ("w", 2): "EA*ue1 + EI*ue2 + 3*EI*ue3",
        ("w", 3): "EI*ue1 + 3*EI*ue3",
        ("w", 4): "-EI + EI*ue1",
        ("u", 1): "EA*we2 + EI*we3 + EI*we4",
        ("u", 2): "EA*we1 + EI*we2 + 3*EI*we3",
        ("u", 3): "3*EI*we2",
        ("u", 4): "EI*we1",
    },
}
"""(3) without f."""

# A_0, and rho A_1 to rho A_4, rho B_1; rows and columns x = (u~, u~_t, w~, w~_t).
FIFTH: tuple[tuple[tuple[str, str, str, str], ...], ...] = (
    (("0", "1", "0", "0"), ("0", "0", "0", "0"), ("0", "0", "0", "1"), ("0", "0", "0", "0")),
    (
        ("0", "0", "0", "0"),
        ("0", "0", "0", "0"),
        ("0", "0", "0", "0"),
        ("EA*we2 + EI*we3 + EI*we4", "0", "EA*ue2 + EI*ue4", "0"),
    ),
    (
        ("0", "0", "0", "0"),
        ("EA", "0", "EA*we1 + EI*we3", "0"),
        ("0", "0", "0", "0"),
        ("EA*we1 + EI*we2 + 3*EI*we3", "0", "EA*ue1 + EI*ue2 + 3*EI*ue3", "0"),
    ),
    (
        ("0", "0", "0", "0"),
        ("0", "0", "EI*we2", "0"),
        ("0", "0", "0", "0"),
        ("3*EI*we2", "0", "EI*ue1 + 3*EI*ue2", "0"),
    ),
    (
        ("0", "0", "0", "0"),
        ("0", "0", "EI*we1", "0"),
        ("0", "0", "0", "0"),
        ("EI*we1", "0", "-EI + EI*ue1", "0"),
    ),
)
INPUT = ("0", "0", "0", "1")
"""rho B_1."""
