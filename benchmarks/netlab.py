"""Hosts on one machine: network namespaces with links between them, and runs of `octarm run --hosts` inside.

By hand, as root: `python benchmarks/netlab.py --delay-ms 0 1 5 --loss 0 0.01` prints a table of sweep times
over a link (lossy_link.py) between plant and root half on one side, tip half on the other. Everything that
it makes is gone afterwards. The launcher's tests use the same namespaces.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT / "benchmarks"))

from lossy_link import Loss  # noqa: E402

HERE, THERE = "10.77.0.1", "10.77.0.2"


def unavailable() -> str | None:
    """Why this machine cannot do it, None if it can."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    if shutil.which("ip") is None:
        return "there is no program ip (iproute2)"
    if not Path("/dev/net/tun").exists():
        return "there is no /dev/net/tun"
    name = f"octarm-{os.getpid()}-try"
    made = subprocess.run(["ip", "netns", "add", name], capture_output=True, check=False)
    subprocess.run(["ip", "netns", "del", name], capture_output=True, check=False)
    return None if made.returncode == 0 else f"no namespace can be made: {made.stderr.decode()}"


class Lab:
    """Namespaces by short names, unique to this process; leaving it removes them and their links."""

    def __init__(self, *names: str) -> None:
        self._spaces = {name: f"octarm-{os.getpid()}-{name}" for name in names}
        self._links: list[subprocess.Popen[bytes]] = []
        self._count = 0

    def __enter__(self) -> Self:
        _sweep()
        try:
            for space in self._spaces.values():
                ip("netns", "add", space)
                ip("-n", space, "link", "set", "lo", "up")
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Remove everything; a namespace takes its links with it."""
        while self._links:
            self.unlink(self._links[-1])
        for space in self._spaces.values():
            subprocess.run(["ip", "netns", "del", space], capture_output=True, check=False)

    def within(self, name: str) -> list[str]:
        """The words before a command that is to run in a namespace."""
        return ["ip", "netns", "exec", self._spaces[name]]

    def wire(self, one: str, address: str, other: str, peer: str) -> None:
        """A link without delay or loss: a veth pair."""
        a, b = self._spaces[one], self._spaces[other]
        ends = [f"v{self._count}{side}" for side in "ab"]
        self._count += 1
        ip("-n", a, "link", "add", ends[0], "type", "veth", "peer", "name", ends[1], "netns", b)
        for space, end, own, far in ((a, ends[0], address, peer), (b, ends[1], peer, address)):
            ip("-n", space, "address", "add", own, "peer", far, "dev", end)
            ip("-n", space, "link", "set", end, "up")

    def lossy(
        self, one: str, address: str, other: str, peer: str, loss: Loss
    ) -> subprocess.Popen[bytes]:
        """A link that delays and loses packets, carried by a process of its own."""
        ends = ["--end", self._spaces[one], address, "--end", self._spaces[other], peer]
        command = [sys.executable, str(ROOT / "benchmarks/lossy_link.py"), *ends, *loss.options()]
        link = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        self._links.append(link)
        assert link.stdout is not None
        if not link.stdout.readline():
            raise RuntimeError(self.unlink(link))
        return link

    def unlink(self, link: subprocess.Popen[bytes]) -> str:
        """End such a link; returns what it counted."""
        self._links.remove(link)
        try:
            _, said = link.communicate(timeout=10)
        except subprocess.TimeoutExpired:
            link.kill()
            _, said = link.communicate()
        return said.decode().strip()

    def route(self, name: str, address: str, by: str, *options: str) -> None:
        """In a namespace: reach an address by a neighbour."""
        ip("-n", self._spaces[name], "route", "replace", address, "via", by, *options)

    def impatient(self, name: str, peer: str, milliseconds: int) -> None:
        """In a namespace: let TCP repeat a lost packet to a peer so much earlier than its 200 ms."""
        space = self._spaces[name]
        shown = subprocess.run(
            ["ip", "-n", space, "-j", "route", "get", peer], capture_output=True, check=True
        )
        device = json.loads(shown.stdout)[0]["dev"]
        ip("-n", space, "route", "replace", peer, "dev", device, "rto_min", f"{milliseconds}ms")


def _sweep() -> None:
    """Remove the namespaces of processes that were killed."""
    listed = subprocess.run(["ip", "netns", "list"], capture_output=True, text=True, check=False)
    for line in listed.stdout.splitlines():
        space = line.split()[0]
        found = re.fullmatch(r"octarm-(\d+)-\w+", space)
        if found and not Path("/proc", found[1]).exists():
            subprocess.run(["ip", "netns", "del", space], capture_output=True, check=False)


def ip(*words: str) -> None:
    """Run ip; RuntimeError with what it said if it fails."""
    done = subprocess.run(
        ["ip", *words], capture_output=True, check=False, stdin=subprocess.DEVNULL
    )
    if done.returncode != 0:
        raise RuntimeError(f"ip {' '.join(words)}: {done.stderr.decode().strip()}")


def hosts_file(plant: str, hosts: Sequence[tuple[str, str, int, Sequence[str]]]) -> str:
    """A hosts file for (name, address, nodes, words of start) on this machine; no words: the launcher's."""
    text = f'[plant]\naddress = "{plant}"\n'
    for name, address, nodes, start in hosts:
        text += f'[[hosts]]\nname = "{name}"\naddress = "{address}"\nnodes = {nodes}\n'
        if start:
            text += f'start = """{" ".join(start)}"""\ndirectory = "{ROOT}"\n'
            text += f'python = "{sys.executable}"\nsame_clock = true\n'
    return text


