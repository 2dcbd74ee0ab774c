"""Whether the files that a process proves itself with can be used, before Zenoh is given them.

Called by the launcher for this machine's processes before any is started, and by every process for its own,
which may be on another machine.
"""

from __future__ import annotations

import os
import socket
import stat
from pathlib import Path

from wire.errors import UsageError
from wire.run_config import TlsConfig


def check_files(tls: TlsConfig) -> None:
    """Raise UsageError if a file is missing or unreadable, or the private key is open to others."""
    for path in (tls.authority, tls.certificate):
        _look(path)
    check_private(tls.private_key)


def check_private(path: str) -> None:
    """Raise UsageError if a private key is missing, unreadable, or open to others."""
    mode = _look(path)
    if mode & 0o077:
        raise UsageError(
            f"--keys: {path} on {socket.gethostname()} is open to others (mode {mode:04o}); a private key is "
            f"its owner's alone: chmod 600 {path}"
        )


def _look(path: str) -> int:
    try:
        with Path(path).open("rb") as file:
            return stat.S_IMODE(os.fstat(file.fileno()).st_mode)
    except OSError as error:
        raise UsageError(
            f"--keys: cannot read {path} on {socket.gethostname()}: {error.strerror}; make it with "
            "`octarm keys` and copy each process's files to its host"
        ) from None
