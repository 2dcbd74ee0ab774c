"""The launcher is killed or stopped: nothing outlives it, nothing is left, and a pause of it hurts nobody."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import psutil
import pytest

from chaos.aftermath import Expected
from chaos.processes import outliving

if TYPE_CHECKING:
    from conftest import Cli, Start

ENDLESS = ("--nodes", "4", "--ticks", "1000000", "--no-plot")
GONE_S = 1.0
"""Everything that a killed launcher leaves has ended after this."""


@pytest.mark.parametrize(
    "more",
    [
        (),
        ("--transport", "tcp"),
        ("--segments-per-process", "2"),
        ("--realtime", "--tick", "0.02", "--hold-ticks", "1000"),
        ("--realtime", "--tick", "0.02", "--hold-ticks", "1000", "--live"),
        ("--segments-per-process", "2", "--transport", "tcp", "--live"),
    ],
    ids=" ".join,
)
def test_killed_launcher_leaves_nothing_alive(start: Start, more: tuple[str, ...]) -> None:
    cli = start.run(*ENDLESS, *more)
    cli.wait_for_records()
    os.kill(cli.popen.pid, signal.SIGKILL)
    assert [str(p) for p in outliving(cli.mark, GONE_S)] == []
    cli.ends(Expected((-signal.SIGKILL,), gone_s=0.0))


def _is_zygote(pid: int) -> bool:
    with contextlib.suppress(OSError):
        return b"--zygote" in Path(f"/proc/{pid}/cmdline").read_bytes()
    return False


@pytest.mark.parametrize("after_s", [0.0, 0.1, 0.25, 0.5])
def test_launcher_killed_during_start_up_leaves_nothing(start: Start, after_s: float) -> None:
    """Its children may still be loading their modules: they look for it when they have."""
    cli = start.run(*ENDLESS, "--out", "out", "--by-hand", "3")
    limit = time.monotonic() + 30
    while not any(map(_is_zygote, cli.processes().values())):  # the first that is started
        assert time.monotonic() < limit
        time.sleep(0.002)
    time.sleep(after_s)
    os.kill(cli.popen.pid, signal.SIGKILL)
    cli.ends(Expected((-signal.SIGKILL,), recording=None, finished=None, ticks=0, gone_s=5.0))


def _ports(cli: Cli, *names: str) -> list[int]:
    """Where these processes listen."""
    found = cli.processes()
    return [
        link.laddr.port
        for name in names
        for link in psutil.Process(found[name]).net_connections("tcp")
        if link.status == psutil.CONN_LISTEN
    ]


def test_silent_connections_do_not_keep_what_a_killed_launcher_leaves(start: Start) -> None:
    """Zenoh waits two seconds for their handshake, and does not close a session meanwhile."""
    cli = start.run(*ENDLESS, "--transport", "tcp")
    cli.wait_for_records()
    listening = _ports(cli, "octarm-plant", "octarm-node0", "octarm-node1")
    assert len(listening) == 3
    with contextlib.ExitStack() as stack:
        for port in listening:
            stack.enter_context(socket.create_connection(("127.0.0.1", port)))
        time.sleep(0.1)
        os.kill(cli.popen.pid, signal.SIGKILL)
        assert [str(p) for p in outliving(cli.mark, GONE_S)] == []
    cli.ends(Expected((-signal.SIGKILL,), gone_s=0.0))


def test_who_is_refused_at_the_end_does_not_keep_it_either(start: Start) -> None:
    """With keys: the book of those who knocked is closed while it waits for several at once."""
    keys = start("keys", "--out", "keys", "--nodes", "4")
    assert keys.finish() == 0, keys.err
    where = ("--transport", "tcp", "--keys", str(keys.work / "keys"))
    cli = start.run(*ENDLESS, *where)
    cli.wait_for_records()
    (port,) = _ports(cli, "octarm-plant")
    for _ in range(20):
        with socket.create_connection(("127.0.0.1", port)) as knocking:
            knocking.sendall(b"GET / HTTP/1.1\r\n\r\n")
        time.sleep(0.02)
    os.kill(cli.popen.pid, signal.SIGKILL)
    assert [str(p) for p in outliving(cli.mark, GONE_S)] == []
    cli.ends(Expected((-signal.SIGKILL,), gone_s=0.0))


def test_launcher_that_is_stopped_for_a_while_is_not_missed(start: Start) -> None:
    """A period so long that a busy machine makes few ticks late, and the pause well before the run's end, 5 s
    after its begin."""
    period_s = 0.04
    cli = start.run(
        *("--nodes", "4", "--ticks", "125", "--tick", str(period_s), "--realtime"),
        *("--hold-ticks", "1000", "--no-plot"),
    )
    cli.wait_for_records()
    began_ns = time.monotonic_ns()
    os.kill(cli.popen.pid, signal.SIGSTOP)
    time.sleep(1.5)
    os.kill(cli.popen.pid, signal.SIGCONT)
    resumed_ns = time.monotonic_ns()
    cli.ends(
        Expected((0, 3), (r"finished: all 125 ticks",), ticks=125)
    )  # 3: a late tick under load
    recording = cli.recorded()
    epoch_ns = int(recording.facts["epoch_ns"])
    done = recording.table("/sweep/timing").numbers("due_wall_ns") + epoch_ns
    swept = done[~recording.late]
    inside = swept[(swept > began_ns) & (swept < resumed_ns)]
    assert (done >= resumed_ns).any()  # the run was not over
    assert len(inside) > 30  # of the 37 that were due
    assert float(np.diff(inside).max()) < 0.25e9


def test_killed_zygote_stops_the_arm(start: Start) -> None:
    """Its nodes end with it."""
    cli = start.run(*ENDLESS)
    cli.wait_for("tick ")
    os.kill(cli.processes()["octarm-zygote"], signal.SIGKILL)
    how = r"zygote was ended by SIGKILL|node \d+ "
    cli.ends(Expected((4,), (f"safety_stop: .*({how})",), (how,)))


@pytest.mark.parametrize("node", [0, 2])
def test_node_killed_during_start_up_is_named(start: Start, node: int) -> None:
    cli = start.run("--nodes", "4", "--ticks", "10", "--by-hand", "3", "--start-timeout", "20")
    limit = time.monotonic() + 20
    while (pid := cli.processes().get(f"octarm-node{node}")) is None:
        assert time.monotonic() < limit
        time.sleep(0.01)
    os.kill(pid, signal.SIGKILL)
    said = (rf"start-up failed: node {node} was ended by SIGKILL",)
    cli.ends(Expected((5,), said=said, recording=False))


@pytest.mark.every
@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("octarm-zygote", "node 0 does not answer"),
        ("octarm-plant", "node 0 waits for the plant"),
    ],
)
def test_process_that_is_stopped_before_it_reads_its_configuration_is_named(
    start: Start, name: str, says: str
) -> None:
    """A configuration is longer than a pipe: nobody waits for it to be read."""
    cli = start.run("--nodes", "40", "--ticks", "10", "--no-plot", "--start-timeout", "5")
    limit = time.monotonic() + 20.0
    while (pid := cli.processes().get(name)) is None:
        assert time.monotonic() < limit
    os.kill(pid, signal.SIGSTOP)
    said = (f"not every link was up after 5 s: {says}",)
    cli.ends(Expected((5,), said=said, recording=False))


@pytest.mark.every
def test_interrupt_while_a_configuration_waits_to_be_read(start: Start) -> None:
    cli = start.run("--nodes", "40", "--ticks", "10", "--no-plot")
    limit = time.monotonic() + 20.0
    while (pid := cli.processes().get("octarm-zygote")) is None:
        assert time.monotonic() < limit
    os.kill(pid, signal.SIGSTOP)
    time.sleep(0.5)
    cli.popen.send_signal(signal.SIGINT)
    cli.ends(Expected((130,), said=("interrupted before the first tick",), recording=False))