def measure(lab: Lab, work: Path, nodes: int, ticks: int) -> dict[str, Any]:
    """One run, plant and root half in "root", tip half in "tip"; returns its summary."""
    tip = lab.within("tip")
    halves = [("root-side", HERE, nodes // 2, ()), ("tip-side", THERE, nodes - nodes // 2, tip)]
    file = work / "hosts.toml"
    file.write_text(hosts_file(HERE, halves))
    out = work / "run"
    shutil.rmtree(out, ignore_errors=True)
    options = ["--nodes", nodes, "--ticks", ticks, "--hosts", file, "--out", out]
    run = [sys.executable, str(ROOT / "launcher.py"), "run", *map(str, options)]
    done = subprocess.run(
        [*lab.within("root"), *run, "--json", "--no-plot", "--start-timeout", "60"],
        stdin=subprocess.DEVNULL,
        capture_output=True,
        check=False,
    )
    if done.returncode != 0:
        raise RuntimeError(f"octarm run ended with {done.returncode}: {done.stderr.decode()}")
    summary: dict[str, Any] = json.loads(done.stdout)
    return summary


def main() -> int:
    """Print the table; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--delay-ms", type=float, nargs="+", default=[0.0, 1.0, 5.0])
    parser.add_argument("--jitter-ms", type=float, default=0.0)
    parser.add_argument("--loss", type=float, nargs="+", default=[0.0, 0.01])
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--rto-min-ms", type=int, help="least time before TCP repeats a packet")
    parser.add_argument("--nodes", type=int, default=10)
    parser.add_argument("--ticks", type=int, default=200)
    chosen = parser.parse_args()
    if reason := unavailable():
        print(f"netlab: {reason}", file=sys.stderr)
        return 2
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(130))
    print(f"{'link':22} {'sweep p50':>10} {'p99':>8} {'ticks/s':>8}  packets")
    with tempfile.TemporaryDirectory() as work, contextlib.suppress(KeyboardInterrupt):
        with Lab("root", "tip") as lab:
            lab.wire("root", HERE, "tip", THERE)
            _row("veth pair", measure(lab, Path(work), chosen.nodes, chosen.ticks), "")
        for rate in chosen.loss:
            for delay_ms in chosen.delay_ms:
                with Lab("root", "tip") as lab:
                    loss = Loss(delay_ms, chosen.jitter_ms, rate, chosen.seed)
                    link = lab.lossy("root", HERE, "tip", THERE, loss)
                    if chosen.rto_min_ms is not None:
                        lab.impatient("root", THERE, chosen.rto_min_ms)
                        lab.impatient("tip", HERE, chosen.rto_min_ms)
                    summary = measure(lab, Path(work), chosen.nodes, chosen.ticks)
                    _row(f"{delay_ms:g} ms, {100 * rate:g} % lost", summary, lab.unlink(link))
    return 0


def _row(name: str, summary: dict[str, Any], packets: str) -> None:
    p50, p99 = (summary["sweep_ms"][key] for key in ("p50", "p99"))
    print(
        f"{name:22} {p50:7.2f} ms {p99:5.1f} ms {summary['ticks_per_s']:8.1f}  {packets}",
        flush=True,
    )


if __name__ == "__main__":
    sys.exit(main())
