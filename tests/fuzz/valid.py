"""What is fuzzed, whole: files and lines of a small run, made once by the code that writes the real ones."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path
from typing import NamedTuple

import msgspec
from closed_form import artefact
from simulated_run import Scenario, write_recording

from analysis.mcap_file import read_mcap
from supervise.endpoints import choose
from supervise.options import RunOptions
from supervise.plan import Plan, make_plan, prepare
from wire.artefact import GainsArtefact, write_artefact
from wire.channels import NODES_ATTACHMENT
from wire.config_json import dumps

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def gains() -> GainsArtefact:
    """Two setpoints, gains in closed form."""
    return artefact()


@cache
def gains_text() -> str:
    """A gains file."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "gains.json"
        write_artefact(gains(), path)
        return path.read_text()


def content_of(text: str) -> str:
    """The part of a gains file that its digest is of."""
    return bytes(msgspec.json.decode(text, type=dict[str, msgspec.Raw])["content"]).decode()


class Lines(NamedTuple):
    """One configuration a kind, as the launcher sends it."""

    node: str
    plant: str
    recorder: str
    live: str
    run: str


@cache
def plan() -> Plan:
    """Of a run in real time of three nodes with a live page; nothing is started."""
    with tempfile.TemporaryDirectory() as name:
        directory = Path(name)
        (directory / "gains.json").write_text(gains_text())
        options = RunOptions(
            gains=directory / "gains.json", nodes=3, ticks=20, realtime=True, live=True
        )
        endpoints = choose(3, "unix", None, directory / "sockets")
        try:
            return make_plan(prepare(options), endpoints, "fuzz", directory)
        finally:
            endpoints.close()


@cache
def lines() -> Lines:
    """The configurations of `plan`."""
    made = plan()
    assert made.live is not None
    return Lines(*map(dumps, (made.nodes[1], made.plant, made.recorder, made.live, made.run)))


@cache
def recording() -> bytes:
    """A small closed recording."""
    return _recording(close=True)


@cache
def cut_recording() -> bytes:
    """The same run, the recorder killed after its last flush."""
    return _recording(close=False)


def _recording(*, close: bool) -> bytes:
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "recording.mcap"
        write_recording(path, Scenario(nodes=3, ticks=8), close=close)
        return path.read_bytes()


@cache
def metadata() -> dict[str, str]:
    """Of `recording`, the record "octarm"."""
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "recording.mcap"
        path.write_bytes(recording())
        content = read_mcap(path)
    return {
        **content.metadata["octarm"],
        NODES_ATTACHMENT: content.attachments[NODES_ATTACHMENT].decode(),
    }


def example(name: str) -> str:
    """A file of examples/."""
    return (EXAMPLES / name).read_text()
