"""A recording as arrays: what the recorder wrote during a run, typed and checked.

Everything that the figures of a run need is in the file itself: the configuration, the gains
artefact (attached), the counters, and one channel per kind of message and node (docs/recording.md).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from analysis.mcap_file import McapContent, read_mcap
from analysis.table import Table, decode_table
from deploy import Deployment, SegmentGrid, deploy
from deploy.path import References, make_references
from wire.artefact import FORMAT as GAINS_FORMAT
from wire.artefact import GainsArtefact, parse_artefact
from wire.channels import (
    COMMAND,
    MEASUREMENT,
    METADATA,
    PACE,
    READABLE,
    SHAPE,
    SHAPE_POINTS,
    STATE,
    SUMMARY,
    label,
)
from wire.errors import UsageError
from wire.foxglove import EVENTS
from wire.run_config import RunConfig, loads

Array = npt.NDArray[np.float64]

QUANTITIES = (*STATE, *COMMAND)
"""What a node computes each tick, in the order of the dense step's output."""
_FLOW = ("messages", "bytes", "crc32")
ENDINGS = ("finished", "interrupted", "safety_stop")
"""Names of the events that say how a run ended."""


@dataclass(frozen=True)
class Link:
    """One direction between two neighbours, by the final counters of both."""

    way: str
    """"forward" or "backward"."""
    sender: int
    receiver: int
    sent: int
    received: int
    intact: bool
    """Both ends agree in number, bytes and checksum."""


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
        """u_i(k): transverse load in N/m, (K, n); in late ticks those that were held."""
        commands = self.of_nodes("command", COMMAND)[:, :, 0]
        for k in np.flatnonzero(self.late):
            commands[k] = commands[k - 1]
        return commands

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
        """The sweep factors and dense steps, computed anew from artefact and configuration."""
        run = self.configuration
        deployment = deploy(self.artefact, run.nodes, run.tick_s, run.faces_m)
        return deployment if run.control else deployment.without_control()

    @cached_property
    def references(self) -> References:
        """What nodes and plant should have done at each tick, computed anew like `deployment`."""
        run = self.configuration
        grid = SegmentGrid(np.asarray(run.faces_m))
        return make_references(
            self.artefact, grid, run.tick_s, run.setpoint, run.first_hold_s, run.legs
        )

    @cached_property
    def setpoints_used(self) -> npt.NDArray[np.int64]:
        """(K,) index of the setpoint whose gains the root node uses; -1 where that was not recorded."""
        table = self.table(f"/node/{self._label(0)}/schedule")
        used = table.by_tick(("setpoint",), self.ticks)[:, 0]
        return np.where(np.isfinite(used), used, -1.0).astype(np.int64)

    def counter(self, name: str) -> int | None:
        """A total of the final counters (docs/recording.md); None if the recorder wrote none."""
        text = (self.counters or {}).get(name)
        if text is None:
            return None
        try:
            return int(text)
        except ValueError:
            raise UsageError(
                f"recording {self.path}: counter {name} is {text[:40]!r}, not a number"
            ) from None

    def process_counters(self, process: str) -> dict[str, int]:
        """The final counters of "plant", "recorder" or "node/NN"; empty if it sent none."""
        text = (self.counters or {}).get(process)
        if text is None:
            return {}
        try:
            return msgspec.json.decode(text, type=dict[str, int])
        except msgspec.DecodeError as error:
            raise UsageError(f"recording {self.path}: counters of {process}: {error}") from None

    def total(self, name: str) -> int | None:
        """A counter summed over all nodes; None unless every node has sent its counters."""
        counts = [self.process_counters(f"node/{self._label(i)}") for i in self._indices]
        if not all(counts):
            return None
        return sum(one.get(name, 0) for one in counts)

    def links(self) -> list[Link] | None:
        """Directed links between neighbours in different processes, forward ones first, each from the root on.

        None unless every node has sent its counters.
        """
        counts = [self.process_counters(f"node/{self._label(i)}") for i in self._indices]
        if not all(counts):
            return None
        pairs = [("forward", i, i + 1) for i in range(self.nodes - 1)]
        pairs += [("backward", i + 1, i) for i in range(self.nodes - 1)]
        return [
            Link(
                way,
                a,
                b,
                counts[a][f"{way}_sent_messages"],
                counts[b].get(f"{way}_received_messages", 0),
                all(
                    counts[a][f"{way}_sent_{what}"] == counts[b].get(f"{way}_received_{what}")
                    for what in _FLOW
                ),
            )
            for way, a, b in pairs
            if f"{way}_sent_messages" in counts[a]  # else both are in one process
        ]

    def intact_links(self) -> int | None:
        """Links whose two ends saw the same bytes in the same order.

        2 (n - 1) if everything that was sent arrived unaltered (with p processes 2 (p - 1)); None unless every
        node has sent its counters.
        """
        links = self.links()
        return None if links is None else sum(link.intact for link in links)

    def sweeps(self) -> int | None:
        """Ticks that had a sweep, by the final counters; None unless every node has sent its own."""
        done = self.counter("ticks_recorded")
        if done is None or self.counter("nodes_reporting") != self.nodes:
            return None
        return done - (self.counter("late_ticks") or 0)

    def ending(self) -> str | None:
        """How the run ended: "finished", "interrupted", "safety_stop"; None if it does not say."""
        table = self.tables.get(EVENTS.topic)
        if table is None or not table.rows:
            return None
        names = [name for name in table.column("name") if name in ENDINGS]
        return names[-1] if names else None

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
    try:
        tables = {topic: decode_table(topic, rows) for topic, rows in content.payloads.items()}
    except UsageError as error:
        raise UsageError(f"recording {path}: {error}") from None
    return Recording(
        path=path,
        unfinished=content.unfinished,
        configuration=configuration,
        artefact=_artefact(content, path),
        facts=facts,
        counters=content.metadata.get(SUMMARY),
        tables=tables,
        ticks=_common_ticks(tables, configuration),
        order=content.order,
        attachments=content.attachments,
    )


