"""`octarm diff`: two recordings side by side, and the verdict whether they are the same run.

Last step of the comparison: `analysis.compare` has the channels, `analysis.compare_facts` the configuration,
`analysis.summary` the figures; `analysis.diff_table` makes text of what is returned here.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from analysis.compare import Comparison, compare, short
from analysis.compare_facts import FactDifference, about_differences, configuration_differences
from analysis.compare_figures import figures
from analysis.compare_values import FieldComparison, KindComparison, Place
from analysis.recording import Recording, find_recording, read_recording
from wire.errors import UsageError

SAME = "same"
WITHIN = "same within the tolerance"
CUT = "same as far as both go"
DIFFERENT = "different"
_LENGTH = "ticks"
"""The part of the configuration that only says how long a run was to be."""


def diff(
    path_a: Path,
    path_b: Path,
    tolerance: float | None,
    progress: Callable[[str], None] = lambda _: None,
) -> dict[str, Any]:
    """Compare two recordings (or the runs' directories that hold them); facts for --json.

    `same` is True if every value of every channel but wall-clock ones, the order of the messages, the
    configuration and the gains agree: bit for bit, or with `tolerance` up to that share of a field's largest
    magnitude. Raises UsageError if a recording cannot be read or the tolerance is not 0 to 1.
    """
    if tolerance is not None and not 0.0 <= tolerance < 1.0:
        raise UsageError(
            f"--tolerance: expected a share from 0 up to 1, as 1e-9, got {tolerance:g}"
        )
    path_a, path_b = find_recording(path_a), find_recording(path_b)
    progress(f"reading {path_a}")
    one = read_recording(path_a)
    progress(f"reading {path_b}")
    other = read_recording(path_b)
    configuration = configuration_differences(one, other, tolerance or 0.0)
    found = compare(one, other, tolerance or 0.0)
    verdict = _verdict(one, other, found, configuration)
    progress("figures")
    return {
        "verdict": verdict,
        "same": verdict in (SAME, WITHIN),
        "sentence": _sentence(verdict, (one, other), found, configuration, tolerance),
        "tolerance": tolerance,
        "a": _about(one, found.ends[0]),
        "b": _about(other, found.ends[1]),
        "configuration": [_fact(fact) for fact in configuration],
        "about": [_fact(fact) for fact in about_differences(one, other)],
        "first": _place(found.first),
        "values_compared": sum(kind.compared for kind in found.kinds),
        "values_different": sum(kind.different for kind in found.kinds),
        "values_within_tolerance": found.within,
        "channels": [_kind(kind) for kind in found.kinds],
        "channels_only_in_a": list(found.missing_b),
        "channels_only_in_b": list(found.missing_a),
        "channels_not_compared": list(found.left_out),
        "order": None if found.order is None else dataclasses.asdict(found.order),
        "figures": figures(one, other, progress),
    }


def _verdict(
    one: Recording, other: Recording, found: Comparison, configuration: Sequence[FactDifference]
) -> str:
    lengths_differ = found.ends[0] != found.ends[1]
    counting = [f for f in configuration if f.counts and not (lengths_differ and f.key == _LENGTH)]
    if counting or not found.same:
        return DIFFERENT
    if lengths_differ or one.unfinished is not None or other.unfinished is not None:
        return CUT
    return WITHIN if found.within or any(f.within for f in configuration) else SAME


def _sentence(
    verdict: str,
    recordings: tuple[Recording, Recording],
    found: Comparison,
    configuration: Sequence[FactDifference],
    tolerance: float | None,
) -> str:
    """The verdict and its reason, for a person."""
    values = sum(kind.compared for kind in found.kinds)
    within = f" within {tolerance:g}" if found.within else ", bit for bit"
    if verdict in (SAME, WITHIN):
        within = f" within {tolerance:g}" if verdict == WITHIN else within
        return f"the same{within}: {values} values, up to tick {found.ends[0]}"
    if verdict == CUT:
        return f"the same{within}, {_until(recordings, found)}"
    reasons = []
    if found.first is not None:
        reasons.append(f"the first different value: {place_text(found.first)}")
    lacks = [kind.first_lacking for kind in found.kinds if kind.first_lacking is not None]
    if lacks and (found.first is None or min(lacks)[0] < found.first.tick):
        tick, topic, side = min(lacks)
        reasons.append(f"{side.upper()} has no message of {topic} at tick {tick}")
    for name, topics in (("A", found.missing_b), ("B", found.missing_a)):
        if topics:
            more = f" and {len(topics) - 1} more channels" if len(topics) > 1 else ""
            reasons.append(f"only {name} has {topics[0]}{more}")
    if any(kind.fields_only_a or kind.fields_only_b for kind in found.kinds):
        reasons.append("some channels have other fields")
    if found.left_out:
        reasons.append("the segments end at other places, so that nodes are not compared")
    if found.order is not None:
        reasons.append(
            f"after {found.order.after} messages the order is another: {found.order.topic_a} tick "
            f"{found.order.tick_a} in A, {found.order.topic_b} tick {found.order.tick_b} in B"
        )
    counting = [fact for fact in configuration if fact.counts]
    if not reasons and counting:
        a, b = short(counting[0].a), short(counting[0].b)
        reasons.append(
            f"all {values} values are the same{within}, the configuration is not: "
            f"{counting[0].key}: {a} | {b}"
        )
    if found.ends[0] != found.ends[1] or any(one.unfinished for one in recordings):
        reasons.append(f"compared {_until(recordings, found)}")
    return f"different; {'; '.join(reasons)}"


def _until(recordings: tuple[Recording, Recording], found: Comparison) -> str:
    """Up to where, and which of the two ends there and how."""
    times = [end * one.tick_s for one, end in zip(recordings, found.ends, strict=True)]
    first = int(times[1] < times[0])
    both = math.isclose(times[0], times[1])
    who = "both end" if both else f"{'AB'[first]} ends"
    text = f"up to tick {found.ends[first]}, where {who}"
    stops = [
        f"{'AB'[i]}: {one.unfinished}"
        for i, one in enumerate(recordings)
        if one.unfinished is not None
    ]
    return f"{text} ({'; '.join(stops)})" if stops else text


def place_text(place: Place) -> str:
    """Tick, node, field and both values with all their digits."""
    node = "" if place.node is None else f", node {place.node}"
    return (
        f"tick {place.tick} ({place.time_s:g} s){node}, {place.topic} {place.field}: "
        f"{short(place.a)} | {short(place.b)}"
    )


def _about(recording: Recording, end: int) -> dict[str, Any]:
    facts = recording.facts
    return {
        "recording": str(recording.path),
        "run_id": recording.configuration.run_id,
        "format_version": int(facts["format_version"]),
        "nodes": recording.nodes,
        "tick_s": recording.tick_s,
        "seed": recording.configuration.seed,
        "last_tick": end,
        "artefact_sha256": recording.configuration.artefact_sha256,
        "ended": recording.ending(),
        "complete": recording.complete,
        "stops": recording.unfinished,
    }


def _fact(fact: FactDifference) -> dict[str, Any]:
    return dataclasses.asdict(fact)


def _place(place: Place | None) -> dict[str, Any] | None:
    if place is None:
        return None
    facts = dataclasses.asdict(place)
    del facts["rank"]
    return facts


def _kind(kind: KindComparison) -> dict[str, Any]:
    lacking = kind.first_lacking
    return {
        "kind": kind.kind,
        "same": kind.same,
        "messages": kind.messages,
        "values": kind.compared,
        "different": kind.different,
        "within_tolerance": kind.within,
        "first": _place(kind.first),
        "largest": _place(kind.largest),
        "messages_missing_in_a": kind.lacking_a,
        "messages_missing_in_b": kind.lacking_b,
        "first_missing": lacking
        and {"tick": lacking[0], "topic": lacking[1], "missing_in": lacking[2]},
        "fields_only_in_a": list(kind.fields_only_a),
        "fields_only_in_b": list(kind.fields_only_b),
        "fields": [_field(field) for field in kind.fields],
    }


def _field(field: FieldComparison) -> dict[str, Any]:
    return {
        "field": field.field,
        "unit": field.unit,
        "values": field.compared,
        "different": field.different,
        "within_tolerance": field.within,
        "largest_magnitude": field.magnitude,
        "first": _place(field.first),
        "largest": _place(field.largest),
    }
