"""Every injector does what it says to real processes, looked at from outside."""

from __future__ import annotations

import functools
import os
import resource
import signal
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import psutil
import pytest
from waiting import until

from chaos.draw import LAUNCHER, RUN, Fault, RunDraw
from chaos.inject import CYCLE_S, INJECTORS, inject
from chaos.scene import Scene
from chaos.strangers import endpoint_of, first_word

if TYPE_CHECKING:
    from conftest import Cli, Start

LOCKSTEP = RunDraw(4, 1, False, 0.0, 0, False, "hold", "unix", False, False, 1, 10**6)
ENDLESS = ("--nodes", "4", "--ticks", "1000000", "--no-plot")
SHORT_S = 0.05
FULL_BYTES = 3_000_000
"""Of a recording, 3 kB a tick, of which 1.4 kB go to everyone who asks for telemetry: more than a queue and a
socket hold."""


class Later:
    """What injectors want done later, done when the test says so."""

    def __init__(self) -> None:
        self.wanted: list[tuple[float, Callable[[], None]]] = []

    def __call__(self, seconds: float, act: Callable[[], None]) -> None:
        self.wanted.append((seconds, act))

    def now(self) -> None:
        wanted, self.wanted = self.wanted, []
        for _, act in wanted:
            act()


def _scene(cli: Cli, run: RunDraw = LOCKSTEP) -> tuple[Scene, Later]:
    later = Later()
    return Scene(run, cli.mark, cli.popen.pid, cli.sockets, cli.work, later), later


@pytest.fixture
def running(start: Start) -> Iterator[tuple[Cli, Scene, Later]]:
    cli = start.run(*ENDLESS)
    cli.wait_for("tick ")
    scene, later = _scene(cli)
    yield cli, scene, later
    scene.close()


def _fault(kind: str, target: str = "run", **more: object) -> Fault:
    return replace(Fault(kind, target, RUN), **more)  # type: ignore[arg-type]


def _state(pid: int) -> str:
    return psutil.Process(pid).status()


_until = functools.partial(until, seconds=60.0)


def test_processes_are_stopped_woken_and_slowed(running: tuple[Cli, Scene, Later]) -> None:
    cli, scene, later = running
    names = {"node": "octarm-node2", "plant": "octarm-plant", "launcher": "launcher"}
    for target, name in names.items():
        pid = cli.processes()[name]
        node = 2 if target == "node" else -1
        hit = inject(scene, _fault("pause", target, node=node, for_s=SHORT_S), begun=True)
        assert hit is not None and f"pid {pid}" in hit.what
        _until(lambda pid=pid: _state(pid) == psutil.STATUS_STOPPED)  # type: ignore[misc]
        assert [seconds for seconds, _ in later.wanted] == [SHORT_S]
        later.now()
        _until(lambda pid=pid: _state(pid) != psutil.STATUS_STOPPED)  # type: ignore[misc]
    recorder = cli.processes()["octarm-recorder"]
    assert inject(scene, _fault("slow", "recorder", for_s=0.5, amount=0.5), begun=True)
    _until(lambda: _state(recorder) == psutil.STATUS_STOPPED)
    assert [seconds for seconds, _ in later.wanted] == [0.5 * CYCLE_S, CYCLE_S]
    later.now()  # wakes, and stops again
    _until(lambda: _state(recorder) == psutil.STATUS_STOPPED)
    time.sleep(0.5)
    later.now()
    later.now()
    assert later.wanted == []
    assert _state(recorder) != psutil.STATUS_STOPPED
    # What is frozen, no end of a pause wakes.
    zygote = cli.processes()["octarm-zygote"]
    assert inject(scene, _fault("freeze", "zygote"), begun=True)
    _until(lambda: _state(zygote) == psutil.STATUS_STOPPED)
    assert inject(scene, _fault("pause", "zygote", for_s=SHORT_S), begun=True)
    later.now()
    scene.wake_all()
    time.sleep(0.1)
    assert _state(zygote) == psutil.STATUS_STOPPED


