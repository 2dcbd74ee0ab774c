"""The summary of a run as a table for a person: figure, value with unit, what it means.

Takes the dictionary of `analysis.summary`, gives text; nothing is computed here but units.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from analysis.folded_table import WIDTH, folded
from analysis.refused import peers_line
from analysis.render_degraded import degraded_rows

LEG = (
    "leg",
    "hold",
    "tip error, end",
    "in the hold",
    "in the move",
    "below 1 cm after",
    "shape estimate, end",
    "gains",
)
SWITCH = ("gains", "tick", "tip at", "jump of the commands", "step that was made", "tick before")


def render(summary: dict[str, Any], width: int = WIDTH) -> str:
    """The summary of `analysis.summary.summarise` as text of the given width, without colours."""
    lines = _table(("figure", "value", "meaning"), rows(summary), width)
    if len(summary["legs"]) > 1:
        lines += ["", *_table(LEG, leg_rows(summary), width)]
    if summary["switches"]:
        lines += ["", *_table(SWITCH, switch_rows(summary), width)]
    state = "complete" if summary["recording_complete"] else f"not complete: {_stops(summary)}"
    return "\n".join([*lines, "", f"recording {summary['recording']} ({state})", ""])


def _table(head: Sequence[str], body: Sequence[Sequence[str]], width: int) -> list[str]:
    return folded([(name, "left") for name in head], body, width)


def report(summary: dict[str, Any]) -> str:
    """What `octarm run` prints at its end: the table, the wall clock, the plot; "" if nothing was recorded."""
    if "ticks" not in summary:
        return ""
    lines = [
        render(summary),
        f"{summary['ticks_per_s']:.0f} ticks/s, {summary['run_s']:.1f} s wall clock",
    ]
    if summary["plot"]:
        lines.append(f"plot {summary['plot']}")
    return "\n".join(lines) + "\n"


def rows(s: dict[str, Any]) -> list[tuple[str, str, str]]:
    """The rows of the table: (figure, value, meaning)."""
    seconds = s["ticks"] * s["tick_s"]
    short = "" if s["ticks"] == s["ticks_asked_for"] else f" of {s['ticks_asked_for']}"
    sweep = s["sweep_ms"]
    out = [
        (
            "run",
            f"{s['nodes']} nodes, {s['ticks']}{short} ticks of {s['tick_s']:g} s",
            f"{seconds:g} s of the arm's time; {_story(s)}, seed {s['seed']}"
            + ("" if s["ended"] == "finished" else f"; ended: {s['ended'] or 'unknown'}"),
        ),
        (
            "neighbour messages",
            _traffic(s),
            _expected(s),
        ),
        ("message size", _number(s["bytes_per_message"], "B", 4), "mean, on the wire"),
        (
            "sweep",
            f"p50 {_number(sweep['p50'], 'ms')}, p99 {_number(sweep['p99'], 'ms')}",
            "wall clock, first measurement sent to last command back",
        ),
        *_pace(s),
        *degraded_rows(s),
        (
            "difference to central",
            _number(s["max_difference_to_central"], "", 2),
            f"relative; the same gains centrally; worst at {_where(s)}{_compared(s)}",
        ),
        *_estimation(s),
        _tip(s),
        (
            "command",
            f"rms {_number(s['command_n_per_m']['rms'], 'mN/m', scale=1e3)}, "
            f"peak {_number(s['command_n_per_m']['peak'], 'mN/m', scale=1e3)}",
            f"{s['actuator']} load per length over arm and time",
        ),
    ]
    out += [_gamma(s, role) for role in ("observer", "controller")]
    out += [
        (
            "rejected messages",
            _count(s["rejected_messages"]),
            f"{_reasons(s)}; ticks lost by the recorder: {_count(s['ticks_lost'])}",
        ),
        *_refused(s),
        ("start-up", _number(s["start_up_s"], "s", 2), "wall clock, plan to first measurement"),
        ("gains", s["artefact_sha256"][:16], "SHA-256 of the artefact, first 16 digits"),
    ]
    return out


def _reasons(s: dict[str, Any]) -> str:
    reasons = s["rejected_by_reason"]
    if not reasons:
        return "malformed, stale or foreign"
    return ", ".join(f"{reason} {count}" for reason, count in reasons.items())


def _refused(s: dict[str, Any]) -> list[tuple[str, str, str]]:
    """Peers that were not let in, if any came."""
    peers = s["refused_peers"]
    total = sum(one["count"] for one in peers)
    return [("refused peers", str(total), peers_line(peers))] if peers else []


def _estimation(s: dict[str, Any]) -> list[tuple[str, str, str]]:
    """How well the arm was known: relative to the start's error where the run starts with one."""
    if s["initial"] == "setpoint":
        energy, shape = s["estimation_rms_root_joule"], s["shape_estimation_rms_m"]
        largest = s["shape_estimation_largest_m"]
        return [
            (
                "estimation error",
                f"rms {_number(energy['observer'], 'J^1/2')}",
                f"energy norm; open-loop model {_number(energy['open_loop_model'], 'J^1/2')}"
                f"{_assumed(s)}",
            ),
            (
                "shape estimation error",
                f"rms {_number(shape['observer'], 'mm', scale=1e3)}, "
                f"largest {_number(largest['observer'], 'mm', scale=1e3)}",
                "rms distance of estimated from true arm; open-loop model "
                f"{_number(shape['open_loop_model'], 'mm', scale=1e3)}, "
                f"{_number(largest['open_loop_model'], 'mm', scale=1e3)}",
            ),
        ]
    linear = s["linear_model_below_1_percent_s"]
    return [
        (
            "estimation error",
            _course(s["estimation_error"], "%", 100.0),
            f"energy norm; open-loop model {_course(s['open_loop_model_error'], '%', 100.0)}"
            f"{_assumed(s)}",
        ),
        _below_1_percent(s, "estimation"),
        (
            "shape estimation error",
            f"{_course(s['shape_estimation_error'], '%', 100.0)} "
            f"({_number(s['shape_estimation_error_m']['final'], 'mm', scale=1e3)})",
            "rms distance of estimated from true arm; open-loop model "
            f"{_course(s['open_loop_model_shape_error'], '%', 100.0)}",
        ),
        _below_1_percent(s, "shape"),
        (
            "  on the linear model",
            _time(linear["observer"], none="not within an hour"),
            "below 1 %, energy norm, without noise and disturbance; open-loop model "
            f"{_time(linear['open_loop_model'], none='not within an hour')}",
        ),
    ]


