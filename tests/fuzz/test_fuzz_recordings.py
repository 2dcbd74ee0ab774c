"""Recordings, damaged anywhere: everything that reads one reads what is left of it, or refuses it by name; what
claims to be larger than memory costs neither memory nor time."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

import lz4.frame
import numpy as np
import pytest
import valid
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from mutations import bytes_of, fewer, json_of, outcome

from analysis.export import export
from analysis.info import info
from analysis.info_table import info_table
from analysis.mcap_records import LARGEST_CHUNK
from analysis.mcap_walk import Damage, Walk
from analysis.recording import read_recording
from analysis.recover import recover, recover_text
from analysis.replay_check import check, story_of
from analysis.summary import summarise
from wire.errors import OctarmError, UsageError


@dataclass(frozen=True)
class Parts:
    """A recording taken apart with the mcap package alone."""

    metadata: dict[str, dict[str, str]]
    attachments: dict[str, bytes]
    messages: tuple[tuple[str, int, bytes], ...] = field(repr=False)
    """Topic, log time, payload."""

    def joined(self) -> bytes:
        """A sound MCAP file of these parts, every checksum right."""
        out = BytesIO()
        writer = Writer(out, compression=CompressionType.NONE)
        writer.start(library="octarm")
        for name, facts in self.metadata.items():
            writer.add_metadata(name, facts)
        for name, data in self.attachments.items():
            writer.add_attachment(0, 0, name, "application/json", data)
        numbers: dict[str, int] = {}
        for topic, when, payload in self.messages:
            if topic not in numbers:
                numbers[topic] = writer.register_channel(topic, "json", 0)
            writer.add_message(numbers[topic], when, payload, when)
        writer.finish()
        return out.getvalue()


@cache
def parts() -> Parts:
    reader = make_reader(BytesIO(valid.recording()))
    return Parts(
        {one.name: one.metadata for one in reader.iter_metadata()},
        {one.name: one.data for one in reader.iter_attachments()},
        tuple(
            (channel.topic, message.log_time, message.data)
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ),
    )


def as_it_is(path: Path) -> None:
    read_recording(path)


def replayed(path: Path) -> None:
    check(story_of(read_recording(path)))


def recovered(path: Path) -> None:
    facts = recover(path, path.with_suffix(".out"), force=True)
    recover_text(facts)
    if facts["recovered"]:
        assert info(Path(facts["recovered"]))["file"]["closed"]


def told(path: Path) -> None:
    facts = info(path)
    json.dumps(facts, allow_nan=False)
    info_table(facts, every=True)


def summed_up(path: Path) -> None:
    json.dumps(summarise(path), allow_nan=False)


def exported(path: Path) -> None:
    export(path, ["npz"], path.with_suffix(".npz"), lambda _: None, force=True)


READERS: dict[str, Callable[[Path], None]] = {
    "read": as_it_is,
    "info": told,
    "recover": recovered,
    "replay": replayed,
    "summary": summed_up,
    "export": exported,
}


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("fuzz") / "the_file.mcap"


FEWER = fewer(4)


def taken(file: Path, raw: bytes, reader: str) -> None:
    """Nothing but the documented errors may come; a number that overflows is no error of the reader."""
    file.write_bytes(raw)
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        _, refusal = outcome(lambda: READERS[reader](file), OctarmError)
    assert not refusal or "the_file" in refusal


@pytest.mark.parametrize("reader", READERS)
@FEWER
@given(data=st.data())
def test_a_file_with_wrong_bytes(file: Path, reader: str, data: st.DataObject) -> None:
    whole = data.draw(st.sampled_from((valid.recording(), valid.cut_recording())))
    taken(file, data.draw(bytes_of(whole)), reader)


@pytest.mark.parametrize("reader", READERS)
@FEWER
@given(data=st.data())
def test_a_sound_file_with_wrong_metadata(file: Path, reader: str, data: st.DataObject) -> None:
    whole = parts()
    name = data.draw(st.sampled_from(sorted(whole.metadata)))
    facts = dict(whole.metadata[name])
    key = data.draw(st.sampled_from(sorted(facts)))
    if facts[key][:1] in "{[":
        facts[key] = data.draw(json_of(facts[key]))
    else:
        facts[key] = data.draw(
            st.sampled_from(("", "-1", "1e9", "9" * 400, "nan", "{", "é", facts[key] + "0"))
        )
    if data.draw(st.integers(0, 9)) == 0:
        del facts[key]
    changed = replace(whole, metadata={**whole.metadata, name: facts})
    try:
        raw = changed.joined()
    except UnicodeEncodeError:  # a lone surrogate has no place in MCAP
        return
    taken(file, raw, reader)


def is_json(payload: bytes) -> bool:
    try:
        json.loads(payload.decode())
    except (ValueError, RecursionError):
        return False
    return True


@pytest.mark.parametrize("reader", READERS)
@FEWER
@given(data=st.data())
def test_a_sound_file_with_wrong_payloads(file: Path, reader: str, data: st.DataObject) -> None:
    whole = parts()
    messages = list(whole.messages)
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(messages) - 1))
        topic, when, payload = messages[at]
        match data.draw(st.integers(0, 5)):
            case 0:
                del messages[at]
            case 1:
                messages.append(messages[at])
            case 2:
                messages[at] = topic, data.draw(st.sampled_from((0, 1, 2**63, 2**64 - 1))), payload
            case 4 | 5 if is_json(payload):  # else it has been damaged already
                text = data.draw(json_of(payload.decode()))
                messages[at] = topic, when, text.encode(errors="surrogatepass")
            case _:
                messages[at] = topic, when, data.draw(bytes_of(payload))
        if not messages:
            return
    taken(file, replace(whole, messages=tuple(messages)).joined(), reader)


@pytest.mark.parametrize("reader", ["read", "info", "replay", "recover"])
@FEWER
@given(data=st.data())
def test_a_sound_file_with_wrong_attachments(file: Path, reader: str, data: st.DataObject) -> None:
    whole = parts()
    name = data.draw(st.sampled_from(sorted(whole.attachments)))
    text = whole.attachments[name].decode()
    wrong = data.draw(
        json_of(text).map(lambda one: one.encode(errors="surrogatepass")) | bytes_of(text.encode())
    )
    taken(file, replace(whole, attachments={**whole.attachments, name: wrong}).joined(), reader)


# -- what was found ----------------------------------------------------------------------------------------


def run_with(**changes: Any) -> Parts:
    """The recording with other fields in the run's configuration."""
    facts = parts().metadata["octarm"]
    run = json.dumps({**json.loads(facts["run"]), **changes})
    return replace(parts(), metadata={**parts().metadata, "octarm": {**facts, "run": run}})