@pytest.mark.alone
def test_limits_loads_and_strangers_come(running: tuple[Cli, Scene, Later]) -> None:
    cli, scene, later = running
    before = cli.processes()
    recorder, node = before["octarm-recorder"], before["octarm-node1"]
    assert inject(scene, _fault("disk", "recorder", amount=10_000_000), begun=True)
    size, _ = resource.prlimit(recorder, resource.RLIMIT_FSIZE)
    assert size is not None and 10_000_000 < size < 100_000_000
    used = len(os.listdir(f"/proc/{node}/fd")) - 1
    assert inject(scene, _fault("descriptors", "node", node=1, amount=1), begun=True)
    soft, _ = resource.prlimit(node, resource.RLIMIT_NOFILE)
    assert soft is not None
    assert used < soft < 100
    endpoint = endpoint_of(scene, "plant")
    assert endpoint is not None
    path = endpoint.partition("/")[2]

    def links() -> int:
        with open("/proc/net/unix") as file:
            return sum(line.rstrip().endswith(path) for line in file)

    had = links()
    assert inject(scene, _fault("flood", "plant", amount=20, for_s=SHORT_S), begun=True)
    assert links() >= had + 15
    time.sleep(SHORT_S)
    later.now()
    _until(lambda: links() <= had + 1)
    hit = inject(scene, _fault("hog", amount=2, for_s=SHORT_S), begun=True)
    assert hit is not None
    burners = [psutil.Process(helper.pid) for helper in scene.helpers]
    assert len(burners) == 2
    _until(lambda: all(sum(one.cpu_times()[:2]) > 0.05 for one in burners))
    later.now()
    _until(lambda: all(helper.poll() == -signal.SIGKILL for helper in scene.helpers))
    assert cli.processes() == before


@pytest.mark.variants("mutated")
@pytest.mark.parametrize("variant", ["mutated", "replayed", "nan"])
def test_garbage_is_sent_and_refused(start: Start, variant: str) -> None:
    cli = start.run(*ENDLESS)
    cli.wait_for("tick ")
    scene, _ = _scene(cli)
    try:
        fault = _fault("garbage", "plant", variant=variant, for_s=1.0, seed=3)
        hit = inject(scene, fault, begun=True)
        assert hit is not None and hit.confirm is not None
        (intruder,) = scene.helpers
        assert intruder.wait(60) == 0
        at = hit.confirm()
        assert at is not None and hit.at < at < time.monotonic()
        assert first_word(intruder) is None  # it says it once
    finally:
        scene.close()
    cli.popen.send_signal(signal.SIGINT)
    assert cli.finish() == 130, cli.err
    assert (cli.recorded().counter("rejected_messages") or 0) > 20


@pytest.mark.every
def test_a_stranger_that_asks_for_everything_and_reads_nothing_holds_nobody_up(
    start: Start,
) -> None:
    cli = start.run(*ENDLESS)
    cli.wait_for("tick ")
    scene, _ = _scene(cli)
    try:
        hit = inject(scene, _fault("garbage", "plant", variant="deaf", seed=3), begun=True)
        assert hit is not None and hit.confirm is not None
        (intruder,) = scene.helpers
        _until(lambda: _state(intruder.pid) == psutil.STATUS_STOPPED)
        assert hit.confirm() is not None
        before = cli.recording().stat().st_size
        _until(lambda: cli.recording().stat().st_size > before + FULL_BYTES)
        cli.popen.send_signal(signal.SIGINT)
        assert cli.finish() == 130, cli.err
    finally:
        scene.close()
    recording = cli.recorded()
    sweeps = recording.table("/sweep/timing").numbers("duration_wall_ns")
    assert recording.ticks > 800
    assert float(np.nanmax(sweeps)) < 1e9


def test_directories_vanish(running: tuple[Cli, Scene, Later]) -> None:
    cli, scene, _ = running
    assert list(cli.sockets.glob("octarm-*/*"))
    assert inject(scene, _fault("sockets gone"), begun=True)
    assert list(cli.sockets.iterdir()) == []
    assert list(cli.work.glob("runs/*/recording.mcap"))
    assert inject(scene, _fault("directory gone"), begun=True)
    assert list(cli.work.glob("runs/*")) == []
    assert inject(scene, _fault("sockets gone"), begun=True) is None
    assert inject(scene, _fault("directory gone"), begun=True) is None


@pytest.mark.variants("kill")
@pytest.mark.parametrize("kind", ["kill", "interrupt", "terminate"])
def test_signals_reach_the_launcher(running: tuple[Cli, Scene, Later], kind: str) -> None:
    cli, scene, _ = running
    assert inject(scene, _fault(kind, LAUNCHER), begun=True)
    assert cli.finish() == (-signal.SIGKILL if kind == "kill" else 130)
    assert cli.gone() == {}
    for missing in INJECTORS.keys() - {"sockets gone", "directory gone", "hog"}:
        assert inject(scene, _fault(missing, "plant"), begun=True) is None, missing


def test_endpoints_over_tcp(start: Start) -> None:
    cli = start.run(*ENDLESS, "--transport", "tcp", "--segments-per-process", "2")
    cli.wait_for("tick ")
    scene, _ = _scene(cli, replace(LOCKSTEP, transport="tcp", segments_per_process=2))
    found = {endpoint_of(scene, "plant"), endpoint_of(scene, "node", 0)}
    assert len(found) == 2
    assert all(one is not None and one.startswith("tcp/127.0.0.1:") for one in found)
    assert endpoint_of(scene, "node", 2) is None  # the tip's
