"""From the user's options to one configuration a process: gains read, deployed on n segments,
everything checked.

Nothing is started here, so every wrong value is refused before a process or a file exists.
"""

from __future__ import annotations

import math
import os
import secrets
import time
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from deploy import Deployment, SegmentGrid, deploy
from deploy.gaps import refuse_growing_gaps
from deploy.node_configs import node_configs
from deploy.path import References, make_references
from supervise.endpoints import Endpoints
from supervise.hosts import Host, this_machine
from supervise.live_config import live_config, tip_of
from supervise.options import RunOptions
from supervise.origin import git_revision, machine_facts, versions
from supervise.scenario import Course, settle
from supervise.spacing import spacing_name
from wire.access import LIVE, PLANT, RECORDER, node_name
from wire.artefact import GainsArtefact, digest, read_artefact
from wire.channels import BATCH_TICKS, FLUSH_S, FORMAT_VERSION, NODES_ATTACHMENT
from wire.config_json import dumps
from wire.errors import UsageError
from wire.placement import FIFO_PRIORITY
from wire.run_config import (
    LinkConfig,
    LiveConfig,
    NodeConfig,
    PaceConfig,
    PlantConfig,
    RecorderConfig,
    RunConfig,
    SchedulingConfig,
)

if TYPE_CHECKING:
    from supervise.secured import Secured

CORES = 2
"""Two sweeps run towards each other; more cores would only add wake-ups across cores (runtime
figures)."""


@dataclass(frozen=True)
class Plan:
    """A run that can be started: the configurations of all its processes."""

    run: RunConfig
    nodes: tuple[NodeConfig, ...]
    plant: PlantConfig
    recorder: RecorderConfig
    live: LiveConfig | None
    """Of the process that shows the run; None: nobody wants to see it."""
    endpoints: Endpoints
    directory: Path
    """Where the recording and everything else about the run goes."""
    hosts: tuple[Host, ...]
    """In the order of their segments; one, this machine, without a hosts file."""
    by_hand: frozenset[int]
    start_timeout_s: float

    def host_of(self, node: int) -> Host:
        """The host that a node runs on."""
        return next(host for host in self.hosts if node in host.indices)


def new_run_id() -> str:
    """A name for a run: date, time and a few random letters."""
    return f"{time.strftime('%Y%m%d-%H%M%S')}-{secrets.token_hex(3)}"


@dataclass(frozen=True)
class Prepared:
    """A run before anything is on the disk: gains, matrices, story and reference, all of them checked."""

    options: RunOptions
    course: Course
    artefact: GainsArtefact
    deployment: Deployment
    references: References


def prepare(options: RunOptions) -> Prepared:
    """Read scenario and gains, deploy them, find the way; raises UsageError or GainsRefusedError."""
    course = settle(options)
    artefact = read_artefact(options.gains)
    for name in course.visited:
        artefact.setpoint_index(name)
    deployment = deploy(artefact, options.nodes, options.tick_s, options.placed)
    if options.restart:
        refuse_growing_gaps(artefact, deployment, course.visited, options.segments_per_process)
    if not course.control:
        deployment = deployment.without_control()
    references = make_references(
        artefact,
        SegmentGrid(deployment.faces_m),
        options.tick_s,
        course.setpoint,
        course.first_hold_s,
        course.legs,
    )
    return Prepared(options, course, artefact, deployment, references)


def scheduling(artefact: GainsArtefact, course: Course) -> SchedulingConfig:
    """Sectors of the setpoints that the run visits, by their tips' polar angles (theory, section 5).

    Raises UsageError if two of them have their tips in one direction.
    """
    angles = {
        index: math.degrees(math.atan2(*reversed(artefact.setpoints[index].tip_m)))
        for index in map(artefact.setpoint_index, course.visited)
    }
    order = sorted(angles, key=lambda index: angles[index])
    for a, b in pairwise(order):
        if angles[b] - angles[a] < 1e-6:
            names = [artefact.setpoints[index].name for index in (a, b)]
            raise UsageError(
                f"setpoints {names[0]} and {names[1]}: their tips lie in one direction from the root, so "
                "the tip's place cannot tell which gains to use; visit only one of them"
            )
    return SchedulingConfig(
        setpoints=tuple(order),
        boundaries_deg=tuple(0.5 * (angles[a] + angles[b]) for a, b in pairwise(order)),
        hysteresis_deg=course.hysteresis_deg,
        bump_s=course.bump_s,
    )


