"""The recorder without its transport: late ticks are not lost ones, and both are told."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from analysis.mcap_file import read_mcap
from recorder.process import RecorderProcess
from wire.channels import SUMMARY, WELL, columns_of, node_channels, plant_channels, width
from wire.child import Child
from wire.errors import ExitCode
from wire.joints import TipConfig
from wire.messages import (
    PLANT,
    Kind,
    decode_counters,
    encode_batch,
    encode_counters,
    kind_of,
    run_tag,
)
from wire.reference import TERMS, Leg, Reference
from wire.run_config import (
    DisturbanceConfig,
    LinkConfig,
    NoiseConfig,
    PaceConfig,
    RecorderConfig,
    RunConfig,
    SchedulingConfig,
)

NODES, TICKS = 3, 12
RUN = run_tag("r")
FORWARD, BACKWARD = (0, 5, 5), (4, 4, 0)
LAYOUT = {i: node_channels(i, NODES, FORWARD[i], BACKWARD[i]) for i in range(NODES)}
PLANT_FIELDS = [
    (channel.topic, field) for channel in plant_channels(NODES) for field in channel.fields
]
REST = Reference(0.1, [Leg(0.0, 0.0, np.zeros((TERMS, 7, 1)))])
LATE = PLANT_FIELDS.index(("/plant/pace", "late"))
PASSIVE = PLANT_FIELDS.index(("/plant/guard", "passive"))
HEALTH = columns_of(plant_channels(NODES), "/plant/health")
SETPOINT = [field for channel in LAYOUT[0] for field in channel.fields].index("setpoint")


def run_config() -> RunConfig:
    return RunConfig(
        run_id="r",
        scenario="s",
        nodes=NODES,
        spacing="equispaced",
        faces_m=(0.0, 0.3, 0.6, 1.0),
        tick_s=0.1,
        ticks=TICKS,
        seed=1,
        setpoint="a",
        setpoint_names=("a", "b"),
        first_hold_s=0.0,
        legs=(),
        scheduling=SchedulingConfig((0,), (), 1.0, 1.0),
        control=True,
        initial="rest",
        disturbance=DisturbanceConfig(),
        noise=NoiseConfig(),
        plant_cells=40,
        artefact_path="p",
        artefact_sha256="0",
        initial_estimates=((0.0,) * 4,) * NODES,
        initial_commands_n_per_m=(0.0,) * NODES,
        energy_weights=((1.0,) * 4,) * NODES,
        segments_per_process=1,
        pace=PaceConfig(0.1, 2),
    )


class Link:
    """Stands in for the session and for the samples that wait in it."""

    def __init__(self, raws: Sequence[bytes]) -> None:
        self.raws = list(raws)

    def declare_subscriber(self, _key: str, _handler: object) -> Link:
        return self

    def try_recv(self) -> SimpleNamespace | None:
        return SimpleNamespace(payload=self.raws.pop(0)) if self.raws else None

    def close(self) -> None:
        """Nothing is open."""


class Told(Child):
    """A launcher that says finish when everything has come, and keeps what it is told."""

    def __init__(self, link: Link) -> None:
        super().__init__("recorder", control=-1, status=-1, directory=None)
        self.said: list[tuple[str, dict[str, Any]]] = []
        self.kept = 0
        """Messages that the recorder has kept for counting when it has written them."""
        self.process: RecorderProcess | None = None
        self._link = link

    def wait(self, seconds: float | None) -> list[dict[str, Any]]:
        if self._link.raws or self.process is None:
            return []
        self.kept = len(self.process._received._waiting)
        return [{"do": "finish", "dead": []}]

    def status(self, event: str, **fields: Any) -> None:
        self.said.append((event, fields))


def node_rows(node: int, ticks: Sequence[int]) -> list[bytes]:
    """Telemetry with one row a tick, setpoint 0 in use."""
    rows = np.zeros((1, width(LAYOUT[node])))
    out = []
    for tick in ticks:
        rows[:] = 100.0 * node + tick
        rows[:, SETPOINT] = 0.0
        out.append(encode_batch(RUN, tick, node, rows))
    return out


def plant_rows(
    late: Sequence[int], ticks: int = TICKS, out: Sequence[tuple[int, int]] = ()
) -> list[bytes]:
    """`out`: (tick, node) of which the plant had no command in time."""
    rows = np.ones((ticks, len(PLANT_FIELDS)))
    rows[:, HEALTH] = WELL
    rows[:, PASSIVE] = 0.0
    for tick, node in out:
        rows[tick, HEALTH.start + node] = 0.0
    rows[:, LATE] = 0.0
    rows[list(late), LATE] = 1.0
    return [encode_batch(RUN, 0, PLANT, rows)]


class Recorded:
    """What the recorder made of these messages."""

    def __init__(self, path: Path, raws: Sequence[bytes], monkeypatch: pytest.MonkeyPatch) -> None:
        link = Link(raws)
        monkeypatch.setattr("wire.session.open_client", lambda *_: link)
        child = Told(link)
        config = RecorderConfig(
            run=run_config(),
            path=str(path),
            forward_widths=FORWARD,
            backward_widths=BACKWARD,
            tip=TipConfig(REST.to_plain(), 0.35),
            flush_s=1.0,
            metadata={},
            attachments={},
            links=LinkConfig((), (), None, 1.0, 0, None, None),
        )
        child.process = RecorderProcess(config, child)
        assert child.process.run() is ExitCode.OK
        child.close()
        self.kept = child.kept
        ((_, self.totals),) = [one for one in child.said if one[0] == "closed"]
        self.content = read_mcap(path)
        self.summary = self.content.metadata[SUMMARY]
        events = [json.loads(event) for event in self.content.payloads.get("/event", [])]
        self.events = [(event["name"], event["tick"]) for event in events]
        self.texts = [event["message"] for event in events]

    def ticks(self, topic: str) -> list[int]:
        return [json.loads(raw)["tick"] for raw in self.content.payloads[topic]]


def ends(ticks: int = TICKS, *, late_ticks: int = 0, nodes: int | None = None) -> list[bytes]:
    """The last words of all."""
    counters = {"late_ticks": late_ticks}
    return [
        encode_counters(RUN, ticks, PLANT, counters),
        *(encode_counters(RUN, nodes or ticks, i, {}) for i in range(NODES)),
    ]


def without(*left_out: int) -> list[int]:
    return [tick for tick in range(TICKS) if tick not in left_out]


def all_nodes(ticks: Sequence[int]) -> list[bytes]:
    return [raw for i in range(NODES) for raw in node_rows(i, ticks)]


def test_a_run_on_time_has_neither_late_nor_lost_ticks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raws = [*all_nodes(range(TICKS)), *plant_rows([]), *ends()]
    recorded = Recorded(tmp_path / "a.mcap", raws, monkeypatch)
    assert recorded.events == []
    assert (recorded.totals["ticks_lost"], recorded.totals["late_ticks"]) == (0, 0)
    assert recorded.ticks("/plant/pace") == list(range(TICKS))


def test_telemetry_is_not_kept_when_it_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raws = [*all_nodes(range(TICKS)), *plant_rows([]), *ends()]
    recorded = Recorded(tmp_path / "a.mcap", raws, monkeypatch)
    counted = json.loads(recorded.summary["recorder"])
    assert counted["telemetry_received_messages"] == len(raws)
    assert counted["telemetry_received_bytes"] == sum(map(len, raws))
    assert recorded.kept <= 1


@pytest.mark.parametrize("plant_first", [True, False])
def test_late_ticks_are_not_lost_and_told_once_in_a_row(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, plant_first: bool
) -> None:
    late = [3, 4, 8]
    nodes, plant = all_nodes(without(*late)), plant_rows(late)
    raws = [*plant, *nodes] if plant_first else [*nodes, *plant]
    recorded = Recorded(tmp_path / "a.mcap", [*raws, *ends(late_ticks=3)], monkeypatch)
    assert recorded.events == [("late", 3), ("late", 8)]
    assert (recorded.totals["ticks_lost"], recorded.totals["late_ticks"]) == (0, 3)
    assert (recorded.summary["ticks_lost"], recorded.summary["late_ticks"]) == ("0", "3")
    assert recorded.totals["ticks_recorded"] == TICKS
    assert recorded.ticks("/plant/pace") == list(range(TICKS))
    for i in range(NODES):
        assert recorded.ticks(f"/node/{i:02d}/command") == without(*late)
    marks = [json.loads(raw)["late"] for raw in recorded.content.payloads["/plant/pace"]]
    assert marks == [float(tick in late) for tick in range(TICKS)]


def test_late_ticks_at_the_end_are_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    late = [TICKS - 2, TICKS - 1]
    raws = [*plant_rows(late), *all_nodes(without(*late)), *ends(late_ticks=2, nodes=TICKS - 2)]
    recorded = Recorded(tmp_path / "a.mcap", raws, monkeypatch)
    assert recorded.events == [("late", TICKS - 2)]
    assert recorded.totals["ticks_lost"] == 0
    assert recorded.totals["ticks_recorded"] == TICKS


def test_a_gap_that_nobody_was_late_in_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raws = [
        *plant_rows([]),
        *node_rows(0, range(TICKS)),
        *node_rows(1, without(5, 6)),
        *node_rows(2, range(TICKS - 1)),
        *ends(),
    ]
    recorded = Recorded(tmp_path / "a.mcap", raws, monkeypatch)
    assert sorted(recorded.events) == [("telemetry_lost", 5), ("telemetry_lost", TICKS - 1)]
    assert "telemetry of node 1: ticks 5 to 6 were lost" in recorded.texts
    assert recorded.totals["ticks_lost"] == 3
    assert recorded.ticks("/node/01/command") == without(5, 6)


def test_of_a_gap_with_late_ticks_the_others_are_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    raws = [
        *plant_rows([5, 6]),
        *node_rows(0, without(5, 6)),
        *node_rows(1, without(4, 5, 6, 7)),
        *node_rows(2, without(5, 6)),
        *ends(late_ticks=2),
    ]
    recorded = Recorded(tmp_path / "a.mcap", raws, monkeypatch)
    assert sorted(recorded.events) == [("late", 5), ("telemetry_lost", 4)]
    assert recorded.totals["ticks_lost"] == 2


def test_of_a_node_that_was_out_only_what_went_with_its_process_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It was killed in tick 5, with the row of tick 4 not sent; its replacement begins in tick 8."""
    raws = [
        *plant_rows([], out=[(5, 1), (6, 1), (7, 1)]),
        *node_rows(0, range(TICKS)),
        *node_rows(1, without(4, 5, 6, 7)),
        *node_rows(2, range(TICKS)),
        *ends(),
    ]
    recorded = Recorded(tmp_path / "a.mcap", raws, monkeypatch)
    assert recorded.events == [("telemetry_lost", 4)]
    assert "ticks 4 to 7 were lost, but for 3 that it may not have done" in recorded.texts[0]
    assert recorded.totals["ticks_lost"] == 1
    assert recorded.totals["ticks_recorded"] == TICKS
    assert recorded.ticks("/node/00/command") == list(range(TICKS))  # the others' rows of the gap