def facts_with(**changes: str) -> Parts:
    """The recording with other metadata of the run."""
    facts = {**parts().metadata["octarm"], **changes}
    return replace(parts(), metadata={**parts().metadata, "octarm": facts})


def counters_with(**changes: str) -> Parts:
    """The recording with other final counters."""
    counters = {**parts().metadata["summary"], **changes}
    return replace(parts(), metadata={**parts().metadata, "summary": counters})


def payloads_with(where: str, change: Callable[[dict[str, Any]], bytes]) -> Parts:
    """The recording with other messages on one channel."""
    messages = tuple(
        (topic, when, change(json.loads(payload)) if topic == where else payload)
        for topic, when, payload in parts().messages
    )
    return replace(parts(), messages=messages)


def but(**fields: Any) -> Callable[[dict[str, Any]], bytes]:
    return lambda row: json.dumps({**row, **fields}).encode()


FOUND: dict[str, tuple[Callable[[], Parts], dict[str, str]]] = {
    "a channel with one empty message": (
        lambda: payloads_with("/event", lambda _: b""),
        {"read": "channel /event, message 0: expected a JSON object", "info": ""},
    ),
    "two objects in one message": (
        lambda: payloads_with("/plant/pace", lambda row: json.dumps([row, row]).encode()[1:-1]),
        {"read": "channel /plant/pace, message 0: expected a JSON object", "info": ""},
    ),
    "an event of one nameless field": (
        lambda: payloads_with("/event", lambda _: b'{"": 0}'),
        {"export": "channel /event has no field 'tick'", "replay": "/event", "info": ""},
    ),
    "an event that says a list": (
        lambda: payloads_with("/event", but(message=[[]])),
        {"export": "channel /event, field 'message': expected text", "info": ""},
    ),
    "an event of a tick of 400 digits": (
        lambda: payloads_with("/event", but(tick=10**400)),
        {"read": "channel /event, field 'tick'", "info": ""},
    ),
    "instants that are not there": (
        lambda: payloads_with("/sweep/timing", but(started_wall_ns=None)),
        {"info": ""},
    ),
    "gains of a setpoint that there is not": (
        lambda: payloads_with("/node/00/schedule", but(setpoint=7)),
        {"summary": "field 'setpoint': expected 0..1", "info": ""},
    ),
    "a total of 400 digits": (
        lambda: counters_with(neighbour_bytes="9" * 400, ticks_lost="9" * 5000),
        {"summary": "counter neighbour_bytes: expected a whole number of 64 bits", "info": ""},
    ),
    "a node's counter of 400 digits": (
        lambda: counters_with(**{"node/00": json.dumps({"rejected_messages": 10**400})}),
        {"summary": "counters of node/00: expected whole numbers of 64 bits", "info": ""},
    ),
    "a link whose bytes nobody has counted": (
        lambda: counters_with(**{"node/00": json.dumps({"forward_sent_messages": 8})}),
        {"summary": "", "info": ""},
    ),
    "bytes below zero, of 400 digits": (
        lambda: counters_with(**{"node/00": json.dumps({"forward_received_bytes": -(10**400)})}),
        {"summary": "counters of node/00: expected whole numbers of 64 bits", "info": ""},
    ),
    "versions nested a hundred deep": (
        lambda: facts_with(versions="[" * 100 + "]" * 100),
        {"info": "", "export": ""},
    ),
    "half a surrogate pair": (
        lambda: run_with(run_id="\ud800"),
        {"export": "run configuration.run_id: expected text", "info": "", "recover": ""},
    ),
    "a gains file whose name is no text": (
        lambda: run_with(artefact_path="\udcff.json"),
        {"export": "", "info": ""},
    ),
    "the shortest time that a double has": (
        lambda: run_with(tick_s=5e-324),
        {"recover": "", "info": "", "read": "run configuration.tick_s: expected 1e-09 s to"},
    ),
    "a tick of 1.1 s": (
        lambda: run_with(tick_s=1.1),
        {"read": "", "summary": "tick 1.1 s is too long"},
    ),
    "faces that do not increase": (
        lambda: run_with(faces_m=[0.0, 0.5, 0.5, 1.0]),
        {"read": "", "summary": "spacing: faces must increase"},
    ),
    "setpoints of other gains": (
        lambda: run_with(setpoint_names=["level", "bent"]),
        {"read": "the run has the setpoints 'level', 'bent', its gains 'straight', 'bent'"},
    ),
    "a schedule without the first setpoint": (
        lambda: run_with(
            scheduling={
                "setpoints": [0],
                "boundaries_deg": [],
                "hysteresis_deg": 1.0,
                "bump_s": 2.0,
            }
        ),
        {"summary": "scheduling: setpoints (0,) without 1", "info": ""},
    ),
}
"""Each made a reader fail with another exception, or refuse without the file's name; what they say now, and
nothing where they read what is left."""


