"""Files of users and other processes: read up to a limit, written so that no reader ever sees half of one."""

from __future__ import annotations

import errno
import os
from pathlib import Path

TEXT_BYTES = 1 << 20
"""Of a file that a person writes: arm, problem, scenario, hosts."""
DATA_BYTES = 1 << 26
"""Of a file that octarm writes as JSON: gains, results."""


def read_limited(path: Path, most: int) -> bytes:
    """The content of a file; OSError also for one of more bytes than that, a device without end for example."""
    with path.open("rb") as file:
        raw = file.read(most + 1)
    if len(raw) > most:
        raise OSError(errno.EFBIG, f"more than {most} bytes, nothing of this kind is so long")
    return raw


def write_whole(path: Path, content: bytes) -> None:
    """Write beside the file and rename. Raises OSError; the file is then as it was before."""
    temporary = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        temporary.write_bytes(content)
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
