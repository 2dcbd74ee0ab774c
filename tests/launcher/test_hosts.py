"""Runs over several hosts: loopback addresses behind start commands, and network namespaces with links that
lose packets."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import netlab
import pytest
from lossy_link import Loss
from ports import free_ports

from analysis.mcap_file import McapContent, read_mcap
from analysis.recording import read_recording

if TYPE_CHECKING:
    from conftest import Cli, Start

SSH = f"{sys.executable} {Path(__file__).with_name('stand_in_ssh.py')} tip-side"
"""Its process is not the zygote: only the pipes bind the two, and the words pass a shell."""
ENDLESS = ("--nodes", "4", "--ticks", "1000000", "--no-plot")


def write_hosts(
    tmp_path: Path, start: str, *more: str, plant: str = "127.0.0.1", far: str = "127.0.0.2"
) -> Path:
    """A hosts file for four nodes, the first two here, the others by a start command."""
    path = tmp_path / "hosts.toml"
    path.write_text(
        f'[plant]\naddress = "{plant}"\n'
        f'[[hosts]]\nname = "root-side"\naddress = "{plant}"\nnodes = 2\n'
        f'[[hosts]]\nname = "tip-side"\naddress = "{far}"\nnodes = 2\n'
        f'start = """{start}"""\ndirectory = "{netlab.ROOT}"\npython = "{sys.executable}"\n'
        f"base_port = {free_port(far)}\n" + "\n".join(more)
    )
    return path


def free_port(address: str) -> int:
    """The first of two ports of a loopback address that nobody holds."""
    return free_ports(2, address) if address.startswith("127.") else 17_000


def numbers(content: McapContent) -> dict[str, tuple[list[bytes], list[int]]]:
    """Everything but wall-clock channels, byte by byte."""
    return {
        topic: (content.payloads[topic], content.log_times_ns[topic])
        for topic in content.payloads
        if not topic.endswith("/timing")
    }


def nothing_left(cli: Cli) -> None:
    assert cli.gone() == {}
    assert list(cli.sockets.iterdir()) == []


# -- start commands on one machine ------------------------------------------------------------------


def test_a_far_half_gives_the_same_numbers(start: Start, tmp_path: Path) -> None:
    same = ["--nodes", "4", "--ticks", "60", "--no-plot", "--quiet"]
    hosts = write_hosts(tmp_path, SSH)
    near, far = start.run(*same), start.run(*same, "--hosts", hosts)
    assert [near.finish(), far.finish()] == [0, 0], near.err + far.err
    nothing_left(far)
    content = read_mcap(far.recording())
    assert numbers(content) == numbers(read_mcap(near.recording()))
    hosts_told = json.loads(content.metadata["octarm"]["hosts"])
    assert [host["name"] for host in hosts_told] == ["root-side", "tip-side"]
    assert "host tip-side: welcome" in (far.recording().parent / "processes.log").read_text()
    # Another machine's clock: the first measurement came at zero. Here's began with the plan.
    recording = read_recording(far.recording())
    first = [
        recording.table(f"/node/0{i}/timing").by_tick(("measurement_received_wall_ns",), 1)[0, 0]
        for i in range(4)
    ]
    assert first[2:] == [0.0, 0.0]
    assert min(first[:2]) > 0.0


def test_a_killed_start_command_stops_the_arm(start: Start, tmp_path: Path) -> None:
    cli = start.run(*ENDLESS, "--hosts", write_hosts(tmp_path, SSH))
    cli.wait_for("tick ")
    os.kill(cli.processes()["stand-in-ssh"], signal.SIGKILL)
    assert cli.finish() == 4
    assert "host tip-side was ended by SIGKILL" in cli.err
    nothing_left(cli)
    recording = read_recording(cli.recording())
    assert recording.ticks > 0
    assert recording.unfinished is None


@pytest.mark.parametrize("node", [2, 3])
def test_a_killed_far_node_stops_the_arm(start: Start, tmp_path: Path, node: int) -> None:
    cli = start.run(*ENDLESS, "--hosts", write_hosts(tmp_path, SSH))
    cli.wait_for("tick ")
    os.kill(cli.processes()[f"octarm-node{node}"], signal.SIGKILL)
    assert cli.finish() == 4
    assert f"node {node} was ended by SIGKILL" in cli.err
    nothing_left(cli)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_an_ended_launcher_leaves_nothing_on_the_other_side(
    start: Start, tmp_path: Path, number: signal.Signals
) -> None:
    cli = start.run(*ENDLESS, "--hosts", write_hosts(tmp_path, SSH))
    cli.wait_for_records()
    cli.popen.send_signal(number)
    assert cli.finish() == (130 if number == signal.SIGINT else -signal.SIGKILL)
    nothing_left(cli)
    assert read_recording(cli.recording()).ticks > 0


def test_an_interrupt_before_a_slow_host_answers(start: Start, tmp_path: Path) -> None:
    """It answers while everything ends, and takes no notice of a signal before."""
    hosts = write_hosts(tmp_path, """sh -c 'trap \"\" TERM; sleep 2; exec \"$@\"' far""")
    cli = start.run("--nodes", "4", "--ticks", "5", "--hosts", hosts, "--by-hand", "0")
    cli.wait_for("node 0 is yours to start: ")
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130
    assert "interrupted before the first tick" in cli.err
    nothing_left(cli)


def test_a_start_command_that_fails_is_named_with_its_last_words(
    start: Start, tmp_path: Path
) -> None:
    hosts = write_hosts(tmp_path, "sh -c 'echo no way in >&2; exit 255' ssh")
    cli = start.run("--nodes", "4", "--ticks", "5", "--hosts", hosts)
    assert cli.finish() == 5
    assert "host tip-side exited with code 255 (last said: no way in)" in cli.err
    assert "Traceback" not in cli.err
    nothing_left(cli)


def test_a_start_command_that_does_not_exist_is_refused(start: Start, tmp_path: Path) -> None:
    hosts = write_hosts(tmp_path, "no-such-shell tip-side")
    cli = start.run("--nodes", "4", "--ticks", "5", "--hosts", hosts)
    assert cli.finish() == 2
    assert "host tip-side: start: 'no-such-shell' cannot be run" in cli.err
    nothing_left(cli)


def test_a_host_that_does_not_answer_is_named(start: Start, tmp_path: Path) -> None:
    hosts = write_hosts(tmp_path, "sh -c 'exec sleep 1000' ssh")
    cli = start.run("--nodes", "4", "--ticks", "5", "--hosts", hosts, "--start-timeout", "4")
    assert cli.finish() == 5
    assert "host tip-side does not answer; node 1 waits for node 2" in cli.err
    nothing_left(cli)


def test_a_far_node_that_cannot_listen_says_where(start: Start, tmp_path: Path) -> None:
    hosts = write_hosts(tmp_path, "env", far="10.77.255.1")
    cli = start.run("--nodes", "4", "--ticks", "5", "--hosts", hosts)
    assert cli.finish() == 5
    assert "node 2: cannot listen on tcp/10.77.255.1:17000 of " in cli.err
    assert ": Cannot assign requested address; " in cli.err
    assert "Traceback" not in cli.err
    nothing_left(cli)


@pytest.mark.every
def test_nodes_of_a_host_can_be_started_by_hand(start: Start, tmp_path: Path) -> None:
    """One from the file, one with its configuration on standard input."""
    hosts = write_hosts(tmp_path, "print", "same_clock = true")
    cli = start.run("--nodes", "4", "--ticks", "30", "--no-plot", "--hosts", hosts)
    cli.wait_for("node 3 is yours to start on tip-side: cd ")
    assert f"{sys.executable} -m node node-2.json" in cli.err
    assert "host tip-side: copy " in cli.err
    (directory,) = cli.work.glob("runs/*")
    node2 = start.node("-", stdin=directory / "node-2.json")
    node3 = start.node(str(directory / "node-3.json"))
    assert cli.finish() == 0, cli.err
    assert (node2.finish(), node3.finish()) == (0, 0), node2.err + node3.err


def test_a_node_that_nobody_started_on_a_host_is_named(start: Start, tmp_path: Path) -> None:
    hosts = write_hosts(tmp_path, "print")
    cli = start.run("--nodes", "4", "--ticks", "5", "--hosts", hosts, "--start-timeout", "3")
    assert cli.finish() == 5
    assert 'node 2 was not started (it is yours: host tip-side has start = "print")' in cli.err
    nothing_left(cli)


def test_a_wrong_configuration_on_standard_input_is_refused(start: Start, tmp_path: Path) -> None:
    wrong = tmp_path / "node.json"
    wrong.write_text("{}")
    node = start.node("-", stdin=wrong)
    assert node.finish() == 2
    assert node.err == "node: configuration on standard input: batch_ticks is missing\n"


def test_a_remote_zygote_ends_when_it_hears_nothing_any_more() -> None:
    code = "import node.zygote as z; z.SILENCE_S = 0.5; raise SystemExit(z.serve(None))"
    zygote = subprocess.Popen(
        [sys.executable, "-c", code], cwd=netlab.ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        assert zygote.wait(20) == 0  # its standard input is still open
    finally:
        zygote.kill()
        zygote.communicate()


# -- network namespaces -----------------------------------------------------------------------------

PLANT, BY_B = "10.77.1.1", "10.77.2.1"
A, B = "10.77.3.1", "10.77.3.2"
WHY_NOT = netlab.unavailable()
needs_namespaces = pytest.mark.skipif(WHY_NOT is not None, reason=str(WHY_NOT))


@pytest.fixture
def lab() -> Iterator[netlab.Lab]:
    """A plant's machine and two hosts, each linked to it; the link between the two hosts is the test's."""
    with netlab.Lab("plant", "a", "b") as lab:
        lab.wire("plant", PLANT, "a", "10.77.1.2")
        lab.wire("plant", BY_B, "b", "10.77.2.2")
        lab.route("b", PLANT, BY_B)
        yield lab


def between_hosts(lab: netlab.Lab, tmp_path: Path, nodes: int, start: str = "{}") -> Path:
    path = tmp_path / "hosts.toml"
    within = {name: start.format(" ".join(lab.within(name)) + " ") for name in "ab"}
    root = ("root-side", A, nodes // 2, [within["a"]])
    tip = ("tip-side", B, nodes - nodes // 2, [within["b"]])
    path.write_text(netlab.hosts_file(PLANT, [root, tip]))
    return path


def same_over_hosts(start: Start, lab: netlab.Lab, hosts: Path, *options: str) -> None:
    """A run over the hosts and one on this machine: equal numbers, two messages a cut and tick."""
    same = [*options, "--no-plot"]
    nodes, ticks = int(options[1]), int(options[3])
    near = start.run(*same, "--quiet")
    far = start.run(*same, "--json", "--hosts", hosts, within=lab.within("plant"))
    assert [near.finish(), far.finish()] == [0, 0], near.err + far.err
    nothing_left(far)
    assert numbers(read_mcap(near.recording())) == numbers(read_mcap(far.recording()))
    summary = far.json()
    assert summary["neighbour_messages"] == 2 * (nodes - 1) * ticks
    assert summary["neighbour_messages_sent"] == summary["neighbour_messages"]
    assert summary["rejected_messages"] == 0


@needs_namespaces
def test_two_hosts_give_the_numbers_of_one(start: Start, lab: netlab.Lab, tmp_path: Path) -> None:
    lab.wire("a", A, "b", B)
    hosts = between_hosts(lab, tmp_path, 6)
    same_over_hosts(start, lab, hosts, "--nodes", "6", "--ticks", "60")


@needs_namespaces
def test_a_slow_link_that_loses_packets_changes_no_number(
    start: Start, lab: netlab.Lab, tmp_path: Path
) -> None:
    link = lab.lossy("a", A, "b", B, Loss(delay_ms=2.0, jitter_ms=1.0, loss=0.05))
    hosts = between_hosts(lab, tmp_path, 4)
    same_over_hosts(start, lab, hosts, "--nodes", "4", "--ticks", "40", "--start-timeout", "60")
    said = lab.unlink(link)
    assert "packets there " in said
    assert "lost 0" not in said, said


@needs_namespaces
def test_a_cut_link_between_hosts_stops_the_arm(
    start: Start, lab: netlab.Lab, tmp_path: Path
) -> None:
    """Nobody dies and nobody is told: the deadline of the tick is what ends the run."""
    link = lab.lossy("a", A, "b", B, Loss())
    hosts = between_hosts(lab, tmp_path, 4, SSH + " {}")
    options = (*ENDLESS, "--hosts", hosts, "--deadline", "3")
    cli = start.run(*options, within=lab.within("plant"))
    cli.wait_for("tick ")
    lab.unlink(link)
    began = time.monotonic()
    assert cli.finish() == 4
    assert time.monotonic() - began < 15.0
    assert "within 3 s" in cli.err or "waited 3 s" in cli.err
    nothing_left(cli)
    assert read_recording(cli.recording()).unfinished is None
