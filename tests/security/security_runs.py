"""What the tests of attacks share: keys, runs that are compared, and what an intruder finds."""

from __future__ import annotations

import contextlib
import datetime
import os
import signal
import ssl
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from bare_peer import client_context
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from pulses import Pulses
from sockets import port_of

from analysis.compare import compare
from analysis.compare_facts import configuration_differences
from analysis.events import read_events
from analysis.recording import Recording
from wire.foxglove import EVENTS
from wire.keys import Keys
from wire.messages import Kind, encode_numbers, run_tag

if TYPE_CHECKING:
    from conftest import Cli

ROOT = Path(__file__).resolve().parents[2]
NODES = 4
"""Of the runs that are attacked."""
STOPPED_S, RUNNING_S = 0.04, 0.004


def keys_made(directory: Path, nodes: int, *options: str | Path) -> Path:
    """Keys, made as a user makes them."""
    command = [sys.executable, str(ROOT / "launcher.py"), "keys", "--nodes", str(nodes)]
    words = [*command, "--out", str(directory), *map(str, options)]
    subprocess.run(words, check=True, stdout=subprocess.DEVNULL)
    return directory


def signed_again(keys: Path, name: str, begin_h: float, end_h: float) -> None:
    """The same certificate with other times, signed by the same authority."""
    path = keys / f"{name}.pem"
    old = x509.load_pem_x509_certificate(path.read_bytes())
    key = serialization.load_pem_private_key((keys / "ca.key").read_bytes(), None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    now = datetime.datetime.now(datetime.UTC)
    builder = (
        x509.CertificateBuilder()
        .subject_name(old.subject)
        .issuer_name(old.issuer)
        .public_key(old.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now + datetime.timedelta(hours=begin_h))
        .not_valid_after(now + datetime.timedelta(hours=end_h))
    )
    for extension in old.extensions:
        builder = builder.add_extension(extension.value, extension.critical)
    path.write_bytes(builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))


@contextlib.contextmanager
def slowed(cli: Cli, node: int) -> Iterator[None]:
    """A run in lock-step, from its first ticks on, one of whose nodes is stopped for ten elevenths of the time.

    All wait for it: the run is not over before an attack has been made, on whatever machine.
    """
    pid = _begun(cli, node)
    pulses = Pulses(pid, STOPPED_S, RUNNING_S)
    try:
        cli.wait_for("tick ")
        yield
    finally:
        pulses.end()


@contextlib.contextmanager
def stopped(cli: Cli, node: int) -> Iterator[None]:
    """A run in lock-step that stands still at one of its first ticks, since this node does nothing."""
    pid = _begun(cli, node)
    os.kill(pid, signal.SIGSTOP)
    try:
        time.sleep(0.1)  # for what the others have still to do
        yield
        time.sleep(0.3)  # for what was sent to them last
    finally:
        os.kill(pid, signal.SIGCONT)


def _begun(cli: Cli, node: int) -> int:
    """The number of a node's process, as soon as the run goes on."""
    cli.wait_for(f"{NODES} nodes, plant and recorder linked")
    return cli.processes()[f"octarm-node{node}"]


@dataclass(frozen=True)
class Target:
    """A run that goes on, as an intruder knows it who knows everything but the keys."""

    run: int
    ports: dict[str, int]
    """By the names of the processes that listen."""
    keys: Path
    """Of the run's authority."""
    secured: bool
    """False: its processes speak in the clear."""
    foreign: Path
    """Keys of another authority, with the same names."""
    forward_numbers: int
    """In a forward sum, but the root's."""
    setpoint: int
    """Whose gains are in use."""

    def commands(self, node: int, ticks: range) -> list[bytes]:
        """Commands for these ticks that are well formed, and too large by far."""
        return [
            encode_numbers(Kind.COMMAND, self.run, k, node, self.setpoint, [1.0]) for k in ticks
        ]

    def forward_sums(self, sender: int, ticks: range) -> list[bytes]:
        """The same of sums."""
        values = [1.0] * self.forward_numbers
        kind, run, setpoint = Kind.FORWARD_SUM, self.run, self.setpoint
        return [encode_numbers(kind, run, k, sender, setpoint, values) for k in ticks]

    def context(self, name: str) -> ssl.SSLContext | None:
        """TLS with somebody's certificate."""
        return client_context(self.keys, name) if self.secured else None

    @property
    def names(self) -> Keys:
        """The key expressions of the run."""
        return Keys(self.run)


def target(cli: Cli, keys: Path, foreign: Path, like: Recording, *, secured: bool = True) -> Target:
    """What there is to attack of a run in the middle of it."""
    (directory,) = cli.work.glob("runs/*")
    listening = {
        name.removeprefix("octarm-"): port_of(pid)
        for name, pid in cli.processes().items()
        if name in ("octarm-plant", "octarm-node0", "octarm-node1", "octarm-node2")
    }
    sums = like.tables["/node/02/forward_sum"].columns
    numbers = len(sums) - len(("tick", "time_s"))
    setpoint = like.configuration.setpoint_index
    return Target(run_tag(directory.name), listening, keys, secured, foreign, numbers, setpoint)


def differences(one: Recording, other: Recording) -> list[str]:
    """Kinds of channels in which two runs differ, and of what they were made; the story is left out."""
    found = compare(one, other)
    kinds = [kind.kind for kind in found.kinds if kind.kind != EVENTS.topic and not kind.same]
    apart = [*found.missing_a, *found.missing_b, *found.left_out]
    facts = [str(fact) for fact in configuration_differences(one, other) if fact.counts]
    return [*kinds, *apart, *facts]


def refused(recording: Recording) -> set[str]:
    """The messages of all events that tell of somebody who was not let in."""
    events = read_events(recording.tables[EVENTS.topic])
    assert {one.level for one in events if one.name == "refused_peer"} <= {"warning"}
    return {one.message for one in events if one.name == "refused_peer"}
