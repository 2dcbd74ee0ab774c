"""The estimated arm's joints in a tick's telemetry: the chain of turned chords, and near the smooth arm."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from simulated_run import Scenario, write_recording

from analysis.estimated_arm import estimated_arms
from analysis.recording import Recording, read_recording
from wire.channels import label, node_channels
from wire.joints import Joints, TipConfig
from wire.run_config import LegConfig


def joints_of(recording: Recording) -> tuple[Joints, list[dict[int, list[float]]]]:
    """Joints as a recorder has them, and the rows that it got, from the file's columns."""
    n = recording.nodes
    widths = [node.forward_received for node in recording.deployment.nodes]
    tip = TipConfig(
        recording.references.nodes[-1].to_plain(), recording.deployment.nodes[-1].bend_m
    )
    rows: list[dict[int, list[float]]] = [{} for _ in range(recording.ticks)]
    for i in range(n):
        backward = recording.deployment.nodes[i].backward_received
        columns = [
            recording.table(f"/node/{label(i, n)}/{channel.topic.rsplit('/', 1)[1]}").numbers(field)
            for channel in node_channels(i, n, widths[i], backward)
            for field in channel.fields
        ]
        for k, row in enumerate(np.stack(columns, axis=1).tolist()):
            rows[k][i] = row
    return Joints(widths, tip), rows


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Six segments on the way from the straight setpoint to the bent one."""
    path = tmp_path_factory.mktemp("joints") / "recording.mcap"
    leg = LegConfig("bent", (), 4.0, 1.0)
    write_recording(path, Scenario(nodes=6, ticks=50, setpoint="straight", legs=(leg,)))
    return read_recording(path)


def test_the_joints_are_the_reference_s_chords_turned_and_stretched(recording: Recording) -> None:
    joints, rows = joints_of(recording)
    for k in (0, 20, 49):
        points = joints.points(k, rows[k])
        assert points is not None
        wanted = recording.references.states(k)
        chords = recording.references.chords_m(k)
        bends = np.array([node.bend_m for node in recording.deployment.nodes])
        turns = np.cumsum((recording.estimates[k, :, 3] - wanted[:, 3]) * bends)
        stretch = (1.0 + recording.estimates[k, :, 2]) / (1.0 + wanted[:, 2])
        ends = np.cumsum(stretch * np.exp(1j * turns) * (chords[:, 0] + 1j * chords[:, 1]))
        expected = [(0.0, 0.0), *zip(ends.real, ends.imag, strict=True)]
        assert np.allclose(points, expected, rtol=0.0, atol=1e-12)


def test_the_joints_lie_on_the_smooth_estimated_arm(tmp_path: Path) -> None:
    """Straight pieces against a spline: 24 of 4 cm each, on an arm that swings by 30 cm."""
    leg = LegConfig("bent", (), 1.0, 0.0)
    path = tmp_path / "recording.mcap"
    write_recording(path, Scenario(nodes=24, ticks=12, setpoint="straight", legs=(leg,)))
    fine = read_recording(path)
    joints, rows = joints_of(fine)
    points = np.array(joints.points(11, rows[11]))
    smooth = estimated_arms(fine, [11])[0]
    apart = np.linalg.norm(points[:, None] - smooth[None], axis=2).min(axis=1)
    assert apart.max() < 0.004


def test_without_a_node_s_row_there_is_no_arm(recording: Recording) -> None:
    joints, rows = joints_of(recording)
    for missing in (1, 5):
        assert joints.points(3, {i: row for i, row in rows[3].items() if i != missing}) is None
