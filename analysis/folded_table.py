"""Tables with sentences in them as text of a given width: what is too long for its column goes on below."""

from __future__ import annotations

from collections.abc import Sequence
from io import StringIO
from typing import Literal

from rich import box
from rich.console import Console
from rich.table import Table

WIDTH = 118
"""Of a table for a terminal, unless another is asked for."""
Column = tuple[str, Literal["left", "right"]]
"""Its head, and where its entries stand together."""


def folded(
    columns: Sequence[Column], rows: Sequence[Sequence[str]], width: int = WIDTH, *, gap: int = 2
) -> list[str]:
    """The lines: head, rule, rows, without colours. The first column keeps its width, the others are folded.

    gap: spaces that an entry has to its right at least, besides one between columns.
    """
    table = Table(box=box.SIMPLE, pad_edge=False, show_edge=False, padding=(0, gap, 0, 0))
    for number, (name, justify) in enumerate(columns):
        table.add_column(name, justify=justify, no_wrap=number == 0, overflow="fold")
    for row in rows:
        table.add_row(*row)
    out = StringIO()
    console = Console(file=out, width=width, color_system=None, markup=False, highlight=False)
    console.print(table)
    return [line.rstrip() for line in out.getvalue().splitlines()]
