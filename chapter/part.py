"""What each part of the reproduction hands over: prose, figures and numbers, in one shape.

`octarm chapter` asks the parts one after the other and writes what they hand over; nothing here knows a file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from matplotlib.figure import Figure

Tell = Callable[[str], None]
"""Says in one line what is being done."""


@dataclass(frozen=True)
class Claim:
    """One statement of the chapter and what became of it."""

    where: str
    """Equation, figure or section of the chapter, as "(5), A_1"."""
    printed: str
    found: str
    holds: bool
    """Whether the printed form is right."""


@dataclass(frozen=True)
class Part:
    """One part of the chapter."""

    key: str
    """Name of the part on the command line and of its page: lower case letters."""
    title: str
    section: str
    """Of the chapter, as "2.1, 2.2"."""
    text: str
    """Markdown below the title (headings from ## on); figures are shown with ![…](name.png)."""
    claims: tuple[Claim, ...] = ()
    figures: Mapping[str, Figure] = field(default_factory=dict)
    """By file name, <key>-<what>.png."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """Numbers for facts.json, what the tests check; plain Python types only."""