def check_version(path: Path, facts: Mapping[str, str]) -> None:
    """UsageError unless the metadata of octarm say a format version that is read."""
    version = facts.get("format_version", "")
    if version not in map(str, READABLE):
        raise UsageError(
            f"recording {path}: expected format version {' or '.join(map(str, READABLE))}, got "
            f"{version or 'none'}; read it with the octarm that wrote it, or a newer one"
        )


def not_ours(path: Path, stops: str | None, topics: Iterable[str]) -> str:
    """Why an MCAP file without the metadata of octarm is refused; `stops` says how it stops, if it does."""
    if stops is not None:
        return f"recording {path}: it {stops}, before anything of octarm; the run did not begin"
    return (
        f"recording {path}: an MCAP file without {METADATA!r} metadata, so not of octarm (its topics: "
        f"{', '.join(sorted(topics)[:5]) or 'none'}); give the .mcap file that a run left behind"
    )


def _artefact(content: McapContent, path: Path) -> GainsArtefact:
    """The attached gains artefact, checked as any artefact file is."""
    for name, data in content.attachments.items():
        if f'"{GAINS_FORMAT}"'.encode() not in data[:200]:
            continue
        return parse_artefact(data, f"{name} attached to recording {path}")
    attached = ", ".join(content.attachments) or "nothing"
    raise UsageError(
        f"recording {path}: expected the gains artefact attached, found {attached}; "
        "it was cut short before the run began, or edited"
    )


def needed_topics(nodes: int) -> list[str]:
    """The channels that a tick must have reached to count as one of the recording."""
    names = [label(i, nodes) for i in range(nodes)]
    kinds = ("measurement", "estimate", "command")
    own = [f"/node/{name}/{kind}" for name in names for kind in kinds]
    return [*own, *(f"/plant/truth/{name}" for name in names)]


def _common_ticks(tables: Mapping[str, Table], run: RunConfig) -> int:
    """Ticks from 0 on that the plant and every node have reached in this file."""
    last = []
    for topic in needed_topics(run.nodes):
        table = tables.get(topic)
        last.append(-1 if table is None or not table.rows else int(table.ticks.max()))
    return min(last) + 1
