"""The figures of a run in one dictionary, as `octarm run --json` prints it.

Last step of the analysis: everything is taken from the recording alone. The keys are stable; a
figure that the recording does not hold (a run cut short has no counters) is null.
`analysis.render` makes a table of it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from analysis.central import CentralComparison, compare_with_central
from analysis.degraded import degraded_facts
from analysis.goals import active_setpoints, visited
from analysis.legs import leg_facts, make_legs, switch_facts
from analysis.linear import LinearDecay, linear_decay
from analysis.metrics import control_effort, time_below
from analysis.open_loop import ErrorCourse, compare_with_open_loop, known_commands
from analysis.recording import Recording, read_recording
from analysis.refused import refused_peers, rejected_by_reason
from analysis.render import render
from wire.artefact import Certificate
from wire.config_json import finite
from wire.errors import UsageError

__all__ = ["render", "summarise", "summary_of"]

SETTLED = 0.05
"""The tip has settled when its error stays below this share of its initial error."""


def summarise(path: Path) -> dict[str, Any]:
    """The figures of the run in a recording; times in s of the simulated arm unless named wall.

    Raises UsageError or GainsRefusedError as `read_recording` does, and UsageError if not one tick
    is complete.
    """
    return summary_of(read_recording(path))


def summary_of(recording: Recording) -> dict[str, Any]:
    """The figures of a recording that is in memory."""
    if recording.ticks == 0:
        stops = recording.unfinished or "was closed properly"
        raise UsageError(
            f"recording {recording.path}: no tick that all nodes and the plant have recorded (it "
            f"{stops}); run again"
        )
    run = recording.configuration
    central = compare_with_central(recording)
    observer, model = compare_with_open_loop(recording)
    has_error = bool(np.isfinite(observer.energy.relative).any())
    linear = linear_decay(recording) if has_error else LinearDecay(None, None)
    durations = recording.sweep_durations_ms[np.isfinite(recording.sweep_durations_ms)]
    tip = recording.tip_error_m
    effort = control_effort(recording.commands, np.asarray(run.faces_m), run.tick_s)
    gammas = {
        setpoint.name: {
            "observer": _gamma(setpoint.observer_certificate),
            "controller": _gamma(setpoint.controller_certificate),
        }
        for setpoint in (recording.artefact.setpoints[index] for index in visited(recording))
    }
    mean_rates = recording.of_plant(
        "regulated", ("mean_velocity_y_m_per_s", "mean_curvature_per_m")
    )
    summary = {
        "run_id": run.run_id,
        "nodes": run.nodes,
        "ticks": recording.ticks,
        "ticks_asked_for": run.ticks,
        "tick_s": run.tick_s,
        "scenario": run.scenario,
        "control": run.control,
        "plant_model": run.plant_model,
        "actuator": recording.artefact.arm.actuator,
        "setpoint": run.setpoint,
        "initial": run.initial,
        "seed": run.seed,
        **_traffic(recording),
        "sweep_ms": _percentiles(durations),
        "realtime": _realtime(recording),
        "degraded": degraded_facts(recording),
        "start_up_s": _start_up(recording),
        "max_difference_to_central": central.worst.relative,
        "difference_to_central": _central(central),
        "estimation_error": _ends(observer.energy.relative),
        "estimation_error_root_joule": _ends(observer.energy.norm),
        "estimation_rms_root_joule": _both(_rms, observer.energy, model.energy),
        "open_loop_model_error": _ends(model.energy.relative),
        "open_loop_commands_assumed": known_commands(recording)[1],
        **_below_1_percent("estimation", observer.energy, model.energy),
        "estimation_decay_per_s": {
            "observer": observer.energy.decay_per_s,
            "open_loop_model": model.energy.decay_per_s,
        },
        "shape_estimation_error": _ends(observer.shape.relative),
        "shape_estimation_error_m": _ends(observer.shape.norm),
        "shape_estimation_rms_m": _both(_rms, observer.shape, model.shape),
        "shape_estimation_largest_m": _both(_largest, observer.shape, model.shape),
        "open_loop_model_shape_error": _ends(model.shape.relative),
        **_below_1_percent("shape", observer.shape, model.shape),
        "linear_model_below_1_percent_s": {
            "observer": linear.observer_s,
            "open_loop_model": linear.open_loop_model_s,
        },
        "tip_error_m": _ends(tip),
        "tip_error_rms_m": _rms(tip),
        "tip_error_largest_m": _largest(tip),
        "tip_settling_s": time_below(recording.times_s, tip, SETTLED * float(tip[0])),
        **_legs(recording, observer.shape.norm),
        "regulated_rms": {
            "mean_velocity_y_m_per_s": _rms(mean_rates[:, 0]),
            "mean_curvature_per_m": _rms(mean_rates[:, 1]),
        },
        "command_n_per_m": {"rms": effort.rms_n_per_m, "peak": effort.peak_n_per_m},
        "control_effort_n2_s_per_m": effort.integral_n2_s_per_m,
        "gamma": gammas[run.setpoint],
        "gamma_of_setpoints": gammas,
        "artefact_sha256": run.artefact_sha256,
        "ended": recording.ending(),
        "recording": str(recording.path),
        "recording_complete": recording.complete,
        "recording_stops": recording.unfinished,
    }
    return {key: finite(value) for key, value in summary.items()}


def _traffic(recording: Recording) -> dict[str, Any]:
    """Message counts of the final counters; null without them."""
    neighbours = recording.counter("neighbour_messages")
    size = recording.counter("neighbour_bytes")
    done = recording.sweeps()
    return {
        "node_processes": len(recording.configuration.firsts),
        "nodes_reporting": recording.counter("nodes_reporting"),
        "neighbour_messages": neighbours,
        "neighbour_messages_sent": recording.counter("neighbour_messages_sent"),
        "neighbour_messages_per_tick": _ratio(neighbours, done),
        "neighbour_messages_expected_per_tick": 2 * (len(recording.configuration.firsts) - 1),
        "passed_messages": recording.counter("passed_messages"),
        "passed_messages_per_tick": _ratio(recording.counter("passed_messages"), done),
        "bytes_per_message": _ratio(size, neighbours),
        "sweep_messages": {
            "forward": recording.total("forward_received_messages"),
            "backward": recording.total("backward_received_messages"),
            "measurement": recording.counter("measurement_messages"),
            "command": recording.counter("command_messages"),
        },
        "intact_links": recording.intact_links(),
        "replaced_links": _replaced_links(recording),
        "rejected_messages": recording.counter("rejected_messages"),
        "rejected_by_reason": rejected_by_reason(recording),
        "refused_peers": refused_peers(recording),
        "ticks_lost": recording.counter("ticks_lost"),
    }


def _replaced_links(recording: Recording) -> int | None:
    """Links with an end that was replaced: their ends have not counted the same messages."""
    links = recording.links()
    return None if links is None else sum(not link.whole for link in links)


def _legs(recording: Recording, shape_error_m: Any) -> dict[str, Any]:
    """What happened leg by leg, and at every change of gains."""
    run = recording.configuration
    active = active_setpoints(recording)
    names = [run.setpoint_names[index] for index in active]
    end_s = recording.ticks * run.tick_s
    times, tip = recording.times_s, recording.tip_error_m
    legs = make_legs(run.setpoint, run.first_hold_s, run.legs, end_s)
    return {
        "legs": [leg_facts(leg, times, tip, shape_error_m, names) for leg in legs],
        "switches": switch_facts(
            active,
            run.setpoint_names,
            run.tick_s,
            recording.tips_m,
            recording.commands,
            recording.bumps,
        ),
    }


def _ratio(count: int | None, by: int | None) -> float | int | None:
    """A quotient, as a whole number where it is one."""
    if count is None or not by:
        return None
    return count // by if count % by == 0 else count / by


def _percentiles(durations: Any) -> dict[str, float | None]:
    names, shares = ("p50", "p95", "p99", "p99.9", "max"), (50.0, 95.0, 99.0, 99.9, 100.0)
    if durations.size == 0:
        return dict.fromkeys(names)
    return dict(zip(names, np.percentile(durations, shares).tolist(), strict=True))


def _realtime(recording: Recording) -> dict[str, Any] | None:
    """How well a run in real time kept its pace; None in lock-step."""
    pace = recording.configuration.pace
    if pace is None:
        return None
    # All of it: late ticks at the end have no row of the nodes, so that `recording.late` ends before them.
    recorded = np.asarray(recording.table("/plant/pace").column("late")) > 0.0
    late = np.concatenate([[False], recorded, [False]])
    edges = np.flatnonzero(np.diff(late.astype(np.int8)))
    return {
        "period_s": pace.period_s,
        "hold_ticks": pace.hold_ticks,
        "late_ticks": int(np.count_nonzero(recorded)),
        "longest_hold_ticks": int(np.max(edges[1::2] - edges[::2], initial=0)),
    }


def _start_up(recording: Recording) -> float:
    """From the plan of the run to the first measurement sent, wall clock, s."""
    first = recording.table("/sweep/timing").by_tick(("started_wall_ns",), 1)[0, 0]
    return float(first) * 1e-9


def _central(central: CentralComparison) -> dict[str, Any]:
    worst = central.worst
    first = central.first_above_tolerance
    return {
        "tick": worst.tick,
        "node": worst.node,
        "quantity": worst.quantity,
        "ticks_compared": central.ticks,
        "degraded_from_tick": central.degraded_from,
        "values_missing": central.missing,
        "by_quantity": central.per_quantity,
        "first_above_1e-12": first and {"tick": first.tick, "node": first.node},
    }


def _below_1_percent(norm: str, observer: ErrorCourse, model: ErrorCourse) -> dict[str, Any]:
    """When the errors are below 1 % in this norm; extrapolated for the model only if it is not."""
    return {
        f"{norm}_below_1_percent_s": {
            "observer": observer.below_1_percent_s,
            "open_loop_model": model.below_1_percent_s,
        },
        f"{norm}_below_1_percent_extrapolated_s": {
            "open_loop_model": model.below_1_percent_extrapolated_s,
        },
    }


def _ends(values: Any) -> dict[str, float | None]:
    return {"initial": float(values[0]), "final": float(values[-1])}


def _largest(values: Any) -> float:
    return float(np.nanmax(values))


def _both(
    figure: Callable[[Any], float], observer: ErrorCourse, model: ErrorCourse
) -> dict[str, float]:
    """One figure of both errors' own values, not relative to the first."""
    return {"observer": figure(observer.norm), "open_loop_model": figure(model.norm)}


def _rms(values: Any) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def _gamma(certificate: Certificate) -> dict[str, float]:
    return {"certified": certificate.certified_gamma, "achieved": certificate.achieved_gamma}
