"""What a campaign does, drawn from its seed: runs of the arm, and the faults put into each. Pure.

First step of a case: the same seed and number give the same run and the same plan of faults, whatever was drawn
before. Instants are those of the plan; when a fault really comes, a busy machine has its say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from random import Random

START = "start"
"""Phase of a fault that comes `at_s` after its target exists, before the first tick if it is quick."""
RUN = "run"
"""Phase of a fault that comes `at_s` after the first tick."""
BEFORE = "before"
"""Phase of a fault that is there before the run is started."""
ENDLESS = 1_000_000
"""Ticks of a run that ends by its faults or is interrupted."""
MOST_FAULTS = 6
SPAN_S = 1.5
"""Faults come within so long after the first tick."""
DEADLINE_S = 2.0
START_TIMEOUT_S = 8.0
"""The machine is busy with the other run, and with faults: a start of one second may take several."""

NODE, PLANT, RECORDER, ZYGOTE, LIVE, LAUNCHER = (
    "node",
    "plant",
    "recorder",
    "zygote",
    "live",
    "launcher",
)
PROCESSES = (NODE, PLANT, RECORDER, ZYGOTE, LIVE, LAUNCHER)
THE_RUN = "run"
"""Target of what is not aimed at one process."""

GAINS_VARIANTS = ("truncated", "flipped", "future", "empty", "noise", "missing")
SCENARIO_VARIANTS = ("truncated", "flipped", "future", "empty", "noise", "missing")
HOSTS_VARIANTS = ("truncated", "future", "empty", "noise", "missing")
KEYS_VARIANTS = ("truncated", "noise", "empty", "missing", "open", "foreign")
PLACE_VARIANTS = ("port", "live port", "socket directory", "out directory")

WEIGHTS: dict[tuple[str, str], float] = {
    **{("kill", target): 2.0 for target in PROCESSES},
    ("kill", NODE): 8.0,
    ("freeze", NODE): 3.0,
    ("freeze", PLANT): 0.7,  # the nodes' patience, three deadlines
    ("freeze", RECORDER): 0.7,  # five seconds of the launcher's patience
    ("freeze", ZYGOTE): 0.7,  # the same
    ("freeze", LIVE): 0.7,
    ("freeze", LAUNCHER): 0.7,
    **{("pause", target): 3.0 for target in PROCESSES},
    ("pause", NODE): 8.0,
    **{("slow", target): 1.5 for target in PROCESSES},
    ("slow", NODE): 4.0,
    ("interrupt", LAUNCHER): 2.0,
    ("terminate", LAUNCHER): 2.0,
    ("garbage", NODE): 5.0,
    ("garbage", PLANT): 5.0,
    ("flood", NODE): 3.0,
    ("flood", PLANT): 3.0,
    ("disk", RECORDER): 3.0,
    **{("descriptors", target): 1.0 for target in PROCESSES},
    ("sockets gone", THE_RUN): 2.0,
    ("directory gone", THE_RUN): 2.0,
    ("hog", THE_RUN): 4.0,
}
"""How often each kind of fault is drawn, by target."""
PREPARED: dict[str, tuple[str, ...]] = {
    "gains": GAINS_VARIANTS,
    "scenario": SCENARIO_VARIANTS,
    "hosts": HOSTS_VARIANTS,
    "place": PLACE_VARIANTS,
    "keys": KEYS_VARIANTS,
}
"""Faults that are there before the run, each with its variants."""
PREPARED_SHARE = 0.12
START_SHARE = 0.2
"""Of the faults of a run that come while it is being started."""
TWIN_SHARE = 0.15
"""Of the faults that come at the very instant of the one before."""
LASTING = ("pause", "slow", "garbage", "flood", "hog", "freeze")
GARBAGE_VARIANTS = ("mutated", "replayed", "nan", "deaf")
ENDING = ("kill", "freeze", "interrupt", "terminate")
"""Kinds that may end a run: drawn for its second half, so that the others come before."""


@dataclass(frozen=True)
class RunDraw:
    """One run of the arm, as options of `octarm run`."""

    nodes: int
    segments_per_process: int
    realtime: bool
    period_s: float
    hold_ticks: int
    restart: bool
    scenario: str
    transport: str
    keys: bool
    """Mutual TLS, with keys made for this run alone."""
    live: bool
    seed: int
    ticks: int

    @property
    def firsts(self) -> tuple[int, ...]:
        """The first segment of each node process: what it is called by."""
        return tuple(range(0, self.nodes, self.segments_per_process))

    def last(self, first: int) -> int:
        """The last segment of the process that is called by this first one."""
        return min(first + self.segments_per_process, self.nodes) - 1

    @property
    def endless(self) -> bool:
        """Whether it does not end by itself."""
        return self.ticks == ENDLESS

    def arguments(self) -> list[str]:
        """Options of `octarm run`; gains are the default's."""
        words = f"--nodes {self.nodes} --ticks {self.ticks} --scenario {self.scenario} --seed {self.seed}"
        words += f" --deadline {DEADLINE_S:g} --start-timeout {START_TIMEOUT_S:g} --no-plot"
        words += f" --transport {self.transport}"
        if self.segments_per_process > 1:
            words += f" --segments-per-process {self.segments_per_process}"
        if self.realtime:
            words += f" --realtime --period {self.period_s:g} --hold-ticks {self.hold_ticks}"
        words += " --restart" if self.restart else ""
        words += " --keys keys" if self.keys else ""
        words += " --live" if self.live else ""
        return words.split()