@pytest.mark.parametrize(
    ("name", "reader"), [(name, reader) for name, (_, says) in FOUND.items() for reader in says]
)
def test_what_was_found(file: Path, name: str, reader: str) -> None:
    damaged, says = FOUND[name]
    file.write_bytes(damaged().joined())
    _, refusal = outcome(lambda: READERS[reader](file), UsageError)
    if says[reader]:
        assert says[reader] in refusal
        assert refusal.startswith(f"recording {file}: ")
    else:
        assert not refusal


# -- claims ------------------------------------------------------------------------------------------------


def record(opcode: int, content: bytes, length: int | None = None) -> bytes:
    return struct.pack("<BQ", opcode, len(content) if length is None else length) + content


def chunk(compression: bytes, claimed: int, data: bytes, *, crc: int = 0) -> bytes:
    head = struct.pack("<QQQI", 0, 0, claimed, crc)
    name = struct.pack("<I", len(compression)) + compression
    return record(0x06, head + name + struct.pack("<Q", len(data)) + data)


def after_the_head(*records: bytes) -> bytes:
    """The metadata and attachments of a real recording, then these records, without an end."""
    whole = replace(parts(), messages=()).joined()
    end = next(
        p.offset for p in Walk(memoryview(whole)) if not isinstance(p, Damage) and p.opcode == 0x0F
    )
    return whole[:end] + b"".join(records)


