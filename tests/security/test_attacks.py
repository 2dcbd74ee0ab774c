"""Intruders at a run with keys: none changes a number of it, each is counted and named.

Every attack is tried with everything that an intruder could know but the keys: the run's tag, its key
expressions, its ports, the form of its messages.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
import zenoh
from bare_peer import BarePeer, PeerRefusedError, client_context
from ports import free_ports
from security_runs import NODES, Target, differences, keys_made, refused, slowed, stopped, target

from analysis.recording import Recording, read_recording
from analysis.summary import summary_of
from wire.keys import Keys
from wire.messages import Kind, Stop, encode_numbers, encode_stop, run_tag
from wire.session import RUNTIME_NODE, _config

if TYPE_CHECKING:
    from conftest import Start

TICKS = 1000
SAME = ("--nodes", str(NODES), "--ticks", str(TICKS), "--no-plot")
REPLAYED = 10


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return keys_made(tmp_path_factory.mktemp("own") / "keys", NODES)


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return keys_made(tmp_path_factory.mktemp("foreign") / "keys", NODES)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, gains: Path) -> Iterator[Recording]:
    """Over unix sockets, without keys: what the numbers are."""
    from conftest import one_run

    with one_run(tmp_path_factory.mktemp("undisturbed"), gains, *SAME) as path:
        yield read_recording(path)


def _zenoh(at: Target, port: str, certificate: Path | None) -> Any:
    """A session of the library with a certificate and the key beside it; ZError if it gets no link."""
    os.environ["ZENOH_RUNTIME"] = RUNTIME_NODE
    config = _config("client", [], [f"tls/127.0.0.1:{at.ports[port]}"], 10_000)
    config["connect"]["timeout_ms"] = 500
    config["transport"]["link"]["protocols"] = ["tls"]
    tls: dict[str, Any] = {"root_ca_certificate": str(at.keys / "ca.pem")}
    config["transport"]["link"]["tls"] = tls
    if certificate is not None:
        tls["enable_mtls"] = True
        tls["connect_certificate"] = f"{certificate}.pem"
        tls["connect_private_key"] = f"{certificate}.key"
    return zenoh.open(zenoh.Config.from_json5(json.dumps(config)))


# -- attacks: each returns when it has been made, whatever came of it ---------------------------------


def without_certificate(at: Target) -> None:
    """A session of the library that believes the run's authority and has nothing to show."""
    with pytest.raises(zenoh.ZError):
        _zenoh(at, "plant", None)


def foreign_authority(at: Target) -> None:
    with pytest.raises(zenoh.ZError):
        _zenoh(at, "node1", at.foreign / "node-2")


def command_of_another_node(at: Target) -> None:
    """Node 3's certificate at the plant, node 1's commands; with the library, then without its manners."""
    with _zenoh(at, "plant", at.keys / "node-3") as session:
        for raw in at.commands(1, range(TICKS)):
            session.put(at.names.command(1), raw)
            session.put(f"{at.names.root}/plant/command/*", raw)
    _pour(at, "plant", "node-3", at.names.command(1), at.commands(1, range(TICKS)))


def own_command_from_elsewhere(at: Target) -> None:
    """A stolen certificate, without the number that the node's process has in this run."""
    _pour(at, "plant", "node-1", at.names.command(1), at.commands(1, range(TICKS)))


def forward_sum_of_another_node(at: Target) -> None:
    """Node 3's certificate at node 2, which it is a neighbour of: but node 1 makes that sum."""
    _pour(at, "node2", "node-3", at.names.forward(2), at.forward_sums(1, range(TICKS)))


def forward_sum_from_a_stranger(at: Target) -> None:
    """Node 0's certificate at node 2, which has nothing to do with it."""
    _pour(at, "node2", "node-0", at.names.forward(2), at.forward_sums(1, range(TICKS)))


def order_to_stop(at: Target) -> None:
    """The recorder's certificate at a node, with the plant's word that the run is over."""
    stop = encode_stop(at.run, Stop(0, "safety", "stop at once"))
    _pour(at, "node0", "recorder", at.names.stop, [stop])


def no_tls(at: Target) -> None:
    """Zenoh in the clear, and something else altogether."""
    for first in (bytes([5, 0, 1, 9, 0x02, 1, 2]), b"GET / HTTP/1.1\r\n\r\n"):
        with socket.create_connection(("127.0.0.1", at.ports["node0"]), timeout=5) as link:
            link.sendall(first)
            with contextlib.suppress(OSError):
                link.recv(100)


