"""What the launcher tells each process of a run, as JSON: the run itself and one configuration a
process.

Made once by the launcher, sent to the children as one line each (`wire.config_json`; or a file, for a node
started by hand), and written into the recording, so that a run can be understood and recomputed from its
recording alone.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any

from wire.errors import UsageError
from wire.joints import TipConfig

MOST_TICKS = 10_000_000
"""Of a run: a recording of so many has tens of gigabytes."""
SHORTEST_TICK_S = 1e-9
"""Instants are recorded in whole nanoseconds."""
LONGEST_RUN_S = 9e9
"""So many nanoseconds have 64 bits; 285 years."""


@dataclass(frozen=True)
class DisturbanceConfig:
    """A built-in disturbance of the plant; the unit of the amplitude is its own
    (plant.disturbance)."""

    name: str = "none"
    amplitude: float = 1.0
    frequency_rad_per_s: float = 1.0
    start_s: float = 0.0
    duration_s: float = 10.0


@dataclass(frozen=True)
class NoiseConfig:
    """Standard deviations of the sensors' noise."""

    velocity_y_m_per_s: float = 0.0
    curvature_per_m: float = 0.0


@dataclass(frozen=True)
class LegConfig:
    """One move of the reference: from where it is to the setpoint `to`, by way of others, then a rest."""

    to: str
    through: tuple[str, ...]
    move_s: float
    hold_s: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.move_s) and self.move_s > 0.0):
            raise UsageError(f"move_s: expected a positive number of seconds, got {self.move_s!r}")
        if not (math.isfinite(self.hold_s) and self.hold_s >= 0.0):
            raise UsageError(f"hold_s: expected 0 s or more, got {self.hold_s!r}")


@dataclass(frozen=True)
class SchedulingConfig:
    """Which setpoint's gains are in use: by the polar angle of the estimated tip (theory, section 5)."""

    setpoints: tuple[int, ...]
    """Indices of the setpoints that the run visits, by increasing angle of their tips."""
    boundaries_deg: tuple[float, ...]
    """Between neighbours of `setpoints`: midway between their tips' angles."""
    hysteresis_deg: float
    """How far beyond a boundary the tip must be before the setpoint changes."""
    bump_s: float
    """Time constant with which the command's jump at a change is faded out."""

    def __post_init__(self) -> None:
        if len(self.boundaries_deg) != len(self.setpoints) - 1:
            raise UsageError(
                f"boundaries_deg: expected {len(self.setpoints) - 1} numbers for "
                f"{len(self.setpoints)} setpoints, got {len(self.boundaries_deg)}"
            )
        if list(self.boundaries_deg) != sorted(set(self.boundaries_deg)):
            raise UsageError(f"boundaries_deg: expected to increase, got {self.boundaries_deg}")
        if not (math.isfinite(self.hysteresis_deg) and self.hysteresis_deg >= 0.0):
            raise UsageError(
                f"hysteresis_deg: expected 0 degrees or more, got {self.hysteresis_deg!r}"
            )
        if not (math.isfinite(self.bump_s) and self.bump_s > 0.0):
            raise UsageError(f"bump_s: expected a positive number of seconds, got {self.bump_s!r}")


