"""From the user's options to one configuration a process: gains read, deployed on n segments,
everything checked.

Nothing is started here, so every wrong value is refused before a process or a file exists.
"""

from __future__ import annotations

import json
import math
import os
import platform
import secrets
import time
from dataclasses import dataclass
from functools import cached_property
from importlib import metadata
from pathlib import Path

import msgspec

from deploy import Deployment, deploy
from plant.disturbance import DisturbanceSpec
from plant.grid import plant_cells
from plant.initial import check_name
from plant.noise import SensorNoise
from supervise.endpoints import Endpoints
from supervise.factors_file import factors_json
from supervise.shipped import DEFAULT_GAINS
from supervise.spacing import parse_spacing, spacing_name
from wire.artefact import GainsArtefact, digest, read_artefact
from wire.channels import FORMAT_VERSION
from wire.errors import UsageError
from wire.run_config import (
    DisturbanceConfig,
    LinkConfig,
    NodeConfig,
    NoiseConfig,
    PlantConfig,
    RecorderConfig,
    RunConfig,
    dumps,
)

BATCH_TICKS = 32
FLUSH_S = 0.5
MOST_NODES = 1000
CORES = 2
"""Two sweeps run towards each other; more cores would only add wake-ups across cores (runtime
figures)."""


@dataclass(frozen=True)
class RunOptions:
    """What the user can choose about a run; checked when made. The command line explains each."""

    gains: Path = DEFAULT_GAINS
    nodes: int = 10
    ticks: int = 1200
    tick_s: float = 0.1
    seed: int = 1
    setpoint: str = "1"
    initial: str = "chapter"
    disturbance: str = "chapter"
    disturbance_amplitude: float = 1.0
    noise_velocity: float = 1e-4
    noise_curvature: float = 1e-3
    plant_cells: int | None = None
    spacing: str = "equispaced"
    out: Path | None = None
    transport: str = "unix"
    base_port: int | None = None
    socket_dir: Path | None = None
    start_timeout_s: float = 20.0
    deadline_s: float = 10.0
    by_hand: tuple[int, ...] = ()
    pin: bool = True

    def __post_init__(self) -> None:
        _at_least("--nodes", self.nodes, 2, "a chain needs a root and a tip segment")
        if self.nodes > MOST_NODES:
            raise UsageError(f"--nodes: expected at most {MOST_NODES}, got {self.nodes}")
        _at_least("--ticks", self.ticks, 1, "one tick is the shortest run")
        _at_least("--seed", self.seed, 0, "any whole number from 0 on")
        _positive("--tick", self.tick_s, "seconds")
        _positive("--start-timeout", self.start_timeout_s, "seconds")
        _positive("--deadline", self.deadline_s, "seconds")
        for node in self.by_hand:
            if not 0 <= node < self.nodes:
                raise UsageError(f"--by-hand {node}: expected a node 0..{self.nodes - 1}")
        check_name(self.initial)
        DisturbanceSpec(self.disturbance, self.disturbance_amplitude)
        SensorNoise(self.seed, self.noise_velocity, self.noise_curvature)
        plant_cells(self.nodes, self.plant_cells)
        _ = self.placed

    @cached_property
    def placed(self) -> str | tuple[float, ...]:
        """The spacing's name, or its boundaries in m; a file is read once."""
        return parse_spacing(self.spacing, self.nodes)


def _at_least(name: str, value: int, least: int, why: str) -> None:
    if value < least:
        raise UsageError(f"{name}: expected at least {least}, got {value} ({why})")


def _positive(name: str, value: float, unit: str) -> None:
    if not (math.isfinite(value) and value > 0.0):
        raise UsageError(f"{name}: expected a positive number of {unit}, got {value!r}")


@dataclass(frozen=True)
class Plan:
    """A run that can be started: the configurations of all its processes."""

    run: RunConfig
    nodes: tuple[NodeConfig, ...]
    plant: PlantConfig
    recorder: RecorderConfig
    endpoints: Endpoints
    directory: Path
    """Where the recording and everything else about the run goes."""
    by_hand: frozenset[int]
    start_timeout_s: float


def new_run_id() -> str:
    """A name for a run: date, time and a few random letters."""
    return f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"


def prepare(options: RunOptions) -> tuple[GainsArtefact, Deployment]:
    """Read the gains and deploy them; raises UsageError or GainsRefusedError."""
    artefact = read_artefact(options.gains)
    artefact.setpoint_index(options.setpoint)
    return artefact, deploy(artefact, options.nodes, options.tick_s, options.placed)