def _pour(at: Target, port: str, name: str, key: str, messages: list[bytes]) -> None:
    """All of them, again and again for half a second."""
    with BarePeer(at.ports[port], at.context(name)) as peer:
        until = time.monotonic() + 0.5
        while time.monotonic() < until:
            for raw in messages:
                peer.put(key, raw)


NOT_ITS_PROCESS = "which is not its process of this run"
STRANGER = "who has no link here"
ATTACKS: list[tuple[Callable[[Target], None], str]] = [
    (without_certificate, "plant refused a peer without a certificate"),
    (foreign_authority, "node 1 refused a certificate of a foreign authority"),
    (
        command_of_another_node,
        f"plant refused the certificate of node-3 from 127.0.0.1, {NOT_ITS_PROCESS}",
    ),
    (
        own_command_from_elsewhere,
        f"plant refused the certificate of node-1 from 127.0.0.1, {NOT_ITS_PROCESS}",
    ),
    (
        forward_sum_of_another_node,
        f"node 2 refused the certificate of node-3 from 127.0.0.1, {NOT_ITS_PROCESS}",
    ),
    (
        forward_sum_from_a_stranger,
        f"node 2 refused the certificate of node-0 from 127.0.0.1, {STRANGER}",
    ),
    (order_to_stop, f"node 0 refused the certificate of recorder from 127.0.0.1, {STRANGER}"),
    (
        no_tls,
        "node 0 refused a connection without a TLS handshake "
        "(received corrupt message of type InvalidContentType)",
    ),
]


@pytest.mark.parametrize(("attack", "named"), ATTACKS, ids=[one.__name__ for one, _ in ATTACKS])
def test_a_run_with_keys_takes_no_notice(
    start: Start,
    keys: Path,
    foreign: Path,
    undisturbed: Recording,
    attack: Callable[[Target], None],
    named: str,
) -> None:
    cli = start.run(*SAME, "--keys", keys)
    with slowed(cli, 3):  # which nobody attacks
        attack(target(cli, keys, foreign, undisturbed))
    assert cli.finish() == 0, cli.err
    assert cli.gone() == {}
    recording = read_recording(cli.recording())
    assert differences(recording, undisturbed) == []
    summary = summary_of(recording)
    # Nothing came so far that a process had to refuse a message.
    assert summary["rejected_messages"] == 0
    assert summary["rejected_by_reason"] == {}
    assert named in refused(recording)
    assert named in cli.err.splitlines()
    by, _, what = named.partition(" refused ")
    counts = {(one["by"], one["what"]): one["count"] for one in summary["refused_peers"]}
    assert counts[by, what] >= 1
    assert "refused peers" in cli.out


@pytest.mark.parametrize("attack", [own_command_from_elsewhere, forward_sum_of_another_node])
def test_a_run_without_keys_is_at_the_mercy_of_the_same(
    start: Start,
    keys: Path,
    foreign: Path,
    undisturbed: Recording,
    attack: Callable[[Target], None],
) -> None:
    """Or the attacks would prove nothing. TLS is all that is left out of them.

    Node 1 does nothing meanwhile: its command and sum of one tick are waited for, and the intruder's come.
    """
    cli = start.run(*SAME, "--transport", "tcp")
    with stopped(cli, 1), contextlib.suppress(ConnectionError):  # the run may break off under it
        attack(target(cli, keys, foreign, undisturbed, secured=False))
    assert cli.finish() in (0, 4), cli.err
    recording = read_recording(cli.recording())
    assert recording.ticks < TICKS or differences(recording, undisturbed)


def test_a_run_with_keys_that_nobody_attacks_has_refused_nobody(
    start: Start, keys: Path, undisturbed: Recording
) -> None:
    cli = start.run(*SAME, "--keys", keys)
    assert cli.finish() == 0, cli.err
    recording = read_recording(cli.recording())
    assert differences(recording, undisturbed) == []
    assert summary_of(recording)["refused_peers"] == []
    assert refused(recording) == set()


