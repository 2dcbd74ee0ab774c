"""A link between two network namespaces that delays packets and loses some, for kernels without netem.

A TUN device in each namespace; this process carries the packets between them, each direction in order. It
lives as long as its standard input is open, and the devices as long as it does. By hand, as root:
`python benchmarks/lossy_link.py --end NS1 10.77.3.1 --end NS2 10.77.3.2 --delay-ms 5 --loss 0.01`.
"""

from __future__ import annotations

import argparse
import fcntl
import heapq
import os
import random
import select
import struct
import subprocess
import sys
from dataclasses import dataclass
from time import monotonic

TUNSETIFF = 0x400454CA
IFF_TUN, IFF_NO_PI = 0x0001, 0x1000
LARGEST_PACKET = 65_536


@dataclass(frozen=True)
class Loss:
    """What happens to a packet, in either direction."""

    delay_ms: float = 0.0
    """One way."""
    jitter_ms: float = 0.0
    """Of the delay, evenly distributed from 0 on, added to it."""
    loss: float = 0.0
    """Probability that a packet is lost."""
    seed: int = 1

    def __post_init__(self) -> None:
        if not (self.delay_ms >= 0.0 and self.jitter_ms >= 0.0 and 0.0 <= self.loss < 1.0):
            raise ValueError(f"expected delays of 0 ms or more and a loss in [0, 1), got {self}")

    def options(self) -> list[str]:
        """As this program's options."""
        return [
            *("--delay-ms", str(self.delay_ms), "--jitter-ms", str(self.jitter_ms)),
            *("--loss", str(self.loss), "--seed", str(self.seed)),
        ]


class Way:
    """One direction: decides over each packet when it is due, or that it never is."""

    def __init__(self, loss: Loss, direction: int) -> None:
        self._loss = loss
        self._random = random.Random(f"{loss.seed} {direction}")
        self._last_due = 0.0
        self.carried = 0
        self.lost = 0

    def due(self, now: float) -> float | None:
        """When a packet that comes now is handed over; None if it is lost."""
        loss = self._loss
        if self._random.random() < loss.loss:
            self.lost += 1
            return None
        self.carried += 1
        delay_ms = loss.delay_ms + loss.jitter_ms * self._random.random()
        self._last_due = max(self._last_due, now + 1e-3 * delay_ms)
        return self._last_due


def open_tun(name: str, namespace: str, address: str, peer: str) -> int:
    """A TUN device of that name in the namespace, up, with `peer` at its other end."""
    descriptor = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    request = struct.pack("16sH22x", name.encode(), IFF_TUN | IFF_NO_PI)
    fcntl.ioctl(descriptor, TUNSETIFF, request)
    _ip("link", "set", name, "netns", namespace)
    _ip("-n", namespace, "address", "add", address, "peer", peer, "dev", name)
    _ip("-n", namespace, "link", "set", name, "mtu", "1500", "up")
    return descriptor


def _ip(*words: str) -> None:
    subprocess.run(["ip", *words], check=True, stdin=subprocess.DEVNULL)


def carry(ends: tuple[int, int], loss: Loss, lifeline: int) -> tuple[Way, Way]:
    """Carry packets between the two devices until the lifeline is closed; returns what came by."""
    ways = (Way(loss, 0), Way(loss, 1))
    waiting: list[tuple[float, int, int, bytes]] = []
    number = 0
    while True:
        left = max(0.0, waiting[0][0] - monotonic()) if waiting else None
        readable, _, _ = select.select([*ends, lifeline], [], [], left)
        if lifeline in readable and not os.read(lifeline, 4096):
            return ways
        for side in (0, 1):
            if ends[side] not in readable:
                continue
            now = monotonic()
            while (packet := _read(ends[side])) is not None:
                due = ways[side].due(now)
                if due is not None:
                    number += 1
                    heapq.heappush(waiting, (due, number, ends[1 - side], packet))
        now = monotonic()
        while waiting and waiting[0][0] <= now:
            _, _, end, packet = heapq.heappop(waiting)
            _write(end, packet)


def _read(end: int) -> bytes | None:
    try:
        return os.read(end, LARGEST_PACKET)
    except BlockingIOError:
        return None


def _write(end: int, packet: bytes) -> None:
    try:
        os.write(end, packet)
    except OSError:  # the device is down or full: one more lost packet
        return


def main() -> int:
    """Make the link and carry; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--end", nargs=2, action="append", metavar=("NAMESPACE", "ADDRESS"))
    parser.add_argument("--delay-ms", type=float, default=0.0)
    parser.add_argument("--jitter-ms", type=float, default=0.0)
    parser.add_argument("--loss", type=float, default=0.0)
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    if chosen.end is None or len(chosen.end) != 2:
        parser.error("give --end twice, once for each namespace")
    (space, address), (other, peer) = chosen.end
    ends = (
        open_tun(f"ot{os.getpid()}a", space, address, peer),
        open_tun(f"ot{os.getpid()}b", other, peer, address),
    )
    print("ready", flush=True)
    loss = Loss(chosen.delay_ms, chosen.jitter_ms, chosen.loss, chosen.seed)
    there, back = carry(ends, loss, sys.stdin.fileno())
    print(f"packets there {there.carried} lost {there.lost}", end=", ", file=sys.stderr)
    print(f"back {back.carried} lost {back.lost}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(main())