@dataclass(frozen=True)
class PaceConfig:
    """A run in real time: the monotonic clock says when a tick begins."""

    period_s: float
    """Between two ticks, wall clock."""
    hold_ticks: int
    """So many ticks in a row may be late, the last commands held; then the arm goes safe."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.period_s) and self.period_s > 0.0):
            raise UsageError(
                f"period_s: expected a positive number of seconds, got {self.period_s!r}"
            )
        if self.hold_ticks < 0:
            raise UsageError(f"hold_ticks: expected 0 or more, got {self.hold_ticks}")


@dataclass(frozen=True)
class RunConfig:
    """One run: everything that its numbers depend on, apart from the gains artefact's content."""

    run_id: str
    scenario: str
    nodes: int
    spacing: str
    faces_m: tuple[float, ...]
    """Segment boundaries from root to tip, n + 1 of them."""
    tick_s: float
    ticks: int
    seed: int
    setpoint: str
    """Where the reference is at the start, and whose gains are in use then."""
    setpoint_names: tuple[str, ...]
    first_hold_s: float
    """How long the reference rests at the start."""
    legs: tuple[LegConfig, ...]
    scheduling: SchedulingConfig
    control: bool
    """False: the commands are the reference's own, without feedback."""
    initial: str
    disturbance: DisturbanceConfig
    noise: NoiseConfig
    plant_cells: int
    artefact_path: str
    artefact_sha256: str
    initial_estimates: tuple[tuple[float, ...], ...]
    """xh(0), one (v_x, v_y, e, k) a node."""
    initial_commands_n_per_m: tuple[float, ...]
    """u(0), one a node."""
    energy_weights: tuple[tuple[float, ...], ...]
    """(n, 4), J per unit squared: sum of w x^2 is the energy of a state deviation x."""
    segments_per_process: int
    """How many segments a node process has; the last one may have fewer."""
    pace: PaceConfig | None
    """None: lock-step, as fast as the machine goes."""
    restart: bool = dataclasses.field(default=False, metadata={"missing": False})
    """Whether a dead node is replaced while the others go on."""
    plant_model: str = dataclasses.field(default="exact", metadata={"missing": "exact"})
    """What moves the emulated arm: see plant.truncated_force."""

    def __post_init__(self) -> None:
        if self.nodes < 2:
            raise UsageError(f"nodes: expected at least 2, got {self.nodes}")
        if not 1 <= self.ticks <= MOST_TICKS:
            raise UsageError(f"ticks: expected 1..{MOST_TICKS}, got {self.ticks}")
        if not SHORTEST_TICK_S <= self.tick_s <= LONGEST_RUN_S / self.ticks:
            raise UsageError(
                f"tick_s: expected {SHORTEST_TICK_S:g} s to {LONGEST_RUN_S / self.ticks:g} s for "
                f"{self.ticks} ticks, got {self.tick_s!r}"
            )
        if len(self.faces_m) != self.nodes + 1:
            raise UsageError(f"faces_m: expected {self.nodes + 1} numbers, got {len(self.faces_m)}")
        shapes = {"initial_estimates": 4, "energy_weights": 4, "initial_commands_n_per_m": None}
        for key, columns in shapes.items():
            rows = getattr(self, key)
            if len(rows) != self.nodes or (columns and any(len(row) != columns for row in rows)):
                each = f" of {columns} numbers each" if columns else ""
                raise UsageError(f"{key}: expected {self.nodes} entries{each}, got others")
        if not (math.isfinite(self.first_hold_s) and self.first_hold_s >= 0.0):
            raise UsageError(f"first_hold_s: expected 0 s or more, got {self.first_hold_s!r}")
        for name in (self.setpoint, *(n for leg in self.legs for n in (*leg.through, leg.to))):
            if name not in self.setpoint_names:
                raise UsageError(f"setpoint {name!r}: not in {self.setpoint_names}")
        if self.segments_per_process < 1:
            raise UsageError(
                f"segments_per_process: expected at least 1, got {self.segments_per_process}"
            )
        count = len(self.setpoint_names)
        if any(not 0 <= index < count for index in self.scheduling.setpoints):
            raise UsageError(f"scheduling: setpoints {self.scheduling.setpoints} of {count}")
        if self.setpoint_index not in self.scheduling.setpoints:
            raise UsageError(
                f"scheduling: setpoints {self.scheduling.setpoints} without {self.setpoint_index}, the one at "
                "the start"
            )

    @property
    def setpoint_index(self) -> int:
        """Position of the setpoint at the start among `setpoint_names`."""
        return self.setpoint_names.index(self.setpoint)

    @property
    def firsts(self) -> tuple[int, ...]:
        """The first segment of each node process: what the process is called by."""
        return tuple(range(0, self.nodes, self.segments_per_process))


@dataclass(frozen=True)
class TlsConfig:
    """How a process proves who it is, and whom it believes. Files by their paths on its own machine."""

    name: str
    """The process, as its certificate has it (wire.access)."""
    identity: str
    """Its Zenoh number in this run, hexadecimal: made by the launcher, known to itself and its peers."""
    authority: str
    """The certificate of the authority that all certificates of the run must be signed by."""
    certificate: str
    private_key: str
    peers: dict[str, str]
    """Whom it has links with: names and Zenoh numbers."""
    access: dict[str, Any]
    """Zenoh's `access_control`: what each peer may say, and nothing else (wire.access)."""


_LATER = {"missing": None}
"""Of a field that configurations in older recordings do not have."""


