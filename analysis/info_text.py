"""How `octarm info` words things: a labelled line, a list, a size; for its head and its tables."""

from __future__ import annotations

import textwrap

WIDTH = 118
_LABEL = 12


def labelled(label: str, text: str) -> str:
    """Lines of at most `WIDTH`, the label before the first one."""
    return wrapped(text, label.ljust(_LABEL))


def wrapped(text: str, label: str) -> str:
    """The same, for a label that is as long as the others."""
    return textwrap.fill(
        text,
        WIDTH,
        initial_indent=label,
        subsequent_indent=" " * len(label),
        break_long_words=False,
        break_on_hyphens=False,
    )


def joined(*parts: str | None) -> str:
    """Those that say something, separated by commas."""
    return ", ".join(part for part in parts if part)


def size_text(value: int) -> str:
    """Bytes in B, kB, MB or GB (powers of 1000), three digits."""
    for limit, unit in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if value >= limit:
            return (
                f"{value / limit:.3g} {unit}"
                if value < 1000 * limit
                else f"{value / limit:.0f} {unit}"
            )
    return f"{value} B"
