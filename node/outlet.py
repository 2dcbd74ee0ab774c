"""What a block (`node.block`) needs of whatever is around it: the process of a run, or a replay."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from node.sweep import Array


class Outlet(Protocol):
    """Where a block's results go: arrays that it fills, and a word when they are complete.

    All of it must be there when the block is made.
    """

    forward: Array
    """The sum to the tip's side; empty at the tip."""
    backward: Array
    """The sum to the root's side; empty at the root."""
    commands: Array
    """u(k+1) of all segments."""

    def send_forward(self, tick: int, setpoint: int) -> None:
        """`forward` is complete; its setpoint has the bit `wire.messages.PARTIAL` if it is not of the whole
        arm up to here."""

    def send_backward(self, tick: int, setpoint: int) -> None:
        """`backward` is complete."""

    def send_commands(self, tick: int, setpoint: int) -> None:
        """`commands` is complete; it belongs to the tick after this one and its setpoint."""

    def recorded(self, tick: int, rows: Sequence[Array]) -> None:
        """Rows (ticks, columns) of each segment from this tick on, to keep."""

    def begins(self, tick: int, setpoint: int) -> None:
        """The tick whose messages are expected now, and its setpoint."""
