"""Aligned and folded tables, against tables written by hand."""

from __future__ import annotations

import pytest

from analysis.folded_table import folded
from analysis.text_table import aligned, ruled


def test_columns_begin_or_end_together() -> None:
    head, rows = ("n", "pattern", "p50"), [("5", "star", "9.5"), ("100", "bare chain", "")]
    assert aligned(head, rows) == [
        "n       pattern  p50",
        "5          star  9.5",
        "100  bare chain",
    ]
    assert aligned(head, rows, left=(1,), gap=3) == [
        "  n   pattern      p50",
        "  5   star         9.5",
        "100   bare chain",
    ]
    assert aligned(head, []) == ["n  pattern  p50"]
    with pytest.raises(ValueError, match="zip"):
        aligned(head, [("5", "star")])


def test_a_rule_is_as_long_as_the_longest_line() -> None:
    lines = ["n", "100", "5"]
    assert ruled(lines) == ["n", "───", "100", "5"]
    assert ruled(lines, 2) == ["n", "──", "100", "5"]
    assert ruled(lines, 9) == ["n", "───", "100", "5"]


def test_a_sentence_goes_on_below() -> None:
    columns = (("figure", "left"), ("value", "right"), ("meaning", "left"))
    rows = [("sweep", "1.5 ms", "first measurement to last command")]
    assert folded(columns, rows, 42) == [  # type: ignore[arg-type]
        "figure    value   meaning",
        "──────────────────────────────────────────",
        "sweep    1.5 ms   first measurement to",
        "                  last command",
    ]
