"""A recording as arrays: what the recorder wrote during a run, typed and checked.

Everything that the figures of a run need is in the file itself: the configuration, the gains
artefact (attached), the counters, and one channel per kind of message and node (docs/recording.md).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from analysis.events import check_events, ending_among
from analysis.mcap_file import read_mcap
from analysis.recorded_commands import in_force
from analysis.recorded_counters import counts_of, number_of
from analysis.recorded_format import (
    attached_artefact,
    check_setpoints,
    check_version,
    common_ticks,
    not_ours,
)
from analysis.recorded_links import Link, links_between
from analysis.table import Table, check_numbers, check_ticks, decode_table, whole_numbers
from deploy import Deployment, deploy
from deploy.grid import make_grid
from deploy.path import References, make_references
from wire.artefact import GainsArtefact
from wire.channels import (
    COMMAND,
    DEGRADED,
    ENERGY,
    GUARD,
    MEASUREMENT,
    METADATA,
    PACE,
    SHAPE,
    SHAPE_POINTS,
    STATE,
    SUMMARY,
    WELL,
    Degraded,
    Health,
    label,
)
from wire.config_json import loads
from wire.errors import UsageError, about
from wire.foxglove import EVENTS
from wire.run_config import RunConfig

Array = npt.NDArray[np.float64]

QUANTITIES = (*STATE, *COMMAND)
"""What a node computes each tick, in the order of the dense step's output."""
_OF_NUMBERS = ("/node/", "/plant/", "/sweep/")
"""Channels whose fields are all numbers."""


