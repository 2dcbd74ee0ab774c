"""A closed, indexed recording out of one that was cut short or damaged: `octarm recover`.

Copies what `analysis.mcap_walk` finds, with `analysis.mcap_copy`, and says in a metadata record what was kept.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from mcap.records import Metadata

from analysis.mcap_copy import McapCopy
from analysis.mcap_records import read_bytes
from analysis.mcap_walk import DATA_DOUBT, Damage, Walk
from analysis.survey import LIBRARY, RECOVERED, Survey, configuration_of, survey_of, ticks_of
from analysis.whole_file import check_free, whole
from wire.channels import SUMMARY
from wire.errors import UsageError

SUFFIX = ".recovered.mcap"


def recover(path: Path, out: Path | None = None, *, force: bool = False) -> dict[str, Any]:
    """Copy every whole record of a recording into a new file that is closed properly; facts for --json.

    `out` None is NAME.recovered.mcap beside the recording. A recording that was closed properly is left alone
    (`recovered` is then None). Damaged chunks, and messages of channels that were never announced, are left
    out, what follows is kept; where the framing is broken the copy stops. Raises UsageError as
    `analysis.survey.survey` does, or if `out` exists (without `force`), is the recording or cannot be written.
    """
    out = path.with_name(path.stem + SUFFIX) if out is None else out
    raw = read_bytes(path)
    found = survey_of(path, raw)
    if found.closed:
        return _facts(found, None, None)
    if out.exists() and out.samefile(path):
        raise UsageError(f"--out {out}: that is the recording itself; give another name")
    check_free(out, force=force)
    with whole(out, force=force) as growing, growing.open("wb") as stream:
        copy = McapCopy(stream, LIBRARY)
        _copy(memoryview(raw), copy, found)
    return _facts(found, out, copy)


def recover_text(facts: Mapping[str, Any]) -> str:
    """The facts of `recover` as a few lines."""
    if facts["recovered"] is None:
        count = facts["kept"]["messages"]
        return f"{facts['recording']}: closed properly, {count} messages; nothing to recover"
    kept, left_out = facts["kept"], facts["left_out"]
    last = "none" if facts["last_tick"] is None else facts["last_tick"]
    lost = "unknown" if left_out["messages"] is None else left_out["messages"]
    without = "nothing"
    if left_out["bytes"] or lost:
        without = (
            f"{left_out['records']} records, {left_out['bytes']} of {facts['bytes']} bytes; "
            f"messages lost: {lost}"
        )
    end = "" if facts["has_summary"] else ", without the run's final counters"
    return "\n".join(
        [
            f"{facts['recording']}: it {facts['stops']}",
            f"kept: {kept['messages']} messages in {kept['chunks']} chunks, {kept['attachments']} attachments, "
            f"{kept['metadata']} metadata records; last whole tick {last}",
            f"left out: {without}",
            f"{facts['recovered']}: {facts['recovered_bytes']} bytes, closed properly{end}",
        ]
    )


def _copy(data: memoryview, copy: McapCopy, found: Survey) -> None:
    """Write all that is good, and the metadata record about it."""
    for piece in Walk(data):
        if not isinstance(piece, Damage):
            copy.add(piece, data[piece.offset : piece.offset + piece.size])
    lost = found.lost_messages
    said = {
        "from": found.path.name,
        "from_bytes": found.bytes,
        "stops": found.stops,
        "stopped_at": found.stopped_at,
        "kept_messages": copy.messages,
        "kept_chunks": copy.chunks,
        "kept_bytes": found.bytes - found.lost_bytes,
        "left_out_messages": "unknown" if lost is None else lost,
        "left_out_records": _records(found),
        "left_out_bytes": found.lost_bytes,
        "doubt": DATA_DOUBT if DATA_DOUBT in found.doubts else "",
        "octarm": _version(),
    }
    copy.add_metadata(Metadata(name=RECOVERED, metadata={k: str(v) for k, v in said.items()}))
    copy.finish()


def _facts(found: Survey, out: Path | None, copy: McapCopy | None) -> dict[str, Any]:
    run = configuration_of(found, [])
    ticks = 0 if run is None else ticks_of(found, run)
    return {
        "recording": str(found.path),
        "bytes": found.bytes,
        "stops": found.stops,
        "stopped_at": found.stopped_at if found.unfinished else None,
        "recovered": None if out is None else str(out),
        "recovered_bytes": None if out is None else out.stat().st_size,
        "kept": {
            "messages": found.messages,
            "chunks": found.chunks if copy is None else copy.chunks,
            "attachments": len(found.attachments),
            "metadata": found.metadata_records,
            "bytes": found.bytes - found.lost_bytes,
        },
        "left_out": {
            "messages": found.lost_messages,
            "records": _records(found),
            "bytes": found.lost_bytes,
        },
        "last_tick": ticks - 1 if ticks else None,
        "has_summary": SUMMARY in found.metadata,
    }


def _records(found: Survey) -> int:
    """Records that cannot be read; of the bytes after broken framing nobody knows how many they were."""
    return sum(one.size > 0 for one in found.damages)


def _version() -> str:
    try:
        return version("octarm")
    except PackageNotFoundError:
        return "unknown"
