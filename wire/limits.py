"""What this machine refuses a process: files, processes, memory; which limit it is, and how to raise it.

Used by whoever starts processes or opens sessions: of a refusal the user learns the limit and the remedy
instead of the place in the program.
"""

from __future__ import annotations

import errno
import os
import resource
from threading import Thread
from time import sleep

_LIMITS = {
    errno.EMFILE: (resource.RLIMIT_NOFILE, "open files", "ulimit -n"),
    errno.EAGAIN: (resource.RLIMIT_NPROC, "processes and threads", "ulimit -u"),
    errno.ENOMEM: (resource.RLIMIT_AS, "memory", "ulimit -v"),
}
SESSION_FILES = 8
SESSION_THREADS = 4
FILES_BESIDES = 40
"""Open files of a launcher or a plant beyond one a node process."""


def refusal(error: BaseException) -> str | None:
    """What was refused, and what to do, if the error is such a refusal; else None."""
    if isinstance(error, MemoryError):
        number = errno.ENOMEM
    elif isinstance(error, RuntimeError) and "can't start new thread" in str(error):
        number = errno.EAGAIN
    elif hasattr(error, "characters_written"):  # an output that would have to wait, no limit
        return None
    elif isinstance(error, OSError) and error.errno is not None:
        number = error.errno
    else:
        return None
    if number == errno.ENFILE:
        return f"{os.strerror(number)} on this machine; end something or raise fs.file-max"
    if number not in _LIMITS:
        return None
    kind, what, command = _LIMITS[number]
    limit, _ = resource.getrlimit(kind)
    if limit == resource.RLIM_INFINITY:
        why, how = f"this machine has no more {what}", "end something"
    else:
        why, how = f"the limit of {what} is {limit}", f"raise it with `{command}`"
    return f"{os.strerror(number)}: {why}; {how} or use fewer nodes"


def files_exhausted() -> OSError | None:
    """The error with which this process's next file would be refused, None if it would not."""
    try:
        os.close(os.open(os.devnull, os.O_RDONLY))
    except OSError as error:
        return error
    return None


def check_files() -> None:
    """Raise the error with which this process's next file, a link to somebody for example, would be refused:
    Zenoh says nothing of it."""
    if (error := files_exhausted()) is not None:
        raise error


def check_session() -> None:
    """Raise the error with which the files or threads of a session would be refused: Zenoh panics on it."""
    files: list[int] = []
    try:
        files += [os.open(os.devnull, os.O_RDONLY) for _ in range(SESSION_FILES)]
        threads = [Thread(target=sleep, args=(1e-3,)) for _ in range(SESSION_THREADS)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    finally:
        for file in files:
            os.close(file)


def make_room_for_files(processes: int) -> str | None:
    """Raise this process's limit of open files, and so its children's, to what a run of so many node processes
    needs; what is in the way, else None."""
    needed = processes + FILES_BESIDES
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft == resource.RLIM_INFINITY or soft >= needed:
        return None
    if hard != resource.RLIM_INFINITY and hard < needed:
        return (
            f"the limit of open files is {hard}, a run of {processes} node processes needs {needed}; raise "
            f"it with `ulimit -n {needed}` or use fewer nodes"
        )
    resource.setrlimit(resource.RLIMIT_NOFILE, (needed, hard))
    return None
