"""Links to neighbours, of which Zenoh's thread tells while the main thread makes or leaves them."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from node.neighbours import Neighbours


class Publisher:
    """One with a subscriber. Whoever asks lets the other thread run, as Zenoh does."""

    def __init__(self, meanwhile: Callable[[], None]) -> None:
        self._meanwhile = meanwhile

    @property
    def matching_status(self) -> Any:
        self._meanwhile()
        return SimpleNamespace(matching=True)


@pytest.mark.parametrize("way", ["made", "left"])
def test_links_may_change_while_they_are_looked_at(way: str) -> None:
    neighbours = object.__new__(Neighbours)
    publishers: dict[str, Any] = {}
    neighbours._publishers, neighbours._states = publishers, []

    def meanwhile() -> None:
        if way == "left":
            neighbours.close()
        else:
            publishers.setdefault("right", Publisher(lambda: None))

    publishers["left"] = Publisher(meanwhile)
    asked: list[tuple[str, ...]] = []
    for _ in range(2):
        neighbours._look()
        asked.append(neighbours.asking)
    assert asked == [("left",), ("left", "right") if way == "made" else ()]
