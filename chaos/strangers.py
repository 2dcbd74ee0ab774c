"""Faults that come from outside a run: busy neighbours on its machine, connections, messages of a stranger.

Part of `chaos.inject`, for processes and connections that are the campaign's own.
"""

from __future__ import annotations

import contextlib
import json
import select
import signal
import socket
import subprocess
import sys
import time
from random import Random

import psutil

from chaos.draw import PLANT, Fault
from chaos.scene import ROOT, Scene, dies_with_parent
from wire.messages import run_tag

FLOOD_AGAIN_S = 0.1
_HOG = "while True: pass"


def hog(scene: Scene, fault: Fault) -> str | None:
    """Processes that want a core each."""
    burners = [_helper(scene, "-S", "-c", _HOG) for _ in range(int(fault.amount))]
    for burner in burners:
        scene.later(fault.for_s, burner.kill)
    return f"{len(burners)} busy processes for {fault.for_s:g} s"


def _helper(scene: Scene, *arguments: str) -> subprocess.Popen[bytes]:
    """A process of the campaign's own, without the run's mark, that ends with this one."""
    helper = subprocess.Popen(
        [sys.executable, *arguments],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        preexec_fn=dies_with_parent(signal.SIGKILL),  # noqa: PLW1509 - no threads here
    )
    scene.helpers.append(helper)
    return helper


def endpoint_of(scene: Scene, target: str, node: int = -1) -> str | None:
    """Where a process listens, in Zenoh's words; None if it does not yet."""
    if scene.run.transport == "unix":
        name = "plant" if target == PLANT else f"node{scene.run.last(node)}"
        found = next(iter(scene.sockets.glob(f"octarm-*/{name}")), None)
        return None if found is None else f"unixsock-stream/{found}"
    process = scene.find(target, node)
    if process is None:
        return None
    with contextlib.suppress(psutil.Error):
        for connection in psutil.Process(process.pid).net_connections("tcp"):
            if connection.status == psutil.CONN_LISTEN:
                return f"tcp/127.0.0.1:{connection.laddr.port}"
    return None


def garbage(scene: Scene, fault: Fault) -> str | None:
    """A stranger links up and publishes messages that are nearly right (chaos.intruder)."""
    target = endpoint_of(scene, fault.target, fault.node)
    plant = endpoint_of(scene, PLANT)
    directory = scene.directory()
    if target is None or plant is None or directory is None:
        return None
    told = {
        "keys": scene.run.keys,
        "run": run_tag(directory.name),
        "target": target,
        "plant": plant,
        "node": fault.node,
        "last": scene.run.last(fault.node),
        "firsts": scene.run.firsts,
        "variant": fault.variant,
        "seconds": fault.for_s,
        "seed": fault.seed,
    }
    _helper(scene, "-m", "chaos.intruder", json.dumps(told))
    return f"{fault.variant} messages to {target}"


def first_word(helper: subprocess.Popen[bytes]) -> float | None:
    """The instant that an intruder named when its first message was out; None: it did not come so far."""
    if helper.stdout is None or not select.select([helper.stdout], (), (), 0)[0]:
        return None
    line = helper.stdout.readline()
    return int(line) * 1e-9 if line.strip().isdigit() else None


def flood(scene: Scene, fault: Fault) -> str | None:
    """Connections to a socket, again and again: some say nothing, some talk nonsense, all stay."""
    endpoint = endpoint_of(scene, fault.target, fault.node)
    if endpoint is None:
        return None
    random = Random(fault.seed)
    limit = time.monotonic() + fault.for_s
    own: list[socket.socket] = []

    def turn(count: int) -> int:
        up = 0
        for _ in range(count):
            connection = _connect(endpoint)
            if connection is None:
                continue
            own.append(connection)
            scene.connections.append(connection)
            up += 1
            if random.random() < 0.5:
                with contextlib.suppress(OSError):
                    connection.send(random.randbytes(random.randint(1, 2000)))
        return up

    def again() -> None:
        if time.monotonic() < limit:
            turn(int(fault.amount) // 10)
            scene.later(FLOOD_AGAIN_S, again)
            return
        for connection in own:
            connection.close()

    up = turn(int(fault.amount))
    if not up:
        return None
    scene.later(FLOOD_AGAIN_S, again)
    return f"{up} connections to {endpoint} for {fault.for_s:g} s"


def _connect(endpoint: str) -> socket.socket | None:
    protocol, _, address = endpoint.partition("/")
    unix = protocol == "unixsock-stream"
    connection = socket.socket(socket.AF_UNIX if unix else socket.AF_INET)
    connection.setblocking(False)
    host, _, port = address.rpartition(":")
    try:
        connection.connect(address if unix else (host, int(port)))
    except BlockingIOError:
        if unix:  # its queue of callers is full
            connection.close()
            return None
    except OSError:
        connection.close()
        return None
    return connection