def make_plan(
    prepared: Prepared,
    endpoints: Endpoints,
    run_id: str,
    directory: Path,
    secured: Secured | None = None,
) -> Plan:
    """Build every process's configuration; `secured` has the identities of a run with --keys."""
    options, course, artefact = prepared.options, prepared.course, prepared.artefact
    deployment, references = prepared.deployment, prepared.references
    active = artefact.setpoint_index(course.setpoint)
    nodes = options.nodes
    run = RunConfig(
        run_id=run_id,
        scenario=course.told.name,
        nodes=nodes,
        spacing=spacing_name(options.placed),
        faces_m=tuple(deployment.faces_m.tolist()),
        tick_s=options.tick_s,
        ticks=course.ticks,
        seed=options.seed,
        setpoint=course.setpoint,
        setpoint_names=deployment.setpoint_names,
        first_hold_s=course.first_hold_s,
        legs=course.legs,
        scheduling=scheduling(artefact, course),
        control=course.control,
        initial=course.initial,
        disturbance=course.disturbance,
        noise=course.noise,
        plant_cells=course.plant_cells,
        artefact_path=str(options.gains),
        artefact_sha256=digest(artefact),
        initial_estimates=tuple(
            tuple(f.initial_estimate[active].tolist()) for f in deployment.nodes
        ),
        initial_commands_n_per_m=tuple(float(f.initial_command[active]) for f in deployment.nodes),
        energy_weights=tuple(map(tuple, deployment.energy_weights.tolist())),
        segments_per_process=options.segments_per_process,
        pace=_pace(options),
        restart=options.restart,
        plant_model=course.plant_model,
    )
    epoch_ns = time.monotonic_ns()
    cores = _cores(nodes) if options.pin else [None] * nodes
    placed = options.placed_on
    hosts = (this_machine(nodes),) if placed is None else placed.hosts
    # Of another machine neither clock nor cores are known.
    elsewhere = {i for host in hosts if host.own_clock for i in host.indices}

    def links(
        name: str, listen: list[str], connect: list[str], node: int | None = None
    ) -> LinkConfig:
        return LinkConfig(
            listen=tuple(listen),
            connect=tuple(connect),
            directory=endpoints.private,
            deadline_s=options.deadline_s,
            epoch_ns=None if node in elsewhere else epoch_ns,
            cpu=None if node is None or node in elsewhere else cores[node],
            fifo=FIFO_PRIORITY if options.fifo else None,
            tls=None if secured is None else secured.tls(name, node),
        )

    def node_links(own: range) -> LinkConfig:
        listen = [endpoints.nodes[own[-1]]] if own[-1] < nodes - 1 else []
        connect = [endpoints.plant, *([endpoints.nodes[own[0] - 1]] if own[0] > 0 else [])]
        return links(node_name(own[0]), listen, connect, own[0])

    configs = node_configs(run, deployment, references, node_links)
    return Plan(
        run=run,
        nodes=configs,
        plant=PlantConfig(
            run=run,
            arm=msgspec.to_builtins(artefact.arm),
            setpoint=msgspec.to_builtins(artefact.setpoints[active]),
            reference=references.plant.to_plain(),
            holding_n_per_m=tuple(
                tuple(float(f.initial_command[i]) for f in deployment.nodes)
                for i in range(len(run.setpoint_names))
            ),
            batch_ticks=BATCH_TICKS,
            links=links(PLANT, [endpoints.plant], []),
        ),
        recorder=RecorderConfig(
            run=run,
            path=str(directory / "recording.mcap"),
            forward_widths=deployment.forward_widths,
            backward_widths=deployment.backward_widths,
            tip=tip_of(deployment, references),
            flush_s=FLUSH_S,
            metadata=_metadata(prepared, run, epoch_ns, () if placed is None else hosts),
            attachments={
                "gains.json": options.gains.read_text(),
                "run.json": dumps(run),
                NODES_ATTACHMENT: f"[{','.join(map(dumps, map(_public, configs)))}]",
            },
            links=links(RECORDER, [], [endpoints.plant]),
        ),
        live=None
        if not options.live
        else live_config(
            run,
            artefact,
            deployment,
            references,
            links=links(LIVE, [], [endpoints.plant]),
            port=options.live_port or 0,
            elsewhere=elsewhere,
            period_s=run.tick_s if run.pace is None else run.pace.period_s,
        ),
        endpoints=endpoints,
        directory=directory,
        hosts=hosts,
        by_hand=frozenset(options.by_hand).union(
            i for host in hosts if host.by_hand for i in run.firsts if i in host.indices
        ),
        start_timeout_s=options.start_timeout_s,
    )


def _public(config: NodeConfig) -> NodeConfig:
    """What a recording, which others read while the run goes on, may have of a configuration."""
    return replace(config, links=replace(config.links, tls=None))


def _pace(options: RunOptions) -> PaceConfig | None:
    if not options.realtime:
        return None
    period_s = options.tick_s if options.period_s is None else options.period_s
    return PaceConfig(period_s, options.hold_ticks)


def _cores(nodes: int) -> list[int | None]:
    """The core of each node: neighbours share one; two runs on a large machine take different
    pairs."""
    allowed = sorted(os.sched_getaffinity(0))
    start = secrets.randbelow(max(1, len(allowed) // CORES)) * CORES
    pair = allowed[start : start + CORES]
    return [pair[i * len(pair) // nodes] for i in range(nodes)]


def _metadata(
    prepared: Prepared, run: RunConfig, epoch_ns: int, hosts: tuple[Host, ...]
) -> dict[str, str]:
    """The record "octarm": what the recording must say about where it came from."""
    artefact = prepared.artefact
    certificates = {
        setpoint.name: {
            "observer": setpoint.observer_certificate,
            "controller": setpoint.controller_certificate,
        }
        for setpoint in artefact.setpoints
    }
    facts: dict[str, Any] = {
        "certificate": certificates,
        "arm": artefact.arm,
        "scenario": prepared.course.told,
        "versions": versions(),
        "machine": machine_facts(),
    }
    if hosts:
        facts["hosts"] = [
            {"name": h.name, "address": h.address, "nodes": h.nodes, "own_clock": h.own_clock}
            for h in hosts
        ]
    revision = git_revision()
    return {
        "format_version": str(FORMAT_VERSION),
        "run_id": run.run_id,
        "artefact_sha256": run.artefact_sha256,
        "seed": str(run.seed),
        "run": dumps(run),
        "epoch_ns": str(epoch_ns),
        "started_at": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        **{name: msgspec.json.encode(fact).decode() for name, fact in facts.items()},
        **({} if revision is None else {"git_revision": revision}),
    }