def _tip(s: dict[str, Any]) -> tuple[str, str, str]:
    if len(s["legs"]) > 1 or s["initial"] == "setpoint":
        rms, largest = (_number(s[f"tip_error_{k}_m"], "mm", scale=1e3) for k in ("rms", "largest"))
        return "tip error", f"rms {rms}, largest {largest}", "distance from the reference's"
    return (
        "tip error",
        _course(s["tip_error_m"], "mm", 1e3),
        f"distance from the setpoint's; under 5 % of the first: {_time(s['tip_settling_s'])}",
    )


def _gamma(s: dict[str, Any], role: str) -> tuple[str, str, str]:
    several = s["gamma_of_setpoints"]
    if len(several) == 1:
        (one,) = several.values()
        value = f"{one[role]['achieved']:.4g} achieved, {one[role]['certified']:.4g} certified"
        return f"gamma, {role}", value, "H-infinity norm of the design, and its proven bound"
    achieved, certified = (
        ", ".join(f"{one[role][kind]:.4f}" for one in several.values())
        for kind in ("achieved", "certified")
    )
    return f"gamma, {role}", achieved, f"at setpoints {', '.join(several)}; proven: {certified}"


def leg_rows(s: dict[str, Any]) -> list[tuple[str, ...]]:
    """The rows of the table of legs, columns `LEG`."""
    return [
        (
            leg["way"],
            _hold(leg),
            _number(leg["tip_error_end_m"], "mm", scale=1e3),
            _number(leg["tip_error_largest_in_hold_m"], "mm", scale=1e3, none="-"),
            _number(leg["tip_error_largest_in_move_m"], "mm", scale=1e3, none="-"),
            _time(leg["tip_below_1_cm_after_s"], none="not in the hold" if held(leg) else "-"),
            _number(leg["shape_estimation_error_end_m"], "mm", scale=1e3),
            leg["gains_at_end"] or "unknown",
        )
        for leg in s["legs"]
    ]


def held(leg: dict[str, Any]) -> bool:
    """Whether the run got to a hold of this leg."""
    return bool(leg["hold_from_s"] < leg["until_s"])


def _hold(leg: dict[str, Any]) -> str:
    if held(leg):
        return f"{leg['hold_from_s']:g} to {leg['until_s']:g} s"
    return "none" if leg["until_s"] == leg["hold_from_s"] else "not reached"


