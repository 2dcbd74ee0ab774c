"""A client of the live page for tests and for the benchmark: reads the stream as a browser would."""

from __future__ import annotations

import json
import re
import socket
from collections.abc import Iterator
from typing import Any

PATIENCE_S = 30.0


def address(text: str) -> int | None:
    """The port that a launcher has told, None if it has not yet."""
    found = re.search(r"^live at http://127\.0\.0\.1:(\d+)/$", text, re.MULTILINE)
    return int(found[1]) if found else None


def events(port: int) -> Iterator[tuple[str, Any]]:
    """Kind and content of every event until the stream ends; ConnectionError if it breaks."""
    with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as client:
        client.sendall(b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        buffer = b""
        while piece := client.recv(1 << 16):
            *blocks, buffer = (buffer + piece).split(b"\n\n")
            for block in blocks:
                fields = dict(line.partition(b": ")[::2] for line in block.splitlines())
                if b"event" in fields:
                    yield fields[b"event"].decode(), json.loads(fields[b"data"])