def make_plan(
    options: RunOptions,
    prepared: tuple[GainsArtefact, Deployment],
    endpoints: Endpoints,
    run_id: str,
    directory: Path,
) -> Plan:
    """Build every process's configuration."""
    artefact, deployment = prepared
    setpoint = options.setpoint
    active = artefact.setpoint_index(setpoint)
    nodes = options.nodes
    run = RunConfig(
        run_id=run_id,
        nodes=nodes,
        spacing=spacing_name(options.placed),
        faces_m=tuple(deployment.faces_m.tolist()),
        tick_s=options.tick_s,
        ticks=options.ticks,
        seed=options.seed,
        setpoint=setpoint,
        setpoint_names=deployment.setpoint_names,
        initial=options.initial,
        disturbance=DisturbanceConfig(options.disturbance, options.disturbance_amplitude),
        noise=NoiseConfig(options.noise_velocity, options.noise_curvature),
        plant_cells=plant_cells(nodes, options.plant_cells),
        artefact_path=str(options.gains),
        artefact_sha256=digest(artefact),
        initial_estimates=tuple(
            tuple(f.initial_estimate[active].tolist()) for f in deployment.nodes
        ),
        initial_commands_n_per_m=tuple(float(f.initial_command[active]) for f in deployment.nodes),
        energy_weights=tuple(map(tuple, deployment.energy_weights.tolist())),
    )
    epoch_ns = time.monotonic_ns()
    cores = _cores(nodes) if options.pin else [None] * nodes

    def links(listen: list[str], connect: list[str], cpu: int | None = None) -> LinkConfig:
        return LinkConfig(
            listen=tuple(listen),
            connect=tuple(connect),
            directory=endpoints.private,
            deadline_s=options.deadline_s,
            epoch_ns=epoch_ns,
            cpu=cpu,
        )

    def node(i: int) -> NodeConfig:
        listen = [endpoints.nodes[i]] if i < nodes - 1 else []
        connect = [endpoints.plant, *([endpoints.nodes[i - 1]] if i > 0 else [])]
        return NodeConfig(
            run_id=run_id,
            index=i,
            nodes=nodes,
            ticks=options.ticks,
            setpoint=active,
            batch_ticks=BATCH_TICKS,
            links=links(listen, connect, cores[i]),
            factors=deployment.nodes[i].to_plain(),
        )

    factors = [f.setpoints[active] for f in deployment.nodes]
    return Plan(
        run=run,
        nodes=tuple(node(i) for i in range(nodes)),
        plant=PlantConfig(
            run=run,
            arm=msgspec.to_builtins(artefact.arm),
            setpoint=msgspec.to_builtins(artefact.setpoints[active]),
            batch_ticks=BATCH_TICKS,
            links=links([endpoints.plant], []),
        ),
        recorder=RecorderConfig(
            run=run,
            path=str(directory / "recording.mcap"),
            forward_widths=tuple(f.forward_received for f in factors),
            backward_widths=tuple(f.backward_received for f in factors),
            flush_s=FLUSH_S,
            metadata=_metadata(run, epoch_ns),
            attachments={
                "gains.json": options.gains.read_text(),
                "run.json": dumps(run),
                "deployment.json": factors_json(deployment),
            },
            links=links([], [endpoints.plant]),
        ),
        endpoints=endpoints,
        directory=directory,
        by_hand=frozenset(options.by_hand),
        start_timeout_s=options.start_timeout_s,
    )


def _cores(nodes: int) -> list[int | None]:
    """The core of each node: neighbours share one; two runs on a large machine take different
    pairs."""
    allowed = sorted(os.sched_getaffinity(0))
    start = secrets.randbelow(max(1, len(allowed) // CORES)) * CORES
    pair = allowed[start : start + CORES]
    return [pair[i * len(pair) // nodes] for i in range(nodes)]


def _metadata(run: RunConfig, epoch_ns: int) -> dict[str, str]:
    """The record "octarm": what the recording must say about where it came from."""
    packages = ("octarm", "numpy", "eclipse-zenoh", "msgpack", "mcap", "msgspec")
    versions = {name: _version(name) for name in packages}
    versions["python"] = platform.python_version()
    return {
        "format_version": str(FORMAT_VERSION),
        "run_id": run.run_id,
        "artefact_sha256": run.artefact_sha256,
        "seed": str(run.seed),
        "run": dumps(run),
        "versions": json.dumps(versions),
        "epoch_ns": str(epoch_ns),
        "started_at": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "machine": platform.machine(),
    }


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return "unknown"