@dataclass(frozen=True)
class Fault:
    """One fault of a plan."""

    kind: str
    target: str
    phase: str
    at_s: float = 0.0
    node: int = -1
    """First segment of the node process that is meant."""
    for_s: float = 0.0
    """How long it lasts, where it does not last for ever."""
    variant: str = ""
    amount: float = 0.0
    """Bytes, descriptors, connections, share of time: what the kind measures."""
    seed: int = 0
    """Of what is random within it."""

    @property
    def name(self) -> str:
        """Kind and target for a table: "kill node", "garbage plant", "gains truncated"."""
        if self.phase == BEFORE:
            return f"{self.kind} {self.variant}"
        return self.kind if self.target == THE_RUN else f"{self.kind} {self.target}"

    def __str__(self) -> str:
        aim = f" {self.node}" if self.target == NODE else ""
        when = {BEFORE: "", START: f" {self.at_s:.2f} s into the start-up"}
        text = f"{self.name}{aim}{when.get(self.phase, f' {self.at_s:.2f} s into the run')}"
        return text + (f" for {self.for_s:.2f} s" if self.for_s else "")


@dataclass(frozen=True)
class Case:
    """A run and its faults, in order of their instants."""

    seed: int
    number: int
    run: RunDraw
    faults: tuple[Fault, ...]

    @property
    def prepared(self) -> Fault | None:
        """The fault that is there before the run, if it is one of those cases."""
        return next((fault for fault in self.faults if fault.phase == BEFORE), None)


def draw_case(seed: int, number: int) -> Case:
    """The case of this number; the same whatever else is drawn."""
    random = Random(f"octarm chaos {seed} {number}")
    run = _draw_run(random)
    if random.random() < PREPARED_SHARE:
        fault = _draw_prepared(random)
        faults: list[Fault] = [fault]
        run = replace(run, keys=fault.kind == "keys")
        if fault.kind in ("hosts", "keys"):
            run = replace(run, transport="tcp", segments_per_process=1)
        return Case(seed, number, replace(run, ticks=min(run.ticks, 100)), tuple(faults))
    faults = []
    for _ in range(random.randint(1, MOST_FAULTS)):
        fault = _draw_fault(random, run)
        if faults and random.random() < TWIN_SHARE:
            fault = replace(fault, phase=faults[-1].phase, at_s=faults[-1].at_s)
        faults.append(fault)
    faults.sort(key=lambda fault: (fault.phase == RUN, fault.at_s))
    return Case(seed, number, run, tuple(faults))


def _draw_run(random: Random) -> RunDraw:
    nodes = random.randint(2, 8)
    realtime = random.random() < 0.6
    period_s = random.choice((0.01, 0.015, 0.02, 0.03, 0.05))
    if random.random() < (0.4 if realtime else 0.6):
        ticks = ENDLESS
    elif realtime:
        ticks = round(random.uniform(1.0, 3.0) / period_s)
    else:
        ticks = random.randint(300, 2500)
    transport = random.choice(("unix", "unix", "tcp"))
    return RunDraw(
        nodes=nodes,
        segments_per_process=random.choice([n for n in (1, 1, 1, 2, 3) if n < nodes]),
        realtime=realtime,
        period_s=period_s,
        hold_ticks=random.randint(0, 6),
        restart=random.random() < 0.5,
        scenario=random.choice(("hold", "reach", "track")),
        transport=transport,
        keys=transport == "tcp" and random.random() < 0.5,
        live=random.random() < 0.25,
        seed=random.randint(0, 10_000),
        ticks=ticks,
    )


def _draw_prepared(random: Random) -> Fault:
    kind = random.choice(tuple(PREPARED))
    return Fault(
        kind,
        THE_RUN,
        BEFORE,
        variant=random.choice(PREPARED[kind]),
        amount=random.random(),
        seed=random.getrandbits(32),
    )


def _possible(run: RunDraw) -> Sequence[tuple[str, str]]:
    """Kinds and targets that this run has."""
    lacking = set() if run.live else {LIVE}
    out = [pair for pair in WEIGHTS if pair[1] not in lacking]
    return [pair for pair in out if run.transport == "unix" or pair[0] != "sockets gone"]


def _draw_fault(random: Random, run: RunDraw) -> Fault:
    pairs = _possible(run)
    kind, target = random.choices(pairs, [WEIGHTS[pair] for pair in pairs])[0]
    phase = START if random.random() < START_SHARE else RUN
    if phase == START:
        at_s = random.uniform(0.0, 0.6)
    elif kind in ENDING and target != LIVE:
        at_s = random.uniform(0.3 * SPAN_S, SPAN_S)
    else:
        at_s = random.uniform(0.0, 0.7 * SPAN_S)
    # The tip's process has no socket of its own.
    nodes = run.firsts[:-1] if kind in ("garbage", "flood") else run.firsts
    fault = Fault(kind, target, phase, round(at_s, 3), seed=random.getrandbits(32))
    if target == NODE:
        fault = replace(fault, node=random.choice(nodes))
    if kind in LASTING and (kind != "freeze" or target == LAUNCHER):
        fault = replace(fault, for_s=round(random.uniform(0.05, 1.2), 3))
    match kind:
        case "garbage":
            return replace(fault, variant=random.choice(GARBAGE_VARIANTS))
        case "slow":
            return replace(fault, amount=round(random.uniform(0.2, 0.8), 2))
        case "flood":
            return replace(fault, amount=random.choice((20, 50, 150)))
        case "disk":
            return replace(fault, amount=random.choice((2_000, 20_000, 200_000, 1_000_000)))
        case "descriptors":
            return replace(fault, amount=random.choice((0, 1, 2)))
        case "hog":
            return replace(fault, amount=random.choice((1, 2, 4)))
    return fault
