"""The clock of a run in real time: when ticks are due, how many were late, how long the emulation takes.

Pure but for reading the monotonic clock; used by the plant's process alone, whose ticks are everybody's.
"""

from __future__ import annotations

from time import monotonic_ns

from wire.run_config import PaceConfig

LEAD_NS = 20_000_000
"""Between the order to start and the first tick."""
SLACK_NS = 100_000
"""Added to what the plant's own work took lately."""
FORGET = 0.98
"""Factor a tick by which the longest work is forgotten."""
MOST_OF_PERIOD = 0.5
"""The plant's own work is begun at the latest after so much of the period."""


class Pace:
    """Ticks at whole multiples of the period after `begin`."""

    def __init__(self, config: PaceConfig) -> None:
        self.period_ns = round(config.period_s * 1e9)
        self.hold_ticks = config.hold_ticks
        self.wait_ticks = (config.hold_ticks + 1) // 2
        """So many late ticks a sweep is waited for; then it is given up, and every tick has a new one."""
        self.late_in_a_row = 0
        self._zero_ns = 0
        self._work_ns = 0.0

    def begin(self) -> None:
        """Tick 0 is due soon."""
        self._zero_ns = monotonic_ns() + LEAD_NS

    def due_ns(self, tick: int) -> int:
        """When a tick should begin, on the monotonic clock."""
        return self._zero_ns + tick * self.period_ns

    def on_time(self) -> None:
        """The sweep before was over when it should be."""
        self.late_in_a_row = 0

    @property
    def gives_up(self) -> bool:
        """Whether the sweep that is late is not waited for any longer."""
        return self.late_in_a_row > self.wait_ticks

    def late(self) -> bool:
        """It was not; False if that is once too often."""
        self.late_in_a_row += 1
        return self.late_in_a_row <= self.hold_ticks

    def worked(self, duration_ns: int) -> None:
        """So long did the emulation of a tick take."""
        self._work_ns = max(float(duration_ns), FORGET * self._work_ns)

    def work_at_ns(self, tick: int) -> int:
        """When the emulation of a tick must begin, to be ready when the next is due."""
        reserve = min(SLACK_NS + self._work_ns, MOST_OF_PERIOD * self.period_ns)
        return self.due_ns(tick + 1) - int(reserve)