def test_a_replayed_message_is_refused_by_its_run(
    start: Start, keys: Path, undisturbed: Recording
) -> None:
    """By somebody who has all that node 1 has: its key, and its configuration of this run."""
    cli = start.run("--nodes", "4", "--ticks", "30", "--no-plot", "--keys", keys, "--by-hand", "1")
    cli.wait_for("node 1 is yours to start: ")
    (file,) = cli.work.glob("runs/*/node-1.json")
    assert file.stat().st_mode & 0o777 == 0o600
    links = json.loads(file.read_text())["links"]
    command = undisturbed.table("/node/01/command").column("force_n_per_m")
    earlier = run_tag(undisturbed.configuration.run_id)
    recorded = encode_numbers(Kind.COMMAND, earlier, 0, 1, 0, [float(command[0])])
    own = Keys(run_tag(file.parent.name))
    port = int(links["connect"][0].rpartition(":")[2])
    with _patiently(port, client_context(keys, "node-1"), links["tls"]["identity"]) as peer:
        for _ in range(REPLAYED):  # the plant's port answers a moment before the plant subscribes
            for key in (own.command(1), Keys(earlier).command(1), own.command(2)):
                peer.put(key, recorded)
            time.sleep(0.1)
    node = start.node(str(file))
    assert cli.finish() == 0, cli.err
    assert node.finish() == 0, node.err
    summary = summary_of(read_recording(cli.recording()))
    found = summary["rejected_messages"]
    assert 1 <= found <= REPLAYED  # the other two did not get to the plant
    assert summary["rejected_by_reason"] == {"run": found}
    assert summary["refused_peers"] == []
    assert f"run {found}; ticks lost" in cli.out


def _patiently(port: int, context: ssl.SSLContext, identity: str) -> BarePeer:
    """The peer, as soon as somebody listens there."""
    limit = time.monotonic() + 30.0
    while True:
        try:
            return BarePeer(port, context, identity)
        except ConnectionRefusedError:
            assert time.monotonic() < limit
            time.sleep(0.02)


def test_all_that_a_node_has_gets_no_second_link(start: Start, keys: Path) -> None:
    """Key and number of node 1, while node 1 is there: in real time, since its link is waited for."""
    slow = ("--realtime", "--tick", "0.05", "--ticks", "140", "--hold-ticks", "200", "--no-plot")
    cli = start.run("--nodes", "4", *slow, "--keys", keys, "--by-hand", "1")
    cli.wait_for("node 1 is yours to start: ")
    (file,) = cli.work.glob("runs/*/node-1.json")
    links = json.loads(file.read_text())["links"]
    node = start.node(str(file))
    cli.wait_for("tick ")
    port = int(links["connect"][0].rpartition(":")[2])
    with pytest.raises(PeerRefusedError):
        BarePeer(port, client_context(keys, "node-1"), links["tls"]["identity"])
    assert cli.finish() in (0, 3), cli.err  # 3: ticks were late
    assert node.finish() == 0, node.err
    recording = read_recording(cli.recording())
    summary = summary_of(recording)
    assert summary["ticks"] == 140
    assert summary["rejected_messages"] == 0
    what = "the certificate of node-1 from 127.0.0.1, which got no link"
    assert summary["refused_peers"] == [{"by": "plant", "what": what, "count": 1}]
    assert refused(recording) == {f"plant refused {what}"}


@pytest.mark.parametrize("stolen", [False, True])
def test_an_impostor_in_the_place_of_a_node_is_not_believed(
    start: Start, keys: Path, foreign: Path, stolen: bool
) -> None:
    """It listens where node 1 should, with a foreign authority's certificate or with node 3's."""
    base = free_ports(4)
    config = _config("router", [f"tls/127.0.0.1:{base + 2}"], [], 10_000)
    directory, name = (keys, "node-3") if stolen else (foreign, "node-1")
    config["transport"]["link"]["protocols"] = ["tls"]
    config["transport"]["link"]["tls"] = {
        "root_ca_certificate": str(keys / "ca.pem"),
        "listen_certificate": str(directory / f"{name}.pem"),
        "listen_private_key": str(directory / f"{name}.key"),
        "enable_mtls": False,
    }
    cli = start.run(
        *("--nodes", "4", "--ticks", "5", "--no-plot", "--keys", keys, "--by-hand", "1"),
        *("--base-port", str(base), "--start-timeout", "4"),
    )
    cli.wait_for("node 1 is yours to start: ")  # the ports have been tried
    os.environ["ZENOH_RUNTIME"] = RUNTIME_NODE
    with zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as impostor:
        heard = impostor.declare_subscriber("**")
        assert cli.finish() == 5
        assert heard.try_recv() is None
    assert "node 1 was not started" in cli.err
    assert "node 2 waits for node 1" in cli.err
    named = f"node 2 refused the certificate of node-3 from 127.0.0.1, {NOT_ITS_PROCESS}"
    assert (named in cli.err) == stolen
    assert cli.gone() == {}
