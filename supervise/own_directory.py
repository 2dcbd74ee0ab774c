"""The directory of a run, a benchmark or a campaign: claimed before anything starts, left tidy in the end."""

from __future__ import annotations

from pathlib import Path

from wire.errors import UsageError


def claim(directory: Path, log: str) -> bool:
    """Make the directory, if it is missing, with this log in it, empty; whether the directory was made here.

    Nothing is ever written over: UsageError if there is something in it, also if another process was quicker
    to claim it, or if it cannot be written.
    """
    try:
        made = not directory.exists()
        directory.mkdir(parents=True, exist_ok=True)
        occupied = next((file.name for file in directory.iterdir()), None)
        if occupied is None:
            occupied = _taken(directory / log)
    except OSError as error:
        raise UsageError(
            f"--out {directory}: {error.strerror or error}; give a directory that can be written"
        ) from None
    if occupied is not None:
        raise UsageError(
            f"--out {directory}: there is something in it already ({occupied}); nothing is written over, give "
            "another directory"
        )
    return made


def _taken(log: Path) -> str | None:
    """Make the log; its name if another process was quicker."""
    try:
        log.touch(exist_ok=False)
    except FileExistsError:
        return log.name
    return None


def tidy(directory: Path, log: str, *, made: bool) -> None:
    """Leave no empty log and, if the directory was `made` here, no empty directory; whatever explains an end
    stays."""
    if not directory.is_dir():  # somebody has removed it
        return
    file = directory / log
    if file.exists() and file.stat().st_size == 0:
        file.unlink()
    if made and not any(directory.iterdir()):
        directory.rmdir()
