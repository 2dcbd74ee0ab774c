"""A directory of files that appears whole or not at all; beside `analysis.whole_file`, for many files."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

from wire.errors import UsageError


def make_directory(out: Path) -> None:
    """Make a directory for files that come later, if it is missing; UsageError if it cannot be written."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=out):
            pass
    except OSError as error:
        raise UsageError(
            f"--out {out}: {error.strerror or error}; give a directory that can be written"
        ) from None


def check_free_directory(out: Path, ours: Callable[[Path], bool], *, force: bool) -> None:
    """Raise UsageError if `out` exists and may not be replaced.

    With `force` a directory is replaced only if `ours` says that it is one that the verb has made: nothing
    else of the user's is ever deleted.
    """
    if not out.exists():
        return
    if not out.is_dir():
        raise UsageError(f"--out {out}: that is a file; give the name of a directory")
    if not any(out.iterdir()):
        return
    if not force:
        raise UsageError(f"--out {out}: it exists already; give another name or --force")
    if not ours(out):
        raise UsageError(
            f"--out {out}: there is something else in it, which --force does not delete; give another name"
        )


@contextlib.contextmanager
def whole_directory(out: Path, ours: Callable[[Path], bool], *, force: bool) -> Iterator[Path]:
    """A directory beside `out` that takes its place when all has gone well, and goes away if not.

    Raises UsageError as `check_free_directory` does, and if `out` cannot be written.
    """
    check_free_directory(out, ours, force=force)
    try:
        growing = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}-"))
    except OSError as error:
        raise UsageError(
            f"--out {out}: {error.strerror or error}; give a place that can be written"
        ) from None
    old = growing.with_name(f"{growing.name}.old")
    try:
        yield growing
        growing.chmod(0o755)
        check_free_directory(out, ours, force=force)  # somebody else may have been quicker
        if out.exists():
            os.replace(out, old)
        try:
            os.replace(growing, out)
        except OSError:
            if old.exists():
                os.replace(old, out)
            raise
    except OSError as error:
        raise UsageError(f"--out {out}: {error.strerror or error}") from None
    finally:
        shutil.rmtree(growing, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)
