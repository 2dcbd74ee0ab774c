"""The loops of a burst on links that answer at once, late or never; no measured time is asserted."""

from __future__ import annotations

from collections.abc import Sequence
from time import monotonic_ns

import pytest

from bench.pacing import TickLostError, lock_step, paced

SECOND_NS = 1_000_000_000


class Answers:
    """Links whose last command comes so many ns after it was waited for; None: never."""

    def __init__(self, after_ns: int | None) -> None:
        self.after_ns = after_ns
        self.sent: list[bytes] = []

    def send(self, messages: Sequence[bytes]) -> int:
        self.sent += messages
        return monotonic_ns()

    def wait(self, limit_s: float) -> int:
        return 0 if self.after_ns is None else monotonic_ns() + self.after_ns


def messages() -> list[bytes]:
    return [b"y"]


def test_lock_step_gives_a_time_a_tick() -> None:
    links = Answers(1000)
    sweeps = lock_step(links, messages, 7, limit_s=60.0)
    assert len(sweeps) == len(links.sent) == 7
    assert min(sweeps) >= 1000


def test_lock_step_ends_when_its_time_is_over() -> None:
    assert lock_step(Answers(0), messages, 7, limit_s=0.0) == []


def test_a_rate_that_cannot_be_held_is_given_up() -> None:
    links = Answers(2000)
    pauses: list[None] = []
    took = paced(links, messages, 50, 1000, warm=3, most_late=2, idle=lambda: pauses.append(None))
    assert len(took) == 3  # one more than may be late; those that warmed up are not among them
    assert len(links.sent) == len(pauses) == 6
    assert min(took) >= 2000


def test_a_paced_tick_counts_from_its_due_instant() -> None:
    took = paced(Answers(0), messages, 5, SECOND_NS // 500, warm=1, most_late=5, idle=lambda: None)
    assert len(took) == 5
    assert min(took) >= 0


def test_a_lost_tick_ends_the_burst() -> None:
    with pytest.raises(TickLostError):
        lock_step(Answers(None), messages, 3, limit_s=60.0)
    with pytest.raises(TickLostError):
        paced(Answers(None), messages, 3, 1000, warm=0, most_late=0, idle=lambda: None)