BOMB = bytes(1 << 28)
"""256 MB of nothing."""


@cache
def claims() -> dict[str, bytes]:
    packed = zstandard.compress(BOMB)
    lz4ed = lz4.frame.compress(BOMB)
    gigabyte = 1 << 40
    return {
        "zstd, honest": after_the_head(chunk(b"zstd", len(BOMB), packed)),
        "zstd, says it is small": after_the_head(chunk(b"zstd", 100, packed)),
        "zstd, says it is huge": after_the_head(chunk(b"zstd", gigabyte, zstandard.compress(b"a"))),
        "zstd without a size": after_the_head(
            chunk(b"zstd", 100, zstandard.ZstdCompressor(write_content_size=False).compress(BOMB))
        ),
        "zstd, a header that claims": after_the_head(
            chunk(
                b"zstd",
                100,
                b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", gigabyte) + b"\x01\x00\x00",
            )
        ),
        "zstd, cut": after_the_head(chunk(b"zstd", len(BOMB), packed)[:-5]),
        "lz4, honest": after_the_head(chunk(b"lz4", len(BOMB), lz4ed)),
        "lz4, says it is small": after_the_head(chunk(b"lz4", 100, lz4ed)),
        "lz4, cut": after_the_head(chunk(b"lz4", len(BOMB), lz4ed)[:-5]),
        "nothing packed, huge": after_the_head(chunk(b"", gigabyte, b"")),
        "a record of exabytes": after_the_head(record(0x05, b"", 2**63)),
        "a text of gigabytes": after_the_head(record(0x0C, struct.pack("<I", 2**32 - 1))),
        "a map of gigabytes": after_the_head(
            record(0x0C, struct.pack("<I", 0) + struct.pack("<I", 2**32 - 1))
        ),
        "an attachment of exabytes": after_the_head(
            record(0x09, bytes(16) + struct.pack("<IIQ", 0, 0, 2**62))
        ),
        "a thousand empty records": after_the_head(
            record(0x80, b"") * 1000, record(0x05, b"") * 1000
        ),
    }


CLAIMS = sorted(claims())
MEMORY = 3 * LARGEST_CHUNK
"""Bytes that a reader of such a file may take beyond the file itself."""


@pytest.mark.timeout(20)
@pytest.mark.parametrize("claim", CLAIMS)
@pytest.mark.parametrize("reader", ["read", "info", "recover"])
def test_a_claim_costs_no_memory(file: Path, reader: str, claim: str) -> None:
    import tracemalloc

    raw = claims()[claim]
    tracemalloc.start()
    try:
        taken(file, raw, reader)
        assert tracemalloc.get_traced_memory()[1] < MEMORY
    finally:
        tracemalloc.stop()


@pytest.mark.timeout(20)
@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(
    "tick", [10**6, 10**9, 2**53, 2**63 - 1, 2**63, 10**30, -1, 1.5, "3", None]
)
def test_ticks_that_no_run_has(file: Path, reader: str, tick: Any) -> None:
    whole = parts()
    messages = [
        (
            topic,
            when,
            json.dumps({**json.loads(payload), "tick": tick}).encode() if when > 6e8 else payload,
        )
        for topic, when, payload in whole.messages
    ]
    taken(file, replace(whole, messages=tuple(messages)).joined(), reader)
