"""What a file must have to be read as a recording of a run, and why it is refused if it has not.

For whoever reads one: `analysis.recording`, which takes all of it, and `analysis.survey`, which only looks.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from analysis.table import Table
from wire.artefact import FORMAT as GAINS_FORMAT
from wire.artefact import GainsArtefact, parse_artefact
from wire.channels import METADATA, READABLE, label
from wire.errors import UsageError
from wire.run_config import RunConfig


def check_version(path: Path, facts: Mapping[str, str]) -> None:
    """UsageError unless the metadata of octarm say a format version that is read."""
    version = facts.get("format_version", "")
    if version not in map(str, READABLE):
        raise UsageError(
            f"recording {path}: expected format version {_one_of(READABLE)}, got "
            f"{version or 'none'}; read it with the octarm that wrote it, or a newer one"
        )


def _one_of(versions: Sequence[int]) -> str:
    *others, last = map(str, versions)
    return f"{', '.join(others)} or {last}"


def not_ours(path: Path, stops: str | None, topics: Iterable[str]) -> str:
    """Why an MCAP file without the metadata of octarm is refused; `stops` says how it stops, if it does."""
    if stops is not None:
        return f"recording {path}: it {stops}, before anything of octarm; the run did not begin"
    return (
        f"recording {path}: an MCAP file without {METADATA!r} metadata, so not of octarm (its topics: "
        f"{', '.join(sorted(topics)[:5]) or 'none'}); give the .mcap file that a run left behind"
    )


def attached_artefact(attachments: Mapping[str, bytes], path: Path) -> GainsArtefact:
    """The attached gains artefact, checked as any artefact file is."""
    for name, data in attachments.items():
        if f'"{GAINS_FORMAT}"'.encode() not in data[:200]:
            continue
        return parse_artefact(data, f"{name} attached to recording {path}")
    attached = ", ".join(attachments) or "nothing"
    raise UsageError(
        f"recording {path}: expected the gains artefact attached, found {attached}; "
        "it was cut short before the run began, or edited"
    )


def check_setpoints(path: Path, run: RunConfig, artefact: GainsArtefact) -> None:
    """UsageError unless the run has the setpoints of its gains, which it means by their places."""
    there = tuple(one.name for one in artefact.setpoints)
    if run.setpoint_names != there:
        raise UsageError(
            f"recording {path}: the run has the setpoints {', '.join(map(repr, run.setpoint_names))}, its "
            f"gains {', '.join(map(repr, there))}; it was edited"
        )


def needed_topics(nodes: int) -> list[str]:
    """The channels that a tick must have reached to count as one of the recording."""
    names = [label(i, nodes) for i in range(nodes)]
    kinds = ("measurement", "estimate", "command")
    own = [f"/node/{name}/{kind}" for name in names for kind in kinds]
    return [*own, *(f"/plant/truth/{name}" for name in names)]


def common_ticks(tables: Mapping[str, Table], nodes: int) -> int:
    """Ticks from 0 on that the plant and every node have reached in this file."""
    last = []
    for topic in needed_topics(nodes):
        table = tables.get(topic)
        last.append(-1 if table is None or not table.rows else int(table.ticks.max()))
    return min(last) + 1
