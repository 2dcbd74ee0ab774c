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
from wire.channels import SUMMARY, node_channels, plant_channels, width
from wire.child import Child
from wire.errors import ExitCode
from wire.joints import TipConfig
from wire.messages import PLANT, encode_batch, encode_counters, run_tag
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


def plant_rows(late: Sequence[int], ticks: int = TICKS) -> list[bytes]:
    rows = np.ones((ticks, len(PLANT_FIELDS)))
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


def test_a_node_that_has_a_row_of_a_late_tick_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The mark says what the plant saw; the rows that came are written."""
    raws = [*plant_rows([5]), *all_nodes(range(TICKS)), *ends(late_ticks=1)]
    recorded = Recorded(tmp_path / "a.mcap", raws, monkeypatch)
    assert recorded.events == [("late", 5)]
    assert recorded.ticks("/node/01/command") == list(range(TICKS))
