"""`--spacing` of the command line: a name, or the segment boundaries themselves, typed or in a file.

What comes out goes to `deploy` and from there as boundaries in m into the run's configuration.
"""

from __future__ import annotations

from pathlib import Path

from deploy import Spacing
from wire.errors import UsageError

GIVEN = "given"
"""The name under which boundaries that the user gave are recorded."""
LARGEST_FILE = 1 << 20
"""Bytes that a file of boundaries may have."""


def parse_spacing(text: str, nodes: int) -> str | tuple[float, ...]:
    """The name of a `Spacing`, or nodes + 1 boundaries in m from root to tip.

    Text with a comma is the list itself; anything else that is no name is a file with the numbers
    separated by commas, blanks or line ends, a # starting a remark. Whether they divide the arm is
    checked by `deploy.make_grid`, which knows its length. Raises UsageError naming the file and
    line, or the place in the list, that is wrong.
    """
    if text in list(Spacing):
        return text
    numbers = _numbers(text, "") if "," in text else _read(text)
    if len(numbers) != nodes + 1:
        remedy = f"; for these, --nodes {len(numbers) - 1}" if len(numbers) > 2 else ""
        raise UsageError(
            f"--spacing {_short(text)}: {nodes} nodes need {nodes + 1} segment boundaries in m from "
            f"root to tip, got {len(numbers)}{remedy}"
        )
    return tuple(numbers)


def spacing_name(spacing: str | tuple[float, ...]) -> str:
    """What a recording calls the spacing: its name, or "given"."""
    return spacing if isinstance(spacing, str) else GIVEN


def _read(text: str) -> list[float]:
    path = Path(text)
    try:
        with path.open("rb") as file:
            content = file.read(LARGEST_FILE + 1)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        names = ", ".join(Spacing)
        raise UsageError(
            f"--spacing {_short(text)}: expected {names}, a comma-separated list of segment "
            f"boundaries in m, or a file of them; as a file: {reason}"
        ) from None
    if len(content) > LARGEST_FILE:
        raise UsageError(
            f"--spacing {_short(text)}: expected a file of segment boundaries of at most "
            f"{LARGEST_FILE} bytes"
        )
    numbers: list[float] = []
    for place, line in enumerate(content.decode("utf-8-sig", errors="replace").splitlines(), 1):
        numbers += _numbers(line.partition("#")[0], f", line {place}", text)
    return numbers


def _numbers(words: str, where: str, source: str | None = None) -> list[float]:
    numbers = []
    for word in words.replace(",", " ").split():
        try:
            numbers.append(float(word))
        except ValueError:
            raise UsageError(
                f"--spacing {_short(source or words)}{where}: expected numbers in m, got "
                f"{_short(word)!r}"
            ) from None
    return numbers


def _short(text: str) -> str:
    return text if len(text) <= 200 else f"{text[:197]}..."