@dataclass(frozen=True)
class LinkConfig:
    """Where a process listens and whom it dials, and the times that it waits."""

    listen: tuple[str, ...]
    connect: tuple[str, ...]
    directory: str | None
    """The run's private directory of sockets, None over TCP or when the user owns it."""
    deadline_s: float
    """Longest wait within a tick before the arm is stopped."""
    epoch_ns: int | None
    """Zero of the recorded wall-clock instants, on the monotonic clock of the launcher's machine. None
    for a node on another machine, whose clock is its own: it takes its first measurement's instant."""
    cpu: int | None
    """The core to run on, None to leave it to the scheduler."""
    fifo: int | None
    """Priority of real-time scheduling (SCHED_FIFO), None for the ordinary one."""
    tls: TlsConfig | None = dataclasses.field(default=None, metadata=_LATER)
    """None: whoever reaches the process is believed."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.deadline_s) and self.deadline_s > 0.0):
            raise UsageError(f"deadline_s: expected a positive number, got {self.deadline_s!r}")
        if self.fifo is not None and not 1 <= self.fifo <= 99:
            raise UsageError(f"fifo: expected a priority 1..99, got {self.fifo}")


@dataclass(frozen=True)
class SegmentConfig:
    """One segment of a node: its matrices and its reference."""

    factors: dict[str, Any]
    """Sweep factors and initial values, see wire.factors."""
    reference: dict[str, Any]
    """State and command that the segment should have at each tick, see wire.reference."""


@dataclass(frozen=True)
class NodeConfig:
    """What one node needs: its place in the chain, its segments, its links."""

    run_id: str
    index: int
    """Of its first segment; what the node is called by."""
    nodes: int
    """Segments of the whole arm."""
    setpoint: int
    """Index of the setpoint whose gains are in use at the start."""
    scheduling: SchedulingConfig
    batch_ticks: int
    """Telemetry is sent every so many ticks."""
    skip_ticks: int
    """How many ticks at most a message may be ahead: in real time a late sweep leaves ticks out."""
    links: LinkConfig
    segments: tuple[SegmentConfig, ...]
    """From the root to the tip; usually one."""
    left: int = dataclasses.field(default=-1, metadata={"missing": -1})
    """The node process towards the root, called by its first segment; -1: none, or nobody has said it."""
    joins: bool = dataclasses.field(default=False, metadata={"missing": False})
    """It replaces a dead process in a run that goes on."""
    bridge_s: float = dataclasses.field(default=0.0, metadata={"missing": 0.0})
    """So long at most a neighbour's sums are bridged without a break; then the node gives up, and the arm goes
    passive. 0: for ever."""

    def __post_init__(self) -> None:
        if not self.segments:
            raise UsageError("segments: expected at least one, got none")
        if self.nodes < 2 or not 0 <= self.index <= self.last < self.nodes:
            raise UsageError(
                f"index: expected {len(self.segments)} of the segments 0..{self.nodes - 1}, got "
                f"{self.index}..{self.last}"
            )
        if self.batch_ticks < 1:
            raise UsageError(f"batch_ticks: expected at least 1, got {self.batch_ticks}")
        if self.skip_ticks < 0:
            raise UsageError(f"skip_ticks: expected 0 or more, got {self.skip_ticks}")
        if not (math.isfinite(self.bridge_s) and self.bridge_s >= 0.0):
            raise UsageError(f"bridge_s: expected 0 s or more, got {self.bridge_s!r}")

    @property
    def last(self) -> int:
        """Index of the last segment."""
        return self.index + len(self.segments) - 1


@dataclass(frozen=True)
class PlantConfig:
    """What the plant needs: the run, the arm and first setpoint of the artefact (as JSON), its links."""

    run: RunConfig
    arm: dict[str, Any]
    setpoint: dict[str, Any]
    reference: dict[str, Any]
    """Where the tip, and the means over the arm, should be at each tick, see wire.reference."""
    holding_n_per_m: tuple[tuple[float, ...], ...]
    """For each setpoint the loads that hold it, one a segment: what a safe arm is left under."""
    batch_ticks: int
    links: LinkConfig


@dataclass(frozen=True)
class RecorderConfig:
    """What the recorder needs: the run, the file, what to attach, and how wide each node's records
    are."""

    run: RunConfig
    path: str
    forward_widths: tuple[int, ...]
    """Numbers in the forward sum that each node receives (0 at the root)."""
    backward_widths: tuple[int, ...]
    """Numbers in the backward sum that each node receives (0 at the tip)."""
    tip: TipConfig
    flush_s: float
    """See wire.channels.FLUSH_S."""
    metadata: dict[str, str]
    attachments: dict[str, str]
    """Name and text of each attached file."""
    links: LinkConfig


@dataclass(frozen=True)
class GoalConfig:
    """A setpoint that the run visits, to be drawn behind the arm."""

    setpoint: int
    """Its index among the run's setpoint_names."""
    shape_m: tuple[tuple[float, ...], ...]
    """Points (x, y) from root to tip."""


@dataclass(frozen=True)
class LiveConfig:
    """What the process of the live page needs: the run, how wide each node's records are, what it draws."""

    run: RunConfig
    port: int
    """Of 127.0.0.1; 0: any that is free."""
    forward_widths: tuple[int, ...]
    """Numbers in the forward sum that each node receives (0 at the root)."""
    backward_widths: tuple[int, ...]
    """Numbers in the backward sum that each node receives (0 at the tip)."""
    tip: TipConfig
    goals: tuple[GoalConfig, ...]
    elsewhere: tuple[int, ...]
    """Segments on machines with clocks of their own: what they measure cannot be compared."""
    period_s: float
    """Between two ticks as they come, wall clock: rows that are older are not on time. 0: nobody knows."""
    replay_from: int | None
    """None beside a run; else a recording is published again from this tick on, perhaps several times."""
    links: LinkConfig

    def __post_init__(self) -> None:
        if not (math.isfinite(self.period_s) and self.period_s >= 0.0):
            raise UsageError(f"period_s: expected 0 or more seconds, got {self.period_s!r}")
        if not 0 <= self.port <= 65_535:
            raise UsageError(f"port: expected 0..65535, got {self.port}")