@dataclass(frozen=True, eq=False)
class Recording:
    """One run. Its arrays have K = `ticks` rows; NaN marks what the recorder did not get."""

    path: Path
    unfinished: str | None
    """None if the file was closed properly, else where and how it stops."""
    configuration: RunConfig
    artefact: GainsArtefact
    facts: Mapping[str, str]
    """The metadata written at the start: versions, digest, configuration."""
    counters: Mapping[str, str] | None
    """The metadata written at the end; None if the recorder did not get there."""
    tables: Mapping[str, Table]
    """Per topic."""
    ticks: int
    """K: ticks 0 .. K - 1 were reached by every node and the plant."""
    attachments: Mapping[str, bytes] = field(repr=False)
    """By name, byte for byte."""
    order: Sequence[str] = ()
    """The topic of every message, in the order of the file."""

    @property
    def format_version(self) -> int:
        """One of `wire.channels.READABLE`."""
        return int(self.facts["format_version"])

    @property
    def complete(self) -> bool:
        """Whether the file was closed properly and has the final counters."""
        return self.unfinished is None and self.counters is not None

    def table(self, topic: str) -> Table:
        """The messages of a topic; UsageError if there is no such channel."""
        try:
            return self.tables[topic]
        except KeyError:
            raise UsageError(f"recording {self.path}: there is no channel {topic} in it") from None

    def of_nodes(self, channel: str, fields: Sequence[str]) -> Array:
        """Fields of /node/NN/<channel> at all nodes, shape (K, n, fields)."""
        return self._stack([f"/node/{self._label(i)}/{channel}" for i in self._indices], fields)

    def of_plant(self, channel: str, fields: Sequence[str]) -> Array:
        """Fields of /plant/<channel>, shape (K, fields)."""
        return self.table(f"/plant/{channel}").by_tick(fields, self.ticks)

    @property
    def nodes(self) -> int:
        """The number of nodes n."""
        return self.configuration.nodes

    @property
    def tick_s(self) -> float:
        """The period of a tick."""
        return self.configuration.tick_s

    @cached_property
    def times_s(self) -> Array:
        """Time of each tick, (K,)."""
        return np.arange(self.ticks, dtype=np.float64) * self.tick_s

    @cached_property
    def measurements(self) -> Array:
        """y_i(k): v_y and curvature, (K, n, 2)."""
        return self.of_nodes("measurement", MEASUREMENT)

    @cached_property
    def estimates(self) -> Array:
        """xh_i(k): v_x, v_y, axial strain, curvature, (K, n, 4), absolute."""
        return self.of_nodes("estimate", STATE)

    @cached_property
    def late(self) -> npt.NDArray[np.bool_]:
        """(K,) ticks of a run in real time that had no sweep: nothing measured, nothing estimated."""
        return self.of_plant("pace", PACE)[:, 0] > 0.0

    @cached_property
    def commands(self) -> Array:
        """u_i(k): transverse load in N/m, (K, n); where a node has told none because it had none to tell, what
        the plant left in force (`analysis.recorded_commands`). NaN where rows were lost."""
        run, used = self.configuration, self.setpoints_used
        rests = np.stack([node.initial_command for node in self.deployment.nodes], axis=1)
        return in_force(
            told=self.of_nodes("command", COMMAND)[:, :, 0],
            late=self.late,
            on_time=self.health_says(Health.ON_TIME),
            alive=self.health_says(Health.ALIVE),
            rest=rests[np.where(used >= 0, used, run.setpoint_index)],
            fade=math.exp(-run.tick_s / run.scheduling.bump_s),
        )

    @cached_property
    def flags(self) -> npt.NDArray[np.int64]:
        """(K, n) wire.channels.Degraded of each node's tick; 0 where there is no row, and before version 5."""
        if self.format_version < 5:
            return np.zeros((self.ticks, self.nodes), dtype=np.int64)
        return whole_numbers(self.of_nodes("degraded", DEGRADED)[:, :, 0], 0.0)

    @cached_property
    def health(self) -> npt.NDArray[np.int64]:
        """(plant ticks, n) wire.channels.Health in every tick of the plant, which may have more than K; all is
        well where it did not say."""
        fields = [f"node_{self._label(i)}" for i in self._indices]
        return whole_numbers(self._whole_plant("/plant/health", fields), float(WELL))

    def health_says(self, what: Health) -> npt.NDArray[np.bool_]:
        """(K, n) one of the three things that the plant knows of a node."""
        return np.asarray((self.health[: self.ticks] & int(what)) != 0)

    @cached_property
    def passive(self) -> npt.NDArray[np.bool_]:
        """(plant ticks,) whether the arm was under static loads only."""
        return np.asarray(self._whole_plant("/plant/guard", GUARD)[:, 0] > 0.0)

    @cached_property
    def energy_above_loads_j(self) -> Array:
        """(plant ticks,) kinetic, axial and bending energy and potential of the loads; NaN before version 5.

        Without motion of the loads and without disturbance only damping changes it.
        """
        energy = self._whole_plant("/plant/energy", ENERGY).sum(axis=1)
        return np.asarray(energy + self._whole_plant("/plant/guard", GUARD)[:, 1])

    @cached_property
    def out(self) -> npt.NDArray[np.bool_]:
        """(K, n) ticks with a sweep of which a node has no row, and had nothing to record: it was out."""
        told = np.isfinite(self.estimates).all(axis=2)
        return np.asarray(~told & ~self.late[:, None] & ~self.health_says(Health.ON_TIME))

    @property
    def first_degraded(self) -> int | None:
        """The first tick in which the chain was not whole: a sum was bridged, a command held, a node out."""
        found = np.flatnonzero((self.flags != 0).any(axis=1) | self.out.any(axis=1))
        return int(found[0]) if found.size else None

    @cached_property
    def replaced(self) -> dict[int, int]:
        """How often each node was replaced, of those that were."""
        times = np.count_nonzero(self.flags & int(Degraded.JOINED), axis=0)
        return {node: int(count) for node, count in enumerate(times) if count}

    @cached_property
    def truth(self) -> Array:
        """The plant's exact state where the nodes hold theirs, (K, n, 4)."""
        return self._stack([f"/plant/truth/{self._label(i)}" for i in self._indices], STATE)

    @cached_property
    def tip_error_m(self) -> Array:
        """Distance of the tip from the reference's, (K,)."""
        return self.of_plant("tip", ("error_m",))[:, 0]

    @cached_property
    def tips_m(self) -> Array:
        """Where the tip is, (K, 2)."""
        return self.of_plant("tip", ("x_m", "y_m"))

    @cached_property
    def bumps(self) -> Array:
        """Part of the commands that hides a change of gains and is faded out, N/m, (K, n)."""
        return self.of_nodes("schedule", ("bump_n_per_m",))[:, :, 0]

    @cached_property
    def shapes_m(self) -> Array:
        """Points along the arm from root to tip, (K, points, 2)."""
        return self.of_plant("shape", SHAPE).reshape(self.ticks, SHAPE_POINTS, 2)

    @cached_property
    def sweep_durations_ms(self) -> Array:
        """From the first measurement sent to the last command received, wall clock, (K,); NaN in a tick in
        which no sweep ended."""
        table = self.table("/sweep/timing")
        durations = table.by_tick(("duration_wall_ns",), self.ticks)[:, 0] * 1e-6
        return np.where(durations > 0.0, durations, np.nan)

    @cached_property
    def initial_estimates(self) -> Array:
        """xh(0) of the configuration, (n, 4)."""
        return np.asarray(self.configuration.initial_estimates, dtype=np.float64)

    @cached_property
    def initial_commands(self) -> Array:
        """u(0) of the configuration, N/m, (n,)."""
        return np.asarray(self.configuration.initial_commands_n_per_m, dtype=np.float64)

    @cached_property
    def energy_weights(self) -> Array:
        """(n, 4): sum(weights * x**2) is the energy in J of a deviation x."""
        return np.asarray(self.configuration.energy_weights, dtype=np.float64)

    @cached_property
    def deployment(self) -> Deployment:
        """The sweep factors and dense steps, computed anew from artefact and configuration.

        Raises UsageError if the gains cannot be put on this arm.
        """
        run = self.configuration
        with about(f"recording {self.path}"):
            deployment = deploy(self.artefact, run.nodes, run.tick_s, run.faces_m)
        return deployment if run.control else deployment.without_control()

    @cached_property
    def references(self) -> References:
        """What nodes and plant should have done at each tick, computed anew like `deployment`."""
        run = self.configuration
        with about(f"recording {self.path}"):
            grid = make_grid(self.artefact.arm.length_m, run.nodes, run.faces_m)
            return make_references(
                self.artefact, grid, run.tick_s, run.setpoint, run.first_hold_s, run.legs
            )

    @cached_property
    def setpoints_used(self) -> npt.NDArray[np.int64]:
        """(K,) index of the setpoint whose gains the root node uses; -1 where that was not recorded.

        Raises UsageError for a setpoint that there is not.
        """
        table = self.table(f"/node/{self._label(0)}/schedule")
        used = table.by_tick(("setpoint",), self.ticks)[:, 0]
        used = np.where(np.isfinite(used), used, -1.0)
        count = len(self.configuration.setpoint_names)
        if used.size and not -1.0 <= used.min() <= used.max() < count:
            raise UsageError(
                f"recording {self.path}: channel {table.topic}, field 'setpoint': expected 0..{count - 1}; it "
                "was edited"
            )
        return used.astype(np.int64)

    def counter(self, name: str) -> int | None:
        """A total of the final counters (docs/recording.md); None if the recorder wrote none."""
        text = (self.counters or {}).get(name)
        if text is None:
            return None
        with about(f"recording {self.path}: counter {name}"):
            return number_of(text)

    def process_counters(self, process: str) -> dict[str, int]:
        """The final counters of "plant", "recorder" or "node/NN"; empty if it sent none."""
        text = (self.counters or {}).get(process)
        if text is None:
            return {}
        with about(f"recording {self.path}: counters of {process}"):
            return counts_of(text)

    def total(self, name: str) -> int | None:
        """A counter summed over all nodes; None unless every node has sent its counters."""
        counts = self._node_counters()
        return None if counts is None else sum(one.get(name, 0) for one in counts)

    def links(self) -> list[Link] | None:
        """Directed links between neighbours in different processes, forward ones first, each from the root on.

        None unless every node has sent its counters.
        """
        counts = self._node_counters()
        return None if counts is None else links_between(counts, set(self.replaced))

    def intact_links(self) -> int | None:
        """Links whose two ends saw the same bytes in the same order.

        2 (n - 1) if everything that was sent arrived unaltered (with p processes 2 (p - 1)), less the links of
        processes that were replaced; None unless every node has sent its counters.
        """
        links = self.links()
        return None if links is None else sum(link.intact and link.whole for link in links)

    def sweeps(self) -> int | None:
        """Ticks that had a sweep, by the final counters; None unless every node has sent its own, and if the
        recording ends before the run does."""
        done = self.counter("ticks_recorded")
        if (self.counter("disk_full_at") or -1) >= 0:
            return None
        if done is None or self.counter("nodes_reporting") != self.nodes:
            return None
        return done - (self.counter("late_ticks") or 0)

    def ending(self) -> str | None:
        """How the run ended: "finished", "interrupted", "safety_stop"; None if it does not say."""
        table = self.tables.get(EVENTS.topic)
        if table is None or not table.rows:
            return None
        return ending_among(table.column("name"))

    def _node_counters(self) -> list[dict[str, int]] | None:
        """The final counters of every node; None unless all have sent theirs."""
        counts = [self.process_counters(f"node/{self._label(i)}") for i in self._indices]
        return counts if all(counts) else None

    def _whole_plant(self, topic: str, fields: Sequence[str]) -> Array:
        """Fields of the plant in all of its ticks, (plant ticks, fields); NaN if there is no such channel."""
        own = self.table("/plant/pace")
        ticks = max(self.ticks, int(own.ticks.max()) + 1 if own.rows else 0)
        table = self.tables.get(topic)
        return (
            np.full((ticks, len(fields)), np.nan)
            if table is None or not table.rows
            else table.by_tick(fields, ticks)
        )

    @property
    def _indices(self) -> range:
        return range(self.nodes)

    def _label(self, node: int) -> str:
        return label(node, self.nodes)

    def _stack(self, topics: Sequence[str], fields: Sequence[str]) -> Array:
        return np.stack([self.table(t).by_tick(fields, self.ticks) for t in topics], axis=1)


