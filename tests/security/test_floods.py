"""Floods at the ports of a run with keys: lock-step keeps its numbers bit for bit, real time its rate."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from security_runs import NODES, Target, differences, keys_made, refused, slowed, target

from analysis.recording import Recording, read_recording
from analysis.summary import summary_of

if TYPE_CHECKING:
    from conftest import Start

SAME = ("--nodes", str(NODES), "--ticks", "1000", "--no-plot")
REAL_TIME = ("--realtime", "--tick", "0.05", "--ticks", "120", "--hold-ticks", "20", "--no-plot")
MOST_LATE = 6
"""Of the 120 ticks; docs/security.md says five of a hundred."""
LEAST = {"handshakes": 5}
"""Of each flood, where it is not a hundred: Zenoh takes a pause of 0.1 s after a handshake that failed."""


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return keys_made(tmp_path_factory.mktemp("own") / "keys", 4)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, gains: Path) -> Iterator[Recording]:
    from conftest import one_run

    with one_run(tmp_path_factory.mktemp("undisturbed"), gains, *SAME) as path:
        yield read_recording(path)


class Flooder:
    """A process that floods a port, ready to begin at once: what it needs is loaded before the run starts."""

    def __init__(self) -> None:
        command = [sys.executable, str(Path(__file__).with_name("flooder.py"))]
        pipe = subprocess.PIPE
        self._process = subprocess.Popen(command, stdin=pipe, stdout=pipe, text=True)
        self._hear("ready")

    def _hear(self, word: str) -> None:
        assert self._process.stdout is not None
        assert self._process.stdout.readline() == f"{word}\n"

    def begin(self, *words: str) -> None:
        """Returns when it has sent something worth the name."""
        assert self._process.stdin is not None
        print(json.dumps([LEAST.get(words[0], 100), *words]), file=self._process.stdin, flush=True)
        self._hear("enough")

    def close(self) -> None:
        """End the flood; AssertionError if it did not go well."""
        _, err = self._process.communicate("", timeout=60.0)
        assert self._process.returncode == 0, err


@contextmanager
def flooders() -> Iterator[list[Flooder]]:
    """One for each of the two ports."""
    with ExitStack() as stack:
        yield [stack.enter_context(closing(Flooder())) for _ in range(2)]


def floods(at: Target, kind: str) -> Iterator[tuple[str, ...]]:
    """Of a kind, at the plant and at a node."""
    if kind == "puts":
        yield "puts", str(at.ports["plant"]), str(at.keys), "node-3", at.names.command(1)
        yield "puts", str(at.ports["node2"]), str(at.keys), "node-0", at.names.forward(2)
    else:
        yield kind, str(at.ports["plant"])
        yield kind, str(at.ports["node1"])


NAMED = {
    "connections": {"a connection without a TLS handshake (tls handshake eof)"},
    "handshakes": {"a peer without a certificate"},
    "silence": set[str](),
    "puts": {
        "the certificate of node-3 from 127.0.0.1, which is not its process of this run",
        "the certificate of node-0 from 127.0.0.1, who has no link here",
    },
}


def named(recording: Recording, kind: str) -> None:
    told = {text.partition(" refused ")[2] for text in refused(recording)}
    assert told >= NAMED[kind]
    peers = summary_of(recording)["refused_peers"]
    assert {one["what"] for one in peers} == told


@pytest.mark.parametrize("kind", ["connections", "handshakes", "silence", "puts"])
def test_a_flood_changes_no_number(
    start: Start, keys: Path, undisturbed: Recording, kind: str
) -> None:
    with flooders() as both:
        cli = start.run(*SAME, "--keys", keys)
        with slowed(cli, 3):
            words = floods(target(cli, keys, keys, undisturbed), kind)
            for flooder, how in zip(both, words, strict=True):
                flooder.begin(*how)
        assert cli.finish() == 0, cli.err
    recording = read_recording(cli.recording())
    assert differences(recording, undisturbed) == []
    assert summary_of(recording)["rejected_messages"] == 0
    named(recording, kind)


@pytest.mark.alone
@pytest.mark.parametrize("kind", ["handshakes", "puts"])
def test_real_time_keeps_its_rate_in_a_flood(
    start: Start, keys: Path, undisturbed: Recording, kind: str
) -> None:
    """A second run beside it, which nobody floods, tells how many ticks are late on a busy machine."""
    beside = start.run("--nodes", str(NODES), *REAL_TIME)
    with flooders() as both:
        cli = start.run("--nodes", str(NODES), *REAL_TIME, "--keys", keys)
        cli.wait_for("tick ")
        words = floods(target(cli, keys, keys, undisturbed), kind)
        for flooder, how in zip(both, words, strict=True):
            flooder.begin(*how)
        assert cli.finish() in (0, 3), cli.err  # 3: ticks were late
    assert beside.finish() in (0, 3), beside.err
    recording = read_recording(cli.recording())
    summary, other = summary_of(recording), summary_of(read_recording(beside.recording()))
    assert summary["ticks"] == other["ticks"] == 120
    late, late_anyhow = (one["realtime"]["late_ticks"] for one in (summary, other))
    assert late <= MOST_LATE + late_anyhow
    assert summary["rejected_messages"] == 0
    named(recording, kind)
