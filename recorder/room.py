"""Room on the disk that is taken before it is needed, so that a recording can always be closed.

Between the recording's file and the file system. Blocks behind the end of the file are reserved well ahead
of what is written: when that fails the disk is full, and what is reserved still takes last event and index.
A file that was killed keeps some blocks that nobody sees; its length is that of what was written.
"""

from __future__ import annotations

import ctypes
import errno
import os
import resource

STEP_BYTES = 4 << 20
"""Reserved at a time."""
_KEEP_SIZE = 1
_CANNOT = (errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL)
"""Answers of file systems that cannot reserve: then the free space that they tell must do."""
_libc = ctypes.CDLL(None, use_errno=True)
_libc.fallocate.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64)


class Room:
    """The reserved room of one open file."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor
        self._end = 0
        """Up to here the file may grow without asking anybody."""

    def missing(self, at: int, reserve: int) -> str | None:
        """Have `reserve` bytes behind position `at`; why that cannot be, in the system's words, else None."""
        limit, _ = resource.getrlimit(resource.RLIMIT_FSIZE)
        if limit != resource.RLIM_INFINITY and at + reserve > limit:
            return f"{os.strerror(errno.EFBIG)}, the limit is {limit} bytes"
        if at + reserve <= self._end:
            return None
        for ahead in (reserve + STEP_BYTES, reserve):
            code = self._reserve(at, ahead)
            if not code:
                self._end = at + ahead
                return None
        return os.strerror(code)

    def _reserve(self, at: int, length: int) -> int:
        """Zero, or the number of the error."""
        if _libc.fallocate(self._descriptor, _KEEP_SIZE, at, length) == 0:
            return 0
        code = ctypes.get_errno()
        if code not in _CANNOT:
            return code
        found = os.fstatvfs(self._descriptor)
        return 0 if found.f_bavail * found.f_frsize >= length else errno.ENOSPC

    def give_back(self) -> None:
        """Release what was reserved behind the end of the file."""
        os.ftruncate(self._descriptor, os.fstat(self._descriptor).st_size)
