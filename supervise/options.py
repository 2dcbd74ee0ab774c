"""What the user can choose about a run, with the defaults of the command line: the only place that has them.

Between `launcher.py`, which shows and fills it, and `supervise.plan`. Nothing heavy is imported here, since
every verb of the command line pays for it. None means: what the scenario says (`supervise.scenario`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from supervise.shipped import DEFAULT_GAINS
from wire.errors import UsageError
from wire.run_config import MOST_TICKS, SHORTEST_TICK_S

if TYPE_CHECKING:
    from supervise.hosts import Hosts

MOST_NODES = 1000
DEFAULT_SCENARIO = "hold"


@dataclass(frozen=True)
class RunOptions:
    """Checked when made. The command line explains each."""

    gains: Path = DEFAULT_GAINS
    scenario: str = DEFAULT_SCENARIO
    nodes: int = 10
    ticks: int | None = None
    tick_s: float = 0.1
    seed: int = 1
    setpoint: str | None = None
    initial: str | None = None
    disturbance: str | None = None
    disturbance_amplitude: float | None = None
    noise_velocity: float | None = None
    noise_curvature: float | None = None
    plant_cells: int | None = None
    plant_model: str | None = None
    spacing: str = "equispaced"
    out: Path | None = None
    transport: str = "unix"
    base_port: int | None = None
    socket_dir: Path | None = None
    start_timeout_s: float = 20.0
    deadline_s: float = 10.0
    by_hand: tuple[int, ...] = ()
    pin: bool = True
    fifo: bool = False
    segments_per_process: int = 1
    realtime: bool = False
    period_s: float | None = None
    """None: the tick, that is one second of the arm's in one of the clock's."""
    hold_ticks: int = 2
    restart: bool = False
    hosts: Path | None = None
    keys: Path | None = None
    """None: no certificates."""
    live: bool = False
    live_port: int | None = None
    """None: any that is free."""

    def __post_init__(self) -> None:
        from plant.disturbance import DisturbanceSpec
        from plant.grid import plant_cells
        from plant.initial import check_name
        from plant.noise import SensorNoise
        from plant.truncated_force import EXACT, check_model

        _at_least("--nodes", self.nodes, 2, "a chain needs a root and a tip segment")
        if self.nodes > MOST_NODES:
            raise UsageError(f"--nodes: expected at most {MOST_NODES}, got {self.nodes}")
        if self.ticks is not None:
            _at_least("--ticks", self.ticks, 1, "one tick is the shortest run")
            if self.ticks > MOST_TICKS:
                raise UsageError(f"--ticks: expected at most {MOST_TICKS}, got {self.ticks}")
        _at_least("--seed", self.seed, 0, "any whole number from 0 on")
        _positive("--tick", self.tick_s, "seconds")
        if self.tick_s < SHORTEST_TICK_S:
            raise UsageError(
                f"--tick: expected {SHORTEST_TICK_S:g} s or more, got {self.tick_s!r}; instants are recorded "
                "in nanoseconds"
            )
        _positive("--start-timeout", self.start_timeout_s, "seconds")
        _positive("--deadline", self.deadline_s, "seconds")
        _at_least("--segments-per-process", self.segments_per_process, 1, "or there is no node")
        _at_least("--hold-ticks", self.hold_ticks, 0, "0 stops the arm at the first late tick")
        if self.segments_per_process >= self.nodes:
            raise UsageError(
                f"--segments-per-process {self.segments_per_process}: {self.nodes} segments would be one "
                f"process, with nobody to talk to; expected at most {self.nodes - 1}"
            )
        if self.period_s is not None:
            _positive("--period", self.period_s, "seconds")
            if not self.realtime:
                raise UsageError("--period is for --realtime; add it or leave the period out")
        for node in self.by_hand:
            if node not in range(0, self.nodes, self.segments_per_process):
                every = self.segments_per_process
                which = "" if every == 1 else f", a multiple of {every} (the first segment of each)"
                raise UsageError(f"--by-hand {node}: expected a node 0..{self.nodes - 1}{which}")
        if self.live_port is not None and not self.live:
            raise UsageError("--live-port is for --live; add it or leave the port out")
        if self.initial is not None:
            check_name(self.initial)
        amplitude = self.disturbance_amplitude
        DisturbanceSpec(self.disturbance or "none", 1.0 if amplitude is None else amplitude)
        SensorNoise(self.seed, self.noise_velocity or 0.0, self.noise_curvature or 0.0)
        if self.plant_model is not None:
            check_model(self.plant_model)
            plant_cells(self.nodes, self.plant_cells, exact=self.plant_model == EXACT)
        _ = self.placed
        if self.keys is not None and self.socket_dir is not None:
            raise UsageError(
                "--socket-dir: with --keys processes meet over TLS; leave one of them out"
            )
        if self.placed_on is not None:
            for name, value in (("--base-port", self.base_port), ("--socket-dir", self.socket_dir)):
                if value is not None:
                    raise UsageError(
                        f"{name}: with --hosts the hosts file says where processes meet; leave it out"
                    )
            self._whole_processes(self.placed_on)

    def _whole_processes(self, hosts: Hosts) -> None:
        """A process is on one host."""
        for host in hosts.hosts:
            if host.first % self.segments_per_process:
                raise UsageError(
                    f"--segments-per-process {self.segments_per_process}: host {host.name} begins with segment "
                    f"{host.first}, in the middle of a process; give each host a multiple of it"
                )

    @cached_property
    def placed(self) -> str | tuple[float, ...]:
        """The spacing's name, or its boundaries in m; a file is read once."""
        from supervise.spacing import parse_spacing

        return parse_spacing(self.spacing, self.nodes)

    @cached_property
    def placed_on(self) -> Hosts | None:
        """The hosts of --hosts, None for this machine alone; the file is read once."""
        if self.hosts is None:
            return None
        from supervise.hosts import read_hosts

        return read_hosts(self.hosts, self.nodes)


def _at_least(name: str, value: int, least: int, why: str) -> None:
    if value < least:
        raise UsageError(f"{name}: expected at least {least}, got {value} ({why})")


def _positive(name: str, value: float, unit: str) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise UsageError(f"{name}: expected a positive number of {unit}, got {value!r}")
