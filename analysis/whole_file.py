"""A file that appears whole or not at all and writes over nothing unasked: for what a verb leaves behind."""

from __future__ import annotations

import contextlib
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from wire.errors import UsageError


def check_free(out: Path, *, force: bool) -> None:
    """Raise UsageError if `out` is a directory, or exists and may not be written over."""
    if out.is_dir():
        raise UsageError(f"--out {out}: that is a directory; give the name of a file")
    if out.exists() and not force:
        raise UsageError(f"--out {out}: it exists already; give another name or --force")


@contextlib.contextmanager
def whole(out: Path, *, force: bool) -> Iterator[Path]:
    """A file beside `out` that takes its place when all has gone well, and goes away if not.

    Raises UsageError if `out` exists (without `force`), is a directory or cannot be written.
    """
    check_free(out, force=force)
    try:
        handle, name = tempfile.mkstemp(dir=out.parent, prefix=f".{out.stem}-", suffix=out.suffix)
        os.close(handle)
    except OSError as error:
        raise UsageError(
            f"--out {out}: {error.strerror or error}; give a place that can be written"
        ) from None
    growing = Path(name)
    try:
        yield growing
        growing.chmod(0o644)
        check_free(out, force=force)  # somebody else may have been quicker
        growing.replace(out)
    except OSError as error:
        raise UsageError(f"--out {out}: {error.strerror or error}") from None
    finally:
        growing.unlink(missing_ok=True)
