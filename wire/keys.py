"""The key expressions of a run: which process publishes what, and who subscribes to it.

Every key begins with `octarm/<run>`, the run's tag in hexadecimal, so that two runs that met on one
link by mistake would still not hear each other.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Keys:
    """Keys of the run with this tag; see `wire.messages.run_tag`."""

    run: int

    @property
    def root(self) -> str:
        """The prefix of every key of the run."""
        return f"octarm/{self.run:016x}"

    def measurement(self, node: int) -> str:
        """Plant -> node: y_i(k)."""
        return f"{self.root}/node/{node}/measurement"

    def forward(self, node: int) -> str:
        """Node - 1 -> node: the forward sum c that `node` receives."""
        return f"{self.root}/node/{node}/forward"

    def backward(self, node: int) -> str:
        """Node + 1 -> node: the backward sum d that `node` receives."""
        return f"{self.root}/node/{node}/backward"

    def state(self, node: int, sender: int) -> str:
        """Neighbour `sender` -> node: its estimate, while `node` is about to replace a dead process."""
        return f"{self.root}/node/{node}/state/{sender}"

    def command(self, node: int) -> str:
        """Node -> plant: u_i(k+1)."""
        return f"{self.root}/plant/command/{node}"

    def telemetry(self, sender: int) -> str:
        """Any process -> recorder: batches and counters; the plant's key ends in 'plant'."""
        return f"{self.root}/telemetry/{'plant' if sender < 0 else sender}"

    @property
    def all_telemetry(self) -> str:
        """What the recorder subscribes to."""
        return f"{self.root}/telemetry/*"

    @property
    def stop(self) -> str:
        """Plant -> every process: the run is over."""
        return f"{self.root}/stop"

    def ready(self, node: int) -> str:
        """Liveliness token of a node whose links are all up."""
        return f"{self.root}/ready/{node}"

    @property
    def all_ready(self) -> str:
        """What the plant watches."""
        return f"{self.root}/ready/*"
