"""The rows of the summary's table that say what was degraded; none of a run in which all was well.

Beside `analysis.render`, which puts them among the others: the facts of `analysis.degraded` in words.
"""

from __future__ import annotations

from typing import Any

_WORDS = {"alive": "not alive", "on_time": "not on time", "valid": "not valid"}


def degraded_rows(s: dict[str, Any]) -> list[tuple[str, str, str]]:
    """(figure, value, meaning) of a summary."""
    facts = s["degraded"]
    return [
        *_health(facts["health"]),
        *_replaced(facts["replacements"]),
        *_bridged(facts["bridged"]),
        *_passive(facts["passive"]),
    ]


def _health(health: dict[str, Any] | None) -> list[tuple[str, str, str]]:
    if health is None or not any(health[kind]["not"] for kind in _WORDS):
        return []
    counts = " / ".join(str(health[kind]["node_ticks"]) for kind in _WORDS)
    lacks = [
        f"{words} {_who(health[kind]['not'])}"
        for kind, words in _WORDS.items()
        if health[kind]["not"]
    ]
    return [
        (
            "alive / on time / valid",
            f"{counts} of {health['node_ticks']}",
            f"node ticks, as the plant saw them; {'; '.join(lacks)}",
        )
    ]


def _who(lacks: dict[str, int]) -> str:
    if len(lacks) > 4:
        return f"{len(lacks)} nodes (at most {max(lacks.values())})"
    return ", ".join(f"node {node} ({count})" for node, count in lacks.items())


def _replaced(replacements: list[dict[str, Any]]) -> list[tuple[str, str, str]]:
    if not replacements:
        return []
    shown = ", ".join(f"node {one['node']} ({one['seconds']:.2g} s)" for one in replacements[:4])
    more = f" and {len(replacements) - 4} more" if len(replacements) > 4 else ""
    first = replacements[0]
    back = "the end" if first["back_tick"] is None else f"tick {first['back_tick']}"
    return [
        (
            "replaced",
            f"{shown}{more}",
            f"wall clock without it; out from tick {first['out_from_tick']} to {back}, the new process's first "
            f"tick is {first['joined_tick']}",
        )
    ]


def _bridged(bridged: dict[str, int]) -> list[tuple[str, str, str]]:
    sums = bridged["forward_sums"] + bridged["backward_sums"]
    held = bridged["commands_held"]
    if not sums and not held:
        return []
    return [
        (
            "bridged sums",
            f"{sums} in {bridged['ticks']} ticks",
            f"the last sum, faded, stood for one that did not come; commands held because their tick was given "
            f"up: {held}",
        )
    ]


def _passive(passive: dict[str, Any] | None) -> list[tuple[str, str, str]]:
    if passive is None:
        return []
    way = "fell" if passive["fall_j"] >= 0.0 else "ROSE"
    rise = (
        "it never rose"
        if passive["largest_rise_j"] == 0.0
        else f"largest rise in a tick {passive['largest_rise_j']:.2g} J"
    )
    moved = ", under the disturbance" if passive["disturbed"] else ""
    return [
        (
            f"passive from tick {passive['from_tick']}",
            f"energy {way} by {abs(passive['fall_j']):.3g} J",
            f"in {passive['ticks']} ticks under static loads, {passive['energy_first_j']:.6g} to "
            f"{passive['energy_last_j']:.6g} J with the potential of the loads, which is zero for the straight "
            f"arm; {rise}{moved}",
        )
    ]