def find_recording(path: Path) -> Path:
    """The recording that a user means: the file itself, or the one in the run's directory."""
    return path / "recording.mcap" if path.is_dir() else path


def read_recording(path: Path) -> Recording:
    """Read the recording of a run, also one that was cut short.

    Raises UsageError if the file is not an MCAP file, has no octarm metadata or artefact in it (too
    short or of another program), or a newer format; GainsRefusedError if the attached artefact is
    damaged.
    """
    content = read_mcap(path)
    facts = content.metadata.get(METADATA)
    if facts is None:
        raise UsageError(not_ours(path, content.unfinished, content.payloads))
    check_version(path, facts)
    if "run" not in facts:
        raise UsageError(f"recording {path}: no run configuration in its metadata; it was edited")
    configuration = loads(RunConfig, facts["run"], f"recording {path}: run configuration")
    where = f"recording {path}: "
    tables = {topic: decode_table(topic, rows, where) for topic, rows in content.payloads.items()}
    check_ticks(tables.values())
    check_numbers(one for topic, one in tables.items() if topic.startswith(_OF_NUMBERS))
    check_events(tables.get(EVENTS.topic))
    artefact = attached_artefact(content.attachments, path)
    check_setpoints(path, configuration, artefact)
    return Recording(
        path=path,
        unfinished=content.unfinished,
        configuration=configuration,
        artefact=artefact,
        facts=facts,
        counters=content.metadata.get(SUMMARY),
        tables=tables,
        ticks=common_ticks(tables, configuration.nodes),
        order=content.order,
        attachments=content.attachments,
    )
