"""Frames of the live page against the recording of the same run: numbers from the file, by other means."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.interpolate import CubicSpline

from analysis.recording import Recording
from wire.channels import label, node_channels, plant_channels
from wire.joints import TipConfig
from wire.messages import PLANT
from wire.run_config import GoalConfig, LinkConfig, LiveConfig

Array = npt.NDArray[np.float64]
METRES, CURVATURES = 0.51e-5, 0.51e-4
"""What a frame may have lost by rounding."""


def live_config(
    recording: Recording,
    elsewhere: tuple[int, ...] = (),
    port: int = 0,
    replay_from: int | None = None,
) -> LiveConfig:
    """What the live process of this run would have got."""
    nodes = recording.deployment.nodes
    return LiveConfig(
        run=recording.configuration,
        port=port,
        forward_widths=tuple(node.forward_received for node in nodes),
        backward_widths=tuple(node.backward_received for node in nodes),
        tip=TipConfig(recording.references.nodes[-1].to_plain(), nodes[-1].bend_m),
        goals=(GoalConfig(0, ((0.0, 0.0), (1.0, 0.0))),),
        elsewhere=elsewhere,
        period_s=recording.tick_s,
        replay_from=replay_from,
        links=LinkConfig((), (), None, deadline_s=5.0, epoch_ns=0, cpu=None, fifo=None),
    )


def telemetry(recording: Recording) -> dict[int, dict[int, Array]]:
    """Rows by sender and tick as they were sent, put together from the file's columns."""
    n = recording.nodes
    nodes = recording.deployment.nodes
    layout = {
        i: node_channels(i, n, nodes[i].forward_received, nodes[i].backward_received)
        for i in range(n)
    } | {PLANT: plant_channels(n)}
    out: dict[int, dict[int, Array]] = {}
    for sender, channels in layout.items():
        tables = [(recording.table(channel.topic), channel.fields) for channel in channels]
        columns = [table.numbers(field) for table, fields in tables for field in fields]
        rows = np.stack(columns, axis=1)
        out[sender] = dict(zip(tables[0][0].ticks.tolist(), rows, strict=True))
    return out


def instants(recording: Recording, node: int, field: str) -> Array:
    """An instant of a node at every tick in ns, NaN in late ones."""
    topic = f"/node/{label(node, recording.nodes)}/timing"
    return recording.table(topic).by_tick((f"{field}_wall_ns",), recording.ticks)[:, 0]


def latency(recording: Recording, sender: int, receiver: int) -> Array:
    """Of one link at every tick, ns: the receiver has the sum, less the sender has what it needs for it."""
    way = "forward" if receiver > sender else "backward"
    ready = instants(recording, sender, "measurement_received")
    if 0 < sender < recording.nodes - 1:
        ready = np.maximum(ready, instants(recording, sender, f"{way}_received"))
    return np.asarray(instants(recording, receiver, f"{way}_received") - ready)


def tip_end(recording: Recording, tick: int) -> tuple[float, float]:
    """The estimated arm's tip: the last chord of the reference, turned and stretched, put to the sum's end."""
    n = recording.nodes
    topic = f"/node/{label(n - 1, n)}/forward_sum"
    turn, x, y = recording.table(topic).by_tick(("turn_rad", "x_m", "y_m"), recording.ticks)[tick]
    wanted = recording.references.nodes[-1].at(tick)
    estimate = recording.estimates[tick, -1]
    turn += (estimate[3] - wanted[3]) * recording.deployment.nodes[-1].bend_m
    chord = complex(wanted[5], wanted[6]) * (1 + estimate[2]) / (1 + wanted[2])
    end = complex(x, y) + chord * complex(math.cos(turn), math.sin(turn))
    return end.real, end.imag


def check_frame(frame: dict[str, Any], recording: Recording) -> None:
    """Everything in a frame that belongs to its tick."""
    k, n = frame["tick"], recording.nodes
    assert frame["estimate_tick"] == k
    assert not frame["late"]
    assert frame["time_s"] == pytest.approx(k * recording.tick_s, rel=1e-5)
    assert frame["tip"] == pytest.approx(recording.tips_m[k].tolist(), abs=METRES, rel=0.0)
    assert frame["shape"] == pytest.approx(
        recording.shapes_m[k].ravel().tolist(), abs=METRES, rel=0.0
    )
    wanted = recording.of_plant("tip", ("reference_x_m", "reference_y_m"))[k]
    assert frame["reference"] == pytest.approx(wanted.tolist(), abs=METRES, rel=0.0)
    assert frame["tip_error_m"] == pytest.approx(recording.tip_error_m[k], rel=1e-5)
    assert frame["curvature"] == pytest.approx(
        recording.truth[k, :, 3].tolist(), abs=CURVATURES, rel=0.0
    )
    assert frame["curvature_estimate"] == pytest.approx(
        recording.estimates[k, :, 3].tolist(), abs=CURVATURES, rel=0.0
    )
    assert frame["setpoint"] == recording.setpoints_used[k]
    joints = np.asarray(frame["joints"]).reshape(n + 1, 2)
    assert joints[0].tolist() == [0.0, 0.0]
    for i in range(1, n):
        topic = f"/node/{label(i, n)}/forward_sum"
        end = recording.table(topic).by_tick(("x_m", "y_m"), recording.ticks)[k]
        assert joints[i].tolist() == pytest.approx(end.tolist(), abs=METRES, rel=0.0)
    assert joints[n].tolist() == pytest.approx(tip_end(recording, k), abs=METRES, rel=0.0)
    faces = np.asarray(recording.configuration.faces_m)
    places = np.linspace(0.0, faces[-1], recording.shapes_m.shape[1])
    true = CubicSpline(places, recording.shapes_m[k])(faces[1:])
    apart = float(np.sqrt(np.mean(np.sum((joints[1:] - true) ** 2, axis=1))))
    # joints are rounded in the frame; and a spline is another curve than a cubic through four points
    assert frame["estimation_error_m"] == pytest.approx(apart, rel=1e-3, abs=1e-5)
    if "estimation_error" in frame:
        squares = (recording.estimates[[k, 0]] - recording.truth[[k, 0]]) ** 2
        now, first = (recording.energy_weights * squares).sum(axis=(1, 2))
        assert frame["estimation_error"] == pytest.approx(math.sqrt(now / first), rel=1e-5)
