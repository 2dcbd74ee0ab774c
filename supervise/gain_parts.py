"""Finished gains of a design that is not finished: `<out>.parts/`, one file a gain, beside the artefact.

Between `supervise.designing`, which keeps every gain the moment it is there, and the next `octarm design`,
which takes those that still answer what is asked. A file's name begins with a digest of everything that its
gain depends on, so that a gain is found again exactly when nothing of that has changed: other weights of the
controllers leave the observers' gains as they are.
"""

from __future__ import annotations

import ast
import contextlib
import fcntl
import hashlib
import os
import re
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import IO, Any

import msgspec

import design
from design.arm_file import ArmFile
from design.command import Job, versions
from design.gain import GainDesign, Options
from design.gain_problem import weight_of
from wire.artefact import check_gain
from wire.errors import GainsRefusedError, UsageError
from wire.files import write_whole

FORMAT = "octarm-gain-part"
_NAME = re.compile(r"[0-9a-f]{16}-(observer|controller)\.json")
_LOCK = "lock"


class _Part(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    format: str
    key: str
    setpoint: str
    """As it was called; the gain does not depend on it."""
    sha256: str
    gain: msgspec.Raw


class GainParts:
    """The parts of the artefact that is to be written to `out`, for one arm file and one set of options."""

    def __init__(self, out: Path, file: ArmFile, options: Options) -> None:
        self.directory = out.with_name(out.name + ".parts")
        self._file = file
        self._options = options

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """The directory, made if missing, for this process alone; removed at the end if nothing is in it.

        Raises UsageError if another process has it, or if it cannot be made.
        """
        made = [self.directory, *(d for d in self.directory.parents if not d.exists())]
        try:
            lock = _lock(self.directory / _LOCK)
        except BlockingIOError:
            raise UsageError(
                f"{self.directory}: another `octarm design` is at work there; wait for it or give another --out"
            ) from None
        except OSError as error:
            raise UsageError(f"--out: {self.directory}: {error.strerror or error}") from None
        try:
            yield
        finally:
            with lock, contextlib.suppress(OSError):
                (self.directory / _LOCK).unlink(missing_ok=True)
                for directory in made:  # the innermost first; what is not empty stays
                    directory.rmdir()

    def path(self, job: Job) -> Path:
        """Where the gain of a job is kept."""
        return self.directory / f"{self._key(job)[:16]}-{job.role}.json"

    def take(self, job: Job) -> GainDesign | None:
        """The gain of a job if it is here. Raises ValueError, saying why, if the file is no use."""
        try:
            raw = self.path(job).read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            raise ValueError(error.strerror or str(error)) from None
        try:
            part = msgspec.json.decode(raw, type=_Part)
            gain = msgspec.json.decode(bytes(part.gain), type=GainDesign)
            if part.format != FORMAT or part.key != self._key(job):
                raise ValueError("made for something else")
            if part.sha256 != hashlib.sha256(bytes(part.gain)).hexdigest():
                raise ValueError("its digest is not that of its content")
            check_gain(gain.factors, gain.certificate, job.role)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise ValueError(f"no whole part ({error})") from None
        except GainsRefusedError as error:
            raise ValueError(str(error)) from None
        return gain

    def keep(self, job: Job, gain: GainDesign) -> None:
        """Write the gain of a job. Raises OSError."""
        content = msgspec.json.encode(gain, order="deterministic")
        part = _Part(
            format=FORMAT,
            key=self._key(job),
            setpoint=job.setpoint,
            sha256=hashlib.sha256(content).hexdigest(),
            gain=msgspec.Raw(content),
        )
        write_whole(self.path(job), msgspec.json.encode(part) + b"\n")

    def others(self, jobs: Sequence[Job]) -> int:
        """How many parts are here that belong to none of the jobs: other data, options or versions."""
        return len(self._present() - {self.path(job) for job in jobs})

    def remove(self) -> None:
        """Remove every part, also those of other data; the artefact that they were for is written."""
        for path in self._present():
            with contextlib.suppress(OSError):
                path.unlink()

    def _present(self) -> set[Path]:
        return {path for path in self.directory.glob("*.json") if _NAME.fullmatch(path.name)}

    def _key(self, job: Job) -> str:
        """SHA-256 of everything that the gain depends on, in hexadecimal."""
        arm = msgspec.structs.replace(self._file.arm(), name="")
        setpoint = self._file.setpoints[job.index].nondimensional(arm.length_m)
        on: dict[str, Any] = {
            "arm": arm,
            "curvature": setpoint.curvature.tolist(),
            "role": job.role,
            "weight": weight_of(self._file, job.role),
            "options": vars(self._options),
            "versions": versions(),
            "code": code_digest(),
        }
        return hashlib.sha256(msgspec.json.encode(on, order="deterministic")).hexdigest()


@cache
def code_digest(root: Path = Path(design.__path__[0]).parent) -> str:
    """SHA-256 of the programs that gains come from: `design.gain` and all of the project that it imports."""
    digest = hashlib.sha256()
    found: dict[str, bytes] = {}
    waiting = ["design.gain"]
    while waiting:
        name = waiting.pop()
        file = root.joinpath(*name.split(".")).with_suffix(".py")
        if name in found or not file.is_file():  # a name in a module, or not of the project
            continue
        found[name] = file.read_bytes()
        for node in ast.walk(ast.parse(found[name])):
            if isinstance(node, ast.Import):
                waiting += [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module:
                waiting += [node.module, *(f"{node.module}.{alias.name}" for alias in node.names)]
    for name in sorted(found):
        digest.update(name.encode() + b"\0" + found[name] + b"\0")
    return digest.hexdigest()


def _lock(path: Path) -> IO[bytes]:
    """An exclusive lock that ends with the process. Raises BlockingIOError if another has it, and OSError."""
    while True:
        path.parent.mkdir(parents=True, exist_ok=True)
        file = path.open("wb")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(file.fileno()), path.stat()):
                    return file  # not one that its owner has just removed
        except BaseException:
            file.close()
            raise
        file.close()