def test_a_node_that_is_out_for_ever_holds_back_nothing_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It says no last word: what the others sent in the meantime is written when the file is closed."""
    out = [(tick, 1) for tick in range(5, TICKS)]
    raws = [
        *plant_rows([], out=out),
        *node_rows(0, range(TICKS)),
        *node_rows(1, range(5)),
        *node_rows(2, range(TICKS)),
        *ends(),
    ]
    raws = [raw for raw in raws if not (kind_of(raw) is Kind.COUNTERS and is_from(raw, 1))]
    recorded = Recorded(tmp_path / "a.mcap", raws, monkeypatch)
    assert recorded.events == []
    assert recorded.totals["ticks_lost"] == 0
    assert recorded.totals["nodes_reporting"] == NODES - 1
    assert recorded.ticks("/node/00/command") == list(range(TICKS))
    assert recorded.ticks("/plant/pace") == list(range(TICKS))
    assert recorded.ticks("/node/01/command") == list(range(5))


def is_from(raw: bytes, sender: int) -> bool:
    """Whether these counters are a sender's."""
    return decode_counters(raw, RUN)[0] == sender


def test_a_node_that_has_a_row_of_a_late_tick_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mark says what the plant saw; the rows that came are written."""
    raws = [*plant_rows([5]), *all_nodes(range(TICKS)), *ends(late_ticks=1)]
    recorded = Recorded(tmp_path / "a.mcap", raws, monkeypatch)
    assert recorded.events == [("late", 5)]
    assert recorded.ticks("/node/01/command") == list(range(TICKS))


@pytest.mark.timeout(30)
@pytest.mark.parametrize("tick", [TICKS + 1001, 10**9, 2**53])
def test_telemetry_and_last_words_of_ticks_that_the_run_has_not_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tick: int
) -> None:
    """They made every later row a repeated one, and a gap whose ticks were counted one by one, for ever."""
    wrong = [*node_rows(1, [tick]), encode_counters(RUN, tick, 1, {})]
    good = [*plant_rows([]), *all_nodes(range(TICKS)), *ends()]
    got = Recorded(tmp_path / "r.mcap", [*wrong, *good], monkeypatch)
    assert got.ticks("/node/01/measurement") == list(range(TICKS))
    assert got.totals["ticks_lost"] == 0
    refused = json.loads(got.summary["recorder"])
    assert refused["rejected_tick"] == refused["rejected_messages"] == 2


def test_a_setpoint_that_there_is_not_is_recorded_and_does_not_end_the_recorder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    strange = encode_batch(RUN, 0, 0, np.full((1, width(LAYOUT[0])), 1e100))
    rest = [
        *node_rows(0, range(1, TICKS)),
        *(m for i in (1, 2) for m in node_rows(i, range(TICKS))),
    ]
    got = Recorded(tmp_path / "r.mcap", [strange, *rest, *plant_rows([]), *ends()], monkeypatch)
    assert got.totals["ticks_recorded"] == TICKS
