"""Ports for tests that must name one before somebody listens there."""

from __future__ import annotations

from supervise.endpoints import LOOPBACK, _free_base


def free_ports(count: int = 1, address: str = LOOPBACK) -> int:
    """The first of so many ports in a row on which nobody listens.

    Below the range from which the kernel gives ports to outgoing connections: a port of that range which was
    free a moment ago may be anybody's.
    """
    base = _free_base(count, address)
    assert base is not None
    return base