def switch_rows(s: dict[str, Any]) -> list[tuple[str, ...]]:
    """The rows of the table of changes of gains, columns `SWITCH`."""
    return [
        (
            f"{one['from']} -> {one['to']}",
            f"{one['tick']} ({one['time_s']:g} s)",
            f"{one['tip_angle_deg']:.1f} degrees",
            f"{_number(one['command_jump_n_per_m'], 'mN/m', scale=1e3)}, faded out",
            _number(one["command_step_n_per_m"], "mN/m", scale=1e3),
            _number(one["command_step_before_n_per_m"], "mN/m", scale=1e3),
        )
        for one in s["switches"]
    ]


def _below_1_percent(s: dict[str, Any], norm: str) -> tuple[str, str, str]:
    """The row that says when the error in the norm of the row above stays below 1 %."""
    reached, later = s[f"{norm}_below_1_percent_s"], s[f"{norm}_below_1_percent_extrapolated_s"]
    return (
        "  below 1 % after",
        _time(reached["observer"]),
        f"open-loop model {_time(reached['open_loop_model'], later['open_loop_model'])}",
    )


def _traffic(s: dict[str, Any]) -> str:
    if s["neighbour_messages"] is None:
        return "unknown"
    return f"{s['neighbour_messages']}, {_count(s['neighbour_messages_per_tick'])} a tick"


def _expected(s: dict[str, Any]) -> str:
    """What there should be between neighbours, and whether the links are sound."""
    letter = "n" if s["node_processes"] == s["nodes"] else "p"
    text = f"counted by receivers; 2 ({letter} - 1) = {s['neighbour_messages_expected_per_tick']} expected"
    if letter == "p":
        text += f" of p = {s['node_processes']} processes"
        text += f"; in memory: {_count(s['passed_messages_per_tick'])} a tick"
    text += f"; links intact: {_count(s['intact_links'])}"
    if s["replaced_links"]:
        text += f", {s['replaced_links']} more ended at a replaced process; what the dead one counted is lost"
    return text


def _pace(s: dict[str, Any]) -> list[tuple[str, str, str]]:
    """How well a run in real time kept its pace."""
    pace = s["realtime"]
    if pace is None:
        return []
    held = f"longest hold {pace['longest_hold_ticks']}, {pace['hold_ticks']} may be"
    period = _number(1e3 * pace["period_s"], "ms", 4)
    value = f"period {period}, {pace['late_ticks']} late"
    return [("real time", value, f"ticks whose sweep before was not over, commands held; {held}")]


def _compared(s: dict[str, Any]) -> str:
    """How far the comparison with the central run goes, if not to the end."""
    facts = s["difference_to_central"]
    tick = facts["degraded_from_tick"]
    if tick is not None:
        return f"; compared up to tick {tick}: from there sums were bridged"
    if facts["ticks_compared"] < s["ticks"]:
        return f"; compared up to tick {facts['ticks_compared'] - 1}, of which measurements are missing"
    return ""


def _assumed(s: dict[str, Any]) -> str:
    count = s["open_loop_commands_assumed"]
    return f" ({count} commands were not recorded, the last ones stand for them)" if count else ""


def _stops(s: dict[str, Any]) -> str:
    return s["recording_stops"] or "it has no final counters"


def _story(s: dict[str, Any]) -> str:
    parts = [] if s["scenario"] == "hold" else [f"scenario {s['scenario']}"]
    parts += [] if len(s["legs"]) > 1 else [f"setpoint {s['setpoint']}"]
    parts += [] if s["control"] else ["no feedback"]
    parts += [] if s["plant_model"] == "exact" else [f"plant model {s['plant_model']}"]
    return ", ".join(parts)


def _where(s: dict[str, Any]) -> str:
    d = s["difference_to_central"]
    return f"tick {d['tick']}, node {d['node']}"


def _count(value: float | None) -> str:
    return "unknown" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


def _number(
    value: float | None, unit: str, digits: int = 3, scale: float = 1.0, none: str = "unknown"
) -> str:
    if value is None:
        return none
    return f"{value * scale:.{digits}g} {unit}".rstrip()


def _course(ends: dict[str, float | None], unit: str, scale: float) -> str:
    first, last = ends["initial"], ends["final"]
    if first is None or last is None:
        return "no initial error" if unit == "%" else "unknown"
    return f"{first * scale:.3g} -> {last * scale:.3g} {unit}"


def _time(
    value: float | None, extrapolated: float | None = None, none: str = "not within the run"
) -> str:
    if value is not None:
        return f"{value:.3g} s"
    if extrapolated is not None:
        return f"{none} (extrapolated: {extrapolated:.3g} s)"
    return none
