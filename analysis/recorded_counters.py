"""The final counters of a recording as numbers: texts of its metadata in, whole numbers of 64 bits out.

For whoever reads them: `analysis.recording`, `analysis.info` and what belongs to them. No process can have
counted further; beyond it nothing of them could be divided.
"""

from __future__ import annotations

from typing import Annotated

import msgspec

from wire.errors import UsageError, shown

LARGEST = 2**63 - 1
Count = Annotated[int, msgspec.Meta(ge=-LARGEST, le=LARGEST)]
"""In JSON; below zero is what never happened (`disk_full_at`)."""
_DIGITS = len(str(LARGEST))

_decode = msgspec.json.Decoder(dict[str, Count]).decode


def number_of(text: str) -> int:
    """A total; UsageError for other text, or a number of more than 64 bits."""
    try:
        number = int(text) if len(text) <= _DIGITS + 1 else LARGEST + 1
    except ValueError:
        raise UsageError(f"expected a whole number, got {shown(text)}") from None
    if abs(number) > LARGEST:
        raise UsageError(f"expected a whole number of 64 bits, got {shown(text)}")
    return number


def counts_of(text: str) -> dict[str, int]:
    """What one process reported; UsageError if it cannot be read."""
    try:
        return _decode(text)
    except (msgspec.DecodeError, RecursionError) as error:
        raise UsageError(f"expected whole numbers of 64 bits by name ({error})") from None
