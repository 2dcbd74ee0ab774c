"""Tables of short entries as aligned text: lines for a terminal or a file, as wide as they need to be."""

from __future__ import annotations

from collections.abc import Container, Iterable, Sequence


def aligned(
    head: Sequence[str], rows: Iterable[Sequence[str]], *, left: Container[int] = (0,), gap: int = 2
) -> list[str]:
    """The head and the rows, a line each: the columns in `left` begin together, the others end together.

    Columns are `gap` spaces apart. ValueError for a row that has more or fewer entries than the head.
    """
    lines = [head, *rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return [
        (" " * gap)
        .join(
            entry.ljust(width) if place in left else entry.rjust(width)
            for place, (entry, width) in enumerate(zip(line, widths, strict=True))
        )
        .rstrip()
        for line in lines
    ]


def ruled(lines: Sequence[str], most: int | None = None) -> list[str]:
    """The lines of `aligned` with a rule below the head: as long as the longest of them, at most `most`."""
    longest = max(map(len, lines))
    return [lines[0], "─" * (longest if most is None else min(most, longest)), *lines[1:]]
